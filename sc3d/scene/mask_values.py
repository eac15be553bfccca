"""What the values of a mask stand for: ids, or the colors of a palette.

A palette PNG may hold ids with any palette, made to be looked at, or the colors of the class table in the
order of whatever program wrote it; PNG optimizers turn gray pictures into palettes and into 1, 2 or 4 bits.
Each way to read a file is tried on the values that occur in it. One that fits is taken; if several fit and
disagree, the palette counts only if it surely is that of the class table, and anything else is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.images import IndexImage, read_samples
from sc3d.scene.class_table import ClassTable

UNKNOWN = -1
BLACK = 0


@dataclass(frozen=True)
class Meanings:
    """Class ids (0 = unlabelled) that stand behind values and colors.

    by_id: (256 or more,) int16 class id per value, UNKNOWN where there is none
    by_color: class id per color 0xRRGGBB
    """

    by_id: np.ndarray
    by_color: Mapping[int, int]


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


def color_code(color: np.ndarray | tuple[int, ...]) -> int:
    """0xRRGGBB"""
    red, green, blue = (int(value) for value in color)
    return red << 16 | green << 8 | blue


def read_labels(path: Path, meanings: Meanings) -> np.ndarray:
    """(H, W) uint8 class ids of a gray or palette PNG as stored; values that mean nothing stay as they are.
    InputError if the palette and the ids disagree and both may be right.
    """
    samples, table = read_values(path, meanings)
    return np.where(table == UNKNOWN, np.arange(256), table).astype(np.uint8)[samples]


def read_values(path: Path, meanings: Meanings) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) uint8 values of a gray or palette PNG as stored; (256,) int16 class id of each value, UNKNOWN
    where there is none. InputError as in `read_labels`.
    """
    image = read_samples(path)
    if image.palette is None and image.bits == 8:
        return image.samples, meanings.by_id[:256]
    used = np.flatnonzero(np.bincount(image.samples.ravel(), minlength=256))
    readings = _readings(image, meanings)
    fitting = {name: found for name, found in readings.items() if (found[used] != UNKNOWN).all()}
    if len({found[used].tobytes() for found in fitting.values()}) > 1:
        if "colors" not in fitting or not _is_table(image, meanings):
            raise InputError(
                f"{path} is a PNG whose values and whose {'palette' if image.palette is not None else 'gray levels'} stand for different "
                "classes: say which counts by `sc3d segment --masks FOLDER --format index` (or `--format color`)"
            )
        return image.samples, fitting["colors"]
    return image.samples, next(iter(fitting.values()), readings["ids"])


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
    """(H, W) uint8 values of a confidence map as stored: gray levels, also those of a gray palette; the index
    of any other.
    """
    image = read_samples(path)
    if image.palette is None:
        return image.samples * np.uint8(image.scale)
    if (image.palette == image.palette[:, :1]).all():
        levels = np.zeros(256, np.uint8)
        levels[: len(image.palette)] = image.palette[:, 0]
        return image.without_clear(levels)[image.samples]
    return image.samples
