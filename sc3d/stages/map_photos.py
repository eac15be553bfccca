"""Photos -> mapped: cameras and sparse points that `reconstruct` brings to their place. Kept, so that other
ground control points do not cost the hours again.
"""

from __future__ import annotations

from pathlib import Path

from sc3d.io.photo_folder import find_photos
from sc3d.scene.photo_names import photo_name
from sc3d.scene.scene import Scene
from sc3d.settings.reconstruction import Mapping
from sc3d.sfm import map_photos


def inputs(scene: Scene, settings: Mapping) -> list[Path]:
    return [scene.images]


def outputs(scene: Scene, settings: Mapping) -> list[Path]:
    return [scene.mapped]


def run(scene: Scene, settings: Mapping) -> dict[str, object]:
    names = [photo_name(photo, scene.images) for photo in find_photos(scene.images)]
    return map_photos(scene.images, names, scene.mapped, settings)
