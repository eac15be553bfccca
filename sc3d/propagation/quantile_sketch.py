"""Quantiles of clouds that come in parts: counts of values in fine steps add up, whatever the parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

DROPPED = 12  # of the 32 bits of a float32: steps of 1/2048 of a value


@dataclass(frozen=True)
class QuantileSketch:
    """How many values fall into each step. steps: (S,) int32, rising; counts: (S,) int64."""

    steps: np.ndarray
    counts: np.ndarray

    @classmethod
    def from_values(cls, values: np.ndarray) -> QuantileSketch:
        """values: (N,) float32."""
        bits = np.ascontiguousarray(values, np.float32).view(np.int32)
        return cls(*np.unique((bits ^ ((bits >> 31) & 0x7FFFFFFF)) >> DROPPED, return_counts=True))

    @classmethod
    def merge(cls, parts: list[QuantileSketch]) -> QuantileSketch:
        steps, inverse = np.unique(np.concatenate([part.steps for part in parts]), return_inverse=True)
        counts = np.zeros(len(steps), np.int64)
        np.add.at(counts, inverse.ravel(), np.concatenate([part.counts for part in parts]))
        return cls(steps, counts)

    def quantiles(self, shares: np.ndarray) -> np.ndarray:
        """(Q,) float32 lower ends of the steps below which lies each share of the values."""
        below = np.cumsum(self.counts)
        steps = (
            self.steps[
                np.searchsorted(below, np.asarray(shares) * below[-1], side="right").clip(0, len(below) - 1)
            ].astype(np.int32)
            << DROPPED
        )
        return (steps ^ ((steps >> 31) & 0x7FFFFFFF)).view(np.float32)
