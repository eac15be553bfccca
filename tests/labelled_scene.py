"""Scene folders with a labelled cloud made from arrays, for the tests of the exports."""

import json
from pathlib import Path

import numpy as np
import open3d as o3d

from sc3d.scene import Scene

CLASSES = [
    {"id": 1, "name": "building", "color": [214, 60, 60], "asprs": 6},
    {"id": 2, "name": "tree", "color": [40, 150, 60], "asprs": 5},
    {"id": 3, "name": "road", "color": [150, 150, 160], "asprs": 11},
    {"id": 4, "name": "grass / lawn", "color": [170, 220, 110], "asprs": 3},
    {"id": 9, "name": "car", "color": [20, 20, 250], "asprs": 64},
]


def labelled_cloud(points: np.ndarray, label: np.ndarray, colors: bool = True) -> o3d.t.geometry.PointCloud:
    """points: (N, 3) world; label: (N,) uint8; every other attribute is random, with a fixed seed."""
    rng, count = np.random.default_rng(5), len(points)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.ascontiguousarray(points, np.float64)))
    normals = rng.normal(size=(count, 3))
    attributes = {
        "normals": (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32), "label": label.astype(np.uint8)[:, None],
        "confidence": rng.random((count, 1), np.float32), "state": rng.integers(0, 5, (count, 1), np.uint8),
        "num_views": rng.integers(0, 90, (count, 1)).astype(np.int32),
    }
    if colors:
        attributes["colors"] = rng.integers(0, 256, (count, 3), np.uint8)
    for name, values in attributes.items():
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(values))
    return cloud


def write_scene(path: Path, cloud: o3d.t.geometry.PointCloud, georeference: dict | None = None, classes: list[dict] = CLASSES) -> Scene:
    """labelled.ply, classes.json and, if given, georeference.json."""
    path.mkdir(parents=True, exist_ok=True)
    assert o3d.t.io.write_point_cloud(str(path / "labelled.ply"), cloud)
    (path / "classes.json").write_text(json.dumps(classes))
    if georeference is not None:
        (path / "georeference.json").write_text(json.dumps(georeference))
    return Scene(path)
