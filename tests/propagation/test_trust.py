"""Appearance that knows when it knows nothing: looks that say nothing or lie, votes that are right or wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sc3d.geometry.graph import Graph
from sc3d.io.clouds import read_cloud
from sc3d.labelling.label import label_scene
from sc3d.propagation.appearance import (
    MAX_OVERRULED,
    LearnedAppearance,
    count_overruled,
    learn_appearance,
    plausible,
)
from sc3d.propagation.labelled_points import LabelledPoints
from sc3d.propagation.potts import minimize_energy
from sc3d.propagation.propagate import neighbor_graph, propagate, seeds_in_channels
from sc3d.propagation.vote_evidence import count_disagreement, error_of, one_view_evidence
from sc3d.scene.labelled_cloud import read_labelled, read_votes
from sc3d.scene.labels import SEED, UNSEEN, Labels
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Label, Propagate
from sc3d.settings.synthesize import Synthesize
from sc3d.synthetic.generate import synthesize
from tests.propagation.test_appearance import ROOF, evidence_of, village


def points_with(votes: np.ndarray, num_views: np.ndarray) -> LabelledPoints:
    """Seeds of the classes with most votes; votes: (N, C + 1)."""
    label, total = votes[:, 1:].argmax(axis=1) + 1, votes[:, 1:].sum(axis=1)
    label = np.where(total > 0, label, 0).astype(np.uint8)
    share = votes[np.arange(len(votes)), label] / np.maximum(total, 1e-9)
    state = np.where(label > 0, SEED, UNSEEN).astype(np.uint8)
    seeds = Labels(label, (share * (label > 0)).astype(np.float32), state, num_views.astype(np.int32))
    return LabelledPoints(np.zeros((len(votes), 3)), seeds, votes.astype(np.float32), None)


@pytest.mark.parametrize("error", [0.02, 0.1, 0.3])
def test_how_often_a_view_is_wrong_follows_from_how_often_views_disagree(error):
    rng = np.random.default_rng(0)
    truth, num_views = rng.integers(1, 3, 40_000), rng.integers(1, 5, 40_000)
    votes = np.zeros((len(truth), 3), np.float32)
    for view in range(4):
        said = np.where(rng.uniform(size=len(truth)) < error, 3 - truth, truth)
        votes[np.arange(len(truth)), said] += np.where(view < num_views, 0.5, 0)
    known = points_with(votes, num_views)
    assert error_of(count_disagreement(known)) == pytest.approx(error, abs=0.01)
    halves = [count_disagreement(known, np.arange(len(truth)) % 2 == part) for part in (0, 1)]
    np.testing.assert_allclose(sum(halves), count_disagreement(known), atol=2)  # parts of a cloud add up


def test_votes_of_a_point_count_as_those_of_one_view():
    votes = np.float32([[0, 2, 0], [0, 0, 0.1], [0, 3, 1], [0, 0, 0]])
    found = one_view_evidence(points_with(votes, np.array([4, 1, 4, 0])), np.array([0.1, 0.2]))
    first, second = np.log(9), np.log(4)
    expected = [[0, -first], [-second, 0], [0, second / 4 - first * 3 / 4], [0, 0]]
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("colors", ["none", "one", "strange"])
def test_right_votes_stay_right_whatever_the_colors(colors):
    """Road and lawn differ in color only; with colors that say nothing they are left to the votes."""
    points, normals, given, truth = (part[::2] for part in village())
    if colors == "one":
        given = np.full_like(given, 128)
    elif colors == "strange":
        patches = np.random.default_rng(3).integers(0, 256, (8, 8, 3))
        given = patches[tuple((points[:, :2] // 12.5).astype(int).clip(0, 7).T)].astype(np.uint8)
    evidence = evidence_of(points, given, truth)
    evidence = replace(evidence, colors=None if colors == "none" else given)
    graph = neighbor_graph(evidence, normals, Propagate())
    for method in ("map", "geometry"):
        found = propagate(evidence, normals, Propagate(method=method), graph).label
        for own in (1, ROOF, 3):
            assert (found[truth == own] == own).mean() > 0.98


def test_near_perfect_votes_of_single_views_stand_against_looks_that_err():
    """Colors that overlap much; half of the points seen by one view, some by two, all right."""
    points, normals, given, truth = (part[::2] for part in village())
    rng = np.random.default_rng(1)
    given = np.clip(given + rng.normal(0, 40, given.shape), 0, 255).astype(np.uint8)
    seen = rng.uniform(size=len(truth))
    evidence = evidence_of(points, given, np.where(seen < 0.5, truth, 0).astype(np.uint8))
    evidence.seeds.num_views[:] = np.where(seen < 0.1, 2, seen < 0.5)
    found = propagate(evidence, normals, Propagate()).label
    assert (found == truth)[seen < 0.5].mean() > 0.995 and (found == truth).mean() > 0.98


def lying(scene: tuple[np.ndarray, ...]) -> tuple[Graph, LabelledPoints, LearnedAppearance]:
    """A village of right votes whose looks were learned with lawn and roof exchanged, and are believed."""
    points, normals, colors, truth = scene
    evidence = evidence_of(points, colors, truth)
    graph = neighbor_graph(evidence, normals, Propagate())
    known = evidence.ordered(graph.order)
    known, learned = learn_appearance(graph, known)
    assert learned is not None
    statistics = tuple(part[:, [1, 0, 2]] for part in learned.statistics)
    trust = replace(learned.trust, errors=np.full(3, 0.3))
    return graph, known, replace(learned, statistics=statistics, trust=trust)


def test_looks_never_overrule_most_of_the_seeds_of_a_class_that_no_view_contradicts():
    graph, known, appearance = lying(tuple(part[::2] for part in village()))
    for label in (
        plausible(known, appearance),
        minimize_energy(graph, known, appearance, Propagate())[0],
        minimize_energy(graph, known, appearance, Propagate(rounds=1))[0],
    ):
        counts = count_overruled(known, label)
        assert counts[0].sum() == len(label) and (counts[1] <= MAX_OVERRULED * counts[0]).all()


def shares(label: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """IoU, percent, of the classes that are there."""
    ids = [own for own in range(1, 5) if (truth == own).any()]
    judged = (truth > 0) & (truth <= 4)
    both = [
        ((label == own) & (truth == own)).sum() / ((label == own) & judged | (truth == own)).sum()
        for own in ids
    ]
    return 100 * np.array(both)


class Site:
    """A small synthetic site, labelled from masks of the usual errors; truth: (N,) of the points."""

    def __init__(self, path, kind: str, seed: int, mask_noise: float = 1.0) -> None:
        views = {"aerial": 12, "street": 16}[kind]
        settings = Synthesize(
            kind=kind, seed=seed, views=views, width=240, num_points=60_000, mask_noise=mask_noise
        )
        synthesize(path, settings)
        scene = Scene(path)
        label_scene(scene, Label(cloud=path / "truth.ply"))
        cloud, seeds = read_labelled(scene.seeds, "label")
        votes, self.truth = read_votes(cloud), read_cloud(path / "truth.ply").point["label"].numpy().ravel()
        assert votes is not None
        self.channels = votes.channels
        seeds = seeds_in_channels(seeds, self.channels, path)
        points, colors = cloud.point.positions.numpy().astype(np.float64), cloud.point.colors.numpy()
        self.known = LabelledPoints(points, seeds, votes.values, colors, none=self.channels.none)
        self.normals = cloud.point.normals.numpy()

    def strange_colors(self, seed: int) -> np.ndarray:
        """Fields of some color each, which have nothing to do with the classes."""
        rng = np.random.default_rng(seed)
        fields = rng.integers(30, 220, (300, 300, 3))
        place = ((self.known.points - self.known.points.min(axis=0))[:, :2] / 17).astype(int)
        strange = fields[tuple(place.T)] + rng.normal(0, 12, (len(place), 3))
        return strange.clip(0, 255).astype(np.uint8)

    def scores(self, colors: np.ndarray | None, settings: Propagate) -> np.ndarray:
        known = replace(self.known, colors=colors)
        return shares(self.channels.to_ids(propagate(known, self.normals, settings).label), self.truth)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["aerial", "street"])
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("colors", ["none", "grey", "strange"])
def test_clouds_without_telling_colors_are_no_worse_for_their_looks(tmp_path, kind, seed, colors):
    site = Site(tmp_path / "scene", kind, seed)
    grey = np.full((len(site.truth), 3), 128, np.uint8)
    given = {"none": None, "grey": grey, "strange": site.strange_colors(seed)}[colors]
    for method in ("geometry", "map"):
        with_looks = site.scores(given, Propagate(method=method))
        without = site.scores(given, Propagate(method=method, appearance=False, verify_seeds=False))
        assert (with_looks >= without - 0.3).all(), (method, with_looks, without)


@pytest.mark.slow
@pytest.mark.parametrize("mask_noise", [0.5, 1.0, 1.6])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_poor_masks_of_a_colored_site_are_cured(tmp_path, seed, mask_noise):
    site = Site(tmp_path / "scene", "aerial", seed, mask_noise)
    colors = site.known.colors
    with_looks = site.scores(colors, Propagate())
    without = site.scores(colors, Propagate(appearance=False))
    assert (with_looks > without).all() and with_looks.mean() > 95
