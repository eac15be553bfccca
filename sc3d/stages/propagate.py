"""Seeds -> labelled cloud."""

from __future__ import annotations

from pathlib import Path

from sc3d.io.provenance import Input, PhotoFrames
from sc3d.propagation.propagate import propagate_scene
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Propagate
from sc3d.tiling.propagate import propagate_fits
from sc3d.tiling.propagate import propagate_scene as propagate_scene_by_tiles


def inputs(scene: Scene, settings: Propagate) -> list[Input]:
    corrections = [scene.corrections, scene.classes] if scene.corrections.exists() else []
    photos = PhotoFrames(scene.images)  # which, with the cameras, tell up
    return [settings.seeds or scene.seeds, scene.sparse, photos, *corrections]


def outputs(scene: Scene, settings: Propagate) -> list[Path]:
    return [settings.output or scene.labelled]


def run(scene: Scene, settings: Propagate) -> dict[str, object]:
    """Complete the labels, in memory or, where the cloud does not fit, by tiles."""
    propagate = propagate_scene if propagate_fits(scene, settings) else propagate_scene_by_tiles
    return propagate(scene, settings).figures()
