"""PNGs with one id or one color per pixel, named like the photos; values are taken exactly, nothing is
guessed.

Ids are those of the class table, or those of a mapping, such as ADE20K's and Cityscapes', of up to 16 bits.
Colors are those of the class table or of a mapping; a color between two classes, as JPEG and smooth scaling
leave behind, is an error and not the nearest class.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.images import image_size, open_image, read_orientation
from sc3d.io.orientation import turned, turned_size
from sc3d.scene.mask_values import UNKNOWN, Values, binary_value, describe_unknown, read_values
from sc3d.segmentation.mask_formats.checks import CheckedMask, Checks
from sc3d.segmentation.mask_formats.mapping import ClassMapping

COLORED = {"RGB", "RGBA"}


def check_png(file: Path, format: str, checks: Checks) -> Iterator[tuple[str, CheckedMask]]:
    """The photo and mask of a PNG, after a look at all its pixels; mismatches go to `checks`.

    format: "color", "index", or "auto" for whichever of the two the file holds
    """
    if not checks.fits(file):
        return
    name = checks.photo((str(file),), str(file))
    own = 1 if name is None else read_orientation(file)
    found = None if name is None else checks.size(name, image_size(file), str(file), own)
    if name is None or found is None:
        return
    size, turn = found
    values = read_values(file, checks.classes.meanings, format)
    labels = values.labels
    unknown = labels == UNKNOWN
    if unknown.any():
        checks.add("value", _describe(file, values, unknown, checks.classes))
        return
    ids = checks.classes.meanings.by_id
    checks.by_palette += not values.colored and bool(
        (labels != ids[np.minimum(values.codes, len(ids) - 1, dtype=np.int64)]).any()
    )
    read = partial(read_png, file, format, checks.classes, turn)
    yield name, CheckedMask(str(file), turned_size(size, turn), read)


def read_png(file: Path, format: str, classes: ClassMapping, orientation: int) -> np.ndarray:
    """(H, W) uint8 class ids of a checked PNG, turned by an orientation."""
    labels = read_values(file, classes.meanings, format).labels
    return np.ascontiguousarray(turned(labels.astype(np.uint8), orientation))


def is_colored(file: Path) -> bool:
    """Whether a PNG holds colors and no ids; a palette may stand for either (`sc3d.scene.mask_values`).

    A damaged file decides nothing here: it is reported later, with all others.
    """
    try:
        with open_image(file) as image:
            return image.mode in COLORED
    except InputError:
        return True


def _describe(file: Path, values: Values, unknown: np.ndarray, classes: ClassMapping) -> str:
    row, column = (int(index[0]) for index in np.nonzero(unknown))
    where = "the class table" if classes.mapping is None else str(classes.origin)
    binary, example = binary_value(values, unknown), next(iter(classes.table)).name
    if binary is not None:
        hint = (
            f": it is a binary mask, say what {binary} stands for by --mapping mapping.json, "
            f'a file that holds {{"{binary}": {json.dumps(example)}}} or the like'
        )
    elif values.colored:
        hint = ": colors are not guessed, save masks without smoothing and not as JPEG"
    else:
        ids = f" (ids {[entry.id for entry in classes.table]})" if classes.mapping is None else ""
        wide = ": it is a 16-bit PNG whose ids need a --mapping to the classes" * (
            values.codes.dtype == np.uint16
        )
        hint = ids + wide
    return (
        f"{describe_unknown(file, values, unknown)}, which is not in {where}{hint}; {np.count_nonzero(unknown)} px "
        f"are of values that are not, the first at column {column}, row {row}"
    )
