"""The voxel field: lookup against a dictionary, merging, saving, sides of a thin wall."""

import numpy as np
import open3d as o3d
import pytest

from sc3d.geometry.voxels import SIDES, LabelGrid, normal_sides, sort_by_voxel


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform(-3, 3, (5000, 3)) + [5e5, 5e6, 100]


def grid_over(points: np.ndarray, voxel_size: float, num_channels: int) -> LabelGrid:
    """An empty field over (N, 3) points."""
    return LabelGrid.from_voxels(sort_by_voxel(points, voxel_size), num_channels)


def test_find_groups_points_exactly_by_voxel(points):
    field = grid_over(points, 0.2, 4)
    cells = field.find(points)
    keys = np.floor((points - field.origin) / 0.2).astype(int)
    by_key, by_cell = {}, {}
    for key, cell in zip(map(tuple, keys), cells, strict=True):
        assert by_key.setdefault(key, cell) == cell
        assert by_cell.setdefault(cell, key) == key
    assert cells.min() >= 0 and (cells % SIDES == 0).all()
    assert (field.find(points + 100) == -1).all()


def test_cells_are_the_voxels_that_open3d_calls_by_the_same_index(points):
    field = grid_over(points, 0.2, 4)
    coordinates, indices = field.grid.voxel_coordinates_and_flattened_indices()
    centers = field.origin + coordinates.numpy().astype(np.float64) + 0.1
    np.testing.assert_array_equal(field.find(centers), indices.numpy() * SIDES)


def test_merge_adds_and_save_round_trips(points, tmp_path):
    one, other = grid_over(points, 0.2, 4), grid_over(points, 0.2, 4)
    rng = np.random.default_rng(1)
    for field, chosen in ((one, points[:3000]), (other, points[2000:])):
        field.add(field.find(chosen), np.eye(4, dtype=np.int32)[rng.integers(0, 4, len(chosen))])
    expected = one.votes[one.find(points)] + other.votes[other.find(points)]
    one.merge(other)
    np.testing.assert_array_equal(one.votes[one.find(points)], expected)
    assert one.votes.sum() == 3000 + 3000
    one.save(tmp_path / "votes.npz")
    loaded = o3d.t.geometry.VoxelBlockGrid.load(str(tmp_path / "votes.npz"))
    again = LabelGrid(loaded, 0.2, one.origin)
    np.testing.assert_array_equal(again.votes[again.find(points)], expected)
    with pytest.raises(ValueError):
        one.merge(grid_over(points, 0.3, 4))


def test_merge_brings_blocks_that_were_not_there():
    near, far = np.zeros((1, 3)), np.full((1, 3), 50.0)
    both = grid_over(np.concatenate([near, far]), 0.5, 2)
    one = LabelGrid(grid_over(near, 0.5, 2).grid, 0.5, both.origin)
    other = grid_over(np.concatenate([near, far]), 0.5, 2)
    other.votes[other.find(far), 1] = 7
    assert one.find(far)[0] == -1
    one.merge(other)
    assert one.votes[one.find(far)[0], 1] == 7


def test_opposite_faces_of_a_wall_within_a_voxel_have_different_sides():
    rng = np.random.default_rng(0)
    front = np.concatenate([np.full((500, 1), 0.52), rng.uniform(0, 4, (500, 2))], axis=1)
    back = front + [0.05, 0, 0]
    points = np.concatenate([front, back])
    normals = np.concatenate(
        [np.tile(np.float32([-1, 0, 0]), (500, 1)), np.tile(np.float32([1, 0, 0]), (500, 1))]
    )
    sides, flat = normal_sides(normals, sort_by_voxel(points, 1.0, np.zeros(3)))
    assert flat.all()
    assert len(set(sides[:500])) == 1 and len(set(sides[500:])) == 1 and sides[0] != sides[-1]
    order = rng.permutation(1000)
    np.testing.assert_array_equal(
        normal_sides(normals[order], sort_by_voxel(points[order], 1.0, np.zeros(3)))[0], sides[order]
    )
    ridge = np.float32([[0.7, 0, 0.714], [-0.7, 0, 0.714]])  # a roof's two slopes stay together
    assert (
        len(
            set(
                normal_sides(
                    ridge / np.linalg.norm(ridge, axis=1, keepdims=True),
                    sort_by_voxel(np.full((2, 3), 0.5), 1.0, np.zeros(3)),
                )[0]
            )
        )
        == 1
    )
