"""Potts energy on a neighbor graph, minimized by mean field: one fused pass over the edges per step."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np

from sc3d.geometry.graph import Graph
from sc3d.propagation.appearance import LearnedAppearance, count_overruled, overruled
from sc3d.propagation.labelled_points import LabelledPoints
from sc3d.propagation.region_growing import grow_regions
from sc3d.propagation.trust import Trust
from sc3d.propagation.vote_evidence import evidence_of, one_view_evidence, softmax
from sc3d.settings.labels import Propagate

SURE = 0.95  # later rounds learn from points of this probability
# confidence: weight of the evidence and of the neighbors; full weights would be sure everywhere
CAUTION, SUPPORT = 0.5, 0.1
PRIOR = 0.2  # the same of what is known of none of the classes before any vote
STEPS = 10


def minimize_energy(
    graph: Graph, known: LabelledPoints, appearance: LearnedAppearance | None, settings: Propagate
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) uint8 labels of the smallest Potts energy, and (N,) float32 their confidences.

    appearance: votes beside the views; None = votes alone. Classes of which it would overrule too many seeds are left
        to the votes.
    """
    offered = np.bincount(known.seed_labels, minlength=known.num_classes + 1)[1:] > 0
    if appearance is not None:
        offered |= appearance.model.offers(known.num_classes)
    while appearance is not None:
        found = learning_marginals(graph, known, offered, appearance, settings)
        if found is None:
            break
        counts = count_overruled(known, found[1].argmax(axis=1) + 1)
        if not (too_many := overruled(counts, appearance.trust)).any():
            return decided(graph, known, *found)
        appearance = replace(appearance, trust=appearance.trust.without(too_many))
    return decided(graph, known, *vote_marginals(graph, known, offered, settings))


def learning_marginals(
    graph: Graph,
    known: LabelledPoints,
    offered: np.ndarray,
    appearance: LearnedAppearance,
    settings: Propagate,
) -> tuple[np.ndarray, np.ndarray] | None:
    """`appearance_marginals` of the last round; what the appearance teaches is learned again from each round's
    result. None if it knows no two looks.
    """
    found = None
    for _ in range(max(settings.rounds, 1)):
        rating = appearance.log_likelihood(known)
        if rating is None:
            break  # too little is sure; what was learned before stands
        found = appearance_marginals(graph, known, offered, rating, appearance.trust, settings)
        label = (found[1].argmax(axis=1) + 1).astype(np.uint8)
        statistics = appearance.model.statistics(label, sure_examples(found[1], known), known.num_classes)
        appearance = replace(appearance, statistics=statistics)
    return found


def vote_marginals(
    graph: Graph, known: LabelledPoints, offered: np.ndarray, settings: Propagate
) -> tuple[np.ndarray, np.ndarray]:
    """Log-evidence and marginals (N, C) from the votes alone; offered: (C,) bool, a class without a single seed
    is not.
    """
    likelihood = evidence_of(known)
    likelihood[:, ~offered] = -np.inf
    hold_corrected(likelihood, known)
    # else the votes would take one edge per step to reach points without any
    grown, _ = grow_regions(graph, known.seed_labels)
    marginals = softmax(likelihood)
    silent = np.flatnonzero(~known.known_votes[:, 1:].any(axis=1) & (grown > 0))
    marginals[silent] = np.eye(likelihood.shape[1], dtype=np.float32)[grown[silent] - 1]
    return likelihood, mean_field(graph, likelihood, settings.smoothness, marginals)


def appearance_marginals(
    graph: Graph,
    known: LabelledPoints,
    offered: np.ndarray,
    rating: np.ndarray,
    trust: Trust,
    settings: Propagate,
) -> tuple[np.ndarray, np.ndarray]:
    """The same from votes and appearance; rating: (N, C) of the appearance, overwritten."""
    rating += one_view_evidence(known, trust.errors)
    rating[:, ~offered] = -np.inf
    hold_corrected(rating, known)
    start = softmax(rating)  # afresh: sure marginals would not move
    split_looks(graph, known, start, trust)
    return rating, mean_field(graph, rating, settings.smoothness, start)


