"""Potts energy on a neighbor graph, minimized by mean field: one fused pass over the edges per step."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np

from sc3d.geometry.graph import Graph
from sc3d.propagation.appearance import LearnedAppearance
from sc3d.propagation.labelled_points import LabelledPoints
from sc3d.propagation.region_growing import grow_regions
from sc3d.settings.labels import Propagate

MAX_EVIDENCE = 5.0  # a point's votes count as at most this many
SMOOTHING = 0.25  # added to the votes of each class
TRUST = 0.5  # weight of the votes beside the appearance, which sees what the views' shared errors hide
SURE = 0.95  # later rounds learn from points of this probability
# confidence: weight of the evidence and of the neighbors; full weights would be sure everywhere
CAUTION, SUPPORT = 0.5, 0.1
PRIOR = 0.2  # the same of what is known of none of the classes before any vote
STEPS = 10


def minimize_energy(
    graph: Graph, known: LabelledPoints, appearance: LearnedAppearance | None, settings: Propagate
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) uint8 labels of the smallest Potts energy, and (N,) float32 their confidences.

    appearance: votes beside the views; what it teaches is learned again from each round's result. None = votes alone
    """
    offered = np.bincount(known.seed_labels, minlength=known.num_classes + 1)[1:] > 0
    if appearance is not None:
        offered |= appearance.model.offers(known.num_classes)
    found, label, rounds = None, known.seed_labels, max(settings.rounds, 1)
    while appearance is not None and rounds:
        rating = appearance.log_likelihood(label)
        if rating is None:
            break  # too little is sure; what was learned before stands
        found = appearance_marginals(graph, known, offered, rating, settings)
        label = (found[1].argmax(axis=1) + 1).astype(np.uint8)
        statistics = appearance.model.statistics(label, sure_examples(found[1], known), known.num_classes)
        appearance, rounds = replace(appearance, statistics=statistics), rounds - 1
    return decided(graph, known, *(found or vote_marginals(graph, known, offered, settings)))


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
    graph: Graph, known: LabelledPoints, offered: np.ndarray, rating: np.ndarray, settings: Propagate
) -> tuple[np.ndarray, np.ndarray]:
    """The same from votes and appearance; rating: (N, C) of the appearance, overwritten."""
    rating += np.float32(TRUST) * evidence_of(known)
    rating[:, ~offered] = -np.inf
    hold_corrected(rating, known)
    return rating, mean_field(graph, rating, settings.smoothness)  # afresh: sure marginals would not move


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


def evidence_of(known: LabelledPoints) -> np.ndarray:
    """(N, C) float32 log-likelihood of all labels from the votes: of the classes among themselves, and of
    none of them against the best.
    """
    if known.rates is None:
        return vote_likelihood(known.known_votes)
    none = known.rates.log_odds(known.known_votes)
    return np.concatenate([vote_likelihood(known.known_votes[:, :-1]), none[:, None]], axis=1)


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


def softmax(values: np.ndarray) -> np.ndarray:
    """(N, C) float32 probabilities of (N, C) logarithms."""
    result = values - values.max(axis=1, keepdims=True)
    np.exp(result, out=result)
    result /= result.sum(axis=1, keepdims=True)
    return result.astype(np.float32, copy=False)


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
