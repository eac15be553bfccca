"""A small labelled scene for the viewer in the browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
from PIL import Image

from scenes import ORIGIN, ground, views, write_bare_scene
from sc3d.scene import Scene
from sc3d.view.picking import Inspector


def labelled_scene(path: Path) -> Scene:
    """Road and grass in UTM coordinates with labels, confidences, states and votes, masks, and photos of different greys, the first 128."""
    write_bare_scene(path)
    points = ground()
    road = points[:, 0] < ORIGIN[0]
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    votes = {"votes_0": np.ones(len(points)), "votes_1": np.where(road, 3.0, 0.5), "votes_2": np.zeros(len(points)), "votes_3": np.where(road, 1.0, 4.5)}
    attributes = {"label": np.where(road, 1, 3).astype(np.uint8), "confidence": np.linspace(0, 1, len(points), dtype=np.float32)}
    attributes["state"] = np.resize(np.uint8([1, 2, 3]), len(points))
    for name, values in {**attributes, **{name: column.astype(np.float32) for name, column in votes.items()}}.items():
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(values[:, None]))
    o3d.t.io.write_point_cloud(str(path / "labelled.ply"), cloud)
    (path / "images").mkdir()
    for row, view in enumerate(views()):
        Image.fromarray(np.full((view.height, view.width, 3), 128 + 20 * row, np.uint8)).save(path / "images" / view.name)
    return Scene(path)


def inspector_of(scene: Scene) -> Inspector:
    """What the viewer looks points up in."""
    return Inspector(o3d.t.io.read_point_cloud(str(scene.labelled)), scene.model.views, scene.class_table(), scene.mesh)
