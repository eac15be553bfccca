"""Which views see the same surface as a view, from directions that differ enough to fix its depth."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree


def neighbor_views(
    tracks: list[np.ndarray] | None,
    points: np.ndarray,
    centers: np.ndarray,
    count: int = 8,
    angles: tuple[float, float] = (5.0, 30.0),
) -> list[np.ndarray]:
    """Neighbors of every view, best first.

    tracks: per view (T,) row indices into `points` of the sparse points it sees; None = unknown
    points: (N, 3) sparse points; centers: (V, 3) camera centers, the same frame
    count: how many to keep; angles: median triangulation angle allowed, degrees
    returns: per view (<= count,) int64 indices of other views. Ranked by the number of shared points among
        those whose median angle is in `angles`; a view with fewer than `count` of them is filled up by
        `nearest_views`.
    """
    centers = np.asarray(centers, np.float64)
    near = nearest_views(centers, count)
    if tracks is None:
        return near
    shared = _shared_counts(tracks, len(points))
    result = []
    for view, fallback in enumerate(near):
        candidates = np.argsort(-shared[view], kind="stable")[: 4 * count]
        candidates = candidates[(shared[view, candidates] >= 10) & (candidates != view)]
        kept = [
            other
            for other in candidates
            if angles[0] <= _median_angle(tracks, points, centers, view, other) <= angles[1]
        ][:count]
        # A fallback view must share something where tracks are known, otherwise it may look the other way.
        extra = [
            other
            for other in fallback
            if other not in kept and (shared[view, other] > 0 or not shared[view].any())
        ]
        result.append(np.array((kept + extra)[:count], np.int64))
    return result


def nearest_views(
    centers: np.ndarray, count: int = 8, distances: tuple[float, float] = (0.5, 6.0)
) -> list[np.ndarray]:
    """Neighbors by camera distance alone, nearest first, for poses without tracks.

    centers: (V, 3); distances: allowed range in units of the median distance of a camera to the nearest one,
        so that scene units do not matter
    returns: per view (<= count,) int64; if none is in range, the nearest ones at another place
    """
    centers = np.asarray(centers, np.float64)
    if len(centers) < 2:
        return [np.zeros(0, np.int64) for _ in centers]
    reach = min(len(centers), 4 * count + 1)
    gaps, order = cKDTree(centers).query(centers, k=reach)
    apart = gaps[:, 1][gaps[:, 1] > 0]
    spacing = np.median(apart) if len(apart) else 1.0
    result = []
    for view in range(len(centers)):
        others = order[view] != view
        in_range = others & (gaps[view] >= distances[0] * spacing) & (gaps[view] <= distances[1] * spacing)
        chosen = in_range if in_range.any() else others & (gaps[view] > 0)
        result.append(order[view][chosen][:count].astype(np.int64))
    return result


def _shared_counts(tracks: list[np.ndarray], num_points: int) -> np.ndarray:
    """(V, V) int number of points that two views both see; 0 on the diagonal."""
    lengths = [len(np.unique(track)) for track in tracks]
    columns = np.concatenate([np.unique(track) for track in tracks]).astype(np.int64)
    rows = np.repeat(np.arange(len(tracks)), lengths)
    seen = csr_array((np.ones(len(rows), np.int32), (rows, columns)), shape=(len(tracks), num_points))
    shared = (seen @ seen.T).toarray()
    np.fill_diagonal(shared, 0)
    return shared


def _median_angle(
    tracks: list[np.ndarray], points: np.ndarray, centers: np.ndarray, view: int, other: int
) -> float:
    """Median angle at the shared points between the directions to both cameras, degrees."""
    common = points[np.intersect1d(tracks[view], tracks[other])]
    to_view, to_other = centers[view] - common, centers[other] - common
    cosine = (to_view * to_other).sum(1) / np.maximum(
        np.linalg.norm(to_view, axis=1) * np.linalg.norm(to_other, axis=1), 1e-12
    )
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)))))


def scene_extent(centers: np.ndarray, points: np.ndarray) -> float:
    """E, world units: 1.1 x the largest distance of a camera from their mean, but at least half the median
    distance to the points. centers: (V, 3) of the cameras
    """
    middle = centers.mean(0)
    spread = np.linalg.norm(centers - middle, axis=1).max()
    return float(max(1.1 * spread, 0.5 * np.median(np.linalg.norm(points - middle, axis=1))))
