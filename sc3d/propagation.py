"""Complete the labels along the geometry (paper section 3.4): KNN voting, eq. 7-9 as a front, Potts by mean field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from sc3d.fusion import PROPAGATED, SEED, UNLOCKED, Labels
from sc3d.geometry.neighbors import NeighborIndex, curvature, estimate_normals
from sc3d.settings import Propagate

ALPHA, BETA, GAMMA = 0.6, 0.4, 1.0  # eq. 7
NORMAL_NEIGHBORS = 30
RADIUS = 3.0  # edges reach this many local point spacings
MAX_SWEEPS = 20
MEAN_FIELD_STEPS = 10


@dataclass(frozen=True)
class Graph:
    """Symmetric neighbour graph of N points.

    weights: (N, N) CSR float32, eq. 7 (times colour similarity where colours were given)
    index: KD-tree over the points
    """

    weights: scipy.sparse.csr_matrix
    index: NeighborIndex


def build_graph(points: np.ndarray, normals: np.ndarray | None, num_neighbors: int, colors: np.ndarray | None = None) -> Graph:
    """Neighbour graph with the joint similarity of eq. 7.

    points: (N, 3) world; normals: (N, 3) unit, oriented, or None = estimated and compared up to sign; colors: (N, 3) uint8 or None
    Edges join points closer than RADIUS x the local spacing (distance to the 4th neighbour); a wider gap has no edge.
    """
    index = NeighborIndex(points)
    neighbors, distances = index.nearest(points, NORMAL_NEIGHBORS + 1)
    oriented = normals is not None
    if not oriented:
        normals = estimate_normals(points, neighbors) if neighbors.shape[1] > 3 else np.tile(np.float32([0, 0, 1]), (len(points), 1))
    bend = curvature(normals, neighbors[:, 1:]) if neighbors.shape[1] > 1 else np.zeros(len(points), np.float32)
    neighbors, distances = neighbors[:, 1 : num_neighbors + 1], distances[:, 1 : num_neighbors + 1]
    spacing = np.maximum(distances[:, min(3, distances.shape[1] - 1)], 1e-12) if distances.shape[1] else np.ones(len(points))
    rows = np.repeat(np.arange(len(points), dtype=np.int32), neighbors.shape[1])
    near = (distances <= RADIUS * spacing[:, None]).ravel()
    rows, columns = rows[near], neighbors.ravel()[near]
    weights = similarity(normals, bend, rows, columns, oriented)
    if colors is not None:
        difference = (colors[rows].astype(np.float32) - colors[columns]) / 255
        weights = weights * np.exp(-np.einsum("ij,ij->i", difference, difference) / (2 * 0.1**2))
    matrix = scipy.sparse.csr_matrix((weights, (rows, columns)), shape=(len(points), len(points)))
    return Graph(matrix.maximum(matrix.T).tocsr(), index)


def similarity(normals: np.ndarray, bend: np.ndarray, rows: np.ndarray, columns: np.ndarray, oriented: bool = True) -> np.ndarray:
    """(E,) float32 weights of eq. 7 for the edges rows-columns: alpha (1 - angle / pi) + beta exp(-gamma |difference of curvature|).

    Without orientation the angle is that of the lines, scaled to the same range.
    """
    cosine = np.clip(np.einsum("ij,ij->i", normals[rows], normals[columns]), -1, 1)
    angle = np.arccos(cosine) if oriented else 2 * np.arccos(np.abs(cosine))
    return (ALPHA * (1 - angle / np.pi) + BETA * np.exp(-GAMMA * np.abs(bend[rows] - bend[columns]))).astype(np.float32)


def propagate(points: np.ndarray, graph: Graph, seeds: Labels, likelihood: np.ndarray | None, settings: Propagate) -> Labels:
    """Label the points that have none.

    seeds: labels from fusion; points of state SEED or UNLOCKED keep theirs (knn, geometry)
    likelihood: (N, num_ids) votes per class, for `map`; column 0 is ignored
    """
    fixed = np.isin(seeds.state, (SEED, UNLOCKED)) & (seeds.label > 0)
    start = np.where(fixed, seeds.label, 0).astype(np.uint8)
    if settings.method == "knn":
        label, confidence = vote_nearest(points, start, settings.num_neighbors)
    elif settings.method == "geometry":
        label, confidence = grow(graph.weights, start)
    else:
        grown, _ = grow(graph.weights, start)  # points without votes start from the front's label; votes would take one edge per step to reach them
        first = np.where(likelihood[:, 1:].any(axis=1), 0, grown)
        label, _ = mean_field(graph.weights, _log_likelihood(likelihood, start), settings.smoothness, first)
        label = np.where(grown > 0, label, 0)
        confidence = vote_support(graph.weights, likelihood, label)
    if settings.fill and (label == 0).any() and (label > 0).any():
        filled, filled_confidence = vote_nearest(points, label, 1)
        label, confidence = np.where(label == 0, filled, label), np.where(label == 0, 0.5 * filled_confidence, confidence)
    kept = fixed & (label == start)
    state = np.where(kept, seeds.state, np.where(label > 0, PROPAGATED, seeds.state))
    confidence = np.where(label == 0, 0, np.where(kept & (settings.method != "map"), seeds.confidence, confidence))
    return Labels(label.astype(np.uint8), confidence.astype(np.float32), state.astype(np.uint8), seeds.num_views)


def vote_nearest(points: np.ndarray, label: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """One-shot majority of the `count` nearest labelled points (ties: smallest id); labelled points keep theirs.

    label: (N,) uint8; returns (N,) uint8 labels, (N,) float32 share of the winner
    """
    open_rows = np.flatnonzero(label == 0)
    known = np.flatnonzero(label)
    result, confidence = label.copy(), (label > 0).astype(np.float32)
    if not len(known) or not len(open_rows):
        return result, confidence
    nearest, _ = NeighborIndex(points[known]).nearest(points[open_rows], count)
    votes = np.zeros((len(open_rows), int(label.max()) + 1), np.int32)
    np.add.at(votes, (np.arange(len(open_rows))[:, None], label[known][nearest]), 1)
    result[open_rows] = votes.argmax(axis=1)
    confidence[open_rows] = votes.max(axis=1) / nearest.shape[1]
    return result, confidence


def grow(weights: scipy.sparse.csr_matrix, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eq. 9 iterated as a front from the seeds until nothing changes; the seeds keep their label.

    Each step labels all points next to the front at once, so the result does not depend on the order of the points.
    weights: (N, N) CSR; label: (N,) uint8
    returns: (N,) uint8 labels, 0 where no edge leads to a seed; (N,) float32 share of the winner
    """
    result, confidence = label.copy(), (label > 0).astype(np.float32)
    pending = np.flatnonzero(label == 0)
    while len(pending):
        votes = _votes(weights, pending, result)
        reached = votes.sum(axis=1) > 0
        if not reached.any():
            break
        result[pending[reached]] = votes[reached].argmax(axis=1)
        pending = pending[~reached]
    changing = np.flatnonzero((label == 0) & (result > 0))
    for _ in range(MAX_SWEEPS):  # neighbours that the front reached later have their say; bounded, because parallel steps may oscillate
        votes = _votes(weights, changing, result)
        best = votes.argmax(axis=1).astype(np.uint8)
        moved = best != result[changing]
        result[changing] = best
        if len(changing):
            confidence[changing] = votes.max(axis=1) / np.maximum(votes.sum(axis=1), 1e-12)
        if not moved.any():
            break
    return result, confidence


