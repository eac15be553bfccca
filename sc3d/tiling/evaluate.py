"""`evaluate` for clouds that do not fit into memory, tile by tile."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path

import numpy as np

from sc3d.io.chunked_clouds import CloudFile
from sc3d.io.provenance import PhotoFrames
from sc3d.metrics import EvaluationSummary, judge, knows_objects, truth_masks
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Evaluate
from sc3d.tiling.executor import open_executor
from sc3d.tiling.seen_points import find_points, read_labels, surface_fits
from sc3d.tiling.work_folder import WorkFolder

logger = logging.getLogger(__name__)


def evaluate_fits(scene: Scene, settings: Evaluate) -> bool:
    """Whether cloud and mesh fit into memory as a whole, and nobody asked for workers."""
    return surface_fits(scene, settings.labelled or scene.labelled, settings)


def evaluate_scene(scene: Scene, settings: Evaluate) -> EvaluationSummary:
    """As `metrics.evaluate_scene`, tile by tile, here or on the workers that the settings ask for."""
    cloud, output = CloudFile.open(settings.labelled or scene.labelled), settings.output or scene.metrics
    labels, truth = read_labels(cloud), settings.truth or scene.truth
    decisive = (scene.sparse, scene.classes, *scene.surface, truth, cloud.path, PhotoFrames(scene.images))
    if knows_objects(scene):
        logger.warning("objects are not judged, as that needs the whole cloud in memory")
    folder = WorkFolder(output, "evaluate", decisive, settings)
    masks = truth_masks(scene, settings)
    files = {view.name: masks[view.name] for view in scene.model.views if view.name in masks}
    sizes = {name: scene.mask_size(file, name) for name, file in files.items()}
    wanted = partial(_judged, scene.path, files, settings.zero_margin)
    with open_executor(settings) as executor:
        surface = find_points(scene, settings, cloud, labels, sizes, folder, executor, wanted)
    summary = judge(scene, settings, surface, labels)
    folder.remove()
    return summary


def _judged(scene: Path, truth: dict[str, Path], zero_margin: float | None, name: str) -> np.ndarray:
    """The pixels of a photo that have truth. zero_margin: as in `Scene.read_truth`"""
    return Scene(scene).read_truth(truth[name], name, zero_margin) > 0
