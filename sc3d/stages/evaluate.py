"""Labelled cloud + truth masks -> metrics.json; the given masks are judged on the same pixels."""

from __future__ import annotations

from pathlib import Path

from sc3d.io.provenance import Input, PhotoFrames
from sc3d.metrics import evaluate_scene
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Evaluate
from sc3d.tiling.evaluate import evaluate_fits
from sc3d.tiling.evaluate import evaluate_scene as evaluate_scene_by_tiles


def inputs(scene: Scene, settings: Evaluate) -> list[Input]:
    truth, labelled = settings.truth or scene.truth, settings.labelled or scene.labelled
    frames = PhotoFrames(scene.images)
    return [scene.sparse, scene.classes, scene.masks, *scene.surface, truth, labelled, frames]


def outputs(scene: Scene, settings: Evaluate) -> list[Path]:
    return [settings.output or scene.metrics]


def run(scene: Scene, settings: Evaluate) -> dict[str, object]:
    """Judge the labels, in memory or, where the cloud does not fit, by tiles."""
    scene.warn_of_unplaced(settings.truth or scene.truth, scene.masks)
    evaluate = evaluate_scene if evaluate_fits(scene, settings) else evaluate_scene_by_tiles
    return evaluate(scene, settings).figures()
