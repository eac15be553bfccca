"""COLMAP models, binary or text, of COLMAP itself or of programs that write its format (Metashape,
RealityScan, GLOMAP).
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from sc3d.errors import InputError, examples
from sc3d.geometry.cameras import View
from sc3d.georeferencing.georeference import georeference_path
from sc3d.importers.project import Project, require_found
from sc3d.io.colmap import (
    cam_from_world,
    copy_cameras,
    is_model,
    load_model,
    observed_rows,
    photo_names,
    point_arrays,
    registered_images,
    warn_of_larger,
)
from sc3d.scene.scene import Scene
from sc3d.settings.reconstruction import Import

logger = logging.getLogger(__name__)

EXPECTED = (
    "a folder with cameras.bin or cameras.txt, or one with such folders in it (sparse/0, sparse), is expected"
)
# folders of models in a project; several of one size: the first, so that photos come before undistorted ones
PLACES = (
    "sparse/0",
    "sparse/*",
    "sparse",
    "[0-9]*",
    "sparse_txt",
    "sparse_txt/*",
    "text",
    "colmap/sparse/0",
    "colmap/sparse/*",
    "colmap/sparse",
    "dense/sparse",
    "dense/sparse/*",
    "dense/*/sparse",
)


def matches(path: Path) -> bool:
    return bool(_folders(path))


def files(path: Path) -> list[Path]:
    return [require_found(_largest(path), path, EXPECTED)]


def read(path: Path, settings: Import) -> Project:
    folder = require_found(_largest(path), path, EXPECTED)
    _warn_of_others(path, folder)
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


def _folders(path: Path) -> list[Path]:
    """Folders of models in a project; a model that is the path itself stands alone, and that of a scene of
    sc3d, whose georeference belongs to no other.
    """
    if not path.is_dir():
        return []
    scene = Scene(path)
    alone = [path, *([scene.sparse] if georeference_path(scene).exists() else [])]
    if found := [folder for folder in alone if is_model(folder)]:
        return found[:1]
    found = [folder for place in PLACES for folder in sorted(path.glob(place)) if is_model(folder)]
    return list(dict.fromkeys(found))


def _largest(path: Path) -> Path | None:
    """The model with most photos: COLMAP numbers models in the order in which it finished them."""
    folders = _folders(path)
    if len(folders) < 2:
        return folders[0] if folders else None
    return max(folders, key=lambda folder: len(_names(folder)))


def _names(folder: Path) -> set[str]:
    """Photos of a model; none if it is damaged."""
    try:
        return set(photo_names(folder))
    except InputError:
        return set()


def _warn_of_others(path: Path, chosen: Path) -> None:
    """Say what is in the other models of a project, which share no frame with the one that is read."""
    others = {folder: _names(folder) for folder in _folders(path) if folder != chosen}
    if not others:
        warn_of_larger(chosen)
        return
    names = _names(chosen)
    lost = sorted(set().union(*others.values()) - names)
    told = [
        f"{folder.relative_to(path)} ({len(found)} photos)"
        if found
        else f"{folder.relative_to(path)} (damaged)"
        for folder, found in others.items()
    ]
    logger.log(
        logging.WARNING if lost else logging.INFO,
        "%s has %d models: %s, with %d photos, is read; left out: %s, of whose photos %d are not in it%s",
        path,
        len(others) + 1,
        chosen.relative_to(path),
        len(names),
        ", ".join(told),
        len(lost),
        f" ({examples(lost)}): import that folder itself for these" if lost else "",
    )
