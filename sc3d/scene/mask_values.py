"""What the values of a mask stand for: ids, or colors.

A palette PNG may hold ids with any palette, made to be looked at, or the colors of the class table in the
order of whatever program wrote it; PNG optimizers turn gray pictures into palettes and into 1, 2 or 4 bits;
a picture of three channels holds colors, or one id in all three. Each file is looked at alone, and each way to
read it is tried on the values that occur in it. One that fits is taken; if several fit and disagree, the
palette counts only if it surely is that of the class table, and anything else is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sc3d.errors import InputError
from sc3d.io.mask_images import IndexImage, is_indexed, read_channels, read_samples
from sc3d.scene.class_table import OTHER, UNJUDGED, ClassTable

UNKNOWN = -1
BLACK = 0


@dataclass(frozen=True)
class Meanings:
    """Class ids (0 = unlabelled) that stand behind values and colors.

    by_id: (256 or more,) int16 class id per value, UNKNOWN where there is none
    by_color: class id per color 0xRRGGBB
    truth: the values `OTHER` and `UNJUDGED` stand for themselves
    """

    by_id: np.ndarray
    by_color: Mapping[int, int]
    truth: bool = False

    @cached_property
    def color_table(self) -> np.ndarray:
        """(2^24,) int16 class id per color 0xRRGGBB, UNKNOWN where there is none."""
        table = np.full(1 << 24, UNKNOWN, np.int16)
        table[list(self.by_color)] = list(self.by_color.values())
        return table


class Values(NamedTuple):
    """A mask as stored, and what its values stand for.

    codes: (H, W) whole numbers: values, or colors 0xRRGGBB if `colored`
    table: (K,) int16 class id of each code, UNKNOWN where there is none
    """

    codes: np.ndarray
    table: np.ndarray
    colored: bool = False

    @property
    def labels(self) -> np.ndarray:
        """(H, W) int16 class ids, UNKNOWN where a value stands for none."""
        if len(self.table) > int(self.codes.max(initial=0)):
            return self.table[self.codes]
        inside = self.codes < len(self.table)
        return np.where(inside, self.table[np.where(inside, self.codes, 0)], np.int16(UNKNOWN))


def meanings_of(table: ClassTable) -> Meanings:
    """Ids and colors of a class table; no colors where two classes share one."""
    by_id = np.full(256, UNKNOWN, np.int16)
    ids = [0, *(entry.id for entry in table)]
    by_id[ids] = ids
    colors = {color_code(entry.color): entry.id for entry in table}
    if len(colors) < len(table):
        return Meanings(by_id, {})
    # the table shows unlabelled pixels in a dark gray, and so do pictures made with it
    return Meanings(by_id, {BLACK: 0, color_code(table.palette[0]): 0} | colors)


def meanings_of_truth(table: ClassTable) -> Meanings:
    """As `meanings_of`, for truth masks: with `OTHER` and `UNJUDGED`, unless classes have these ids."""
    found = meanings_of(table)
    if not table.leaves_other:
        return found
    found.by_id[[OTHER, UNJUDGED]] = OTHER, UNJUDGED
    return Meanings(found.by_id, found.by_color, truth=True)


def judged_labels(labels: np.ndarray, table: ClassTable, zero_margin: float | None) -> np.ndarray:
    """What is judged of a truth mask: class ids and `OTHER`; 0 = not judged.

    labels: (H, W) uint8 as `read_labels` gives them
    zero_margin: 0 counts as `OTHER` where it is farther than this from all classes, px; None = nowhere
    """
    if not table.leaves_other:
        return labels
    if zero_margin is not None:
        import cv2

        free = (labels == 0) | (labels >= OTHER)
        away = np.full(labels.shape, np.inf)
        if not free.all():
            away = cv2.distanceTransform(free.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        labels = np.where((labels == 0) & (away > zero_margin), OTHER, labels)
    return np.where(labels == UNJUDGED, 0, labels).astype(np.uint8)


def color_code(color: np.ndarray | tuple[int, ...]) -> int:
    """0xRRGGBB"""
    red, green, blue = (int(value) for value in color)
    return red << 16 | green << 8 | blue


def read_labels(path: Path, meanings: Meanings) -> np.ndarray:
    """(H, W) uint8 class ids of a PNG as stored; values up to 255 that mean nothing stay as they are. InputError
    for other values and colors that mean nothing, and as in `read_values`.
    """
    values = read_values(path, meanings)
    labels = values.labels
    unknown = labels == UNKNOWN
    if unknown.any() and values.codes.dtype != np.uint8:
        raise InputError(f"{describe_unknown(path, values, unknown)}, which is not in the class table")
    return np.where(unknown, values.codes, labels).astype(np.uint8)


def describe_unknown(path: Path, values: Values, unknown: np.ndarray) -> str:
    """The first value of a mask that stands for nothing; unknown: (H, W) bool pixels of such values."""
    code = int(values.codes[unknown][0])
    return f"{path} has " + (f"the color #{code:06x}" if values.colored else f"class id {code}")


def binary_value(values: Values, unknown: np.ndarray) -> int | None:
    """What the pixels that stand for nothing hold, if that is one value at the end of its range and all others
    are 0, as in pictures of one object; None otherwise. unknown: (H, W) bool
    """
    found = np.unique(values.codes[unknown])
    if len(found) != 1 or values.codes[~unknown].any():
        return None
    return {1: 1, 255: 255, 65535: 65535, 0xFFFFFF: 255}.get(int(found[0]))


def read_values(path: Path, meanings: Meanings, format: str = "auto") -> Values:
    """Values of a PNG as stored and what they stand for.

    format: "index" for ids, "color" for colors, "auto" for what fits
    Raises InputError if ids and colors both fit and disagree, and for pictures that hold neither.
    """
    if format == "color":
        return _colors(path, read_channels(path), meanings)
    if not is_indexed(path):
        return _read_channels(path, meanings, format)
    image = read_samples(path)
    if format == "index":
        return Values(image.samples, image.without_clear(meanings.by_id))
    if image.palette is None and image.bits == 8:
        if meanings.by_color and (meanings.by_id == UNKNOWN).all():  # a mapping of nothing but colors
            return _colors(path, read_channels(path), meanings)
        return Values(image.samples, meanings.by_id)
    used = np.flatnonzero(np.bincount(image.samples.ravel(), minlength=256))
    readings = _readings(image, meanings)
    fitting = {name: found for name, found in readings.items() if (found[used] != UNKNOWN).all()}
    if meanings.truth:
        fitting = {name: found for name, found in fitting.items() if _says(found[used])} or fitting
    if len({found[used].tobytes() for found in fitting.values()}) > 1:
        if "colors" not in fitting or not _is_table(image, meanings):
            raise _ambiguous(path, "palette" if image.palette is not None else "gray levels")
        return Values(image.samples, fitting["colors"])
    return Values(image.samples, next(iter(fitting.values()), readings["ids"]))


def _read_channels(path: Path, meanings: Meanings, format: str) -> Values:
    """Values of a PNG of 16 bits or several channels."""
    pixels = read_channels(path)
    if pixels.ndim == 2:
        return Values(pixels, meanings.by_id)
    if (pixels != pixels[..., :1]).any():
        if format == "index":
            raise InputError(
                f"{path} has colors: one id per pixel is expected, in one channel or alike in all"
            )
        return _colors(path, pixels, meanings)
    ids = Values(np.ascontiguousarray(pixels[..., 0]), meanings.by_id)
    if format == "index" or not meanings.by_color or _as_bytes(pixels) is None:
        return ids
    colors = _colors(path, pixels, meanings)
    by_id, by_color = ids.labels, colors.labels
    strange = [np.count_nonzero(labels == UNKNOWN) for labels in (by_id, by_color)]
    if meanings.truth and not strange[1] and not _says(by_id):
        return colors
    if strange == [0, 0] and (by_id != by_color).any():
        raise _ambiguous(path, "colors")
    return ids if strange[0] < strange[1] else colors


def _says(labels: np.ndarray) -> bool:
    """Whether a reading of truth is more than 0 and `UNJUDGED`, as of any black-and-white picture."""
    return bool(((labels != 0) & (labels != UNJUDGED)).any())


def _colors(path: Path, pixels: np.ndarray, meanings: Meanings) -> Values:
    """The colors of (H, W, 3) pixels of 8 or 16 bits, or of (H, W) gray levels of 16, which have none."""
    if pixels.ndim == 2:
        raise InputError(f"{path} is a 16-bit gray PNG and has no colors: --format index is for ids")
    if not meanings.by_color:
        raise InputError(
            f"{path} has colors, which cannot tell the classes apart: two classes share one, or the --mapping has none"
        )
    rgb = _as_bytes(pixels)
    if rgb is None:
        raise InputError(f"{path} has colors of 16 bits that are none of 8: save it with 8 bits per channel")
    codes = rgb[..., 0].astype(np.int32) << 16
    codes |= rgb[..., 1].astype(np.int32) << 8
    codes |= rgb[..., 2]
    return Values(codes, meanings.color_table, True)


def _as_bytes(pixels: np.ndarray) -> np.ndarray | None:
    """uint8 pixels, also of 8 bits that are written as 16, the high byte twice or a low byte of 0; None for others."""
    if pixels.dtype == np.uint8:
        return pixels
    high, low = (pixels >> 8).astype(np.uint8), (pixels & 255).astype(np.uint8)
    return high if not low.any() or (low == high).all() else None


def _ambiguous(path: Path, other: str) -> InputError:
    return InputError(
        f"{path} is a PNG whose values and whose {other} stand for different "
        "classes: say which counts by `sc3d segment --masks FOLDER --format index` (or `--format color`)"
    )


def _readings(image: IndexImage, meanings: Meanings) -> dict[str, np.ndarray]:
    """(256,) int16 class ids of the values of an image, for every way to read it."""
    values = np.arange(256)
    readings = {"ids": meanings.by_id[:256]}
    if image.palette is None:
        readings["gray"] = meanings.by_id[np.minimum(values * image.scale, 255)]
        return readings
    colors = np.zeros((256, 3), np.uint8)
    colors[: len(image.palette)] = image.palette
    if (colors == colors[:, :1]).all():
        readings["gray"] = meanings.by_id[colors[:, 0]]
    elif meanings.by_color:
        codes = [meanings.by_color.get(color_code(color), UNKNOWN) for color in colors]
        readings["colors"] = np.array(codes, np.int16)
    return {name: image.without_clear(found) for name, found in readings.items()}


def _is_table(image: IndexImage, meanings: Meanings) -> bool:
    """Whether a palette holds nothing but colors of the class table, or all of them."""
    codes = {color_code(color) for color in image.palette} if image.palette is not None else set()
    classes = {code for code, label in meanings.by_color.items() if label > 0}
    return codes <= set(meanings.by_color) or classes <= codes


def read_confidence(path: Path) -> np.ndarray:
    """(H, W) uint8 values of a confidence map as stored: gray levels, also those of a gray palette and of channels
    that are alike; the index of any other palette. InputError for 16 bits and for colors.
    """
    if not is_indexed(path):
        channels = read_channels(path)
        if channels.dtype != np.uint8 or (channels != channels[..., :1]).any():
            raise InputError(
                f"{path} has {'colors' if channels.dtype == np.uint8 else '16 bits per pixel'}: "
                "a confidence map is an 8-bit gray PNG, 255 = sure"
            )
        return channels[..., 0]
    image = read_samples(path)
    if image.palette is None:
        return image.samples * np.uint8(image.scale)
    if (image.palette == image.palette[:, :1]).all():
        levels = np.zeros(256, np.uint8)
        levels[: len(image.palette)] = image.palette[:, 0]
        return image.without_clear(levels)[image.samples]
    return image.samples
