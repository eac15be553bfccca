"""From seeds to a label for every point that the graph connects to one."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numba
import numpy as np

from sc3d.fusion import LOCKED, PROPAGATED, SEED, UNLOCKED, Labels
from sc3d.geometry.graph import Graph, build_graph
from sc3d.propagation.front import grow, vote_nearest
from sc3d.propagation.potts import mean_field, softmax
from sc3d.propagation.rater import MIN_EXAMPLES, MIN_SKILL, Raters, relief_features
from sc3d.settings import Propagate

logger = logging.getLogger(__name__)

MAX_EVIDENCE = 5.0  # a point's votes count as at most this many
SMOOTHING = 0.25  # added to the votes of each class
TRUST = 0.5  # weight of the votes beside the raters, which see what the views' shared errors hide
AGREED_VIEWS, AGREED_SHARE = 3, 0.9  # seeds to learn from: seen by so many views, this share of their votes
SURE = 0.95  # later rounds learn from points of this probability
IMPLAUSIBLE = np.log(0.5)  # a seed whose class the raters give less is a conflict
CAUTION, SUPPORT = 0.5, 0.1  # confidence: weight of the evidence and of the neighbours; full weights would be sure everywhere


@dataclass(frozen=True)
class Evidence:
    """What is known of N points, canonical order.

    points: (N, 3) world; seeds: labels of fusion; votes: (N, num_ids) float32 or None, column 0 is ignored; colors: (N, 3) uint8 or None
    """

    points: np.ndarray
    seeds: Labels
    votes: np.ndarray | None
    colors: np.ndarray | None

    def ordered(self, order: np.ndarray) -> Evidence:
        return Evidence(self.points[order], reordered(self.seeds, order), *(None if part is None else part[order] for part in (self.votes, self.colors)))

    @property
    def start(self) -> np.ndarray:
        """(N,) uint8 labels of the seeds, 0 elsewhere."""
        return np.where(np.isin(self.seeds.state, (SEED, UNLOCKED)), self.seeds.label, 0).astype(np.uint8)

    @property
    def agreed(self) -> np.ndarray:
        """(N,) bool seeds that many views agree on; fewer views, where some class would have too few examples: to the raters it would not exist."""
        start, views = self.start, self.seeds.num_views
        sure = (self.seeds.state == SEED) & (start > 0) & (self.seeds.confidence >= AGREED_SHARE)
        wanted = np.bincount(start[sure], minlength=256) >= MIN_EXAMPLES
        for least in range(AGREED_VIEWS, 1, -1):
            examples = sure & (views >= least)
            if (np.bincount(start[examples], minlength=256)[wanted] >= MIN_EXAMPLES).all():
                return examples
        return sure

    @property
    def num_classes(self) -> int:
        return (int(self.seeds.label.max(initial=1)) + 1 if self.votes is None else self.votes.shape[1]) - 1


def tie_breakers(evidence: Evidence, normals: np.ndarray | None) -> tuple[np.ndarray, ...]:
    """Arrays (N,) that tell points of equal position apart, for `build_graph`."""
    seeds = evidence.seeds
    tables = (part for part in (evidence.votes, evidence.colors, normals) if part is not None)
    return (seeds.label, seeds.state, seeds.num_views, seeds.confidence, *(column for table in tables for column in table.T))


def complete(evidence: Evidence, normals: np.ndarray | None, settings: Propagate) -> Labels:
    """Label the points that have none, on their own neighbour graph. normals: (N, 3) unit, oriented, or None = estimated."""
    colors = evidence.colors if settings.color else None
    graph = build_graph(evidence.points, normals, settings.num_neighbors, colors, tie_breakers(evidence, normals))
    return propagate(graph, evidence, settings)


def propagate(graph: Graph, evidence: Evidence, settings: Propagate) -> Labels:
    """Label the points that have none; all arrays, given and returned, in the order of the cloud.

    geometry, knn: points of state SEED or UNLOCKED keep their label (with verify_seeds: those that look like their class)
    map: needs votes
    """
    known = evidence.ordered(graph.order)
    start = known.start
    raters = _raters(graph, known) if settings.appearance and (settings.method == "map" or settings.verify_seeds) else None
    if settings.method == "map":
        label, confidence = _map(graph, known, raters, settings)
    else:
        if settings.verify_seeds and raters is not None:
            start = _verified(known, raters)
        label, confidence = vote_nearest(known.points, start, settings.num_neighbors) if settings.method == "knn" else grow(graph, start)
    if settings.fill and (label == 0).any() and (label > 0).any():
        filled, filled_confidence = vote_nearest(known.points, label, 1)
        label, confidence = np.where(label == 0, filled, label), np.where(label == 0, 0.5 * filled_confidence, confidence)
    return reordered(_labels(known.seeds, start, label, confidence, settings), np.argsort(graph.order))


def _labels(seeds: Labels, start: np.ndarray, label: np.ndarray, confidence: np.ndarray, settings: Propagate) -> Labels:
    kept = (start > 0) & (label == start)
    doubted = np.where(np.isin(seeds.state, (SEED, UNLOCKED)) & (label == 0), LOCKED, seeds.state)
    state = np.where(kept, seeds.state, np.where(label > 0, PROPAGATED, doubted))
    confidence = np.where(label == 0, 0, np.where(kept & (settings.method != "map"), seeds.confidence, confidence))
    return Labels(label.astype(np.uint8), confidence.astype(np.float32), state.astype(np.uint8), seeds.num_views)


def _raters(graph: Graph, known: Evidence) -> Raters | None:
    """Colour and relief as raters, if they do well on agreed points that they have not seen."""
    raters = Raters.of(relief_features(graph, known.points), known.colors)
    skill = raters.skill(known.start, known.agreed, known.num_classes)
    logger.info("colour and relief avoid %.0f%% of errors on held-out agreed points%s", 100 * skill, "" if skill >= MIN_SKILL else ": not used")
    return raters if skill >= MIN_SKILL else None


def _verified(known: Evidence, raters: Raters) -> np.ndarray:
    """The seeds without those that look like another class: conflicts that all views share."""
    rating, start = raters.learn(known.start, known.agreed, known.num_classes), known.start
    given = rating[np.arange(len(start)), np.maximum(start, 1).astype(np.int64) - 1]
    return np.where((start > 0) & (given < IMPLAUSIBLE), 0, start).astype(np.uint8)


def _map(graph: Graph, known: Evidence, raters: Raters | None, settings: Propagate) -> tuple[np.ndarray, np.ndarray]:
    """Labels and confidences of the smallest Potts energy; 0 where no edge leads to a seed."""
    start, likelihood = known.start, vote_likelihood(known.votes)
    offered = np.bincount(start, minlength=likelihood.shape[1] + 1)[1:] > 0  # a class without a single seed is not offered
    if raters is None:
        likelihood[:, ~offered] = -np.inf
        grown, _ = grow(graph, start)  # else the votes would take one edge per step to reach points without any
        belief = softmax(likelihood)
        silent = np.flatnonzero(~known.votes[:, 1:].any(axis=1) & (grown > 0))
        belief[silent] = np.eye(likelihood.shape[1], dtype=np.float32)[grown[silent] - 1]
        evidence, belief = likelihood, mean_field(graph, likelihood, settings.smoothness, belief)
    else:
        label, examples = start, known.agreed
        for turn in range(max(settings.rounds, 1)):
            rating = raters.learn(label, examples, known.num_classes)
            if turn and rating is None:
                break  # too little is sure; what was learned from agreed points stands
            rating += np.float32(TRUST) * likelihood
            rating[:, ~offered], evidence = -np.inf, rating
            belief = mean_field(graph, evidence, settings.smoothness)  # afresh: a sure belief would not move
            label = (belief.argmax(axis=1) + 1).astype(np.uint8)
            examples = (belief.max(axis=1) > SURE) & (known.seeds.num_views > 0)
    label = (belief.argmax(axis=1) + 1).astype(np.uint8)
    evidence *= np.float32(CAUTION)
    cautious = mean_field(graph, evidence, SUPPORT, belief, steps=1)
    return np.where(reachable(graph, start), label, 0).astype(np.uint8), cautious[np.arange(len(label)), label.astype(np.int64) - 1]


def vote_likelihood(votes: np.ndarray) -> np.ndarray:
    """(N, C) float32 log-likelihood of the classes 1..C from the votes (N, C + 1); 0 for points without votes."""
    total = votes[:, 1:].sum(axis=1, keepdims=True)
    result = votes[:, 1:] + np.float32(SMOOTHING)
    result /= total + np.float32(SMOOTHING * (votes.shape[1] - 1))
    np.log(result, out=result)
    result *= np.minimum(1 + total, np.float32(MAX_EVIDENCE))
    result -= result.max(axis=1, keepdims=True)
    return result.astype(np.float32, copy=False)


def reachable(graph: Graph, start: np.ndarray) -> np.ndarray:
    """(N,) bool: some path of edges leads to a point whose start label is not 0."""
    return _flood(graph.starts, graph.neighbors, start > 0)


@numba.njit(cache=True)
def _flood(starts, neighbors, reached):  # noqa: ANN001, ANN202 - see reachable; changes and returns `reached` (N,) bool
    stack = np.empty(len(reached), np.int64)
    size = 0
    for i in range(len(reached)):
        if reached[i]:
            stack[size] = i
            size += 1
    while size:
        size -= 1
        i = stack[size]
        for edge in range(starts[i], starts[i + 1]):
            j = neighbors[edge]
            if not reached[j]:
                reached[j] = True
                stack[size] = j
                size += 1
    return reached


def reordered(labels: Labels, order: np.ndarray) -> Labels:
    """Labels of the points in another order: row i of the result is row order[i]."""
    return Labels(labels.label[order], labels.confidence[order], labels.state[order], labels.num_views[order])