def split_looks(graph: Graph, known: LabelledPoints, marginals: np.ndarray, trust: Trust) -> None:
    """Between classes that look alike, make the marginals (N, C) of a point without votes, in place, say what
    the front from the seeds says: votes would take one edge per step to reach it.
    """
    if not trust.shared.any():
        return
    grown, _ = grow_regions(graph, known.seed_labels)
    silent = ~known.known_votes[:, 1:].any(axis=1)
    for own in np.flatnonzero(trust.shared):
        rows = np.flatnonzero(silent & (grown == own + 1))
        alike = np.flatnonzero(trust.look == trust.look[own])
        total = marginals[np.ix_(rows, alike)].sum(axis=1)
        marginals[np.ix_(rows, alike)] = 0
        marginals[rows, own] = total


def hold_corrected(likelihood: np.ndarray, known: LabelledPoints) -> None:
    """Make the log-likelihood (N, C), in place, certain of what people have corrected; what is none of
    the classes is no evidence of any.
    """
    label = known.seeds.label.astype(np.int64)
    likelihood[known.corrected & (label == 0)] = 0
    rows = np.flatnonzero(known.corrected & (label > 0))
    likelihood[rows] = -np.inf
    likelihood[rows, label[rows] - 1] = 0


def sure_examples(marginals: np.ndarray, known: LabelledPoints) -> np.ndarray:
    """(N,) bool points that a later round learns from."""
    is_none = known.corrected & (known.seeds.label == 0)
    return (marginals.max(axis=1) > SURE) & (known.sightings > 0) & ~is_none


def decided(
    graph: Graph, known: LabelledPoints, evidence: np.ndarray, marginals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) uint8 labels and (N,) float32 confidences of marginals (N, C); evidence (N, C) is overwritten."""
    label = marginals.argmax(axis=1) + 1
    evidence *= np.float32(CAUTION)
    if known.rates is not None:
        evidence[:, -1] += np.float32(PRIOR * known.rates.prior_odds)
    cautious = mean_field(graph, evidence, SUPPORT, marginals, steps=1)
    return label.astype(np.uint8), cautious[np.arange(len(label)), label - 1]


def mean_field(
    graph: Graph,
    log_likelihood: np.ndarray,
    smoothness: float,
    start: np.ndarray | None = None,
    steps: int = STEPS,
) -> np.ndarray:
    """Minimize sum_i -log p_i(l_i) + smoothness sum_(i,j) w_ij [l_i != l_j], all points at once in each step.

    log_likelihood: (N, C) float32, column c = class id c + 1; -inf = class not offered
    start: (N, C) first marginals; None = as the likelihood says
    returns: (N, C) float32 marginals, rows sum to 1. Each row is summed in a fixed order: the same for any
        number of threads.
    """
    marginals = softmax(log_likelihood) if start is None else np.ascontiguousarray(start, np.float32)
    other = np.empty_like(marginals)
    for _ in range(steps):
        _step(
            graph.starts,
            graph.neighbors,
            graph.weights,
            log_likelihood,
            np.float32(smoothness),
            marginals,
            other,
        )
        marginals, other = other, marginals
    return marginals


@numba.njit(cache=True)
def _update(starts, neighbors, weights, log_likelihood, smoothness, marginals, i, field):
    """Fills field (C,)."""
    for c in range(len(field)):
        field[c] = 0
    for edge in range(starts[i], starts[i + 1]):
        j, weight = neighbors[edge], weights[edge]
        for c in range(len(field)):
            field[c] += weight * marginals[j, c]
    highest = np.float32(-np.inf)
    for c in range(len(field)):
        field[c] = log_likelihood[i, c] + smoothness * field[c]
        highest = max(highest, field[c])
    total = np.float32(0)
    for c in range(len(field)):
        field[c] = np.exp(field[c] - highest)
        total += field[c]
    for c in range(len(field)):
        field[c] /= total


@numba.njit(cache=True, parallel=True)
def _step(starts, neighbors, weights, log_likelihood, smoothness, marginals, result):
    """See mean_field."""
    for i in numba.prange(len(starts) - 1):
        _update(starts, neighbors, weights, log_likelihood, smoothness, marginals, i, result[i])
