"""Panoptic quality against the definition, written out over sets."""

from __future__ import annotations

import numpy as np
import pytest

from sc3d.panoptic import Segments, match_segments, panoptic_quality, summarize
from sc3d.scene.class_table import OTHER, parse_classes
from tests.builders import LABELLED_CLASSES

TABLE = parse_classes(LABELLED_CLASSES, "test")


def by_sets(truth: np.ndarray, found: np.ndarray, unjudged: np.ndarray) -> tuple[float, int, int, int]:
    """Kirillov et al. 2019, section 4.1: the slow twin of `match_segments`."""
    judged = set(np.flatnonzero(~unjudged).tolist())
    true = {n: set(np.flatnonzero(truth == n).tolist()) & judged for n in np.unique(truth) if n}
    whole = {n: set(np.flatnonzero(found == n).tolist()) for n in np.unique(found) if n}
    true = {n: points for n, points in true.items() if points}
    overlap, matched_true, matched_found = 0.0, set(), set()
    for a, one in true.items():
        for b, other in whole.items():
            iou = len(one & other) / len(one | (other & judged))
            if iou > 0.5:
                overlap, matched_true, matched_found = overlap + iou, matched_true | {a}, matched_found | {b}
    extra = [
        b
        for b, other in whole.items()
        if b not in matched_found and other & judged and 2 * len(other & judged) >= len(other)
    ]
    return overlap, len(matched_true), len(extra), len(true) - len(matched_true)


@pytest.mark.parametrize("seed", range(20))
def test_against_sets(seed):
    rng = np.random.default_rng(seed)
    truth = rng.integers(0, 5, 60)
    found = np.where(rng.random(60) < 0.75, truth * 7, rng.integers(0, 9, 60))
    unjudged = rng.random(60) < 0.2
    result = match_segments(truth, found, unjudged)
    overlap, *counts = by_sets(truth, found, unjudged)
    assert [result.matched, result.extra, result.missed] == counts
    assert result.overlap == pytest.approx(overlap)


def test_perfect_is_one_and_numbers_mean_nothing():
    label = np.uint8([1, 1, 1, 2, 2, 3, 3, 4, OTHER])
    instance = np.uint32([5, 5, 6, 7, 7, 0, 0, 0, 0])
    again = np.uint32([1, 1, 9, 2, 2, 0, 0, 0, 0])
    found = panoptic_quality(
        Segments(label, instance), Segments(np.where(label == OTHER, 0, label), again), TABLE
    )
    assert {number: quality.quality for number, quality in found.items()} == {1: 1, 2: 1, 3: 1, 4: 1}
    figures = summarize(found, TABLE)
    assert (figures["pq"], figures["pq_things"], figures["pq_stuff"]) == (1, 1, 1)
    assert figures["classes"]["building"] == {"pq": 1, "sq": 1, "true": 2, "found": 2, "matched": 2}


def test_what_is_found_on_other_is_extra_and_on_unjudged_points_is_not():
    true = Segments(np.uint8([1, 1, OTHER, OTHER, 2, 2]), np.uint32([1, 1, 0, 0, 0, 0]))
    found = Segments(np.uint8([1, 1, 1, 1, 1, 1]), np.uint32([1, 1, 2, 2, 3, 3]))
    quality = panoptic_quality(true, found, TABLE)[1]
    assert (quality.matched, quality.extra, quality.missed) == (1, 1, 0)
    assert quality.quality == pytest.approx(1 / 1.5)  # trees without a number are not judged
    nothing = Segments(np.zeros(6, np.uint8), np.zeros(6, np.uint32))
    assert panoptic_quality(true, nothing, TABLE)[1].quality == 0
