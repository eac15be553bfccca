"""The cameras and sparse points as nerfstudio's transforms.json."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d

from sc3d.errors import InputError
from sc3d.exporters.projected_cloud import copy_georeference
from sc3d.geometry.cameras import View
from sc3d.georeferencing.georeference import georeference_path
from sc3d.importers.nerfstudio import OPENGL, camera_parameters
from sc3d.io.clouds import write_geometry
from sc3d.io.json_files import write_json
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / "transforms" / "transforms.json"]


def besides(scene: Scene, settings: Export) -> list[Path]:
    folder = outputs(scene, settings)[0].parent
    return [folder / "sparse_pc.ply", georeference_path(Scene(folder))]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/transforms/transforms.json` and `sparse_pc.ply`, in the scene's own frame; the photos stay
    where they are and are named relative to it.
    """
    views, path = scene.model.views, outputs(scene, settings)[0]
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
        write_geometry(path.with_name("sparse_pc.ply"), points)
    copy_georeference(scene, path.parent)
    write_json(
        path,
        {
            **shared,
            "frames": frames,
            "applied_transform": np.eye(4)[:3].tolist(),
            "orientation_override": "none",
        }
        | ({"ply_file_path": "sparse_pc.ply"} if len(scene.model.points) else {}),
    )
    return {"photos": len(views), "points": len(scene.model.points)}


def _frame(view: View, lens: dict) -> dict[str, object]:
    matrix = np.eye(4)
    matrix[:3, :3] = view.cam_from_world[:3, :3].T * OPENGL
    matrix[:3, 3] = view.center
    return {"file_path": f"../../images/{view.name}", **lens, "transform_matrix": matrix.tolist()}
