"""How much of each photo the others show."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sc3d.preflight.looks import GRID
from sc3d.preflight.pairs import Pair

ENOUGH = 2  # other photos that must show a place to make it a surface


@dataclass(frozen=True)
class Overlap:
    """Of N photos, by rows.

    partners: (N,) int others that show the same; best: (N,) share of the photo that the best of them shows
    covered: (N,) share that at least ENOUGH others show
    """

    partners: np.ndarray
    best: np.ndarray
    covered: np.ndarray


def overlap_of(number: int, pairs: list[Pair]) -> Overlap:
    """What two photos share is the convex hull of the points that both show: a little less than they do."""
    times = np.zeros((number, GRID, GRID), np.int32)
    partners, best = np.zeros(number, int), np.zeros(number)
    for pair in pairs:
        for row, points in ((pair.first, pair.points), (pair.second, pair.others)):
            shown = _hull(points)
            times[row] += shown
            partners[row] += 1
            best[row] = max(best[row], shown.mean())
    return Overlap(partners, best, (times >= ENOUGH).mean(axis=(1, 2)))


def _hull(points: np.ndarray) -> np.ndarray:
    """(GRID, GRID) uint8, 1 within the hull of points (K, 2), shares of width and height."""
    mask = np.zeros((GRID, GRID), np.uint8)
    corners = cv2.convexHull((points * GRID - 0.5).round().astype(np.int32).reshape(-1, 1, 2))
    return cv2.fillConvexPoly(mask, corners, 1)
