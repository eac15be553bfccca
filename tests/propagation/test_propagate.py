"""Propagation: planes, sheets, gaps, energy against brute force, order independence."""

import itertools
from dataclasses import replace

import numba
import numpy as np
import pytest
import scipy.sparse

from sc3d.geometry.graph import Graph, build_graph, similarity
from sc3d.geometry.neighbors import NeighborIndex, curvature
from sc3d.propagation import propagate as propagation
from sc3d.propagation.labelled_points import LabelledPoints, tie_breakers
from sc3d.propagation.potts import mean_field
from sc3d.propagation.region_growing import grow_regions, vote_nearest
from sc3d.propagation.vote_evidence import softmax
from sc3d.scene.labels import LOCKED, PROPAGATED, SEED, UNSEEN, Labels
from sc3d.settings.labels import Propagate
from tests.reference.potts import free_energy, mean_field_sequential, potts_energy


def propagate(graph: Graph, points: LabelledPoints, settings: Propagate) -> Labels:
    return propagation.propagate(points, None, settings, graph)


def plane(height: float = 0.0, count: int = 40, offset: float = 0.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(count) * 0.1 + offset, np.arange(count) * 0.1)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)


def seeds_of(label: np.ndarray) -> Labels:
    return Labels(
        label,
        (label > 0).astype(np.float32),
        np.where(label > 0, SEED, UNSEEN).astype(np.uint8),
        (label > 0).astype(np.int32),
    )


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
    result = propagate(
        graph, LabelledPoints(points, seeds_of(label), votes_of(label), None), Propagate(method=method)
    )
    if method != "knn":  # votes by distance alone cannot know the sheets
        assert (result.label[: len(low)] == 1).all() and (result.label[len(low) :] == 2).all()
    assert result.state[0] == SEED and (result.state[1:-1] == PROPAGATED).all()
    assert (result.confidence > 0).all() and (result.confidence <= 1).all()


@pytest.mark.parametrize("method", ["geometry", "map"])
def test_a_gap_stops_labels_unless_filled(method):
    points = np.concatenate([plane(), plane(offset=8.0)])
    label = np.zeros(len(points), np.uint8)
    label[5] = 3
    graph = build_graph(points, up(points), 16)
    result = propagate(
        graph, LabelledPoints(points, seeds_of(label), votes_of(label), None), Propagate(method=method)
    )
    half = len(points) // 2
    assert (
        (result.label[:half] == 3).all()
        and (result.label[half:] == 0).all()
        and (result.state[half:] == UNSEEN).all()
    )
    filled = propagate(
        graph,
        LabelledPoints(points, seeds_of(label), votes_of(label), None),
        Propagate(method=method, fill=True),
    )
    assert (filled.label == 3).all() and (filled.state[half:] == PROPAGATED).all()


def test_geometry_prefers_the_similar_surface_at_a_crease():
    """A locked strip at the foot of a wall: floor points go with the floor, wall points with the wall."""
    floor = plane()
    wall = floor[:, [0, 2, 1]] + [0, 4.0, 0.1]
    points = np.concatenate([floor, wall])
    normals = np.concatenate([up(floor), np.tile(np.float32([0, -1, 0]), (len(wall), 1))])
    label = np.concatenate([np.where(floor[:, 1] < 3.65, 1, 0), np.where(wall[:, 2] > 0.45, 2, 0)]).astype(
        np.uint8
    )
    truth = np.concatenate([np.full(len(floor), 1), np.full(len(wall), 2)])
    graph = build_graph(points, normals, 16)
    grown = grow_regions(graph, label[graph.order])[0][np.argsort(graph.order)]
    voted, _ = vote_nearest(points, label, 16)
    assert (grown == truth).mean() > 0.99
    assert (grown == truth).mean() >= (voted == truth).mean()


def test_eq_7_by_hand():
    normals = np.float32([[0, 0, 1], [0, 0, 1], [1, 0, 0], [0, 0, -1]])
    bend = np.float32([0.0, 0.5, 0.0, 0.0])
    rows, columns = np.array([0, 0, 0]), np.array([1, 2, 3])
    np.testing.assert_allclose(
        similarity(normals, bend, rows, columns), [0.6 + 0.4 * np.exp(-0.5), 0.6 * 0.5 + 0.4, 0.4], rtol=1e-6
    )
    np.testing.assert_allclose(
        similarity(normals, bend, rows[2:], columns[2:], oriented=False), [1.0], rtol=1e-6
    )
    assert curvature(normals[:2], np.array([[1], [0]])).max() == 0


