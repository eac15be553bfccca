"""Greedy agglomeration of a graph whose edges say how much two parts belong together (GAEC: Keuper et al.
2015, Efficient decomposition of image and mesh graphs by lifted multicuts).
"""

from __future__ import annotations

import heapq

import numpy as np


def agglomerate(count: int, edges: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(count,) int64 group of each part: the two groups with the largest weight between them become one,
    until none is above 0; equal weights are decided by the numbers of the parts, so that the order of the
    edges is nothing.

    edges: (E, 2) int parts, none to itself; weights: (E,) int, > 0 = together, < 0 = apart; parallel ones
    add up
    """
    around: list[dict[int, int]] = [{} for _ in range(count)]
    for (first, second), weight in zip(edges.tolist(), weights.tolist(), strict=True):
        around[first][second] = around[second][first] = around[first].get(second, 0) + weight
    queue = [
        (-weight, one, other) for one in range(count) for other, weight in around[one].items() if one < other
    ]
    heapq.heapify(queue)
    parent = np.arange(count)
    while queue:
        weight, one, other = heapq.heappop(queue)
        if weight >= 0:
            break
        if parent[one] != one or parent[other] != other or around[one].get(other) != -weight:
            continue  # of groups that have changed since
        parent[other] = one
        del around[one][other]
        for third, more in around[other].items():
            if third != one:
                del around[third][other]
                total = around[one].get(third, 0) + more
                around[one][third] = around[third][one] = total
                heapq.heappush(queue, (-total, min(one, third), max(one, third)))
        around[other] = {}
    while (parent[parent] != parent).any():
        parent = parent[parent]
    return parent
