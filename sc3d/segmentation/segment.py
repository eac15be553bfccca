"""Segment the photos of a scene one by one, with any segmenter; what is finished stays finished."""

from __future__ import annotations

import json
import logging
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from sc3d.io.atomic import claim, discard, remove_leftovers, require_replaceable
from sc3d.io.images import image_size, read_image, read_opaque, read_orientation, write_image
from sc3d.io.json_files import read_json, write_json
from sc3d.io.mask_images import index_image_size
from sc3d.io.orientation import inverse, turned
from sc3d.io.photo_folder import find_photos, require_within
from sc3d.io.progress import progress
from sc3d.io.provenance import digest
from sc3d.io.readable_photos import tell_of_transparent
from sc3d.scene.class_table import ClassTable
from sc3d.scene.photo_names import PhotoNames, photo_name
from sc3d.scene.scene import Scene, check_mask_aspect
from sc3d.segmentation.instances import Instance, write_instances
from sc3d.settings.labels import Segment

logger = logging.getLogger(__name__)


class Segmentation(NamedTuple):
    """What a backend says of a photo: (H, W) uint8 class id, 0 = unlabelled; (H, W) uint8 confidence, 255 =
    sure, of unlabelled pixels that they are of no class, 0 = not looked at; objects, None if it finds none.
    """

    labels: np.ndarray
    confidence: np.ndarray
    instances: tuple[Instance, ...] | None = None


class Segmenter(Protocol):
    """What a backend offers."""

    def segment(self, image: np.ndarray) -> Segmentation:
        """Segment an (H, W, 3) uint8 RGB photo as shown, the right way up."""
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

    def figures(self, class_table: ClassTable) -> dict[str, object]:
        """What the summary and the sidecar say."""
        return {
            "segmented": len(self.segmented),
            "already_there": len(self.skipped),
            "instances": self.num_instances,
            **{
                f"pixels_{class_table.name(label)}": int(count)
                for label, count in enumerate(self.num_pixels)
                if count
            },
        }


class Folders(NamedTuple):
    """Where the results of each photo go, named like it (see `sc3d.scene.photo_names`)."""

    masks: Path
    confidence: Path
    instances: Path


def segment_scene(
    scene: Scene, settings: Segment, class_table: ClassTable, segmenter: Segmenter
) -> SegmentSummary:
    """Write masks, confidence maps and instances of a scene's photos.

    Those of an interrupted run are gone on with if they were made with the same settings; others are set
    aside.
    """
    folders = Folders(scene.masks, scene.confidence, scene.instances)
    marker, state = unfinished_marker(scene), _state(scene, settings, class_table)
    unfinished = claim(marker).exists()
    if unfinished and read_json(marker) == state:
        for folder in folders:
            for place in [folder, *folder.rglob("*")]:
                remove_leftovers(place)
    else:
        set_aside(folders, "unfinished" if unfinished else "before")
    write_json(marker, state)
    summary = segment_photos(find_photos(scene.images), folders, segmenter, class_table, images=scene.images)
    marker.unlink()
    return summary


def unfinished_marker(scene: Scene) -> Path:
    """File that says with which settings an interrupted run had begun."""
    return scene.path / "segment.unfinished.json"


def _state(scene: Scene, settings: Segment, class_table: ClassTable) -> object:
    """What decides the masks, as JSON: everything but where the models lie and run."""
    decisive = replace(settings, device="auto", download=False, model_dir=None, strokes=None)
    strokes = digest(settings.strokes or scene.strokes) if settings.backend == "strokes" else ""
    return json.loads(json.dumps([repr(decisive), class_table.as_json(), strokes, digest(scene.images)]))


def set_aside(folders: Folders, suffix: str) -> None:
    """Older masks may hold somebody's work: they become `<folder>.<suffix>`, in place of still older ones.
    Goes on where it was interrupted.
    """
    for folder in folders:
        aside = folder.with_name(f"{folder.name}.{suffix}")
        if folder.is_dir():
            discard(aside)
            require_replaceable(aside, is_folder=True)
            folder.rename(aside)
            logger.info("%s is now %s", folder, aside)


def segment_photos(
    photos: list[Path],
    folders: Folders,
    segmenter: Segmenter,
    class_table: ClassTable,
    overwrite: bool = False,
    images: Path | None = None,
) -> SegmentSummary:
    """Write a mask and a confidence map for every photo, and its instances if the segmenter tells objects
    apart.

    images: folder below which the photos are named; None = the one that they have in common
    Photos that have a mask are skipped unless `overwrite`, so an interrupted run goes on where it stopped,
    whatever stopped it.
    Raises InputError before the work starts if a photo cannot be opened, or an old mask does not fit its
    photo.
    """
    images = images or Path(os.path.commonpath([photo.parent for photo in photos]))
    names = PhotoNames(photo_name(photo, images) for photo in photos)
    todo = _check_photos(images, names, folders.masks, overwrite)
    tell_of_transparent({name: images / name for name in names.names}, "have an empty mask")
    pending, num_pixels, num_instances = set(todo), np.zeros(256, np.int64), 0
    for photo in progress(todo, "segment", "photo"):
        image = read_image(images / photo, images, shown=True)
        result = Segmentation(*segmenter.segment(image))
        for array in (result.labels, result.confidence):
            if array.shape != image.shape[:2] or array.dtype != np.uint8:
                raise ValueError(
                    f"the segmenter returned {array.shape} {array.dtype} for a photo of {image.shape[:2]}"
                )
        _write(
            photo,
            names,
            folders,
            _as_stored(images / photo, result),
            read_orientation(images / photo),
            class_table,
        )
        num_pixels += np.bincount(result.labels.ravel(), minlength=256)
        num_instances += len(result.instances or ())
    return SegmentSummary(
        todo,
        [photo for photo in names.names if photo not in pending],
        num_pixels,
        num_instances,
    )


def _as_stored(photo: Path, result: Segmentation) -> Segmentation:
    """Labels and confidence turned from the photo as shown to that as stored, nothing where it is
    transparent; instances stay as shown.
    """
    back, opaque = inverse(read_orientation(photo)), read_opaque(photo)
    labels, confidence = (
        np.ascontiguousarray(turned(values, back)) for values in (result.labels, result.confidence)
    )
    if opaque is not None:
        labels, confidence = np.where(opaque, labels, np.uint8(0)), np.where(opaque, confidence, np.uint8(0))
    return Segmentation(labels, confidence, result.instances)


def _write(
    photo: str,
    names: PhotoNames,
    folders: Folders,
    result: Segmentation,
    orientation: int,
    class_table: ClassTable,
) -> None:
    """The mask comes last: that it exists says that the photo is finished."""
    for folder in folders:
        require_within(names.path(folder, photo).parent, folder)
    objects = names.path(folders.instances, photo, ".json")
    if result.instances is not None:
        write_instances(
            objects, photo, turned(result.labels, orientation).shape, result.instances, class_table
        )
    else:
        objects.unlink(missing_ok=True)  # of masks that are replaced
    write_image(names.path(folders.confidence, photo), result.confidence, orientation)
    write_image(names.path(folders.masks, photo), result.labels, orientation)


def _check_photos(images: Path, names: PhotoNames, out_masks: Path, overwrite: bool) -> list[str]:
    """Photos that have no mask yet, after a look at the header of all of them."""
    todo = []
    for photo in names.names:
        size = image_size(images / photo)
        mask = names.find(out_masks, photo)
        if overwrite or mask is None:
            todo.append(photo)
        else:
            check_mask_aspect(mask, index_image_size(mask, images / photo), size)
    return todo
