"""PNGs with one id or one color per pixel, named like the photos; values are taken exactly, nothing is
guessed.

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
from sc3d.io.images import image_size, open_image, read_orientation, read_samples
from sc3d.io.orientation import turned, turned_size
from sc3d.scene.mask_values import UNKNOWN, read_values
from sc3d.segmentation.mask_formats.checks import CheckedMask, Checks
from sc3d.segmentation.mask_formats.mapping import ClassMapping

SIXTEEN_BIT = {"I", "I;16", "I;16B"}
COLORED = {"RGB", "RGBA"}


def check_png(file: Path, format: str, checks: Checks) -> Iterator[tuple[str, CheckedMask]]:
    """The photo and mask of a PNG, after a look at all its pixels; mismatches go to `checks`.

    format: "color", "index", or "auto" for ids unless the palette holds the colors of the classes
    """
    if not checks.fits(file):
        return
    name = checks.photo((str(file),), str(file))
    own = 1 if name is None else read_orientation(file)
    found = None if name is None else checks.size(name, image_size(file), str(file), own)
    if name is None or found is None:
        return
    size, turn = found
    colored = format == "color"
    codes, table = _read_codes(file, colored, format, checks.classes)
    unknown = table[codes] == UNKNOWN
    if unknown.any():
        checks.add("value", _describe(file, codes, unknown, colored, checks.classes))
        return
    ids = checks.classes.meanings.by_id
    checks.by_palette += not colored and bool(
        (table[codes] != ids[np.minimum(codes, len(ids) - 1, dtype=np.int64)]).any()
    )
    read = partial(read_png, file, colored, format, checks.classes, turn)
    yield name, CheckedMask(str(file), turned_size(size, turn), read)


def read_png(file: Path, colored: bool, format: str, classes: ClassMapping, orientation: int) -> np.ndarray:
    """(H, W) uint8 class ids of a checked PNG, turned by an orientation."""
    codes, table = _read_codes(file, colored, format, classes)
    return np.ascontiguousarray(turned(table[codes].astype(np.uint8), orientation))


def is_colored(file: Path) -> bool:
    """Whether a PNG holds colors and no ids; a palette may stand for either (`sc3d.scene.mask_values`).

    A damaged file decides nothing here: it is reported later, with all others.
    """
    try:
        with open_image(file) as image:
            return image.mode in COLORED
    except InputError:
        return True


def _read_codes(
    file: Path, colored: bool, format: str, classes: ClassMapping
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) values or colors 0xRRGGBB of a PNG, and the class id of each (int16, UNKNOWN where there is
    none).
    """
    if colored:
        return _read_colors(file), classes.by_color
    with open_image(file, "mask") as image:
        if image.mode in SIXTEEN_BIT:
            if classes.mapping is None:
                raise InputError(
                    f"{file} is a 16-bit PNG: its ids need a --mapping to the classes of the table"
                )
            return np.array(image).astype(np.uint16), classes.by_id
    if format == "index":
        index = read_samples(file)
        return index.samples, index.without_clear(classes.by_id)
    return read_values(file, classes.meanings)


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
