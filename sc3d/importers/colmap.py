"""COLMAP models, binary or text, of COLMAP itself or of programs that write its format (Metashape,
RealityScan, GLOMAP).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sc3d.geometry.cameras import View
from sc3d.importers.project import Project, require_found
from sc3d.io.colmap import (
    cam_from_world,
    copy_cameras,
    load_model,
    observed_rows,
    point_arrays,
    registered_images,
)
from sc3d.settings.reconstruction import Import

EXPECTED = "a folder with cameras.bin or cameras.txt, or one in which sparse/0 or sparse is such a folder, is expected"


def matches(path: Path) -> bool:
    return _folder(path) is not None


def files(path: Path) -> list[Path]:
    return [require_found(_folder(path), path, EXPECTED)]


def read(path: Path, settings: Import) -> Project:
    folder = require_found(_folder(path), path, EXPECTED)
    model = load_model(folder)
    cameras = copy_cameras(model)
    point_ids, xyz, colors = point_arrays(model)
    views, observations = [], []
    for image in registered_images(model):
        views.append(View(image.name, cameras[image.camera_id], cam_from_world(image)))
        rows = observed_rows(image, point_ids)
        pixels = np.array([keypoint.xy for keypoint in image.get_observation_points2D()]).reshape(-1, 2)
        observations.append((rows[rows >= 0], pixels[rows >= 0]))
    photos = next(
        (root / "images" for root in (folder, *folder.parents[:2]) if (root / "images").is_dir()), None
    )
    return Project(
        "colmap", views, xyz, colors, observations, photos, notes={"read": str(folder)}, model=model
    )


def _folder(path: Path) -> Path | None:
    if not path.is_dir():
        return None
    folders = (path / "sparse" / "0", path / "sparse", path)
    return next(
        (
            folder
            for folder in folders
            if (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file()
        ),
        None,
    )
