"""PNGs with one id or one color per pixel, named like the photos; values are taken exactly, nothing is guessed.

Ids are those of the class table, or those of a mapping: then also 16-bit, such as ADE20K's and Cityscapes'.
Colors are those of the class table or of a mapping; a color between two classes, as JPEG and smooth scaling
leave behind, is an error and not the nearest class.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.images import image_size, open_image, read_index_image
from sc3d.segmentation.mask_formats.checks import CheckedMask, Checks
from sc3d.segmentation.mask_formats.mapping import UNKNOWN, ClassMapping

SIXTEEN_BIT = {"I", "I;16", "I;16B"}
COLORED = {"RGB", "RGBA"}


def check_png(file: Path, colored: bool, checks: Checks) -> Iterator[tuple[str, CheckedMask]]:
    """The photo and mask of a PNG, after a look at all its pixels; mismatches go to `checks`."""
    if not checks.fits(file):
        return
    name = checks.photo((str(file),), str(file))
    size = None if name is None else checks.size(name, image_size(file), str(file))
    if name is None or size is None:
        return
    codes = _read_colors(file) if colored else _read_ids(file, checks.classes)
    unknown = (checks.classes.by_color if colored else checks.classes.by_id)[codes] == UNKNOWN
    if unknown.any():
        checks.add("value", _describe(file, codes, unknown, colored, checks.classes))
        return
    yield name, CheckedMask(str(file), size, partial(read_png, file, colored, checks.classes))


def read_png(file: Path, colored: bool, classes: ClassMapping) -> np.ndarray:
    """(H, W) uint8 class ids of a checked PNG."""
    if colored:
        return classes.by_color[_read_colors(file)].astype(np.uint8)
    return classes.by_id[_read_ids(file, classes)].astype(np.uint8)


def is_colored(file: Path) -> bool:
    """Whether a PNG holds colors rather than ids: a palette counts as ids, because that is how index masks
    are made to be looked at.

    A damaged file decides nothing here: it is reported later, with all others.
    """
    try:
        with open_image(file) as image:
            return image.mode in COLORED
    except InputError:
        return True


def _read_ids(file: Path, classes: ClassMapping) -> np.ndarray:
    """(H, W) uint8 or uint16."""
    with open_image(file, "mask") as image:
        if image.mode not in SIXTEEN_BIT:
            return read_index_image(file)
        if classes.mapping is None:
            raise InputError(f"{file} is a 16-bit PNG: its ids need a --mapping to the classes of the table")
        return np.array(image).astype(np.uint16)


def _read_colors(file: Path) -> np.ndarray:
    """(H, W) int32 0xRRGGBB; transparent pixels are black."""
    with open_image(file, "mask") as image:
        if image.mode in SIXTEEN_BIT:
            raise InputError(f"{file} is a 16-bit gray PNG and has no colors: --format index is for ids")
        channels = np.array(image.convert("RGBA"))
    codes = channels[..., 0].astype(np.int32) << 16
    codes |= channels[..., 1].astype(np.int32) << 8
    codes |= channels[..., 2]
    codes[channels[..., 3] == 0] = 0
    return codes


def _describe(
    file: Path, codes: np.ndarray, unknown: np.ndarray, colored: bool, classes: ClassMapping
) -> str:
    row, column = (int(index[0]) for index in np.nonzero(unknown))
    code, count = int(codes[row, column]), int(np.count_nonzero(unknown))
    where = "the class table" if classes.mapping is None else str(classes.origin)
    if colored:
        value, hint = (
            f"the color #{code:06x}",
            ": colors are not guessed, save masks without smoothing and not as JPEG",
        )
    else:
        value, hint = (
            f"class id {code}",
            f" (ids {[entry.id for entry in classes.table]})" if classes.mapping is None else "",
        )
    return f"{file} has {value}, which is not in {where}{hint}; {count} px are of values that are not, the first at column {column}, row {row}"