@pytest.mark.parametrize("method", ["knn", "geometry", "map"])
def test_point_order_does_not_matter(method):
    rng = np.random.default_rng(0)
    points = plane() + rng.normal(0, 0.01, plane().shape)
    label = np.where(rng.uniform(size=len(points)) < 0.1, rng.integers(1, 4, len(points)), 0).astype(np.uint8)
    order = rng.permutation(len(points))
    first = propagate(
        build_graph(points, up(points), 16),
        LabelledPoints(points, seeds_of(label), votes_of(label), None),
        Propagate(method=method),
    )
    moved = points[order]
    second = propagate(
        build_graph(moved, up(moved), 16),
        LabelledPoints(moved, seeds_of(label[order]), votes_of(label[order]), None),
        Propagate(method=method),
    )
    np.testing.assert_array_equal(first.label[order], second.label)
    np.testing.assert_array_equal(first.state[order], second.state)


def graph_of(weights: np.ndarray) -> Graph:
    """A graph of given symmetric weights (N, N), without positions."""
    matrix, count = scipy.sparse.csr_matrix(weights.astype(np.float32)), len(weights)
    nothing = np.zeros(count, np.float32)
    return Graph(
        np.arange(count),
        matrix.indptr.astype(np.int64),
        matrix.indices.astype(np.int32),
        matrix.data,
        np.ones(count, np.float32),
        np.zeros((count, 3), np.float32),
        nothing,
        nothing,
    )


def random_problem(seed: int, count: int = 10) -> tuple[np.ndarray, Graph, np.ndarray]:
    rng = np.random.default_rng(seed)
    edges = np.triu(rng.uniform(0.2, 1.0, (count, count)) * (rng.uniform(size=(count, count)) < 0.4), 1)
    return edges, graph_of(edges + edges.T), np.log(rng.dirichlet([1, 1, 1], count)).astype(np.float32)


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_energy_counts_each_edge_once_and_mean_field_is_near_the_brute_force_minimum(seed):
    edges, graph, unary = random_problem(seed)
    every = np.array(list(itertools.product([1, 2, 3], repeat=10)))
    energies = -unary[np.arange(10), every - 1].sum(axis=1)
    for row, column in zip(*np.nonzero(edges), strict=True):
        energies += edges[row, column] * (every[:, row] != every[:, column])
    sample = np.random.default_rng(0).integers(0, len(every), 50)
    np.testing.assert_allclose(
        [potts_energy(graph, unary, every[row], 1.0) for row in sample], energies[sample], rtol=1e-5
    )
    marginals = mean_field(graph, unary, 1.0)
    assert potts_energy(graph, unary, marginals.argmax(axis=1) + 1, 1.0) <= np.quantile(energies, 0.005)
    np.testing.assert_allclose(marginals.sum(axis=1), 1, rtol=1e-5)


@pytest.mark.parametrize("smoothness", [0.3, 1.0, 5.0])
def test_free_energy_never_rises_in_sequential_sweeps(smoothness):
    for seed in range(5):
        _, graph, unary = random_problem(seed, 40)
        marginals = softmax(unary)
        energies = [free_energy(graph, unary, marginals, smoothness)]
        for _ in range(15):
            marginals = mean_field_sequential(graph, unary, smoothness, marginals)
            energies.append(free_energy(graph, unary, marginals, smoothness))
        assert (np.diff(energies) <= 1e-4).all() and energies[-1] < energies[0]


def test_a_step_equals_plain_numpy():
    edges, graph, unary = random_problem(7, 60)
    expected = softmax(unary)
    for _ in range(4):
        expected = softmax(unary + 0.7 * ((edges + edges.T).astype(np.float32) @ expected))
    np.testing.assert_allclose(mean_field(graph, unary, 0.7, steps=4), expected, atol=1e-5)


def test_map_corrects_a_wrong_seed_that_its_surroundings_contradict():
    points = plane()
    label = np.full(len(points), 2, np.uint8)
    label[820] = 1
    votes = votes_of(label)
    votes[820] = [0, 0.6, 0.4, 0, 0]
    result = propagate(
        build_graph(points, up(points), 16),
        LabelledPoints(points, seeds_of(label), votes, None),
        Propagate(method="map"),
    )
    assert result.label[820] == 2 and result.state[820] == PROPAGATED and result.state[0] == SEED


