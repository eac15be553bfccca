"""nerfstudio's transforms.json: see sc3d.exporters.cameras."""

from __future__ import annotations

from pathlib import Path

from sc3d.exporters.cameras import transforms_folder, write_transforms
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [transforms_folder(scene) / "transforms.json"]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    return write_transforms(scene)
