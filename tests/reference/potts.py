"""What mean field minimizes (eq. 8), and a slower way to minimize it whose free energy never rises."""

from __future__ import annotations

import numpy as np

from sc3d.geometry.graph import Graph
from sc3d.propagation.potts import _update


def mean_field_sequential(
    graph: Graph, log_likelihood: np.ndarray, smoothness: float, marginals: np.ndarray
) -> np.ndarray:
    """One sweep that updates one point after another in place: slower twin of a step of `mean_field` whose
    free energy never rises.
    """
    marginals = np.array(marginals, np.float32)
    field = np.empty(marginals.shape[1], np.float32)
    for i in range(len(marginals)):
        _update(
            graph.starts,
            graph.neighbors,
            graph.weights,
            log_likelihood,
            np.float32(smoothness),
            marginals,
            i,
            field,
        )
        marginals[i] = field
    return marginals


def potts_energy(graph: Graph, log_likelihood: np.ndarray, label: np.ndarray, smoothness: float) -> float:
    """The energy of a labelling; each undirected edge counts once. label: (N,) class ids from 1, canonical
    order.
    """
    marginals = np.zeros(log_likelihood.shape, np.float32)
    marginals[np.arange(len(label)), label.astype(np.int64) - 1] = 1
    return free_energy(graph, log_likelihood, marginals, smoothness)  # without entropy they are the same


def free_energy(graph: Graph, log_likelihood: np.ndarray, marginals: np.ndarray, smoothness: float) -> float:
    """Expected energy minus entropy of independent marginals (N, C): what mean field minimizes."""
    marginals = marginals.astype(np.float64)
    cost = -(np.where(marginals > 0, log_likelihood, 0) * marginals).sum()
    entropy = -(marginals * np.log(np.maximum(marginals, 1e-300))).sum()
    rows = np.repeat(np.arange(len(graph.order)), np.diff(graph.starts))
    once = rows < graph.neighbors
    rows, columns, weights = rows[once], graph.neighbors[once], graph.weights[once].astype(np.float64)
    cut = (weights * (1 - np.einsum("ec,ec->e", marginals[rows], marginals[columns]))).sum()
    return float(cost + smoothness * cut - entropy)
