"""`evaluate` judges objects where the truth has them."""

from __future__ import annotations

import logging

import numpy as np
import open3d as o3d
import pytest

from sc3d.geometry.neighbors import NeighborIndex
from sc3d.io.clouds import write_geometry
from sc3d.metrics import judge_objects, knows_objects
from sc3d.scene.scene import Scene
from tests.builders import labelled_cloud, write_scene

REACH = 0.5


@pytest.fixture
def scene(tmp_path) -> Scene:
    """Two houses and a lawn; truth.ply knows the houses."""
    x, y = np.random.default_rng(0).uniform(0, 20, (2, 4000))
    house = y > 10
    cloud = labelled_cloud(np.column_stack([x, y, 0 * x]), np.where(house, 1, 4))
    scene = write_scene(tmp_path / "scene", cloud)
    cloud.point["instance"] = o3d.core.Tensor(
        np.where(house, np.where(x < 8, 3, 5), 0).astype(np.uint32)[:, None]
    )
    write_geometry(scene.truth_cloud, cloud)
    return scene


def judged(scene: Scene, label, instance, offset: float = 0.0) -> dict | None:
    points = o3d.t.io.read_point_cloud(str(scene.labelled)).point.positions.numpy() + offset
    return judge_objects(scene, NeighborIndex(points, points.min(axis=0)), REACH, label, instance)


def test_objects_are_judged_at_the_points_of_the_truth(scene, caplog):
    cloud = o3d.t.io.read_point_cloud(str(scene.labelled))
    x, label = cloud.point.positions.numpy()[:, 0], cloud.point["label"].numpy().ravel()
    assert knows_objects(scene)
    right = judged(scene, label, np.where(label == 1, np.where(x < 8, 9, 2), 0).astype(np.uint32))
    assert right["pq"] == right["pq_things"] == right["pq_stuff"] == 1
    # one house for two: 12 of 20 m are more than half of the union
    one = judged(scene, label, (label == 1).astype(np.uint32))["classes"]["building"]
    share = ((label == 1) & (x >= 8)).sum() / (label == 1).sum()
    assert (one["true"], one["found"], one["matched"]) == (2, 1, 1)
    assert one["pq"] == pytest.approx(share / 1.5)
    assert judged(scene, label, np.zeros(len(label), np.uint32))["classes"]["building"]["pq"] == 0
    with caplog.at_level(logging.WARNING):
        assert judged(scene, label, None) is None and "run `sc3d propagate` again" in caplog.text
        assert judged(scene, label, label.astype(np.uint32), 500.0) is None and "0%" in caplog.text


def test_a_true_cloud_without_objects_is_left_alone(scene):
    (scene.path / "truth.ply").write_bytes(scene.labelled.read_bytes())
    assert not knows_objects(scene)
    scene.truth_cloud.unlink()
    assert not knows_objects(scene)
