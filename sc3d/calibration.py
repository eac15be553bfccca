"""Does a confidence mean what it says? Reliability over bins of confidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Reliability:
    """One entry per bin: confidence and accuracy (B,) float64, means over the bin, NaN where empty; count (B,) int64; ece: expected calibration error.

    ece = sum over bins of count / total x |confidence - accuracy|; NaN without any sample
    """

    confidence: np.ndarray
    accuracy: np.ndarray
    count: np.ndarray
    ece: float

    @classmethod
    def of_sums(cls, confidence: np.ndarray, right: np.ndarray, count: np.ndarray) -> Reliability:
        """From the sum of confidences, the number of right samples and of all samples in each bin (B,)."""
        some, total = np.where(count > 0, count, np.nan), count.sum()
        mean, accuracy = confidence / some, right / some
        ece = float(np.nansum(count * np.abs(mean - accuracy)) / total) if total else float("nan")
        return cls(mean, accuracy, count, ece)

    @classmethod
    def total(cls, parts: list[Reliability]) -> Reliability:
        """Of all samples of several parts, one at least."""
        count = sum(part.count for part in parts)
        sums = (sum(np.nan_to_num(mean) * part.count for part, mean in ((part, getattr(part, name)) for part in parts)) for name in ("confidence", "accuracy"))
        return cls.of_sums(*sums, count)

    def summary(self) -> dict[str, object]:
        """JSON-ready figures; None for an empty bin."""
        rows = [None if not count else [float(mean), float(share), int(count)]
                for mean, share, count in zip(self.confidence, self.accuracy, self.count, strict=True)]
        return {"ece": self.ece, "bins": rows}


def reliability(confidence: np.ndarray, right: np.ndarray, bins: int = 10) -> Reliability:
    """confidence: (N,) in [0, 1]; right: (N,) bool, was the label right; bins of equal width, 1.0 in the last."""
    if len(confidence) and (np.min(confidence) < 0 or np.max(confidence) > 1):
        raise ValueError("confidences must lie in [0, 1]")
    row = np.minimum((np.asarray(confidence, np.float64) * bins).astype(np.int64), bins - 1)
    count = np.bincount(row, minlength=bins)
    return Reliability.of_sums(np.bincount(row, confidence, minlength=bins), np.bincount(row, np.asarray(right, np.float64), minlength=bins), count)
