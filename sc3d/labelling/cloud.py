"""The cloud that is to be labelled, and what must be known of the whole where it comes in parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

STEPS = 1 << 16  # of a histogram of positions, along each axis


@dataclass(frozen=True)
class CloudExtent:
    """Of a whole cloud; it decides the voxels, and the range at which a vote has full weight.

    low, high: (3,) world, box around the points; median: (3,) along each axis, to 1 / STEPS of the box
    """

    low: np.ndarray
    high: np.ndarray
    median: np.ndarray

    @classmethod
    def from_points(cls, points: np.ndarray) -> CloudExtent:
        """points: (N, 3) world."""
        low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
        return cls(low, high, histogram_median(position_histogram(points, low, high), low, high))


@dataclass(frozen=True)
class Cloud:
    """What is to be labelled.

    points: (N, 3) float64 world; normals: (N, 3) float32 unit, towards the outside, or None
    density: (N,) float32 how much matter there is, for the points' weights inside a voxel; None = all weigh the same
    whole: of the cloud that these points are a part of; None = they are all
    """

    points: np.ndarray
    normals: np.ndarray | None
    density: np.ndarray | None = None
    whole: CloudExtent | None = None

    @property
    def extent(self) -> CloudExtent:
        return self.whole or CloudExtent.from_points(self.points)


def position_histogram(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(3, STEPS) int64 points in each of the steps between low and high (3,) along each axis: counts of parts of a
    cloud add up to those of the whole.
    """
    shares = (points - low) / np.maximum(high - low, 1e-300)
    steps = np.minimum(shares * STEPS, STEPS - 1).astype(np.int32)
    return np.stack([np.bincount(column, minlength=STEPS) for column in steps.T])


def histogram_median(counts: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(3,) median position from the counts of `position_histogram`."""
    below = np.cumsum(counts, axis=1)
    step = (below < (below[:, -1:] + 1) // 2).sum(axis=1)
    return low + (step + 0.5) / STEPS * (high - low)
