"""Masks + cloud + cameras -> seeds and conflicts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from sc3d.georeferencing.georeference import georeference_path
from sc3d.importers.given_cloud import cloud_in_world
from sc3d.io.provenance import Input, PhotoFrames
from sc3d.labelling.inputs import best_confidence
from sc3d.labelling.label import label_scene
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Label
from sc3d.tiling.label import label_fits
from sc3d.tiling.label import label_scene as label_scene_by_tiles


def inputs(scene: Scene, settings: Label) -> list[Input]:
    splats = [scene.gaussians] if settings.resolved.mechanisms.density else []
    cloud = [settings.cloud, georeference_path(scene)] if settings.cloud else [scene.cloud]
    frames = PhotoFrames(scene.images)
    confidence = best_confidence(scene)
    return [scene.sparse, scene.classes, scene.masks, confidence, *scene.surface, *cloud, *splats, frames]


def outputs(scene: Scene, settings: Label) -> list[Path]:
    return [settings.output or scene.seeds, scene.votes_of(settings.output)]


def run(scene: Scene, settings: Label) -> dict[str, object]:
    """Fuse the masks, in memory or, where the cloud does not fit, by tiles; a cloud of another program is
    brought into the world of the scene before.
    """
    scene.warn_of_unplaced(scene.masks, *([best_confidence(scene)] if settings.use_confidence else []))
    if settings.cloud is None:
        return _label(scene, settings)
    with cloud_in_world(scene, settings.cloud, settings, settings.output or scene.seeds) as cloud:
        return _label(scene, replace(settings, cloud=cloud))


def _label(scene: Scene, settings: Label) -> dict[str, object]:
    label = label_scene if label_fits(scene, settings) else label_scene_by_tiles
    return label(scene, settings).figures()
