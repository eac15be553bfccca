"""Masks and confidence maps as they are stored: ids, gray levels, palettes, channels; and how they lie on their
photos.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from sc3d.errors import InputError
from sc3d.io.images import image_size, open_image, orientation_of, stored_size
from sc3d.io.orientation import mask_turn, turned, turned_size
from sc3d.io.photo_depth import FLOAT, bits_of, raw_mode


class IndexImage(NamedTuple):
    """A gray or palette picture as it is stored.

    samples: (H, W) uint8 values, those of 1, 2 and 4 bits not scaled
    bits: per value; palette: (K, 3) uint8 RGB, None if it is gray
    clear: values whose palette entry has alpha 0
    """

    samples: np.ndarray
    bits: int
    palette: np.ndarray | None
    clear: tuple[int, ...] = ()

    @property
    def scale(self) -> int:
        """Gray level of the value 1."""
        return 255 // ((1 << self.bits) - 1)

    def without_clear(self, table: np.ndarray) -> np.ndarray:
        """A table by value in which those that are clear mean 0."""
        return np.where(np.isin(np.arange(len(table)), self.clear), table.dtype.type(0), table)


def read_samples(path: Path) -> IndexImage:
    """Values of a gray or palette PNG of up to 8 bits; alpha 0 gives 0. InputError for other pictures."""
    with open_image(path, "mask") as image:
        if image.mode.startswith("I"):
            raise InputError(f"{path} has 16 bits per pixel: an 8-bit PNG with one id per pixel is expected")
        if image.mode not in ("L", "P", "1", "LA") or bits_of(image) != 8:
            raise InputError(
                f"{path} has colors ({image.mode}): an 8-bit PNG with one id per pixel is expected"
            )
        raw = raw_mode(image)
        bits = 1 if image.mode == "1" else next((bits for bits in (2, 4) if raw == f"L;{bits}"), 8)
        if image.mode == "LA":
            gray, alpha = np.moveaxis(np.array(image), -1, 0)
            return IndexImage(np.where(alpha > 0, gray, 0).astype(np.uint8), 8, None)
        clear = _clear_values(image.info.get("transparency"))
        if image.mode == "1":  # Pillow says 255 for 1
            clear = tuple(min(value, 1) for value in clear)
        colors = image.getpalette("RGB") if image.mode == "P" else None
        samples = np.array(image, np.uint8)  # Pillow scales 2 and 4 bits to 255, and makes 1 bit 0 and 1
    if colors is not None:
        return IndexImage(samples, 8, np.array(colors, np.uint8).reshape(-1, 3), clear)
    if bits in (2, 4):
        samples //= np.uint8(255 // ((1 << bits) - 1))
    return IndexImage(np.where(np.isin(samples, clear), np.uint8(0), samples), bits, None)


def is_indexed(path: Path) -> bool:
    """Whether a picture has one channel of up to 8 bits, or a palette: what `read_samples` reads."""
    with open_image(path, "mask") as image:
        return image.mode in ("L", "P", "1", "LA") and bits_of(image) == 8


def read_channels(path: Path) -> np.ndarray:
    """(H, W) uint16 gray of a picture of 16 bits, else (H, W, 3) uint8 or uint16 RGB, palettes as their colors, as
    stored; 0 where alpha is 0. InputError for other depths.
    """
    import cv2

    with open_image(path, "mask") as image:
        bits = bits_of(image)
        if bits == FLOAT:
            raise InputError(f"{path} holds floating point: whole numbers of 8 or 16 bits are expected")
        if bits == 8:
            rgba = np.array(image.convert("RGBA"))
            rgba[rgba[..., 3] == 0] = 0
            return rgba[..., :3]
        if image.mode.startswith("I"):
            gray, clear = np.array(image), image.info.get("transparency")
            if gray.min() < 0 or gray.max() >= 1 << 16:
                raise InputError(
                    f"{path} holds values of more than 16 bits: ids from 0 to 65535 are expected"
                )
            return np.where(gray == clear, 0, gray).astype(np.uint16)
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)  # of colors of 16 bits, Pillow keeps the high byte
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 3:
        raise InputError(f"cannot read the mask {path}: save it with 8 bits per channel")
    if pixels.shape[2] == 4:
        pixels[pixels[..., 3] == 0] = 0
    return np.ascontiguousarray(pixels[..., 2::-1])


def _clear_values(transparency: int | bytes | None) -> tuple[int, ...]:
    """Values that a tRNS chunk makes transparent: one gray level or entry, or the alpha of every entry."""
    if isinstance(transparency, bytes):
        return tuple(value for value, alpha in enumerate(transparency) if alpha == 0)
    return () if transparency is None else (transparency,)


def read_index_image(path: Path) -> np.ndarray:
    """(H, W) uint8 of a gray or palette PNG: gray levels of the one, indices of the other."""
    image = read_samples(path)
    return image.samples if image.palette is not None else image.samples * np.uint8(image.scale)


def turned_onto(pixels: np.ndarray, path: Path, photo: Path | None) -> np.ndarray:
    """(H, W) values of the mask `path` in the frame of its photo as stored (`mask_orientation`)."""
    return np.ascontiguousarray(turned(pixels, mask_orientation(path, photo)[0]))


def index_image_size(path: Path, photo: Path | None) -> tuple[int, int]:
    """(width, height) of a mask in the frame of its photo as stored, from the header."""
    return turned_size(image_size(path), mask_orientation(path, photo)[0])


def mask_orientation(path: Path, photo: Path | None) -> tuple[int, bool]:
    """How a mask is turned into the frame of its photo as stored, and whether only a rule says so
    (`mask_turn`); (1, False) where there is no photo.
    """
    if photo is None or not photo.is_file():
        return 1, False
    with open_image(photo, "photo") as image:
        orientation, size = orientation_of(image), stored_size(image)
    with open_image(path, "mask") as image:
        return mask_turn(orientation_of(image), stored_size(image), orientation, size)
