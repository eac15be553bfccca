"""Neighbors, normals (eq. 5) and curvature (eq. 6) on analytic surfaces; KDTreeFlann and scipy as oracles."""

import numpy as np
import open3d as o3d
import pytest
import scipy.spatial

from sc3d.geometry import neighbors


def sphere(count: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def angle_degrees(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.arccos(np.clip(np.abs(np.einsum("ij,ij->i", first, second)), 0, 1)))


def test_batched_search_equals_scipy_and_single_queries():
    rng = np.random.default_rng(0)
    points, queries = rng.uniform(size=(3000, 3)), rng.uniform(size=(200, 3))
    found, distances = neighbors.NeighborIndex(points).nearest(queries, 7)
    expected, expected_rows = scipy.spatial.cKDTree(points).query(queries, 7)
    np.testing.assert_array_equal(found, expected_rows)
    np.testing.assert_allclose(distances, expected, atol=1e-6)
    tree = o3d.geometry.KDTreeFlann(o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))
    for query, rows in zip(queries[:20], found[:20], strict=True):
        assert list(tree.search_knn_vector_3d(query, 7)[1]) == list(rows)


def test_search_at_utm_size_and_with_fewer_points_than_asked():
    points = np.random.default_rng(0).uniform(size=(5, 3))
    near, distances = neighbors.NeighborIndex(points + [5e5, 5e6, 100]).nearest(points + [5e5, 5e6, 100], 10)
    assert near.shape == (5, 5)
    assert (near[:, 0] == np.arange(5)).all() and distances[:, 0].max() < 1e-6
    with pytest.raises(ValueError):
        neighbors.NeighborIndex(np.empty((0, 3)))


def test_of_equally_near_points_the_first_is_found():
    """Among the corners of cells, and of points at one place."""
    lattice = np.stack(np.meshgrid(*[np.arange(9.0)] * 3), axis=-1).reshape(-1, 3)
    points = np.concatenate([lattice, lattice[::3]])[np.random.default_rng(0).permutation(729 + 243)]
    for queries in (lattice, lattice[lattice.max(axis=1) < 8] + [0.5, 0.5, 0]):
        apart = np.linalg.norm(queries[:, None] - points, axis=2)
        found, distances = neighbors.NeighborIndex(points, np.zeros(3)).nearest_first(queries)
        np.testing.assert_array_equal(found, apart.argmin(axis=1))
        np.testing.assert_array_equal(distances, apart.min(axis=1).astype(np.float32))


def test_normals_of_noisy_plane_and_sphere_within_two_degrees():
    rng = np.random.default_rng(0)
    plane = np.concatenate([rng.uniform(-5, 5, (20000, 2)), rng.normal(0, 0.002, (20000, 1))], axis=1)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    normals = neighbors.estimate_normals(
        plane @ rotation.T, neighbors.NeighborIndex(plane @ rotation.T).nearest(plane @ rotation.T, 30)[0]
    )
    assert np.quantile(angle_degrees(normals, np.tile(rotation[:, 2], (len(plane), 1))), 0.99) < 2
    ball = sphere(40000)
    normals = neighbors.estimate_normals(ball, neighbors.NeighborIndex(ball).nearest(ball, 30)[0])
    assert angle_degrees(normals, ball).max() < 2


def test_orientation_towards_the_cameras():
    ball = sphere(20000)
    estimated = neighbors.estimate_normals(ball, neighbors.NeighborIndex(ball).nearest(ball, 20)[0])
    centers = 10 * sphere(60, seed=1)
    oriented = neighbors.orient_normals(ball, estimated, centers)
    assert (np.einsum("ij,ij->i", oriented, ball) > 0).all()


def test_curvature_zero_on_a_plane_and_large_on_a_cubes_edge_whatever_the_signs():
    step = np.linspace(0, 1, 41)
    top = np.stack([*np.meshgrid(step, step), np.ones((41, 41))], axis=2).reshape(-1, 3)
    side = top[:, [0, 2, 1]][top[:, 1] < 1]  # the face y = 1; the shared edge only once
    cube = np.concatenate([top, side])
    normals = np.concatenate(
        [np.tile(np.float32([0, 0, 1]), (len(top), 1)), np.tile(np.float32([0, 1, 0]), (len(side), 1))]
    )
    near = neighbors.NeighborIndex(cube).nearest(cube, 31)[0][:, 1:]
    bend = neighbors.curvature(normals, near)
    inner = (np.abs(cube[:, 1] - 0.3) < 0.05) & (cube[:, 2] == 1) & (np.abs(cube[:, 0] - 0.5) < 0.2)
    edge = (cube[:, 1] > 0.99) & (cube[:, 2] > 0.99) & (np.abs(cube[:, 0] - 0.5) < 0.2)
    assert inner.sum() > 10 and edge.sum() > 10
    assert bend[inner].max() < 1e-6
    assert bend[edge].min() > 0.2
    signs = np.random.default_rng(0).choice(np.float32([-1, 1]), (len(normals), 1))
    flipped = neighbors.curvature(normals * signs, near)
    np.testing.assert_allclose(flipped[inner], bend[inner], atol=1e-6)


def test_spacing_of_grid_and_random_sample():
    grid = np.stack(np.meshgrid(np.arange(60) * 0.5, np.arange(60) * 0.5, [0.0]), axis=-1).reshape(-1, 3)
    random = np.random.default_rng(0).uniform([0, 0, 0], [30, 30, 0], (3600, 3))
    for points in (grid, random):
        assert neighbors.point_spacing(
            neighbors.NeighborIndex(points).nearest(points, 9)[1]
        ) == pytest.approx(0.5, rel=0.2)