def test_locked_points_are_completed_and_seeds_keep_their_label():
    points = plane()
    label = np.full(len(points), 2, np.uint8)
    state = np.full(len(points), SEED, np.uint8)
    label[300:340], state[300:340] = 0, LOCKED
    label[0] = 1
    seeds = replace(seeds_of(label), state=state)
    for method in ("knn", "geometry"):
        result = propagate(
            build_graph(points, up(points), 16),
            LabelledPoints(points, seeds, None, None),
            Propagate(method=method),
        )
        assert (
            (result.label[300:340] == 2).all()
            and (result.state[300:340] == PROPAGATED).all()
            and result.label[0] == 1
        )


def test_two_points_and_no_neighbors():
    points = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    label = np.uint8([1, 0])
    result = propagate(
        build_graph(points, None, 16),
        LabelledPoints(points, seeds_of(label), votes_of(label), None),
        Propagate(method="geometry"),
    )
    assert result.label[0] == 1


def test_graph_equals_scipy_union_of_both_directions():
    rng = np.random.default_rng(2)
    points = np.concatenate([plane() + rng.normal(0, 0.02, plane().shape), rng.uniform(0, 4, (200, 3))])
    normals = rng.normal(size=points.shape).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    near, distances = (found[:, 1:] for found in NeighborIndex(points).nearest(points, 9))
    rows = np.repeat(np.arange(len(points)), 8)
    kept = (distances <= 3 * distances[:, 3:4]).ravel()
    weights = similarity(normals, curvature(normals, near), rows, near.ravel().astype(np.int64))
    expected = scipy.sparse.csr_matrix(
        (weights[kept], (rows[kept], near.ravel()[kept])), shape=(len(points),) * 2
    )
    expected = expected.maximum(expected.T).toarray()
    graph = build_graph(points, normals, 8)
    back = np.argsort(graph.order)
    np.testing.assert_allclose(graph.sparse().toarray()[np.ix_(back, back)], expected, atol=1e-5)


def test_coinciding_points_are_told_apart_by_what_they_carry():
    rng = np.random.default_rng(0)
    points = np.repeat(plane(), 2, axis=0)
    label = np.where(rng.uniform(size=len(points)) < 0.2, rng.integers(1, 4, len(points)), 0).astype(np.uint8)
    results = []
    for order in (np.arange(len(points)), rng.permutation(len(points))):
        evidence = LabelledPoints(points[order], seeds_of(label[order]), votes_of(label[order]), None)
        graph = build_graph(evidence.points, up(points), 16, None, tie_breakers(evidence, None))
        results.append(propagate(graph, evidence, Propagate()).label[np.argsort(order)])
    np.testing.assert_array_equal(*(np.sort(result.reshape(-1, 2), axis=1) for result in results))


def test_one_or_two_threads_give_the_same_bits():
    rng = np.random.default_rng(1)
    points = plane(count=90) + rng.normal(0, 0.02, plane(count=90).shape)
    label = np.where(rng.uniform(size=len(points)) < 0.1, rng.integers(1, 4, len(points)), 0).astype(np.uint8)
    before, found = numba.get_num_threads(), []
    try:
        for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
            numba.set_num_threads(threads)
            graph = build_graph(points, None, 16)
            found.append(
                (
                    graph.weights,
                    *(
                        propagate(
                            graph,
                            LabelledPoints(points, seeds_of(label), votes_of(label), None),
                            Propagate(method=method),
                        ).confidence
                        for method in ("map", "geometry")
                    ),
                )
            )
    finally:
        numba.set_num_threads(before)
    for first, second in zip(*found, strict=True):
        np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("method", ["geometry", "map"])
def test_sheets_two_voxels_apart_keep_their_labels(method):
    """Voxel = 2 spacings: sheets 4 spacings apart, each with its own class in its seeds, the rest locked or
    unseen.
    """
    rng = np.random.default_rng(0)
    low, high = (plane(height, 60) + rng.normal(0, 0.01, (3600, 3)) for height in (0.0, 0.4))
    points, truth = np.concatenate([low, high]), np.repeat(np.uint8([1, 2]), 3600)
    label = np.where(rng.uniform(size=len(points)) < 0.02, truth, 0).astype(np.uint8)
    result = propagate(
        build_graph(points, up(points), 16),
        LabelledPoints(points, seeds_of(label), votes_of(label), None),
        Propagate(method=method),
    )
    np.testing.assert_array_equal(result.label, truth)
