"""Which depths other views confirm: there and back through both maps."""

from __future__ import annotations

import numba
import numpy as np

from sc3d.geometry.cameras import View
from sc3d.stereo.pinhole_pairs import stacked, transfers

TOLERANCE = 1.0  # px, there and back
RELATIVE = 0.01  # of the depth


def count_agreements(
    inverse: np.ndarray,
    view: View,
    others: list[np.ndarray],
    other_views: list[View],
    looseness: float = 1.0,
) -> np.ndarray:
    """(H, W) uint8: how many other views land back within TOLERANCE px of a pixel, at the same depth within
    RELATIVE; both times `looseness`.

    inverse: (H, W) float32 inverse depths of `view`, 0 = none; others: (h, w, 3+) float32 planes q, a, b of
        the other views, any sizes: between pixel centers a plane goes on, which matters on ground at
        grazing angles
    """
    counts = np.zeros(inverse.shape, np.uint8)
    if others:
        forth = transfers([view] * len(others), other_views)
        back = transfers(other_views, [view] * len(others))
        sizes = np.array([(other.shape[1], other.shape[0]) for other in others], np.int64)
        _count(inverse, stacked(others), sizes, *forth, *back, np.float32(looseness), counts)
    return counts


@numba.njit(cache=True, inline="always")
def moved(A, B, s, x, y, q):
    """(column, row, third component) of a pixel (x, y) with inverse depth q in view s; column -1 behind it."""
    w = A[s, 2, 0] * x + A[s, 2, 1] * y + A[s, 2, 2] + B[s, 2] * q
    if w <= np.float32(1e-6):
        return np.float32(-1), np.float32(-1), w
    inverse = np.float32(1) / w
    u = (A[s, 0, 0] * x + A[s, 0, 1] * y + A[s, 0, 2] + B[s, 0] * q) * inverse
    v = (A[s, 1, 0] * x + A[s, 1, 1] * y + A[s, 1, 2] + B[s, 1] * q) * inverse
    return u, v, w


@numba.njit(cache=True, inline="always")
def continued(planes, s, u, v):
    """Inverse depth at (u, v) of the plane of the pixel there in view s, 0 = none; planes: (S, h, w, 3)."""
    row, column = np.uintp(v), np.uintp(u)
    q = planes[s, row, column, 0]
    if q <= 0:
        return np.float32(0)
    return (
        q
        + planes[s, row, column, 1] * (u - np.float32(column) - np.float32(0.5))
        + planes[s, row, column, 2] * (v - np.float32(row) - np.float32(0.5))
    )


@numba.njit(cache=True, parallel=True)
def _count(inverse, others, sizes, A, B, back_A, back_B, looseness, counts):
    height, width = inverse.shape
    for row in numba.prange(height):
        for column in range(width):
            x, y, q = np.float32(column + 0.5), np.float32(row + 0.5), inverse[row, column]
            if q <= 0:
                continue
            for s in range(len(sizes)):
                u, v, w = moved(A, B, s, x, y, q)
                if not (u >= 0 and v >= 0 and u < sizes[s, 0] and v < sizes[s, 1]):
                    continue
                found = continued(others, s, u, v)
                if found <= 0 or abs(found * w / q - 1) > looseness * RELATIVE:
                    continue
                u, v, w = moved(back_A, back_B, s, u, v, found)
                if w > 1e-6 and (u - x) ** 2 + (v - y) ** 2 < (looseness * TOLERANCE) ** 2:
                    counts[row, column] += 1
