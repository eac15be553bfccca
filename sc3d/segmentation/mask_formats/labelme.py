"""LabelMe: one JSON file per photo; later shapes lie on top, as LabelMe itself exports them.

Format: https://github.com/wkentaro/labelme. Also read by its relatives, such as X-AnyLabeling.
"""

from __future__ import annotations

import base64
import binascii
import io
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.json_files import read_json
from sc3d.segmentation.mask_formats.annotations import Annotation, PhotoAnnotations
from sc3d.segmentation.mask_formats.outlines import (
    OutlineError,
    Polygons,
    RunLengths,
    Values,
    ellipse,
    numbers,
    polygons,
    rectangle,
    row_lengths,
    run_lengths,
)

WITHOUT_AREA = {"point", "points", "line", "linestrip"}


def read_labelme(file: Path) -> Iterator[PhotoAnnotations]:
    """The annotations of a LabelMe file; the photo is found by its imagePath, or else by the file's own name."""
    content = read_json(file)
    shapes = content.get("shapes") if isinstance(content, dict) else None
    if (
        not isinstance(content, dict)
        or not isinstance(shapes, list)
        or not all(isinstance(shape, dict) for shape in shapes)
    ):
        raise InputError(f"{file} is not a LabelMe file: it has no list of shapes")
    size = (content.get("imageWidth"), content.get("imageHeight"))
    path = content.get("imagePath")
    photos = (path, str(file)) if isinstance(path, str) and path else (str(file),)
    found = tuple(_annotation(shape) for shape in shapes)
    yield PhotoAnnotations(str(file), photos, None if None in size else size, found)


def _annotation(shape: dict) -> Annotation:
    kind = str(shape.get("shape_type") or "polygon")
    keys = (str(shape.get("label", "")),)
    return Annotation(kind, keys, None if kind in WITHOUT_AREA else partial(_outline, shape, kind))


def _outline(shape: dict, kind: str, size: tuple[int, int]) -> Polygons | RunLengths:
    points = shape["points"]
    if kind in ("polygon", "oriented_rectangle", "rotation"):
        return polygons([points], size)
    if kind == "rectangle":
        corners = numbers(points).reshape(-1, 2)
        return rectangle(corners.min(axis=0), corners.max(axis=0), 0.0, size)
    if kind == "circle":
        center, edge = numbers(points)
        return ellipse(center, [np.hypot(*(edge - center))] * 2, 0.0, size)
    if kind == "mask":
        left, top, mask = decode_mask(shape["mask"], points, size)
        return run_lengths(row_lengths(mask), (left, top, mask.shape[1], mask.shape[0]), False, size)
    raise OutlineError("is of a type that is not known")


def decode_mask(text: str, points: Values, size: tuple[int, int]) -> tuple[int, int, np.ndarray]:
    """The left column, the top row and the (H, W) bool pixels of a mask shape: a PNG in base64 for the pixels from
    the first to the second corner, both included; its size is checked before it is decoded. OutlineError if it
    does not fit; size: (width, height) px of the image.
    """
    from PIL import Image

    corners = numbers(points)
    if (
        corners.shape != (2, 2)
        or (corners < 0).any()
        or (corners >= size).any()
        or (corners[1] < corners[0]).any()
    ):
        raise OutlineError("lies outside of the image")
    (left, top), (right, bottom) = corners.astype(int).tolist()
    width, height = right - left + 1, bottom - top + 1
    try:
        with Image.open(io.BytesIO(base64.b64decode(text, validate=True)), formats=["PNG"]) as image:
            if image.size != (width, height):
                raise OutlineError("has a picture of another size than its corners say")
            return left, top, np.array(image.convert("L")) > 0
    except (OSError, SyntaxError, binascii.Error, Image.DecompressionBombError):
        raise OutlineError("has a damaged picture") from None


def encode_mask(mask: np.ndarray) -> str:
    """What `decode_mask` reads, of the (H, W) bool pixels of a mask shape."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(mask.astype(np.uint8) * np.uint8(255)).save(stream, "PNG")
    return base64.b64encode(stream.getvalue()).decode()
