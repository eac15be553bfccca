"""Masks + cloud + cameras -> seeds and conflicts."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from sc3d.errors import InputError
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
    prior = [settings.prior, georeference_path(scene)] if settings.prior else []
    return [
        scene.sparse,
        scene.classes,
        scene.masks,
        confidence,
        *scene.surface,
        *cloud,
        *splats,
        *prior,
        frames,
    ]


def outputs(scene: Scene, settings: Label) -> list[Path]:
    return [settings.output or scene.seeds, scene.votes_of(settings.output)]


def run(scene: Scene, settings: Label) -> dict[str, object]:
    """Fuse the masks, in memory or, where the cloud does not fit, by tiles; clouds of another program are
    brought into the world of the scene before.
    """
    if settings.prior and settings.prior.resolve() == (settings.output or scene.seeds).resolve():
        raise InputError(f"{settings.prior} is what label writes, and no prior: copy it, or pass --output")
    scene.warn_of_unplaced(scene.masks, *([best_confidence(scene)] if settings.use_confidence else []))
    output = settings.output or scene.seeds
    with ExitStack() as stack:
        moved = settings
        if settings.cloud is not None:
            cloud = stack.enter_context(cloud_in_world(scene, settings.cloud, settings, output))
            moved = replace(moved, cloud=cloud)
        if settings.prior is not None:
            beside = output.with_name(f"{output.name}.prior")
            prior = stack.enter_context(cloud_in_world(scene, settings.prior, settings, beside))
            moved = replace(moved, prior=prior)
        return _label(scene, moved, settings.prior)


def _label(scene: Scene, settings: Label, prior: Path | None) -> dict[str, object]:
    label = label_scene if label_fits(scene, settings) else label_scene_by_tiles
    return label(scene, settings, prior).figures()
