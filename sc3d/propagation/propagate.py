"""From seeds to a label for every point that the graph connects to one."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numba
import numpy as np

from sc3d.geometry.graph import Graph, build_graph
from sc3d.propagation.appearance import (
    MIN_EXAMPLES,
    MIN_SKILL,
    AppearanceModel,
    AppearanceStatistics,
    folds_of,
    skill_score,
)
from sc3d.propagation.potts import mean_field, softmax
from sc3d.propagation.region_growing import grow_regions, vote_nearest
from sc3d.propagation.terrain import relief_features
from sc3d.scene.labels import LOCKED, PROPAGATED, SEED, UNLOCKED, Labels
from sc3d.settings.labels import Propagate

logger = logging.getLogger(__name__)

MAX_EVIDENCE = 5.0  # a point's votes count as at most this many
SMOOTHING = 0.25  # added to the votes of each class
TRUST = 0.5  # weight of the votes beside the raters, which see what the views' shared errors hide
AGREED_VIEWS, AGREED_SHARE = 3, 0.9  # seeds to learn from: seen by so many views, this share of their votes
SURE = 0.95  # later rounds learn from points of this probability
IMPLAUSIBLE = np.log(0.5)  # a seed whose class the raters give less is a conflict
# confidence: weight of the evidence and of the neighbors; full weights would be sure everywhere
CAUTION, SUPPORT = 0.5, 0.1


@dataclass(frozen=True)
class LabelledPoints:
    """What is known of N points, canonical order.

    points: (N, 3) world; seeds: labels of fusion; votes: (N, num_ids) float32 or None, column 0 is ignored;
        colors: (N, 3) uint8 or None
    """

    points: np.ndarray
    seeds: Labels
    votes: np.ndarray | None
    colors: np.ndarray | None

    def ordered(self, order: np.ndarray) -> LabelledPoints:
        return LabelledPoints(
            self.points[order],
            reordered(self.seeds, order),
            *(None if part is None else part[order] for part in (self.votes, self.colors)),
        )

    @property
    def start(self) -> np.ndarray:
        """(N,) uint8 labels of the seeds, 0 elsewhere."""
        return np.where(np.isin(self.seeds.state, (SEED, UNLOCKED)), self.seeds.label, 0).astype(np.uint8)

    @property
    def sure(self) -> np.ndarray:
        """(N,) bool seeds with hardly a vote against them."""
        return (self.seeds.state == SEED) & (self.start > 0) & (self.seeds.confidence >= AGREED_SHARE)

    def agreement(self, core: np.ndarray | None = None) -> np.ndarray:
        """(AGREED_VIEWS, 256) int64: sure seeds of each class that at least 1, 2, ... views saw; core: (N,)
        bool points to count, None = all.
        """
        sure, start = self.sure if core is None else self.sure & core, self.start
        return np.stack(
            [
                np.bincount(start[sure & (self.seeds.num_views >= least)], minlength=256)
                for least in range(1, AGREED_VIEWS + 1)
            ]
        )

    def agreed_by(self, least: int) -> np.ndarray:
        """(N,) bool sure seeds that at least so many views saw."""
        return self.sure & (self.seeds.num_views >= least)

    @property
    def agreed(self) -> np.ndarray:
        """(N,) bool seeds that many views agree on."""
        return self.agreed_by(views_to_agree(self.agreement()))

    @property
    def num_classes(self) -> int:
        return (int(self.seeds.label.max(initial=1)) + 1 if self.votes is None else self.votes.shape[1]) - 1


def views_to_agree(agreement: np.ndarray) -> int:
    """How many views must have seen an example: AGREED_VIEWS, or fewer, where some class would have too few
    examples, as to the raters it would not exist.

    agreement: (AGREED_VIEWS, 256) of the whole cloud
    """
    wanted = agreement[0] >= MIN_EXAMPLES
    return next(
        (
            least
            for least in range(AGREED_VIEWS, 1, -1)
            if (agreement[least - 1][wanted] >= MIN_EXAMPLES).all()
        ),
        1,
    )


def tie_breakers(evidence: LabelledPoints, normals: np.ndarray | None) -> tuple[np.ndarray, ...]:
    """Arrays (N,) that tell points of equal position apart, for `build_graph`."""
    seeds = evidence.seeds
    tables = (part for part in (evidence.votes, evidence.colors, normals) if part is not None)
    return (
        seeds.label,
        seeds.state,
        seeds.num_views,
        seeds.confidence,
        *(column for table in tables for column in table.T),
    )


def complete(evidence: LabelledPoints, normals: np.ndarray | None, settings: Propagate) -> Labels:
    """Label the points that have none, on their own neighbor graph. normals: (N, 3) unit, oriented, or None
    = estimated.
    """
    colors = evidence.colors if settings.color else None
    graph = build_graph(
        evidence.points, normals, settings.num_neighbors, colors, tie_breakers(evidence, normals)
    )
    return propagate(graph, evidence, settings)


def propagate(graph: Graph, evidence: LabelledPoints, settings: Propagate) -> Labels:
    """Label the points that have none; all arrays, given and returned, in the order of the cloud.

    geometry, knn: points of state SEED or UNLOCKED keep their label (with verify_seeds: those that look like
        their class)
    map: needs votes
    """
    known = evidence.ordered(graph.order)
    start = known.start
    learned = _learned(graph, known) if needs_appearance(settings) else None
    if settings.method == "map":
        label, confidence = _map(graph, known, learned, settings)
        label = np.where(reachable(graph, start), label, 0).astype(np.uint8)
    else:
        start = start if learned is None else verified(start, learned[0].log_likelihood(learned[1], start))
        label, confidence = spread(graph, known.points, start, settings)
    if settings.fill and (label == 0).any() and (label > 0).any():
        filled, filled_confidence = vote_nearest(known.points, label, 1)
        label, confidence = (
            np.where(label == 0, filled, label),
            np.where(label == 0, 0.5 * filled_confidence, confidence),
        )
    return reordered(final_labels(known.seeds, start, label, confidence, settings), np.argsort(graph.order))


def needs_appearance(settings: Propagate) -> bool:
    return settings.appearance and (settings.method == "map" or settings.verify_seeds)


def spread(
    graph: Graph, points: np.ndarray, start: np.ndarray, settings: Propagate
) -> tuple[np.ndarray, np.ndarray]:
    """Labels and confidences by knn or geometry; points: (N, 3), start: (N,) uint8, both in the order of the
    graph.
    """
    return (
        vote_nearest(points, start, settings.num_neighbors)
        if settings.method == "knn"
        else grow_regions(graph, start)
    )


def final_labels(
    seeds: Labels, start: np.ndarray, label: np.ndarray, confidence: np.ndarray, settings: Propagate
) -> Labels:
    kept = (start > 0) & (label == start)
    doubted = np.where(np.isin(seeds.state, (SEED, UNLOCKED)) & (label == 0), LOCKED, seeds.state)
    state = np.where(kept, seeds.state, np.where(label > 0, PROPAGATED, doubted))
    confidence = np.where(
        label == 0, 0, np.where(kept & (settings.method != "map"), seeds.confidence, confidence)
    )
    return Labels(
        label.astype(np.uint8), confidence.astype(np.float32), state.astype(np.uint8), seeds.num_views
    )


def _learned(graph: Graph, known: LabelledPoints) -> tuple[AppearanceModel, AppearanceStatistics] | None:
    """Color and relief as raters, and what the agreed points teach, if that does well on agreed points that
    it has not seen.
    """
    appearance, start, examples = (
        AppearanceModel.from_features(relief_features(graph, known.points), known.colors),
        known.start,
        known.agreed,
    )
    folds = folds_of(known.points, known.points.min(axis=0), known.points.max(axis=0))
    halves = [appearance.statistics(start, examples & (folds == fold), known.num_classes) for fold in (0, 1)]
    wrong = [appearance.errors(halves[1 - fold], start, examples & (folds == fold)) for fold in (0, 1)]
    statistics = sum_statistics(halves)
    return (appearance, statistics) if is_skillful(wrong, statistics) else None


def sum_statistics(lessons: list[AppearanceStatistics]) -> AppearanceStatistics:
    """The lesson of all parts."""
    return tuple(sum(parts) for parts in zip(*lessons, strict=True))


def is_skillful(wrong: list[int | None], statistics: AppearanceStatistics) -> bool:
    """Whether the raters do well enough; wrong: their errors on each fold held out."""
    skill = skill_score(wrong, statistics[0].sum(axis=0))
    logger.info(
        "color and relief avoid %.0f%% of errors on held-out agreed points%s",
        100 * skill,
        "" if skill >= MIN_SKILL else ": not used",
    )
    return skill >= MIN_SKILL


def verified(start: np.ndarray, rating: np.ndarray) -> np.ndarray:
    """The seeds (N,) without those that look like another class: conflicts that all views share. rating: (N,
    C)
    """
    given = rating[np.arange(len(start)), np.maximum(start, 1).astype(np.int64) - 1]
    return np.where((start > 0) & (given < IMPLAUSIBLE), 0, start).astype(np.uint8)


def _map(
    graph: Graph,
    known: LabelledPoints,
    learned: tuple[AppearanceModel, AppearanceStatistics] | None,
    settings: Propagate,
) -> tuple[np.ndarray, np.ndarray]:
    """Labels and confidences of the smallest Potts energy."""
    offered = np.bincount(known.start, minlength=known.num_classes + 1)[1:] > 0
    if learned is None:
        evidence, marginals = vote_marginals(graph, known, offered, settings)
        return decided(graph, evidence, marginals)
    (appearance, statistics), label = learned, known.start
    for turn in range(max(settings.rounds, 1)):
        rating = appearance.log_likelihood(statistics, label)
        if turn and rating is None:
            break  # too little is sure; what was learned from agreed points stands
        evidence, marginals = appearance_marginals(graph, known, offered, rating, settings)
        label = (marginals.argmax(axis=1) + 1).astype(np.uint8)
        statistics = appearance.statistics(label, examples_in(marginals, known), known.num_classes)
    return decided(graph, evidence, marginals)


def vote_marginals(
    graph: Graph, known: LabelledPoints, offered: np.ndarray, settings: Propagate
) -> tuple[np.ndarray, np.ndarray]:
    """Log-evidence and belief (N, C) from the votes alone; offered: (C,) bool, a class without a single seed
    is not.
    """
    likelihood = vote_likelihood(known.votes)
    likelihood[:, ~offered] = -np.inf
    # else the votes would take one edge per step to reach points without any
    grown, _ = grow_regions(graph, known.start)
    marginals = softmax(likelihood)
    silent = np.flatnonzero(~known.votes[:, 1:].any(axis=1) & (grown > 0))
    marginals[silent] = np.eye(likelihood.shape[1], dtype=np.float32)[grown[silent] - 1]
    return likelihood, mean_field(graph, likelihood, settings.smoothness, marginals)


def appearance_marginals(
    graph: Graph, known: LabelledPoints, offered: np.ndarray, rating: np.ndarray, settings: Propagate
) -> tuple[np.ndarray, np.ndarray]:
    """The same from votes and raters; rating: (N, C), overwritten."""
    rating += np.float32(TRUST) * vote_likelihood(known.votes)
    rating[:, ~offered] = -np.inf
    return rating, mean_field(graph, rating, settings.smoothness)  # afresh: a sure belief would not move


def examples_in(marginals: np.ndarray, known: LabelledPoints) -> np.ndarray:
    """(N,) bool points that a later round learns from."""
    return (marginals.max(axis=1) > SURE) & (known.seeds.num_views > 0)


def decided(graph: Graph, evidence: np.ndarray, marginals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) uint8 labels and (N,) float32 confidences of a belief (N, C); evidence (N, C) is overwritten."""
    label = marginals.argmax(axis=1) + 1
    evidence *= np.float32(CAUTION)
    cautious = mean_field(graph, evidence, SUPPORT, marginals, steps=1)
    return label.astype(np.uint8), cautious[np.arange(len(label)), label - 1]


def vote_likelihood(votes: np.ndarray) -> np.ndarray:
    """(N, C) float32 log-likelihood of the classes 1..C from the votes (N, C + 1); 0 for points without
    votes.
    """
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
def _flood(starts, neighbors, reached):
    """See reachable; changes and returns `reached` (N,) bool."""
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
