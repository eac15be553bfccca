"""Masks back: the fused labels as each photo sees them, through its own camera model."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np

from sc3d.errors import left_out
from sc3d.exporters.mask_edges import follow_edges
from sc3d.geometry.cameras import View
from sc3d.io.atomic import atomic_path
from sc3d.io.images import read_orientation, write_image
from sc3d.io.progress import progress
from sc3d.scene.labelled_cloud import LabelledSurface
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export
from sc3d.tiling.seen_points import SeenPoints, labelled_sight
from sc3d.view.contact_sheet import side_by_side

SHOWN, PANEL = 4, 600  # photos in masks.jpg, and the width of each picture there, px

logger = logging.getLogger(__name__)


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / "masks", scene.export / "confidence", scene.export / "masks.jpg"]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """A mask in `export/masks` and a confidence map in `export/confidence` for every photo, named like it;
    usable as `segment --masks`, `--confidence`.
    """
    views, covered = scene.model.views, []
    sizes = {view.name: mask_size(view, settings.max_size) for view in views}
    masks, confidences, sheet = outputs(scene, settings)
    with (
        labelled_sight(scene, settings, settings.labelled or scene.labelled, sizes, masks) as seen,
        atomic_path(masks) as mask_folder,
        atomic_path(confidences) as confidence_folder,
    ):
        labels = seen.labels
        mask_folder.mkdir()
        confidence_folder.mkdir()
        for view in progress(views, "rendering masks", "photo"):
            mask, confidence = render_mask(
                seen.surface, labels.confidence, view, settings.max_size, labels.of_no_class
            )
            photo = scene.photo(view.name)
            if settings.follow_edges and photo.exists():
                mask, confidence = cleaned(mask, confidence, scene.read_photo(view.name))
            orientation = read_orientation(photo)
            write_image(scene.photo_names.path(mask_folder, view.name), mask, orientation)
            write_image(scene.photo_names.path(confidence_folder, view.name), confidence, orientation)
            covered.append(float((mask > 0).mean()))
    write_image(sheet, _comparison(scene, views))
    if settings.follow_edges and (
        gone := [view.name for view in views if not scene.photo(view.name).exists()]
    ):
        logger.warning(
            left_out(gone, len(views), "photos are not there; their masks keep the surface's edges")
        )
    empty = [view.name for view, share in zip(views, covered, strict=True) if not share]
    if empty:
        logger.warning(left_out(empty, len(views), "photos see no label; their masks are empty"))
    return {"photos": len(views), "labelled_pixels": f"{np.mean(covered):.1%}"}


def _comparison(scene: Scene, views: list[View]) -> np.ndarray:
    """Some photos, evenly spread over the flight, beside the mask that went in and the mask that comes back:
    (H, W, 3) uint8 RGB.
    """
    palette, rows = scene.class_table().palette, []
    for view in [
        views[row]
        for row in np.unique(np.linspace(0, len(views) - 1, min(SHOWN, len(views))).round().astype(int))
    ]:
        size = PANEL, round(PANEL * view.height / view.width)
        pictures, captions = [], []
        if scene.photo(view.name).exists():
            pictures.append(cv2.resize(scene.read_photo(view.name), size, interpolation=cv2.INTER_AREA))
            captions.append(view.name)
        for folder, caption in ((scene.masks, "mask in"), (scene.export / "masks", "mask back")):
            file = scene.mask_file(folder, view.name)
            mask = np.zeros((1, 1), np.uint8) if file is None else scene.read_mask(file, view.name)
            pictures.append(palette[cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)])
            captions.append(caption)
        rows.append(side_by_side(pictures, captions))
    width = max(row.shape[1] for row in rows)
    return np.concatenate(
        [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    )


def cleaned(mask: np.ndarray, confidence: np.ndarray, photo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What `render_mask` gives, with the edges of the photo (see `mask_edges`). Where that changes a label, the
    confidence is how clear the new one is. photo: (H', W', 3) uint8 RGB
    """
    colors = cv2.resize(photo, mask.shape[::-1], interpolation=cv2.INTER_AREA)
    # what is known to be of none of the classes, and what nobody knows, are labels of their own
    given = np.where(mask > 0, mask.astype(np.int16), np.where(confidence > 0, 0, -1))
    found, clear = follow_edges(given, colors)
    sure = np.where(found == given, confidence, np.clip(np.rint(255 * clear), 1, 255)).astype(np.uint8)
    return found.clip(0).astype(np.uint8), np.where(found < 0, 0, sure).astype(np.uint8)


def mask_size(view: View, max_size: int) -> tuple[int, int]:
    """(width, height) of a mask, px; max_size: longest side, 0 = the photo's"""
    scale = min(1.0, max_size / max(view.width, view.height)) if max_size else 1.0
    return max(1, round(view.width * scale)), max(1, round(view.height * scale))


def render_mask(
    surface: LabelledSurface | SeenPoints,
    confidence: np.ndarray,
    view: View,
    max_size: int = 0,
    none: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Labels and confidence of one photo.

    confidence: (N,) float32 of the cloud's points, 0 to 1; max_size: longest side, px, 0 = the photo's
    none: (N,) bool points known to be of none of the classes
    returns: (H, W) uint8 ids, 0 = no label; (H, W) uint8, 255 = sure, at least 1 where there is a label or
        none is known, else 0: nothing is known there
    """
    rows, _ = surface.rows(view, mask_size(view, max_size))
    mask = np.where(rows >= 0, surface.label[rows], 0).astype(np.uint8)
    sure = np.clip(np.rint(confidence[rows] * 255), 1, 255)
    known = mask > 0 if none is None else (mask > 0) | ((rows >= 0) & none[rows])
    return mask, np.where(known, sure, 0).astype(np.uint8)
