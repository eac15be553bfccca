"""Panoptic quality of labelled objects, by points (Kirillov et al. 2019): a segment of the truth and one
that was found match if they have more than half of their union in common.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sc3d.scene.class_table import ClassTable

MATCH = 0.5  # intersection over union above which two segments match: at most one can


@dataclass(frozen=True)
class Segments:
    """Class and object of the same N points. label: (N,) uint8 ids; instance: (N,) whole numbers, 0 = none"""

    label: np.ndarray
    instance: np.ndarray


@dataclass(frozen=True)
class ClassQuality:
    """Of one class. overlap: sum of the intersections over union of the matches; matched, extra, missed:
    segments that match, found ones without a match, true ones without
    """

    overlap: float
    matched: int
    extra: int
    missed: int

    @property
    def quality(self) -> float:
        """PQ: NaN where neither truth nor prediction has a segment."""
        total = self.matched + 0.5 * (self.extra + self.missed)
        return self.overlap / total if total else float("nan")

    @property
    def segmentation(self) -> float:
        """SQ: mean intersection over union of the matches; NaN without any."""
        return self.overlap / self.matched if self.matched else float("nan")

    def summary(self) -> dict[str, object]:
        """JSON-ready."""
        counts = {"true": self.matched + self.missed, "found": self.matched + self.extra}
        sq = self.segmentation if self.matched else None
        return {"pq": self.quality, "sq": sq, **counts, "matched": self.matched}


def panoptic_quality(truth: Segments, found: Segments, table: ClassTable) -> dict[int, ClassQuality]:
    """By id of each class that the truth has. Classes that are not counted are one segment each.

    Points of the truth with label 0, and those of a countable class without an object, are not judged: they
    count in no union, and what is found mostly on them is not extra.
    """
    things = {entry.id for entry in table if table.is_countable(entry)}
    result = {}
    for entry in table:
        if not (truth.label == entry.id).any():
            continue
        true, predicted = (
            np.where(part.label == entry.id, part.instance if entry.id in things else 1, 0)
            for part in (truth, found)
        )
        unjudged = (truth.label == 0) | (np.isin(truth.label, list(things)) & (truth.instance == 0))
        result[entry.id] = match_segments(true, predicted, unjudged)
    return result


def match_segments(truth: np.ndarray, found: np.ndarray, unjudged: np.ndarray) -> ClassQuality:
    """Of one class. truth, found: (N,) number of the segment of each point, 0 = none; unjudged: (N,) bool."""
    true_ids, true = np.unique(truth, return_inverse=True)
    found_ids, predicted = np.unique(found, return_inverse=True)
    whole = np.bincount(predicted, minlength=len(found_ids))
    true, predicted = true[~unjudged], predicted[~unjudged]
    true_sizes = np.bincount(true, minlength=len(true_ids))
    sizes = np.bincount(predicted, minlength=len(found_ids))
    pairs, common = np.unique(true * len(found_ids) + predicted, return_counts=True)
    row, column = pairs // len(found_ids), pairs % len(found_ids)
    overlap = common / (true_sizes[row] + sizes[column] - common)
    matches = (overlap > MATCH) & (true_ids[row] > 0) & (found_ids[column] > 0)
    judged = (found_ids > 0) & (sizes > 0) & (sizes >= MATCH * whole)
    judged[column[matches]] = False
    missed = (true_ids > 0) & (true_sizes > 0)
    missed[row[matches]] = False
    return ClassQuality(
        float(overlap[matches].sum()), int(matches.sum()), int(judged.sum()), int(missed.sum())
    )


def summarize(found: dict[int, ClassQuality], table: ClassTable) -> dict[str, object]:
    """JSON-ready: the mean over all classes, over those that are counted and over the others, and each
    class.
    """
    things = {entry.id for entry in table if table.is_countable(entry)}
    groups = {
        "pq": list(found.values()),
        "pq_things": [quality for label, quality in found.items() if label in things],
        "pq_stuff": [quality for label, quality in found.items() if label not in things],
    }
    means = {name: _mean(group) for name, group in groups.items()}
    return {**means, "classes": {table.name(label): quality.summary() for label, quality in found.items()}}


def _mean(found: list[ClassQuality]) -> float | None:
    """Of the classes that have a quality; None without any."""
    values = [quality.quality for quality in found if np.isfinite(quality.quality)]
    return float(np.mean(values)) if values else None
