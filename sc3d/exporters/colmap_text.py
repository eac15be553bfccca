"""The COLMAP model as text: see sc3d.exporters.cameras."""

from __future__ import annotations

from pathlib import Path

from sc3d.exporters.cameras import colmap_text_folder, write_colmap_text
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [colmap_text_folder(scene)]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    return write_colmap_text(scene)
