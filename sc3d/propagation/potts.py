"""Potts energy on a neighbor graph, minimized by mean field (METHOD 0.1): one fused pass over the edges per
step.
"""

from __future__ import annotations

import numba
import numpy as np

from sc3d.geometry.graph import Graph

STEPS = 10


def mean_field(
    graph: Graph,
    log_likelihood: np.ndarray,
    smoothness: float,
    start: np.ndarray | None = None,
    steps: int = STEPS,
) -> np.ndarray:
    """Minimize sum_i -log p_i(l_i) + smoothness sum_(i,j) w_ij [l_i != l_j], all points at once in each step.

    log_likelihood: (N, C) float32, column c = class id c + 1; -inf = class not offered
    start: (N, C) first belief; None = as the likelihood says
    returns: (N, C) float32 belief, rows sum to 1. Each row is summed in a fixed order: the same for any
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


def mean_field_sequential(
    graph: Graph, log_likelihood: np.ndarray, smoothness: float, marginals: np.ndarray
) -> np.ndarray:
    """One sweep that updates one point after another in place: slower twin of a step of `mean_field` whose
    free energy never rises.
    """
    marginals = np.array(marginals, np.float32)
    _sweep(graph.starts, graph.neighbors, graph.weights, log_likelihood, np.float32(smoothness), marginals)
    return marginals


def potts_energy(graph: Graph, log_likelihood: np.ndarray, label: np.ndarray, smoothness: float) -> float:
    """The energy of a labelling; each undirected edge counts once. label: (N,) class ids from 1, canonical
    order.
    """
    marginals = np.zeros(log_likelihood.shape, np.float32)
    marginals[np.arange(len(label)), label.astype(np.int64) - 1] = 1
    return free_energy(graph, log_likelihood, marginals, smoothness)  # without entropy they are the same


def free_energy(graph: Graph, log_likelihood: np.ndarray, marginals: np.ndarray, smoothness: float) -> float:
    """Expected energy minus entropy of independent beliefs (N, C): what mean field minimizes."""
    marginals = marginals.astype(np.float64)
    cost = -(np.where(marginals > 0, log_likelihood, 0) * marginals).sum()
    entropy = -(marginals * np.log(np.maximum(marginals, 1e-300))).sum()
    rows = np.repeat(np.arange(len(graph.order)), np.diff(graph.starts))
    once = rows < graph.neighbors
    rows, columns, weights = rows[once], graph.neighbors[once], graph.weights[once].astype(np.float64)
    cut = (weights * (1 - np.einsum("ec,ec->e", marginals[rows], marginals[columns]))).sum()
    return float(cost + smoothness * cut - entropy)


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


@numba.njit(cache=True)
def _sweep(starts, neighbors, weights, log_likelihood, smoothness, marginals):
    """See mean_field_sequential."""
    field = np.empty(marginals.shape[1], np.float32)
    for i in range(len(starts) - 1):
        _update(starts, neighbors, weights, log_likelihood, smoothness, marginals, i, field)
        marginals[i] = field
