"""Color and relief as raters: errors that all views share, the guard, scale, order."""

import numpy as np
import pytest

from sc3d.geometry.graph import Graph, build_graph
from sc3d.propagation import propagate as propagation
from sc3d.propagation.appearance import AppearanceModel
from sc3d.propagation.labelled_points import LabelledPoints
from sc3d.propagation.terrain import relief_features
from sc3d.propagation.trust import Trust
from sc3d.scene.labels import SEED, UNSEEN, Labels
from sc3d.settings.labels import Propagate

LAWN, ROOF, ROAD = 1, 2, 3


def propagate(graph: Graph, points: LabelledPoints, settings: Propagate) -> Labels:
    return propagation.propagate(points, None, settings, graph)


def fitted(
    model: AppearanceModel, label: np.ndarray, examples: np.ndarray, num_classes: int
) -> np.ndarray | None:
    """What the model says of a cloud by the cloud's own examples, if it is believed."""
    trust = Trust(np.full(num_classes, 0.1), np.arange(num_classes))
    shares = np.eye(num_classes + 1, dtype=np.float32)[label][:, 1:]
    return model.log_likelihood(model.statistics(label, examples, num_classes), trust, shares)


def village(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals, colors and truth of a lawn with a road and flat roofs 5 high; spacing about 0.5. Lawn
    and roofs share half of their colors.
    """
    rng = np.random.default_rng(seed)
    flat = rng.uniform(0, 100, (40_000, 2))
    roof = ((flat // 10).astype(int) % 3 == 1).all(axis=1)
    road = ~roof & (np.abs(flat[:, 0] - 50) < 8)
    truth = np.where(roof, ROOF, np.where(road, ROAD, LAWN)).astype(np.uint8)
    points = np.column_stack([flat, np.where(roof, 5.0, 0.0) + rng.normal(0, 0.01, len(flat))])
    means = np.array([[0, 0, 0], [90, 140, 70], [140, 120, 90], [120, 120, 125]])
    colors = np.clip(means[truth] + rng.normal(0, 18, (len(flat), 3)), 0, 255).astype(np.uint8)
    return points, np.tile(np.float32([0, 0, 1]), (len(flat), 1)), colors, truth


def evidence_of(points: np.ndarray, colors: np.ndarray, label: np.ndarray) -> LabelledPoints:
    votes = np.zeros((len(label), 4), np.float32)
    votes[np.arange(len(label)), label] = 1.5
    votes[:, 0] = 0
    seen = label > 0
    seeds = Labels(
        label,
        seen.astype(np.float32),
        np.where(seen, SEED, UNSEEN).astype(np.uint8),
        np.where(seen, 5, 0).astype(np.int32),
    )
    return LabelledPoints(points, seeds, votes, colors)


def swollen(points: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Labels as masks bleed: the lawn and the road within 1.5 of a roof are called roof by every view."""
    cell = (points[:, :2] // 0.5).astype(int)
    raster = np.zeros((201, 201), bool)
    raster[tuple(cell[truth == ROOF].T)] = True
    grown = np.zeros_like(raster)
    for row in range(-3, 4):
        for column in range(-3, 4):
            grown |= np.roll(raster, (row, column), (0, 1))
    return np.where(grown[tuple(cell.T)], ROOF, truth).astype(np.uint8)


@pytest.fixture(scope="module")
def scene():
    points, normals, colors, truth = village()
    return points, normals, colors, truth, swollen(points, truth)


def solve(scene, settings: Propagate, order=slice(None), transform=lambda points: points) -> Labels:
    points, normals, colors, _, label = scene
    moved = transform(points[order])
    return propagate(
        build_graph(moved, normals[order], 16, colors[order]),
        evidence_of(moved, colors[order], label[order]),
        settings,
    )


def test_relief_is_height_over_the_ground_in_spacings_whatever_the_unit_and_the_order(scene):
    points, normals, _, truth, _ = scene
    graph = build_graph(points, normals, 16)
    relief = relief_features(graph, points[graph.order])
    height = relief[:, 3] * graph.spacing
    assert np.abs(height - np.where(truth[graph.order] == ROOF, 5, 0)).max() < 0.2
    assert (relief[:, 1] > 0.999).all()
    scaled = points * 100 + [5e7, 5e8, 1e4]
    again = build_graph(scaled, normals, 16)
    np.testing.assert_array_equal(again.order, graph.order)
    np.testing.assert_allclose(relief_features(again, scaled[again.order]), relief, atol=1e-3)


def test_errors_that_all_views_share_are_cured_and_only_by_the_raters(scene):
    truth, label = scene[3], scene[4]
    before = (label != truth).mean()
    with_raters, without = (
        (solve(scene, Propagate(appearance=fit)).label != truth).mean() for fit in (True, False)
    )
    assert before > 0.05 and without > 0.9 * before and with_raters < 0.1 * before
    for method in ("geometry", "knn"):
        verified, trusting = (
            (solve(scene, Propagate(method=method, verify_seeds=verify)).label != truth).mean()
            for verify in (True, False)
        )
        assert trusting > 0.9 * before and verified < 0.3 * before


def test_labels_that_color_and_relief_cannot_know_switch_the_raters_off(scene):
    """Classes as a random chessboard of large squares: nothing to learn, so the votes stay as they are."""
    points, normals, colors, _, _ = scene
    board = np.random.default_rng(1).integers(1, 4, (5, 5)).astype(np.uint8)
    label = board[tuple((points[:, :2] // 20).astype(int).T)]
    result = solve((points, normals, colors, label, label), Propagate())
    assert (result.label == label).mean() > 0.99


def test_product_of_raters_by_hand_on_two_independent_features():
    """Two binary features, independent given the class: the product must be Bayes' rule."""
    rng = np.random.default_rng(0)
    label = np.where(rng.uniform(size=200_000) < 0.7, 1, 2).astype(np.uint8)
    first = rng.uniform(size=len(label)) < np.where(label == 1, 0.2, 0.6)
    second = rng.uniform(size=len(label)) < np.where(label == 1, 0.3, 0.9)
    relief = np.zeros((len(label), 4), np.float32)
    relief[:, 0] = first
    colors = np.zeros((len(label), 3), np.uint8)
    colors[:, 0] = 255 * second
    appearance = AppearanceModel.from_features(relief, colors)
    rating = fitted(appearance, label, np.ones(len(label), bool), 2)
    odds = (0.7 * np.where(first, 0.2, 0.8) * np.where(second, 0.3, 0.7)) / (
        0.3 * np.where(first, 0.6, 0.4) * np.where(second, 0.9, 0.1)
    )
    np.testing.assert_allclose(rating[:, 0] - rating[:, 1], np.log(odds), atol=0.1)
    np.testing.assert_allclose(np.exp(rating).sum(axis=1), 1, atol=1e-4)


def test_a_class_with_few_examples_is_left_to_the_votes():
    rng = np.random.default_rng(0)
    label = np.repeat([1, 2, 3], [2000, 2000, 40]).astype(np.uint8)
    relief = rng.normal(size=(len(label), 4)).astype(np.float32) + label[:, None]
    rating = fitted(AppearanceModel.from_features(relief, None), label, np.ones(len(label), bool), 3)
    assert np.ptp(rating[:4000, 2]) == 0 and np.exp(rating[0, 2]) == pytest.approx(0.05)
    assert (rating[4000:] == 0).all()
    assert fitted(AppearanceModel.from_features(relief, None), label, label == 1, 3) is None


@pytest.mark.parametrize("method", ["map", "geometry", "knn"])
def test_a_class_that_few_views_saw_is_not_erased(scene, method):
    """Roofs seen by one view, the rest by five: roofs would have no examples, and the raters, which would not
    know them, would call them something else.
    """
    points, normals, colors, truth, _ = scene
    evidence = evidence_of(points, colors, truth)
    evidence.seeds.num_views[truth == ROOF] = 1
    assert evidence.agreed.all()
    label = propagate(build_graph(points, normals, 16, colors), evidence, Propagate(method=method)).label
    assert (label[truth == ROOF] == ROOF).mean() > 0.98 and (label == truth).mean() > 0.98
    # one roof, too few points at all: left to the votes
    rare = (truth != ROOF) | (np.abs(points[:, :2] - 15).max(axis=1) < 4)
    points, normals, colors, truth = points[rare], normals[rare], colors[rare], truth[rare]
    label = propagate(
        build_graph(points, normals, 16, colors), evidence_of(points, colors, truth), Propagate(method=method)
    ).label
    assert (label[truth == ROOF] == ROOF).mean() > 0.95


def test_same_labels_for_any_order_unit_and_offset(scene):
    order = np.random.default_rng(5).permutation(len(scene[0]))
    for method in ("map", "geometry"):
        expected = solve(scene, Propagate(method=method))
        permuted = solve(scene, Propagate(method=method), order)
        for name in ("label", "confidence", "state", "num_views"):
            np.testing.assert_array_equal(
                getattr(expected, name)[order], getattr(permuted, name), err_msg=name
            )
        for transform in (lambda points: points * 100, lambda points: points + [5e5, 5e6, 100]):
            np.testing.assert_array_equal(
                solve(scene, Propagate(method=method), transform=transform).label, expected.label
            )
