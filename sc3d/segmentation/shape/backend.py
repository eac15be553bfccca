"""Masks without masks: the cloud of a scene is classified by its shape, and every photo shows what it sees of
it, so that labels, strokes and corrections go on from there as from any masks.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from sc3d.errors import left_out
from sc3d.geometry.cameras import View, local_origin
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.io.atomic import atomic_path, discard
from sc3d.io.clouds import read_cloud
from sc3d.io.images import read_orientation, write_image
from sc3d.io.json_files import write_json
from sc3d.io.progress import progress, under_way
from sc3d.scene.class_table import ClassTable
from sc3d.scene.frame_check import check_frame
from sc3d.scene.labelled_cloud import REACH, LabelledSurface, read_surface, spacing_of
from sc3d.scene.scene import Scene
from sc3d.segmentation.segment import Folders, set_aside, unfinished_marker
from sc3d.segmentation.shape.classes import DEFAULT, class_ids
from sc3d.segmentation.shape.frame import SHARE, TALL, Frame, find_frame
from sc3d.segmentation.shape.points import Thinned, classify, require_enough

logger = logging.getLogger(__name__)

CUBE = 0.25  # m: the shapes that are looked at are larger
MAX_SIDE = 1600  # px, of the masks; larger photos show no more of the shapes


def write_default_classes(scene: Scene) -> None:
    """classes.json, where a scene has none, but a folder."""
    if scene.path.is_dir() and not scene.classes.exists():
        write_json(scene.classes, DEFAULT.as_json())
        logger.info("%s: ground, low vegetation, high vegetation, building", scene.classes)


def segment_by_shape(scene: Scene, table: ClassTable) -> dict[str, object]:
    """Write masks and confidence maps of all photos with a camera; masks that were there are set aside.
    Returns figures for the summary.

    Raises InputError, before anything is written, for classes that the shapes cannot be brought to, and
    without a cloud.
    """
    ids = class_ids(table)
    source = cloud_path(scene)
    cloud = read_cloud(source)
    points = cloud.point.positions.numpy().astype(np.float64)
    require_enough(points)
    views = scene.model.views
    check_frame(source, np.array([points.min(axis=0), points.max(axis=0)]), views, scene.model.points)
    colors = cloud.point.colors.numpy() if "colors" in cloud.point else None
    with under_way("shapes"):
        frame = find_frame(scene, points)
        _tell(frame, colors)
        thinned = Thinned.from_points(frame.place(points), colors, CUBE)
        probabilities = classify(thinned.points, thinned.colors)
    shape = probabilities.argmax(axis=1)
    label = ids[shape]
    sure = confidence_of(probabilities, ids)
    surface = LabelledSurface(
        read_surface(scene.surface, points, None, local_origin(views)),
        NeighborIndex(points, points.min(axis=0)),
        label[thinned.rows],
        REACH * spacing_of(points),
    )
    _write(scene, surface, sure[thinned.rows])
    counts = np.bincount(label[thinned.rows], minlength=256)
    shares = {
        f"points_{table.name(int(row))}": f"{counts[row] / len(points):.1%}" for row in np.flatnonzero(counts)
    }
    measured = "measured" if frame.measured else "estimated"
    return {"masks": len(views), "meters_per_unit": f"{frame.scale:.3g} ({measured})", **shares}


def confidence_of(probabilities: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """(N,) uint8 1 to 255: probability of the class of the likeliest shape, which may be of several shapes.

    probabilities: (N, 5); ids: (5,) as `class_ids`
    """
    same = ids[probabilities.argmax(axis=1)][:, None] == ids
    return np.clip(np.rint((probabilities * same).sum(axis=1) * 255), 1, 255).astype(np.uint8)


def cloud_path(scene: Scene) -> Path:
    """What is classified: the cloud, else the vertices of the mesh; InputError if there is neither."""
    source = scene.cloud if scene.cloud.exists() else scene.mesh
    if not source.exists():
        source = scene.cloud
    scene.require(source, hint="--backend geometry looks at the surface: run `sc3d extract SCENE` first")
    return source


def _tell(frame: Frame, colors: np.ndarray | None) -> None:
    if not frame.measured:
        logger.warning(
            "the scene has no place, so that lengths are a guess: %d %% of what stands on the ground are taken to be "
            "lower than %g m, which makes a unit %.3g m; GPS, control points or `sc3d georeference` say it rightly",
            SHARE,
            TALL,
            frame.scale,
        )
    if colors is None:
        logger.warning("the cloud has no colors: vegetation is told by its roughness alone, lawn not at all")


def _write(scene: Scene, surface: LabelledSurface, sure: np.ndarray) -> None:
    """Masks and confidence maps, all of them before anything replaces what is there. sure: (N,) uint8 of the
    points
    """
    views, names = scene.model.views, scene.photo_names
    folders = Folders(scene.masks, scene.confidence, scene.instances)
    empty = []
    with atomic_path(folders.masks) as masks, atomic_path(folders.confidence) as confidence:
        masks.mkdir()
        confidence.mkdir()
        for view in progress(views, "masks", "photo"):
            labels, known = _render(scene, surface, sure, view)
            orientation = read_orientation(scene.photo(view.name))
            write_image(names.path(masks, view.name), labels, orientation)
            write_image(names.path(confidence, view.name), known, orientation)
            if not known.any():
                empty.append(view.name)
        discard(unfinished_marker(scene))
        set_aside(folders, "before")
    if empty:
        logger.warning(left_out(empty, len(views), "photos see no surface; their masks are empty"))
    if missing := sorted(set(names.names) - {view.name for view in views}):
        logger.warning(left_out(missing, len(names), "photos have no camera and get no mask"))


def _render(
    scene: Scene, surface: LabelledSurface, sure: np.ndarray, view: View
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) uint8 ids and (H, W) uint8 confidence of a photo as stored; 0 and 0 where no surface is."""
    scale = min(1.0, MAX_SIDE / max(view.width, view.height))
    size = max(1, round(view.width * scale)), max(1, round(view.height * scale))
    rows, _ = surface.rows(view, size)
    seen = (rows >= 0) & scene.opaque_pixels_of(rows.shape, view.name)
    labels = np.where(seen, surface.label[rows], 0).astype(np.uint8)
    return labels, np.where(seen, sure[rows], 0).astype(np.uint8)
