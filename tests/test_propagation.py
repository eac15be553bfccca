"""Propagation: planes, sheets, gaps, energy against brute force, order independence."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse

from sc3d.fusion import LOCKED, PROPAGATED, SEED, UNSEEN, Labels
from sc3d.geometry.neighbors import curvature
from sc3d.propagation import build_graph, grow, mean_field, potts_energy, propagate, similarity, vote_nearest, vote_support
from sc3d.settings import Propagate


def plane(height: float = 0.0, count: int = 40, offset: float = 0.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(count) * 0.1 + offset, np.arange(count) * 0.1)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)


def seeds_of(label: np.ndarray) -> Labels:
    return Labels(label, (label > 0).astype(np.float32), np.where(label > 0, SEED, UNSEEN).astype(np.uint8), (label > 0).astype(np.int32))


def up(points: np.ndarray) -> np.ndarray:
    return np.tile(np.float32([0, 0, 1]), (len(points), 1))


def votes_of(label: np.ndarray, num_ids: int = 5) -> np.ndarray:
    votes = np.zeros((len(label), num_ids), np.float32)
    votes[np.arange(len(label)), label] = 3
    votes[:, 0] = 0
    return votes


@pytest.mark.parametrize("method", ["knn", "geometry", "map"])
def test_one_seed_fills_its_plane_and_not_the_sheet_above(method):
    low, high = plane(0.0), plane(0.5)  # 5 spacings apart, the seed of the other in the opposite corner
    points = np.concatenate([low, high])
    label = np.zeros(len(points), np.uint8)
    label[0], label[-1] = 1, 2
    graph = build_graph(points, up(points), 16)
    result = propagate(points, graph, seeds_of(label), votes_of(label), Propagate(method=method))
    if method != "knn":  # votes by distance alone cannot know the sheets
        assert (result.label[: len(low)] == 1).all() and (result.label[len(low):] == 2).all()
    assert result.state[0] == SEED and (result.state[1:-1] == PROPAGATED).all()
    assert (result.confidence > 0).all() and (result.confidence <= 1).all()


@pytest.mark.parametrize("method", ["geometry", "map"])
def test_a_gap_stops_labels_unless_filled(method):
    points = np.concatenate([plane(), plane(offset=8.0)])
    label = np.zeros(len(points), np.uint8)
    label[5] = 3
    graph = build_graph(points, up(points), 16)
    result = propagate(points, graph, seeds_of(label), votes_of(label), Propagate(method=method))
    half = len(points) // 2
    assert (result.label[:half] == 3).all() and (result.label[half:] == 0).all() and (result.state[half:] == UNSEEN).all()
    filled = propagate(points, graph, seeds_of(label), votes_of(label), Propagate(method=method, fill=True))
    assert (filled.label == 3).all() and (filled.state[half:] == PROPAGATED).all()


def test_geometry_prefers_the_similar_surface_at_a_crease():
    """A locked strip at the foot of a wall: floor points go with the floor, wall points with the wall."""
    floor = plane()
    wall = floor[:, [0, 2, 1]] + [0, 4.0, 0.1]
    points = np.concatenate([floor, wall])
    normals = np.concatenate([up(floor), np.tile(np.float32([0, -1, 0]), (len(wall), 1))])
    label = np.concatenate([np.where(floor[:, 1] < 3.65, 1, 0), np.where(wall[:, 2] > 0.45, 2, 0)]).astype(np.uint8)
    truth = np.concatenate([np.full(len(floor), 1), np.full(len(wall), 2)])
    graph = build_graph(points, normals, 16)
    grown, _ = grow(graph.weights, label)
    voted, _ = vote_nearest(points, label, 16)
    assert (grown == truth).mean() > 0.99
    assert (grown == truth).mean() >= (voted == truth).mean()


def test_eq_7_by_hand():
    normals = np.float32([[0, 0, 1], [0, 0, 1], [1, 0, 0], [0, 0, -1]])
    bend = np.float32([0.0, 0.5, 0.0, 0.0])
    rows, columns = np.array([0, 0, 0]), np.array([1, 2, 3])
    np.testing.assert_allclose(similarity(normals, bend, rows, columns), [0.6 + 0.4 * np.exp(-0.5), 0.6 * 0.5 + 0.4, 0.4], rtol=1e-6)
    np.testing.assert_allclose(similarity(normals, bend, rows[2:], columns[2:], oriented=False), [1.0], rtol=1e-6)
    assert curvature(normals[:2], np.array([[1], [0]])).max() == 0


@pytest.mark.parametrize("method", ["knn", "geometry", "map"])
def test_point_order_does_not_matter(method):
    rng = np.random.default_rng(0)
    points = plane() + rng.normal(0, 0.01, plane().shape)
    label = np.where(rng.uniform(size=len(points)) < 0.1, rng.integers(1, 4, len(points)), 0).astype(np.uint8)
    order = rng.permutation(len(points))
    first = propagate(points, build_graph(points, up(points), 16), seeds_of(label), votes_of(label), Propagate(method=method))
    moved = points[order]
    second = propagate(moved, build_graph(moved, up(moved), 16), seeds_of(label[order]), votes_of(label[order]), Propagate(method=method))
    np.testing.assert_array_equal(first.label[order], second.label)
    np.testing.assert_array_equal(first.state[order], second.state)


def test_energy_counts_each_edge_once_and_mean_field_is_near_the_brute_force_minimum():
    rng = np.random.default_rng(3)
    edges = np.triu(rng.uniform(0.2, 1.0, (10, 10)) * (rng.uniform(size=(10, 10)) < 0.4), 1)
    weights = scipy.sparse.csr_matrix(edges + edges.T).astype(np.float32)
    unary = np.log(rng.dirichlet([1, 1, 1], 10)).astype(np.float32)
    unary = np.concatenate([np.full((10, 1), -np.inf, np.float32), unary], axis=1)
    every = np.array(list(itertools.product([1, 2, 3], repeat=10)))
    energies = -unary[np.arange(10), every].sum(axis=1)
    for row, column in zip(*np.nonzero(edges), strict=True):
        energies += edges[row, column] * (every[:, row] != every[:, column])
    sample = rng.integers(0, len(every), 50)
    np.testing.assert_allclose([potts_energy(weights, unary, every[row], 1.0) for row in sample], energies[sample], rtol=1e-5)
    label, probability = mean_field(weights, unary, 1.0)
    assert potts_energy(weights, unary, label, 1.0) <= np.quantile(energies, 0.001)
    assert (label > 0).all() and (probability <= 1).all()


def test_map_corrects_a_wrong_seed_that_its_surroundings_contradict():
    points = plane()
    label = np.full(len(points), 2, np.uint8)
    label[820] = 1
    votes = votes_of(label)
    votes[820] = [0, 0.6, 0.4, 0, 0]
    result = propagate(points, build_graph(points, up(points), 16), seeds_of(label), votes, Propagate(method="map"))
    assert result.label[820] == 2 and result.state[820] == PROPAGATED and result.state[0] == SEED


def test_locked_points_are_completed_and_seeds_keep_their_label():
    points = plane()
    label = np.full(len(points), 2, np.uint8)
    state = np.full(len(points), SEED, np.uint8)
    label[300:340], state[300:340] = 0, LOCKED
    label[0] = 1
    seeds = replace(seeds_of(label), state=state)
    for method in ("knn", "geometry"):
        result = propagate(points, build_graph(points, up(points), 16), seeds, None, Propagate(method=method))
        assert (result.label[300:340] == 2).all() and (result.state[300:340] == PROPAGATED).all() and result.label[0] == 1


def test_two_points_and_no_neighbours():
    points = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    label = np.uint8([1, 0])
    result = propagate(points, build_graph(points, None, 16), seeds_of(label), votes_of(label), Propagate(method="geometry"))
    assert result.label[0] == 1


def test_vote_support_by_hand():
    weights = scipy.sparse.csr_matrix(np.array([[0, 1, 0, 0], [1, 0, 2, 0], [0, 2, 0, 0], [0, 0, 0, 0]], np.float32))
    votes = np.float32([[0, 3, 1], [0, 0, 2], [0, 0, 0], [0, 0, 0]])
    support = vote_support(weights, votes, np.array([1, 2, 2, 1]))
    np.testing.assert_allclose(support, [(0.75 + 0) / 2, (1 + 0.25) / 2, 1.0, 0.5], rtol=1e-6)
