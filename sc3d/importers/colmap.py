"""COLMAP models, binary or text, of COLMAP itself or of programs that write its format (Metashape,
RealityScan, GLOMAP).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from sc3d.geometry.cameras import View
from sc3d.importers.project import Project
from sc3d.io.colmap import load_model
from sc3d.settings.reconstruction import Import

EXPECTED = "a folder with cameras.bin or cameras.txt, or one in which sparse/0 or sparse is such a folder, is expected"


def matches(path: Path) -> bool:
    return _folder(path) is not None


def files(path: Path) -> list[Path]:
    return [_folder(path)]


def read(path: Path, settings: Import) -> Project:
    folder = _folder(path)
    model = load_model(folder)
    images = sorted(
        (model.image(image_id) for image_id in model.reg_image_ids()), key=lambda image: image.name
    )
    cameras = {camera_id: pycolmap.Camera(model.camera(camera_id).todict()) for camera_id in model.cameras}
    rows = {point_id: row for row, point_id in enumerate(sorted(model.point3D_ids()))}
    points = [model.point3D(point_id) for point_id in rows]
    views, observations = [], []
    for image in images:
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        views.append(View(image.name, cameras[image.camera_id], pose))
        seen = [point for point in image.get_observation_points2D() if point.point3D_id in rows]
        observations.append(
            (
                np.array([rows[point.point3D_id] for point in seen], int),
                np.array([point.xy for point in seen]).reshape(-1, 2),
            )
        )
    xyz = np.array([point.xyz for point in points], np.float64).reshape(-1, 3)
    colors = np.array([point.color for point in points], np.uint8).reshape(-1, 3)
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
