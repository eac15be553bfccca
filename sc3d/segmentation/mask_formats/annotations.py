"""What an annotation program says of one photo, and how its regions become one class per pixel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from sc3d.segmentation.mask_formats.checks import Checks, Mask
from sc3d.segmentation.mask_formats.outlines import OutlineError, Polygons, Runs, draw

Region = tuple[int, Polygons | Runs]  # class id, outline


@dataclass(frozen=True)
class Shape:
    """One annotation, not looked at yet.

    kind: what it is, such as "polygon"
    keys: its class as the file says it: a name, or a name and a number
    build: makes the outline for an image of (width, height) px, raising OutlineError, KeyError, TypeError or
        ValueError; None if it has no area
    """

    kind: str
    keys: tuple[str, ...]
    build: Callable[[tuple[int, int]], Polygons | Runs] | None


@dataclass(frozen=True)
class Drawing:
    """The annotations of one photo.

    origin: the file, for messages
    photos: file names that the photo may have, the likeliest first
    size: (width, height) px that the file states; None where it does not
    shapes: from the bottom to the top
    smaller_on_top: the file has no order: where shapes overlap, the one with fewer pixels wins, then the
        lower class id
    """

    origin: str
    photos: tuple[str, ...]
    size: tuple[object, object] | None
    shapes: tuple[Shape, ...]
    smaller_on_top: bool = False


def to_mask(drawing: Drawing, checks: Checks) -> tuple[str, Mask] | None:
    """The photo and its mask, not drawn yet; None if there is nothing to draw or something is wrong, which
    `checks` keeps.
    """
    with_area = [shape for shape in drawing.shapes if shape.build is not None]
    checks.skip(shape.kind for shape in drawing.shapes if shape.build is None)
    if not with_area:
        return None
    name = checks.photo(drawing.photos, drawing.origin)
    size = None if name is None else checks.size(name, drawing.size, drawing.origin)
    regions = []
    for shape in with_area:
        class_id = checks.class_id(shape.keys, drawing.origin)
        outline = None if size is None else _build(shape, size, drawing, checks)
        if class_id is not None and outline is not None:
            regions.append((class_id, outline))
    return (
        None
        if size is None
        else (name, Mask(drawing.origin, size, partial(paint, regions, size, drawing.smaller_on_top)))
    )


def _build(shape: Shape, size: tuple[int, int], drawing: Drawing, checks: Checks) -> Polygons | Runs | None:
    try:
        return shape.build(size)
    except OutlineError as error:
        text = str(error)
    except (ValueError, TypeError, KeyError, OverflowError):
        text = "is not complete or not of this format"
    checks.add(
        text,
        f"the {shape.kind[:40]} of {shape.keys[0][:40]!r} on {drawing.photos[0][-80:]} in {drawing.origin} {text}",
    )
    return None


def paint(regions: list[Region], size: tuple[int, int], smaller_on_top: bool) -> np.ndarray:
    """(H, W) uint8 class ids, 0 where there is no region; later regions cover earlier ones, or smaller ones
    larger ones.

    size: (width, height) px
    """
    if smaller_on_top:
        areas = [np.count_nonzero(draw(outline, size).mask) for _, outline in regions]
        order = sorted(range(len(regions)), key=lambda index: (-areas[index], -regions[index][0]))
        regions = [regions[index] for index in order]
    labels = np.zeros((size[1], size[0]), np.uint8)
    for class_id, outline in regions:
        patch = draw(outline, size)
        labels[patch.window][patch.mask] = class_id
    return labels
