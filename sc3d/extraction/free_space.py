"""Space through which other views look: no surface can be there."""

from __future__ import annotations

import cv2
import numba
import numpy as np

from sc3d.geometry.cameras import View, camera_rays
from sc3d.stereo.agreement import moved
from sc3d.stereo.pinhole_pairs import stacked, transfers

MARGIN = 0.03  # share of the depth by which a surface must lie behind to be another one
Prepared = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
AROUND = 5  # px: outlines and ground at grazing angles are not surer
MIN_COSINE = 0.08  # between ray and normal; flatter, MARGIN grows no more
STEPS = 128  # depths tried along a ray


def count_opposed(
    depth: np.ndarray, normals: np.ndarray, view: View, others: list[np.ndarray], views: list[View]
) -> np.ndarray:
    """(H, W) uint8: how many other views look through a pixel's point, as they know a surface, or sky, behind
    it.

    depth: (H, W) float32, 0 = none; normals: (H, W, 3) of any length, camera frame: seen flat, depth is less
        sure
    others: (h, w) float32 depth of the other `views`, 0 = unknown, inf = sky
    """
    counts = np.zeros(depth.shape, np.uint8)
    if others:
        directions = camera_rays(view.camera).reshape(*depth.shape, 3)
        length = np.maximum(np.linalg.norm(normals.astype(np.float32), axis=2), 1e-12)
        cosine = np.abs((directions * normals).sum(axis=2)) / length
        margin = (MARGIN / np.clip(cosine, MIN_COSINE, 1)).astype(np.float32)
        _count_opposed(depth.astype(np.float32), margin, *_prepared(view, others, views), counts)
    return counts


def farthest_free(
    far: np.ndarray,
    nearest: float,
    view: View,
    others: list[np.ndarray],
    views: list[View],
    bounded: bool = False,
) -> np.ndarray:
    """(H, W) float32: the farthest depth up to `far` through which no other view looks; 0 where everything is
    looked through, or, unless `bounded`, where nothing is behind it, so that nothing tells how far it is.

    far: (H, W) float32 depth from which to look, 0 = nowhere; nearest: depth, world units; others, views: as
        in `count_opposed`
    """
    depth = np.zeros(far.shape, np.float32)
    if others:
        prepared = _prepared(view, others, views)
        _farthest_free(far.astype(np.float32), np.float32(nearest), bounded, *prepared, depth)
    return depth


def _prepared(view: View, others: list[np.ndarray], views: list[View]) -> Prepared:
    """Nearest inverse depth around every pixel, -1 = unknown, 0 = sky; sizes; the maps of the pixels."""
    inverses = [np.where(other > 0, 1 / np.where(other > 0, other, 1), -1) for other in others]
    inverses = [cv2.dilate(inverse.astype(np.float32), np.ones((AROUND, AROUND))) for inverse in inverses]
    sizes = np.array([other.shape[::-1] for other in others], np.int64)
    return stacked(inverses), sizes, *transfers([view] * len(views), views)


@numba.njit(cache=True, inline="always")
def _looks_through(others, sizes, A, B, s, x, y, q, margin):
    """Whether view s knows something farther behind the point at pixel (x, y) with inverse depth q."""
    u, v, w = moved(A, B, s, x, y, q)
    if not (u >= 0 and v >= 0 and u < sizes[s, 0] and v < sizes[s, 1]):
        return False
    known = others[s, int(v), int(u)]
    return known >= 0 and known * w < (1 - margin) * q


@numba.njit(cache=True, parallel=True)
def _count_opposed(depth, margin, others, sizes, A, B, counts):
    height, width = depth.shape
    for row in numba.prange(height):
        for column in range(width):
            if depth[row, column] <= 0:
                continue
            x, y, q = np.float32(column + 0.5), np.float32(row + 0.5), np.float32(1 / depth[row, column])
            for s in range(len(sizes)):
                if _looks_through(others, sizes, A, B, s, x, y, q, margin[row, column]):
                    counts[row, column] += 1


@numba.njit(cache=True, parallel=True)
def _farthest_free(far, nearest, bounded, others, sizes, A, B, depth):
    height, width = far.shape
    for row in numba.prange(height):
        for column in range(width):
            if far[row, column] <= nearest:
                continue
            x, y = np.float32(column + 0.5), np.float32(row + 0.5)
            step = (far[row, column] / nearest) ** np.float32(1 / STEPS)
            # the first depth may lie on a surface behind
            q = (np.float32(1) if bounded else step) / far[row, column]
            known = bounded
            for _ in range(STEPS):
                opposed = False
                for s in range(len(sizes)):
                    if _looks_through(others, sizes, A, B, s, x, y, q, MARGIN):
                        opposed = True
                        break
                if not opposed:
                    if known:
                        depth[row, column] = 1 / q
                    break
                known = True
                q *= step
