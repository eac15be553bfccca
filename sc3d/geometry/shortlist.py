"""Which photos may show the same: neighbors by name, by place and by look, so that not all pairs must be
matched.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial import cKDTree

WORDS = 32  # visual words of a set
SAMPLE = 20_000  # descriptors that they are made from
BLOCK = 1024  # photos that are compared with all others at a time

Pairs = set[tuple[int, int]]  # rows, the smaller one first


def neighbors_in_order(number: int, count: int) -> Pairs:
    """Pairs of `number` photos whose rows differ by no more than `count`."""
    return {(row, row + step) for step in range(1, count + 1) for row in range(number - step)}


def neighbors_by_place(positions: dict[int, np.ndarray], count: int) -> Pairs:
    """Pairs of each photo with the `count` nearest.

    positions: (3,) of photos by row, in any unit
    """
    if len(positions) < 2:
        return set()
    rows, places = np.array(list(positions)), np.array(list(positions.values()))
    found = cKDTree(places).query(places, min(count + 1, len(rows)))[1]
    return {
        _sorted(rows[row], rows[other]) for row in range(len(rows)) for other in found[row] if row != other
    }


def neighbors_by_look(descriptors: Sequence[np.ndarray], count: int) -> Pairs:
    """Pairs of each photo with the `count` whose features are most alike on the whole: vectors of locally
    aggregated descriptors (Jegou et al. 2010) over visual words that are made of the set itself, so that no
    vocabulary has to be fetched. The same for the same photos.

    descriptors: per photo, (K, D) float32 unit vectors; a photo may have none
    """
    everything = np.concatenate(descriptors)
    if len(everything) < WORDS:
        return set()
    cv2.setRNGSeed(0)
    sample = np.ascontiguousarray(everything[:: max(1, len(everything) // SAMPLE)], np.float32)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER, 10, 0)
    words = cv2.kmeans(sample, min(WORDS, len(sample)), None, criteria, 1, cv2.KMEANS_PP_CENTERS)[2]
    vectors = np.stack([_aggregate(each, words) for each in descriptors])
    found: Pairs = set()
    for start in range(0, len(vectors), BLOCK):
        likeness = vectors[start : start + BLOCK] @ vectors.T
        rows = np.arange(len(likeness))
        likeness[rows, start + rows] = -np.inf
        best = np.argsort(-likeness, axis=1, kind="stable")[:, : min(count, len(vectors) - 1)]
        found |= {_sorted(start + row, other) for row in rows for other in best[row]}
    return found


def _aggregate(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """(words x D,) float32 unit vector."""
    total = np.zeros_like(words)
    if len(descriptors):
        nearest = np.argmax(descriptors @ words.T - 0.5 * (words**2).sum(axis=1), axis=1)
        np.add.at(total, nearest, descriptors - words[nearest])
    total = np.sign(total) * np.sqrt(np.abs(total))
    return total.ravel() / max(float(np.linalg.norm(total)), 1e-9)


def _sorted(one: int, other: int) -> tuple[int, int]:
    return int(min(one, other)), int(max(one, other))
