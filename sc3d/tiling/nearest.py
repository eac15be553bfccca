"""The nearest of points that come in parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sc3d.geometry.neighbors import NeighborIndex

AT_ONCE = 200_000  # points that are searched at a time: bounds memory, not results


@dataclass
class NearestLabels:
    """What the nearest labelled point says to each of N points; of equally near ones that of the lowest row,
    whatever the order of the parts.

    origin: (3,) as in `NeighborIndex`; label: (N,) uint8, 0 = nothing yet; distance: (N,) float32 world units
    """

    points: np.ndarray
    origin: np.ndarray
    label: np.ndarray
    distance: np.ndarray
    _rows: np.ndarray

    @classmethod
    def of_points(cls, points: np.ndarray, origin: np.ndarray) -> NearestLabels:
        """Before any part. points: (N, 3) world"""
        count = len(points)
        rows = np.full(count, np.iinfo(np.int64).max)
        return cls(points, origin, np.zeros(count, np.uint8), np.full(count, np.inf, np.float32), rows)

    def add(self, points: np.ndarray, labels: np.ndarray, rows: np.ndarray) -> None:
        """A part: (K, 3) world, K >= 1, their labels (K,) and rows (K,), which rise."""
        nearest, distance = NeighborIndex(points, self.origin).nearest_first(self.points)
        told = rows[nearest]
        nearer = (distance < self.distance) | ((distance == self.distance) & (told < self._rows))
        self.label[nearer] = labels[nearest[nearer]]
        self.distance[nearer], self._rows[nearer] = distance[nearer], told[nearer]
