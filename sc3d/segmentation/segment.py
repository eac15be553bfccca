"""Segment the photos of a scene one by one, with any segmenter; what is finished stays finished."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from sc3d.errors import InputError
from sc3d.io.images import image_size, read_image, write_image
from sc3d.scene.class_table import ClassTable
from sc3d.scene.scene import check_mask_aspect
from sc3d.segmentation.instances import Instance, write_instances


class Segmentation(NamedTuple):
    """What a backend says of a photo: (H, W) uint8 class id, 0 = unlabelled; (H, W) uint8 confidence, 255 =
    sure; objects, None if it finds none.
    """

    labels: np.ndarray
    confidence: np.ndarray
    instances: tuple[Instance, ...] | None = None


class Segmenter(Protocol):
    """What a backend offers."""

    def segment(self, image: np.ndarray) -> Segmentation:
        """Segment an (H, W, 3) uint8 RGB photo."""
        ...


@dataclass(frozen=True)
class SegmentSummary:
    """What `segment_photos` did.

    segmented, skipped: names of the photos
    num_pixels: (256,) int64 pixels per class id, over the photos segmented in this run
    num_instances: objects in them
    """

    segmented: list[str]
    skipped: list[str]
    num_pixels: np.ndarray
    num_instances: int


@dataclass(frozen=True)
class Folders:
    """Where the results of each photo go, as `<photo stem>.png`, `.png` and `.json`."""

    masks: Path
    confidence: Path
    instances: Path


def segment_photos(
    photos: list[Path],
    folders: Folders,
    segmenter: Segmenter,
    class_table: ClassTable,
    overwrite: bool = False,
) -> SegmentSummary:
    """Write a mask and a confidence map for every photo, and its instances if the segmenter tells objects
    apart.

    Photos that have a mask are skipped unless `overwrite`, so an interrupted run goes on where it stopped,
    whatever stopped it.
    Raises InputError before the work starts if a photo cannot be opened, two share a stem, or an old mask
    does not fit its photo.
    """
    from tqdm import tqdm

    todo = _check_photos(photos, folders.masks, overwrite)
    pending, num_pixels, num_instances = set(todo), np.zeros(256, np.int64), 0
    for photo in tqdm(todo, desc="segment", unit="photo", disable=None):
        image = read_image(photo)
        result = Segmentation(*segmenter.segment(image))
        for array in (result.labels, result.confidence):
            if array.shape != image.shape[:2] or array.dtype != np.uint8:
                raise ValueError(
                    f"the segmenter returned {array.shape} {array.dtype} for a photo of {image.shape[:2]}"
                )
        _write(photo, folders, result, class_table)
        num_pixels += np.bincount(result.labels.ravel(), minlength=256)
        num_instances += len(result.instances or ())
    return SegmentSummary(
        [photo.name for photo in todo],
        [photo.name for photo in photos if photo not in pending],
        num_pixels,
        num_instances,
    )


def _write(photo: Path, folders: Folders, result: Segmentation, class_table: ClassTable) -> None:
    """The mask comes last: that it exists says that the photo is finished."""
    objects = folders.instances / f"{photo.stem}.json"
    if result.instances is not None:
        write_instances(objects, photo.name, result.labels.shape, result.instances, class_table)
    else:
        objects.unlink(missing_ok=True)  # of masks that are replaced
    write_image(folders.confidence / f"{photo.stem}.png", result.confidence)
    write_image(folders.masks / f"{photo.stem}.png", result.labels)


def _check_photos(photos: list[Path], out_masks: Path, overwrite: bool) -> list[Path]:
    """Photos that have no mask yet, after a look at the header of all of them."""
    by_stem: dict[str, Path] = {}
    todo = []
    for photo in photos:
        size = image_size(photo)
        other = by_stem.setdefault(photo.stem, photo)
        if other is not photo:
            raise InputError(
                f"{other} and {photo} share the name {photo.stem!r}, by which masks are found: rename one"
            )
        mask = out_masks / f"{photo.stem}.png"
        if overwrite or not mask.exists():
            todo.append(photo)
        else:
            check_mask_aspect(mask, image_size(mask), size)
    return todo
