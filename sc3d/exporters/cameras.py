"""Cameras and sparse points for other programs: nerfstudio's transforms.json, and a COLMAP model as text."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pycolmap

from sc3d.errors import InputError
from sc3d.geometry.cameras import View
from sc3d.georeferencing.georeference import read_georeference, write_georeference
from sc3d.importers.nerfstudio import OPENGL, camera_parameters
from sc3d.io.atomic import atomic_path
from sc3d.io.clouds import write_geometry
from sc3d.io.json_files import write_json
from sc3d.scene.scene import Scene


def transforms_folder(scene: Scene) -> Path:
    return scene.export / "transforms"


def colmap_text_folder(scene: Scene) -> Path:
    return scene.export / "colmap-text"


def write_transforms(scene: Scene) -> dict[str, object]:
    """`export/transforms/transforms.json` and `sparse_pc.ply`, in the scene's own frame; the photos stay
    where they are and are named relative to it.
    """
    views, folder = scene.model.views, transforms_folder(scene)
    lenses = [camera_parameters(view.camera, view.name) for view in views]
    if len({lens["camera_model"] for lens in lenses}) > 1:
        raise InputError(
            "transforms.json cannot hold perspective and fisheye photos together: export a COLMAP model instead"
        )
    model = {"camera_model": lenses[0]["camera_model"]}
    shared = lenses[0] if all(lens == lenses[0] for lens in lenses) else model
    frames = [
        _frame(
            view,
            {} if shared is lenses[0] else {key: value for key, value in lens.items() if key not in model},
        )
        for view, lens in zip(views, lenses)
    ]
    points = o3d.t.geometry.PointCloud(o3d.core.Tensor(scene.model.points))
    points.point.colors = o3d.core.Tensor(scene.model.colors)
    if len(scene.model.points):
        write_geometry(folder / "sparse_pc.ply", points)
    _write_place(scene, folder)
    write_json(
        folder / "transforms.json",
        {
            **shared,
            "frames": frames,
            "applied_transform": np.eye(4)[:3].tolist(),
            "orientation_override": "none",
        }
        | ({"ply_file_path": "sparse_pc.ply"} if len(scene.model.points) else {}),
    )
    return {"photos": len(views), "points": len(scene.model.points)}


def write_colmap_text(scene: Scene) -> dict[str, object]:
    """`export/colmap-text/cameras.txt`, `images.txt`, `points3D.txt` and what else COLMAP writes."""
    scene.model
    model = pycolmap.Reconstruction(str(scene.sparse))
    with atomic_path(colmap_text_folder(scene)) as temporary:
        temporary.mkdir()
        model.write_text(str(temporary))
        _write_place(scene, temporary)
    return {"photos": model.num_reg_images(), "points": model.num_points3D()}


def _write_place(scene: Scene, folder: Path) -> None:
    """Put the scene's georeference beside an export, as the formats have no place for it; `sc3d import` finds
    it there.
    """
    found = read_georeference(scene)
    if found is not None:
        write_georeference(Scene(folder), found)


def _frame(view: View, lens: dict) -> dict[str, object]:
    matrix = np.eye(4)
    matrix[:3, :3] = view.cam_from_world[:3, :3].T * OPENGL
    matrix[:3, 3] = view.center
    return {"file_path": f"../../images/{view.name}", **lens, "transform_matrix": matrix.tolist()}
