"""Overall accuracy, IoU per class and mIoU against truth masks, through the first surface (paper section 4.2)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from sc3d.classes import ClassTable


@dataclass(frozen=True)
class Confusion:
    """counts: (C, C) int64 pixels, row = truth, column = prediction, indexed by class id; row 0 stays empty, column 0 = no prediction."""

    counts: np.ndarray

    @classmethod
    def of(cls, truth: np.ndarray, predicted: np.ndarray, num_ids: int) -> Confusion:
        """Count the pixels whose truth is not 0. truth, predicted: uint8 arrays of one shape."""
        judged = truth > 0
        flat = truth[judged].astype(np.int64) * num_ids + predicted[judged]
        return cls(np.bincount(flat, minlength=num_ids**2).reshape(num_ids, num_ids))

    def __add__(self, other: Confusion) -> Confusion:
        return Confusion(self.counts + other.counts)

    @property
    def present(self) -> np.ndarray:
        """Ids of the classes that the truth has."""
        return np.flatnonzero(self.counts.sum(axis=1))

    @property
    def accuracy(self) -> float:
        """OA: share of the judged pixels that are right; no prediction counts as wrong (eq. 10)."""
        total = self.counts.sum()
        return float(np.trace(self.counts) / total) if total else float("nan")

    @property
    def iou(self) -> np.ndarray:
        """(C,) intersection over union per class id; NaN where the truth has none."""
        right = np.diag(self.counts).astype(np.float64)
        union = self.counts.sum(axis=0) + self.counts.sum(axis=1) - right
        return np.where(self.counts.sum(axis=1) > 0, right / np.maximum(union, 1), np.nan)

    @property
    def mean_iou(self) -> float:
        """mIoU over the classes present (eq. 11 without its off-by-one)."""
        return float(self.iou[self.present].mean()) if len(self.present) else float("nan")

    @property
    def coverage(self) -> float:
        """Share of the judged pixels that have a prediction."""
        total = self.counts.sum()
        return float(1 - self.counts[:, 0].sum() / total) if total else float("nan")

    def summary(self, class_table: ClassTable) -> dict[str, object]:
        """JSON-ready figures; fractions, not per cent."""
        iou = self.iou
        return {
            "oa": self.accuracy,
            "miou": self.mean_iou,
            "iou": {class_table.name(label): float(iou[label]) for label in self.present},
            "coverage": self.coverage,
            "pixels": int(self.counts.sum()),
            "confusion": self.counts[1:].tolist(),
        }


def total(parts: Iterable[Confusion], num_ids: int) -> Confusion:
    """Sum of confusion matrices; empty sum = zeros."""
    return sum(parts, Confusion(np.zeros((num_ids, num_ids), np.int64)))


def depth_edge_band(depth: np.ndarray, width: float) -> np.ndarray:
    """(H, W) bool: pixels within `width` px of a depth discontinuity (a step of more than 2 % of the depth, or the end of the surface).

    depth: (H, W) range or z, inf = nothing
    """
    finite = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(finite, kernel), cv2.dilate(finite, kernel)
    edges = high - low > 0.02 * high
    if not edges.any():
        return edges
    return cv2.distanceTransform((~edges).astype(np.uint8), cv2.DIST_L2, 5) <= width
