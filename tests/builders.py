"""Scenes for the tests, made from scratch: a square of ground in UTM coordinates, half road and half grass,
photographed from above; clouds with labels.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pycolmap
from PIL import Image

from sc3d.geometry.cameras import View, look_at, rays
from sc3d.io.clouds import write_geometry
from sc3d.scene.channels import Channels
from sc3d.scene.labelled_cloud import Votes, with_labels
from sc3d.scene.labels import PROPAGATED, SEED, Labels
from sc3d.scene.scene import Scene
from sc3d.segmentation.instances import Instance
from sc3d.segmentation.rle import find_runs
from sc3d.view.picking import Inspector

ROOT = Path(__file__).parents[1]  # of the checkout
ORIGIN = np.array([512345.0, 5187654.0, 210.0])
SIZE = (160, 120)
CLASSES = [
    {"id": 1, "name": "road", "color": [150, 150, 160]},
    {"id": 3, "name": "grass", "color": [170, 220, 110]},
]


def ground(step: float = 0.1, half: float = 4.0) -> np.ndarray:
    """(N, 3) float64 UTM positions in a shuffled order."""
    x, y = np.meshgrid(np.arange(-half, half, step), np.arange(-half, half, step))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) + ORIGIN
    return points[np.random.default_rng(0).permutation(len(points))]


def views() -> list[View]:
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=SIZE[0], height=SIZE[1], params=[150.0, 80.0, 60.0, -0.05], camera_id=1
    )
    centers = [[-1, -1, 9], [1, -1, 9], [1, 1, 9], [-1, 1, 9], [0, 0, 10]]
    return [
        View(f"photo_{row}.jpg", camera, look_at(ORIGIN + center, ORIGIN))
        for row, center in enumerate(centers)
    ]


def truth_mask(view: View) -> np.ndarray:
    """Exact labels: road where x < 0, grass elsewhere, 0 outside the ground."""
    directions, _ = rays(view)
    hits = view.center + directions * (-(view.center[2] - ORIGIN[2]) / directions[:, 2])[:, None] - ORIGIN
    label = np.where(hits[:, 0] < 0, 1, 3)
    label[np.abs(hits[:, :2]).max(axis=1) > 3.9] = 0
    return label.reshape(view.height, view.width).astype(np.uint8)


def write_model(path: Path, scene_views: list[View]) -> None:
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(scene_views[0].camera)
    for row, view in enumerate(scene_views):
        image = pycolmap.Image(name=view.name, camera_id=1, image_id=row + 1)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world[:3]))
    path.mkdir(parents=True)
    reconstruction.write_binary(str(path))


def write_bare_scene(path: Path) -> Path:
    """sparse/0, cloud.ply, masks/, truth/ and classes.json; no photos, no mesh."""
    write_model(path / "sparse" / "0", views())
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(ground()))
    o3d.t.io.write_point_cloud(str(path / "cloud.ply"), cloud)
    (path / "classes.json").write_text(json.dumps(CLASSES))
    for folder in ("masks", "truth"):
        (path / folder).mkdir()
        for view in views():
            Image.fromarray(truth_mask(view)).save(path / folder / f"{Path(view.name).stem}.png")
    return path


LABELLED_CLASSES = [
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
        "normals": (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        "label": label.astype(np.uint8)[:, None],
        "confidence": rng.random((count, 1), np.float32),
        "state": rng.integers(0, 5, (count, 1), np.uint8),
        "num_views": rng.integers(0, 90, (count, 1)).astype(np.int32),
    }
    if colors:
        attributes["colors"] = rng.integers(0, 256, (count, 3), np.uint8)
    for name, values in attributes.items():
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(values))
    return cloud


def write_scene(
    path: Path,
    cloud: o3d.t.geometry.PointCloud,
    georeference: dict | None = None,
    classes: list[dict] = LABELLED_CLASSES,
) -> Scene:
    """labelled.ply, classes.json and, if given, georeference.json."""
    path.mkdir(parents=True, exist_ok=True)
    assert o3d.t.io.write_point_cloud(str(path / "labelled.ply"), cloud)
    (path / "classes.json").write_text(json.dumps(classes))
    if georeference is not None:
        (path / "georeference.json").write_text(json.dumps(georeference))
    return Scene(path)


def labelled_scene(path: Path) -> Scene:
    """Road and grass in UTM coordinates with labels, confidences, states and votes, masks, and photos of
    different grays, the first 128.
    """
    write_bare_scene(path)
    points = ground()
    road = points[:, 0] < ORIGIN[0]
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    votes = {
        "votes_0": np.ones(len(points)),
        "votes_1": np.where(road, 3.0, 0.5),
        "votes_2": np.zeros(len(points)),
        "votes_3": np.where(road, 1.0, 4.5),
    }
    attributes = {
        "label": np.where(road, 1, 3).astype(np.uint8),
        "confidence": np.linspace(0, 1, len(points), dtype=np.float32),
    }
    attributes["state"] = np.resize(np.uint8([1, 2, 3]), len(points))
    for name, values in {
        **attributes,
        **{name: column.astype(np.float32) for name, column in votes.items()},
    }.items():
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(values[:, None]))
    o3d.t.io.write_point_cloud(str(path / "labelled.ply"), cloud)
    (path / "images").mkdir()
    for row, view in enumerate(views()):
        Image.fromarray(np.full((view.height, view.width, 3), 128 + 20 * row, np.uint8)).save(
            path / "images" / view.name
        )
    return Scene(path)


LARGE, SMALL = np.array([2.0, 2.0]), np.array([-2.0, -1.5])  # middles of two doubtful places, m
LARGE_SIZE, SMALL_SIZE = 0.8, 0.5  # their radii


def doubtful_scene(path: Path) -> Scene:
    """Road and grass with labels that are sure but for a large place in the grass and a small one on the road, of
    which some views say the other class; seeds.ply has the votes.
    """
    scene = labelled_scene(path)
    points = ground()
    local, label = points[:, :2] - ORIGIN[:2], np.where(points[:, 0] < ORIGIN[0], 1, 3).astype(np.uint8)
    large, small = (
        np.linalg.norm(local - middle, axis=1) < size
        for middle, size in ((LARGE, LARGE_SIZE), (SMALL, SMALL_SIZE))
    )
    confidence = np.where(large, 0.5, np.where(small, 0.4, 0.99)).astype(np.float32)
    count = len(points)
    labels = Labels(label, confidence, np.full(count, PROPAGATED, np.uint8), np.full(count, 3, np.int32))
    votes = np.where(large | small, [[0], [1.5], [2]], [[0], [0], [2]]).T.astype(np.float32)
    votes[label == 1] = votes[label == 1][:, [0, 2, 1]]
    bare = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    normals = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    write_geometry(scene.labelled, with_labels(bare, normals, labels))
    seeds = replace(labels, state=np.full(count, SEED, np.uint8))
    cast = Votes(votes, Channels.of_classes([1, 3]))
    write_geometry(scene.seeds, with_labels(bare, normals, seeds, cast))
    return Scene(scene.path)


def inspector_of(scene: Scene) -> Inspector:
    """What the viewer looks points up in."""
    return Inspector(
        o3d.t.io.read_point_cloud(str(scene.labelled)), scene.model.views, scene.class_table(), scene.surface
    )


def instance_of(
    mask: np.ndarray, class_id: int, box_score: float, mask_score: float, prompt: str = ""
) -> Instance:
    """What a segmenter found: an (H, W) bool mask of the whole photo."""
    return Instance(find_runs(mask, mask.shape[0]), mask.shape, class_id, box_score, mask_score, prompt)
