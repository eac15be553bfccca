"""The annotations of a photo, whatever program made them, and how their regions become one class per pixel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sc3d.io.orientation import turned, turned_size
from sc3d.segmentation.mask_formats.checks import CheckedMask, Checks
from sc3d.segmentation.mask_formats.outlines import OutlineError, Polygons, RunLengths, rasterize

Region = tuple[int, Polygons | RunLengths]  # class id, outline


@dataclass(frozen=True)
class Annotation:
    """One annotation, not looked at yet.

    kind: what it is, such as "polygon"
    keys: its class as the file says it: a name, or a name and a number
    build: makes the outline for an image of (width, height) px, raising OutlineError, KeyError, TypeError or
        ValueError; None if it has no area
    """

    kind: str
    keys: tuple[str, ...]
    build: Callable[[tuple[int, int]], Polygons | RunLengths] | None


@dataclass(frozen=True)
class PhotoAnnotations:
    """The annotations of one photo.

    origin: the file, for messages
    photos: file names that the photo may have, the likeliest first
    size: (width, height) px that the file states; None where it does not
    annotations: from the bottom to the top
    smaller_on_top: the file has no order: where annotations overlap, the one with fewer pixels wins, then the
        lower class id
    """

    origin: str
    photos: tuple[str, ...]
    size: tuple[Any, Any] | None
    annotations: tuple[Annotation, ...]
    smaller_on_top: bool = False


def to_mask(photo: PhotoAnnotations, checks: Checks) -> tuple[str, CheckedMask] | None:
    """The photo's name and its mask, not painted yet; None if there is nothing to paint or something is
    wrong, which `checks` keeps.
    """
    with_area = [annotation for annotation in photo.annotations if annotation.build is not None]
    checks.skip(annotation.kind for annotation in photo.annotations if annotation.build is None)
    if not with_area:
        return None
    name = checks.photo(photo.photos, photo.origin)
    found = None if name is None else checks.size(name, photo.size, photo.origin)
    regions = []
    for annotation in with_area:
        class_id = checks.class_id(annotation.keys, photo.origin)
        outline = None if found is None else _build(annotation, found[0], photo, checks)
        if class_id is not None and outline is not None:
            regions.append((class_id, outline))
    if name is None or found is None:
        return None
    size, turn = found
    read = partial(paint, regions, size, photo.smaller_on_top, turn)
    return name, CheckedMask(photo.origin, turned_size(size, turn), read)


def _build(
    annotation: Annotation, size: tuple[int, int], photo: PhotoAnnotations, checks: Checks
) -> Polygons | RunLengths | None:
    try:
        return annotation.build(size) if annotation.build else None
    except OutlineError as error:
        text = str(error)
    except (ValueError, TypeError, KeyError, OverflowError):
        text = "is not complete or not of this format"
    where = f"on {photo.photos[0][-80:]} in {photo.origin}"
    checks.add(text, f"the {annotation.kind[:40]} of {annotation.keys[0][:40]!r} {where} {text}")
    return None


def paint(
    regions: list[Region], size: tuple[int, int], smaller_on_top: bool, orientation: int = 1
) -> np.ndarray:
    """(H, W) uint8 class ids, 0 where there is no region; later regions cover earlier ones, or smaller ones
    larger ones.

    size: (width, height) px that they were drawn on; orientation: by which that is turned then
    """
    if smaller_on_top:
        areas = [np.count_nonzero(rasterize(outline, size).mask) for _, outline in regions]
        order = sorted(range(len(regions)), key=lambda index: (-areas[index], -regions[index][0]))
        regions = [regions[index] for index in order]
    labels = np.zeros((size[1], size[0]), np.uint8)
    for class_id, outline in regions:
        crop = rasterize(outline, size)
        labels[crop.window][crop.mask] = class_id
    return np.ascontiguousarray(turned(labels, orientation))
