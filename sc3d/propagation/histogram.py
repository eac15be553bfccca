"""Joint histograms of features, from which classes are rated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

PRIOR_WEIGHT = 2.0  # points of the overall mixture added to each cell


@dataclass(frozen=True)
class Histogram:
    """The histogram cell of each point: cell (N,) int32, of prod(shape) cells; blur: standard deviation in
    bins.
    """

    cell: np.ndarray
    shape: tuple[int, ...]
    blur: float

    @classmethod
    def from_features(cls, features: np.ndarray, edges: list[np.ndarray], blur: float) -> Histogram:
        """features: (N, F); edges: per feature the inner borders of its bins."""
        cell = np.zeros(len(features), np.int32)
        for values, borders in zip(features.T, edges, strict=True):
            cell *= len(borders) + 1
            cell += np.searchsorted(borders, values, side="right").astype(np.int32)
        return cls(cell, tuple(len(borders) + 1 for borders in edges), blur)

    def count(self, label: np.ndarray, examples: np.ndarray, num_classes: int) -> np.ndarray:
        """(cells, C) int64 examples of each class; label: (N,) in 1..C at the examples (N,) bool."""
        counts = np.bincount(
            self.cell[examples].astype(np.int64) * num_classes + (label[examples] - 1),
            minlength=int(np.prod(self.shape)) * num_classes,
        )
        return counts.reshape(-1, num_classes)

    def table(self, counts: np.ndarray) -> np.ndarray:
        """(cells, C) log of the class shares in each cell, from the counts (cells, C)."""
        blurred = [
            gaussian_filter(
                part.reshape(self.shape).astype(np.float64), self.blur, mode="nearest", truncate=2.0
            )
            for part in counts.T
        ]
        smoothed = np.stack(blurred).reshape(len(blurred), -1).T + PRIOR_WEIGHT * np.maximum(
            counts.sum(axis=0) / max(counts.sum(), 1), 1e-9
        )
        return np.log(smoothed / smoothed.sum(axis=1, keepdims=True))

    def likelihood(self, counts: np.ndarray) -> np.ndarray:
        """(cells, C) float32 log-likelihood of each class, up to a number per cell, from the counts (cells,
        C).
        """
        shares = np.log(np.maximum(counts.sum(axis=0), 1) / max(counts.sum(), 1))
        return (self.table(counts) - shares).astype(np.float32)
