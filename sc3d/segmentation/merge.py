"""Overlapping instances of one photo to one label and one confidence per pixel."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sc3d.errors import InputError


@dataclass(frozen=True)
class Instance:
    """One object that a segmenter found in a photo.

    mask: (H, W) bool
    class_id: 1 to 255
    box_score, mask_score: 0 to 1, how sure the detector is of the class and the segmenter of the outline
    """

    mask: np.ndarray
    class_id: int
    box_score: float
    mask_score: float

    @property
    def score(self) -> float:
        """Box score x mask score; mask scores are regressed and may leave 0 to 1 a little, so both are clipped."""
        return float(np.clip(self.box_score, 0, 1) * np.clip(self.mask_score, 0, 1))


def merge_instances(instances: Iterable[Instance], shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Give every pixel the class of its best instance, whatever the order of the instances.

    instances: taken one by one, so a generator keeps memory at a few bytes per pixel; those with a score of 0 or NaN are ignored
    shape: (H, W) px
    returns: (H, W) uint8 class id, 0 where there is no instance; (H, W) uint8 confidence, 1 to 255 = score 1, 0 where unlabelled
    source: highest box score x mask score wins; ties go to the smaller mask, then to the lower class id
    """
    # Each pixel keeps the number of its best instance so far; number 0 is "none", which everything beats.
    best = np.zeros(shape, np.int32)
    ranks: list[tuple[float, int, int]] = [(0.0, 0, 0)]
    for instance in instances:
        if instance.mask.shape != tuple(shape):
            raise InputError(f"a mask is {instance.mask.shape} (rows, columns), but its photo is {tuple(shape)}")
        rank = (instance.score, -int(np.count_nonzero(instance.mask)), -int(instance.class_id))
        if not rank[0] > 0:
            continue
        beaten = np.array([rank > other for other in ranks])
        best[instance.mask & beaten[best]] = len(ranks)
        ranks.append(rank)
    labels = np.array([-rank[2] for rank in ranks], np.uint8)
    # At least 1, so that a confidence of 0 always means unlabelled.
    confidences = np.array([0] + [max(1, round(255 * rank[0])) for rank in ranks[1:]], np.uint8)
    return labels[best], confidences[best]
