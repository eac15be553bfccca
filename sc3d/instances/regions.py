"""Regions of a grid: numbered cells, which of them touch, and shapes to grow and shrink them by."""

from __future__ import annotations

import numpy as np
from scipy import sparse


def connected_cells(groups: np.ndarray, heights: np.ndarray, step: float) -> np.ndarray:
    """(H, W) int32 component from 1 of the cells of one group (from 1, 0 = no cell) whose neighbors (4)
    differ by less than `step`; 0 = no cell.
    """
    index = np.arange(groups.size).reshape(groups.shape)
    edges = []
    for a, b in neighbors():
        joined = (groups[a] > 0) & (groups[a] == groups[b])
        joined[joined] = np.abs(heights[a][joined] - heights[b][joined]) < step
        edges.append(np.stack([index[a][joined], index[b][joined]]))
    first, second = np.concatenate(edges, axis=1)
    graph = sparse.coo_matrix(
        (np.ones(len(first), np.int8), (first, second)), shape=(groups.size, groups.size)
    )
    _, component = sparse.csgraph.connected_components(graph, directed=False)
    return renumbered(np.where(groups > 0, component.reshape(groups.shape) + 1, 0))


def cells_by_number(parts: np.ndarray, count: int) -> list[np.ndarray]:
    """For each number from 1 to `count`, the flat indices of its cells."""
    order = np.argsort(parts, axis=None, kind="stable")
    ends = np.cumsum(np.bincount(parts.ravel(), minlength=count + 1))
    return [order[start:end] for start, end in zip(ends[:-1], ends[1:])]


def renumbered(parts: np.ndarray) -> np.ndarray:
    """(H, W) int32 the same parts numbered 1, 2, ... in the order of their first cells; 0 stays."""
    ids, first, inverse = np.unique(parts, return_index=True, return_inverse=True)
    order = np.argsort(np.where(ids == 0, -1, first), kind="stable")
    rank = np.empty(len(ids), np.int32)
    rank[order] = np.arange(len(ids)) + (0 if (ids == 0).any() else 1)
    return rank[inverse].reshape(parts.shape)


def neighbors() -> list[tuple[tuple[slice, slice], tuple[slice, slice]]]:
    """The cells and their right, then lower neighbors."""
    everything, first, last = slice(None), slice(None, -1), slice(1, None)
    return [((everything, first), (everything, last)), ((first, everything), (last, everything))]


def disk(radius: float) -> np.ndarray:
    """(K, K) bool: cells within `radius` cells of the middle one, and a quarter more."""
    reach = int(radius)
    return np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) <= radius + 0.25
