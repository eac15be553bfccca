"""The cameras and sparse points as a COLMAP model in text files."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from sc3d.exporters.projected_cloud import copy_georeference
from sc3d.io.atomic import atomic_path
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / "colmap-text"]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/colmap-text/cameras.txt`, `images.txt`, `points3D.txt` and what else COLMAP writes."""
    _ = scene.model  # is read with checks, which pycolmap does not make
    model = pycolmap.Reconstruction(str(scene.sparse))
    with atomic_path(outputs(scene, settings)[0]) as folder:
        folder.mkdir()
        model.write_text(str(folder))
        copy_georeference(scene, folder)
    return {"photos": model.num_reg_images(), "points": model.num_points3D()}
