"""Neighborhoods of points: batched KD-tree queries, normals (eq. 5), curvature (eq. 6), spacing.

Batches go through `open3d.core.nns.NearestNeighborSearch`, the tensor form of `KDTreeFlann`.
"""

from __future__ import annotations

import numpy as np
import open3d as o3d

QUERIES_AT_ONCE = 500_000  # queries per batch: bounds memory, not results
TIES = 8  # equally near points of which the first is found


class NeighborIndex:
    """A KD-tree over (N, 3) points, world; N >= 1.

    origin: (3,) what the points are shifted by, so that UTM positions keep their precision; None = their
        first point. The parts of a cloud find the same distances, to the last bit, if their origin is the
        same.
    """

    def __init__(self, points: np.ndarray, origin: np.ndarray | None = None) -> None:
        points = np.asarray(points, np.float64)
        if len(points) == 0:
            raise ValueError("an empty cloud has no neighbors")
        self.num_points = len(points)
        self._origin = np.array(points[0] if origin is None else origin, np.float64)
        self._search = o3d.core.nns.NearestNeighborSearch(
            o3d.core.Tensor(np.ascontiguousarray(points - self._origin, np.float32))
        )
        self._search.knn_index()

    def nearest_first(self, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The nearest point of each query; of up to TIES equally near ones that of the lowest row, where
        `nearest` leaves it to the tree.

        queries: (Q, 3) world
        returns: (Q,) int32 rows; (Q,) float32 distances
        """
        rows, distances = self.nearest(queries, TIES)
        last = np.iinfo(rows.dtype).max
        return np.where(distances == distances[:, :1], rows, last).min(axis=1), distances[:, 0]

    def nearest(self, queries: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """The `count` (at most N) nearest points of each query.

        queries: (Q, 3) world
        returns: (Q, count) int32 rows, nearest first, equal distances by row; (Q, count) float32 distances
        """
        count = min(count, self.num_points)
        indices = np.empty((len(queries), count), np.int32)
        distances = np.empty((len(queries), count), np.float32)
        for start in range(0, len(queries), QUERIES_AT_ONCE):
            part = slice(start, start + QUERIES_AT_ONCE)
            local = np.ascontiguousarray(np.asarray(queries[part], np.float64) - self._origin, np.float32)
            found, squared = self._search.knn_search(o3d.core.Tensor(local), count)
            indices[part] = found.numpy().reshape(-1, count)
            distances[part] = np.sqrt(np.maximum(squared.numpy().reshape(-1, count), 0))
        return indices, distances


def point_spacing(distances: np.ndarray) -> float:
    """Sampling distance of a surface cloud: the side of the area per point, from the median distance to the
    farthest of K neighbors.

    distances: (N, K + 1) of points to themselves, column 0 = self; K = 8 or so makes grids and random samples
        agree
    returns: d_K / sqrt(K / pi), world units; 0 if all points coincide
    """
    count = distances.shape[1] - 1
    return float(np.median(distances[:, -1]) / np.sqrt(count / np.pi)) if count > 0 else 0.0


def estimate_normals(points: np.ndarray, neighbors: np.ndarray) -> np.ndarray:
    """Unit normals: eigenvector of the smallest eigenvalue of the neighborhood covariance (eq. 5); the sign
    is arbitrary.

    points: (N, 3) world; neighbors: (N, K) rows, K >= 3
    returns: (N, 3) float32
    """
    normals = np.empty((len(points), 3), np.float32)
    for start in range(0, len(points), QUERIES_AT_ONCE // 4):
        part = slice(start, start + QUERIES_AT_ONCE // 4)
        local = np.asarray(points, np.float64)[neighbors[part]]
        local -= local.mean(axis=1, keepdims=True)
        covariance = np.einsum("nki,nkj->nij", local, local) / local.shape[1]
        normals[part] = np.linalg.eigh(covariance)[1][:, :, 0]
    return normals


def orient_normals(
    points: np.ndarray, normals: np.ndarray, centers: np.ndarray, visible_from: np.ndarray | None = None
) -> np.ndarray:
    """Flip normals towards the cameras.

    points, normals: (N, 3); centers: (M, 3) camera centers, world
    visible_from: (N,) row of a camera that sees the point, -1 = none known; None or -1: the nearest camera
        center
    """
    origin = centers[0]
    nearest = NeighborIndex(centers).nearest(points, 1)[0][:, 0]
    chosen = nearest if visible_from is None else np.where(visible_from >= 0, visible_from, nearest)
    towards = (centers - origin)[chosen] - (points - origin)
    away = np.einsum("ij,ij->i", normals, towards.astype(np.float32)) < 0
    return np.where(away[:, None], -normals, normals)


def curvature(normals: np.ndarray, neighbors: np.ndarray) -> np.ndarray:
    """Dispersion of a normal against its neighbors: |n_i - mean_j n_j| (eq. 6).

    Each neighbor normal is sign-aligned with n_i, so that unoriented normals give the same value as oriented
    ones of a smooth surface.

    normals: (N, 3) unit; neighbors: (N, K) rows
    returns: (N,) float32, 0 = plane
    """
    result = np.empty(len(normals), np.float32)
    for start in range(0, len(normals), QUERIES_AT_ONCE):
        part = slice(start, start + QUERIES_AT_ONCE)
        around = normals[neighbors[part]]
        signs = np.where(np.einsum("nki,ni->nk", around, normals[part]) < 0, np.float32(-1), np.float32(1))
        result[part] = np.linalg.norm(
            normals[part] - np.einsum("nki,nk->ni", around, signs) / around.shape[1], axis=1
        )
    return result