def mean_field(
    weights: scipy.sparse.csr_matrix, log_likelihood: np.ndarray, smoothness: float, start: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Minimise the Potts energy sum_i -log p_i(l_i) + smoothness sum_(i,j) w_ij [l_i != l_j] by mean field (METHOD 0.1).

    log_likelihood: (N, C) float32, column 0 = -inf
    start: (N,) first labels of points, 0 = as the likelihood says
    returns: (N,) uint8 labels, (N,) float32 probability of each
    """
    belief = _softmax(log_likelihood)
    if start is not None:
        given = np.flatnonzero(start)
        belief[given] = 0
        belief[given, start[given]] = 1
    for _ in range(MEAN_FIELD_STEPS):
        belief = _softmax(log_likelihood + smoothness * (weights @ belief))
    label = belief.argmax(axis=1)
    return label.astype(np.uint8), belief[np.arange(len(label)), label]


def vote_support(weights: scipy.sparse.csr_matrix, votes: np.ndarray, label: np.ndarray) -> np.ndarray:
    """(N,) share of the votes for a point's label: the mean of its own share and its neighbours', of whichever have votes; 0.5 where none has.

    The probabilities of `mean_field` are no confidence: they are near 1 almost everywhere.
    """
    total = votes[:, 1:].sum(axis=1, keepdims=True)
    shares = votes / np.maximum(total, 1e-12)
    rows, seen = np.arange(len(label)), (total[:, 0] > 0).astype(np.float32)
    around, weight = (weights @ shares)[rows, label], weights @ seen
    parts = np.stack([shares[rows, label] * seen, around / np.maximum(weight, 1e-12)])
    counted = np.stack([seen, weight > 0])
    return np.where(counted.any(axis=0), parts.sum(axis=0) / np.maximum(counted.sum(axis=0), 1), 0.5).astype(np.float32)


def potts_energy(weights: scipy.sparse.csr_matrix, log_likelihood: np.ndarray, label: np.ndarray, smoothness: float) -> float:
    """The energy that `mean_field` minimises; each undirected edge counts once."""
    edges = scipy.sparse.triu(weights, 1).tocoo()
    cut = edges.data[label[edges.row] != label[edges.col]].sum(dtype=np.float64)
    return float(-log_likelihood[np.arange(len(label)), label].sum(dtype=np.float64) + smoothness * cut)


def _votes(weights: scipy.sparse.csr_matrix, rows: np.ndarray, label: np.ndarray) -> np.ndarray:
    one_hot = np.zeros((len(label), int(label.max(initial=0)) + 1), np.float32)
    one_hot[np.arange(len(label)), label] = 1
    one_hot[:, 0] = 0
    return weights[rows] @ one_hot


def _log_likelihood(votes: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Votes per class as log-likelihoods; points without votes are undecided."""
    strength = np.asarray(votes, np.float32).copy()
    strength[:, 0] = 0
    absent = np.ones(strength.shape[1], bool)
    absent[np.unique(start)] = False  # a class without a single seed is not offered
    smoothed = np.log((strength + 0.25) / (strength.sum(axis=1, keepdims=True) + 0.25 * (strength.shape[1] - 1)))
    smoothed = smoothed * np.minimum(1 + strength.sum(axis=1, keepdims=True), 5)
    smoothed[:, absent] = -np.inf
    smoothed[:, 0] = -np.inf
    return smoothed


def _softmax(values: np.ndarray) -> np.ndarray:
    shifted = np.exp(values - values.max(axis=1, keepdims=True))
    return shifted / shifted.sum(axis=1, keepdims=True)
