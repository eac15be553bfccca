"""Overall accuracy, IoU per class and mIoU against truth masks, through the first surface (paper section
4.2).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from sc3d.scene.class_table import ClassTable


@dataclass(frozen=True)
class Confusion:
    """counts: (C, C) int64 pixels, row = truth, column = prediction, indexed by class id; row 0 stays empty,
    column 0 = no prediction.
    """

    counts: np.ndarray

    @classmethod
    def from_labels(cls, truth: np.ndarray, predicted: np.ndarray, num_ids: int) -> Confusion:
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


@dataclass(frozen=True)
class EvaluationPixels:
    """The P pixels that have truth, and the cloud point that each of them shows: found once, then every
    labelling of the cloud is judged by a look-up.

    truth: (P,) uint8 ids, never 0; rows: (P,) int32 row of the cloud, -1 = no point there; band: (P,) bool
        near a depth edge
    """

    truth: np.ndarray
    rows: np.ndarray
    band: np.ndarray

    @classmethod
    def from_photo(cls, truth: np.ndarray, rows: np.ndarray, band: np.ndarray) -> EvaluationPixels:
        """One photo. truth: (H, W) uint8, 0 = not judged; rows: (H, W) int32 as `nearest_points` returns
        them; band: (H, W) bool.
        """
        judged = truth > 0
        return cls(truth[judged], rows[judged].astype(np.int32), band[judged])

    @classmethod
    def concatenate(cls, parts: list[EvaluationPixels]) -> EvaluationPixels:
        """All pixels of several photos, in order."""
        return cls(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in ("truth", "rows", "band"))
        )

    def look_up(self, values: np.ndarray) -> np.ndarray:
        """(P,) value of the point that each pixel shows, 0 where there is none. values: (N,) per point of the
        cloud.
        """
        return np.where(self.rows >= 0, values[self.rows], values.dtype.type(0))

    def confusions(self, predicted: np.ndarray, num_ids: int) -> tuple[Confusion, Confusion]:
        """Confusion of (P,) uint8 predictions inside and outside the band; their sum is that of all pixels."""
        flat = (self.band.astype(np.int64) * num_ids + self.truth) * num_ids + predicted
        inside, outside = np.bincount(flat, minlength=2 * num_ids**2).reshape(2, num_ids, num_ids)[::-1]
        return Confusion(inside), Confusion(outside)

    def reliability(self, label: np.ndarray, confidence: np.ndarray) -> Reliability:
        """Confidence of the label at each pixel that has one, against being right. label: (N,) uint8,
        confidence: (N,) float32 per point of the cloud.
        """
        predicted = self.look_up(label)
        labelled = predicted > 0
        return reliability(self.look_up(confidence)[labelled], (predicted == self.truth)[labelled])


def depth_edge_band(depth: np.ndarray, width: float) -> np.ndarray:
    """(H, W) bool: pixels within `width` px of a depth discontinuity (a step of more than 2 % of the depth,
    or the end of the surface).

    depth: (H, W) range or z, inf = nothing
    """
    finite = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(finite, kernel), cv2.dilate(finite, kernel)
    edges = high - low > 0.02 * high
    if not edges.any():
        return edges
    return cv2.distanceTransform((~edges).astype(np.uint8), cv2.DIST_L2, 5) <= width


@dataclass(frozen=True)
class Reliability:
    """One entry per bin: confidence and accuracy (B,) float64, means over the bin, NaN where empty; count
    (B,) int64; ece: expected calibration error.

    ece = sum over bins of count / total x |confidence - accuracy|; NaN without any sample
    """

    confidence: np.ndarray
    accuracy: np.ndarray
    count: np.ndarray
    ece: float

    @classmethod
    def from_sums(cls, confidence: np.ndarray, right: np.ndarray, count: np.ndarray) -> Reliability:
        """From the sum of confidences, the number of right samples and of all samples in each bin (B,)."""
        some, total = np.where(count > 0, count, np.nan), count.sum()
        mean, accuracy = confidence / some, right / some
        ece = float(np.nansum(count * np.abs(mean - accuracy)) / total) if total else float("nan")
        return cls(mean, accuracy, count, ece)

    @classmethod
    def merge(cls, parts: list[Reliability]) -> Reliability:
        """Of all samples of several parts, one at least."""
        count = sum(part.count for part in parts)
        sums = (
            sum(
                np.nan_to_num(mean) * part.count
                for part, mean in ((part, getattr(part, name)) for part in parts)
            )
            for name in ("confidence", "accuracy")
        )
        return cls.from_sums(*sums, count)

    def summary(self) -> dict[str, object]:
        """JSON-ready figures; None for an empty bin."""
        rows = [
            None if not count else [float(mean), float(share), int(count)]
            for mean, share, count in zip(self.confidence, self.accuracy, self.count, strict=True)
        ]
        return {"ece": self.ece, "bins": rows}


def reliability(confidence: np.ndarray, right: np.ndarray, bins: int = 10) -> Reliability:
    """confidence: (N,) in [0, 1]; right: (N,) bool, was the label right; bins of equal width, 1.0 in the
    last.
    """
    if len(confidence) and (np.min(confidence) < 0 or np.max(confidence) > 1):
        raise ValueError("confidences must lie in [0, 1]")
    row = np.minimum((np.asarray(confidence, np.float64) * bins).astype(np.int64), bins - 1)
    count = np.bincount(row, minlength=bins)
    return Reliability.from_sums(
        np.bincount(row, confidence, minlength=bins),
        np.bincount(row, np.asarray(right, np.float64), minlength=bins),
        count,
    )
