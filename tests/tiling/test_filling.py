"""`propagate --fill` by tiles: the nearest label, however far."""

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial import cKDTree

from sc3d.io.clouds import read_cloud, write_geometry
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Propagate
from sc3d.stages import propagate
from sc3d.tiling import filling
from sc3d.tiling import propagate as tiled
from sc3d.tiling.nearest import NearestLabels

ROOM = {"2G": 14_000, "3G": 9_000}  # points of a tile with its margin


@pytest.fixture
def scene(tmp_path, monkeypatch) -> Scene:
    """A band of ground around an island that no edge leads to, farther off than the margin of a tile; the western half
    of the band is seen as class 1, the eastern as class 2.
    """
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 60, (60_000, 3)) * [1, 1, 0]
    points = points[(np.abs(points[:, :2] - 30) > 24).any(axis=1)]
    points = np.concatenate([points, rng.uniform(22, 38, (3_000, 3)) * [1, 1, 0] + [0, 0, 1]])
    votes = np.zeros((len(points), 3), np.float32)
    seed = np.where(points[:, 0] < 30, 1, 2).astype(np.uint8)
    seed[-3_000:] = 0
    rows = np.flatnonzero(seed)
    votes[rows, 0] = votes[rows, seed[rows]] = 2
    cloud = o3d.t.geometry.PointCloud(points)
    cloud.point.normals = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    seeded = seed > 0
    attributes = {
        "label": seed,
        "confidence": seeded.astype(np.float32),
        "state": seeded.astype(np.uint8),
        "num_views": (2 * seeded).astype(np.int32),
    } | {f"votes_{number}": votes[:, number] for number in range(3)}
    for name, values in attributes.items():
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(values[:, None]))
    write_geometry(tmp_path / "seeds.ply", cloud)
    monkeypatch.setattr(tiled, "max_points", lambda resources, _: ROOM[resources.max_memory])
    monkeypatch.setattr(tiled, "fits", lambda _, resources: not resources.max_memory)
    monkeypatch.setattr(filling, "AT_ONCE", 1_000)
    return Scene(tmp_path)


def run(scene: Scene, **options) -> tuple[np.ndarray, ...]:
    """Positions, labels, confidences and states."""
    propagate.run(scene, Propagate(appearance=False, **options))
    cloud = read_cloud(scene.labelled).point
    names = ("label", "confidence", "state")
    return cloud.positions.numpy(), *(cloud[name].numpy().ravel() for name in names)


@pytest.mark.parametrize("method", ["map", "geometry"])
def test_far_places_get_the_nearest_label_by_tiles_as_in_one_piece(scene, method):
    points, before, _, _ = run(scene, method=method, max_memory="2G")
    _, label, confidence, state = run(scene, method=method, max_memory="2G", fill=True)
    empty = before == 0
    assert empty[-3_000:].all() and (label > 0).all()
    nearest_label = before[~empty][cKDTree(points[~empty]).query(points[empty])[1]]
    assert (label[empty] == nearest_label).mean() > 0.999 and set(np.unique(nearest_label)) == {1, 2}
    assert (confidence[empty] == 0.5).all() and (label[~empty] == before[~empty]).all()
    whole = run(scene, method=method, fill=True)
    assert (whole[1] != label).mean() <= 1e-4 and (whole[3] != state).mean() <= 1e-4


def test_neither_workers_nor_the_size_of_tiles_change_a_byte(scene):
    found = []
    for memory, workers in (("2G", 0), ("3G", 0), ("3G", 2)):
        run(scene, fill=True, max_memory=memory, workers=workers)
        found.append(scene.labelled.read_bytes())
    assert found.count(found[0]) == 3


def test_the_order_of_parts_does_not_matter():
    rng = np.random.default_rng(2)
    lattice = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), axis=-1).reshape(-1, 3)
    labels, asked = rng.integers(1, 5, len(lattice)).astype(np.uint8), lattice[:200] + [0.5, 0.5, 0]
    apart = np.linalg.norm(asked[:, None] - lattice, axis=2)
    for seed in range(3):
        found, order = NearestLabels.of_points(asked, np.zeros(3)), np.random.default_rng(seed)
        for rows in np.array_split(order.permutation(len(lattice)), 7):
            rows = np.sort(rows)
            found.add(lattice[rows], labels[rows], rows)
        np.testing.assert_array_equal(found.label, labels[apart.argmin(axis=1)])
        np.testing.assert_array_equal(found.distance, apart.min(axis=1).astype(np.float32))
