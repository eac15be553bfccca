"""Labels carried from seeds: eq. 9 of the paper as a front over the graph, and KNN voting, its baseline."""

from __future__ import annotations

import numba
import numpy as np

from sc3d.geometry.graph import Graph
from sc3d.geometry.neighbors import NeighborIndex

MAX_SWEEPS = 20


def grow_regions(graph: Graph, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eq. 9 iterated as a front from the seeds until nothing changes; the seeds keep their label.

    Each step labels all points next to the front at once, so the result does not depend on the order of the
    points.
    label: (N,) uint8, canonical order; returns: (N,) uint8 labels, 0 where no edge leads to a seed; (N,)
        float32 share of the winner
    """
    result, confidence = label.copy(), (label > 0).astype(np.float32)
    pending = np.flatnonzero(label == 0)
    num_ids = int(label.max(initial=0)) + 1
    while len(pending):
        best, share = vote_rows(graph, pending, result, num_ids)
        reached = best > 0
        if not reached.any():
            break
        result[pending[reached]] = best[reached]
        confidence[pending[reached]] = share[reached]
        pending = pending[~reached]
    changing = np.flatnonzero((label == 0) & (result > 0))
    # neighbors that the front reached later have their say; bounded, because parallel steps may oscillate
    for _ in range(MAX_SWEEPS):
        best, share = vote_rows(graph, changing, result, num_ids)
        moved = best != result[changing]
        result[changing], confidence[changing] = best, share
        if not moved.any():
            break
    return result, confidence


def vote_rows(
    graph: Graph, rows: np.ndarray, label: np.ndarray, num_ids: int
) -> tuple[np.ndarray, np.ndarray]:
    """(R,) uint8 label with the largest sum of weights among the neighbors of each row (0 = none labelled;
    ties: smallest id), (R,) its share.
    """
    best, share = np.zeros(len(rows), np.uint8), np.zeros(len(rows), np.float32)
    _vote(graph.starts, graph.neighbors, graph.weights, rows, label, num_ids, best, share)
    return best, share


@numba.njit(cache=True, parallel=True)
def _vote(starts, neighbors, weights, rows, label, num_ids, best, share):
    """See vote_rows."""
    for row in numba.prange(len(rows)):
        votes, total = np.zeros(num_ids, np.float32), np.float32(0)
        for edge in range(starts[rows[row]], starts[rows[row] + 1]):
            given = label[neighbors[edge]]
            if given:
                votes[given] += weights[edge]
                total += weights[edge]
        if total > 0:
            best[row] = votes.argmax()
            share[row] = votes.max() / total


def vote_nearest(points: np.ndarray, label: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """One-shot majority of the `count` nearest labelled points (ties: smallest id); labelled points keep
    theirs.

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
