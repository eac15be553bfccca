"""Neighbor graph of a cloud with the joint similarity of eq. 7 as edge weights, in a canonical order of the
points.

The points are sorted along a Morton curve first: neighbors are then near in memory, and everything computed
on the graph (nearest neighbors of equal distance, sums of floats) is the same whatever the order in which the
points came.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import scipy.sparse

from sc3d.geometry.neighbors import NeighborIndex, estimate_normals

ALPHA, BETA, GAMMA = 0.6, 0.4, 1.0  # eq. 7
RADIUS = 3.0  # edges reach this many local point spacings
SPACING_NEIGHBOR = 4  # the local spacing is the distance to this neighbor
COLOR_WIDTH = 0.1  # standard deviation of colors on one surface, of 1
ORDER_BITS = 10  # per axis, of the curve that orders the points
MORTON_BITS = 21  # per axis; three of them fit into 63 bits
POINTS_AT_ONCE = 200_000  # points whose neighbors are held twice at a time


@dataclass(frozen=True)
class Graph:
    """Symmetric graph of N points. All arrays but `order` are in canonical order.

    order: (N,) int64 row of the cloud of each point of the graph
    starts, neighbors, weights: CSR arrays (N + 1,) int64, (E,) int32, (E,) float32; every undirected edge is
        there twice
    spacings: (N,) float32 local point spacing, world units
    normals: (N, 3) float32 unit
    curvature: (N,) float32 of eq. 6; roughness: (N,) float32 mean distance of the neighbors from the tangent
        plane, over that to the farthest
    """

    order: np.ndarray
    starts: np.ndarray
    neighbors: np.ndarray
    weights: np.ndarray
    spacings: np.ndarray
    normals: np.ndarray
    curvature: np.ndarray
    roughness: np.ndarray

    @property
    def spacing(self) -> float:
        """Median local point spacing, world units."""
        return float(np.median(self.spacings))

    def sparse(self) -> scipy.sparse.csr_matrix:
        """(N, N) CSR matrix of the weights, canonical order."""
        return scipy.sparse.csr_matrix(
            (self.weights, self.neighbors, self.starts), shape=(len(self.order),) * 2
        )


def build_graph(
    points: np.ndarray,
    normals: np.ndarray | None,
    num_neighbors: int,
    colors: np.ndarray | None = None,
    ties: tuple[np.ndarray, ...] = (),
    box: tuple[np.ndarray, np.ndarray] | None = None,
) -> Graph:
    """Neighbor graph with the joint similarity of eq. 7, times that of colors where given.

    points: (N, 3) world; normals: (N, 3) unit, oriented, or None = estimated and compared up to sign; colors:
        (N, 3) uint8 or None
    ties: arrays (N,) that order points of equal position
    box: lowest and highest corner (3,) of the cloud that the points are a part of, None = of the points:
        parts of a cloud then have the edges of the whole
    Edges join points closer than RADIUS x the local spacing; a wider gap has no edge. Curvature is over the
    same neighbors.
    """
    low, high = (points.min(axis=0), points.max(axis=0)) if box is None else box
    local, scale = normalized(points, low, high), float((high - low).max()) or 1.0
    order = canonical_order(local, ties)
    local, oriented = local[order], normals is not None
    neighbors, distances = _others(local, num_neighbors)
    if normals is not None:
        normals = np.ascontiguousarray(normals[order], np.float32)
    elif neighbors.shape[1] > 2:
        normals = estimate_normals(local, neighbors)
    else:
        normals = np.tile(np.array([0, 0, 1], np.float32), (len(points), 1))
    bend, roughness = _shape(local, normals, neighbors, distances)
    reach = (
        RADIUS * np.maximum(distances[:, min(SPACING_NEIGHBOR, distances.shape[1]) - 1], 1e-12)
        if distances.shape[1]
        else np.ones(len(points))
    )
    _cut(neighbors, distances, reach.astype(np.float32))
    del distances  # as large as all the edges
    shades = (
        np.zeros((len(points), 0), np.float32)
        if colors is None
        else colors[order].astype(np.float32) / np.float32(255)
    )
    starts, columns = _link(neighbors)
    del neighbors
    weights = np.empty(starts[-1], np.float32)
    _weigh(starts, columns, normals, bend, shades, oriented, weights)
    return Graph(
        order, starts, columns, weights, (reach / RADIUS * scale).astype(np.float32), normals, bend, roughness
    )


def normalized(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(N, 3) float32 positions in the unit cube over the box from low to high (3,): the same for a world in
    other units or with an offset.
    """
    return ((np.asarray(points, np.float64) - low) / (float((high - low).max()) or 1.0)).astype(np.float32)


def canonical_order(points: np.ndarray, ties: tuple[np.ndarray, ...] = ()) -> np.ndarray:
    """(N,) int64 rows along a Morton curve; within a cell by x, y, z, then by `ties`. points: (N, 3) float32
    in the unit cube.
    """
    code = morton_codes((points * np.float32((1 << ORDER_BITS) - 1)).astype(np.int64))
    keys = (points[:, 2], points[:, 1], points[:, 0], code)
    order = np.lexsort(keys)
    moved = points[order]
    if len(ties) and (moved[1:] == moved[:-1]).all(axis=1).any():
        order = np.lexsort((*ties, *keys))
    return order


def similarity(
    normals: np.ndarray, bend: np.ndarray, rows: np.ndarray, columns: np.ndarray, oriented: bool = True
) -> np.ndarray:
    """(E,) float32 weights of eq. 7 for the edges rows-columns: alpha (1 - angle / pi) + beta exp(-gamma
    |difference of curvature|).

    Without orientation the angle is that of the lines, scaled to the same range.
    """
    return _similarities(
        np.asarray(normals, np.float32), np.asarray(bend, np.float32), rows, columns, oriented
    )


def morton_codes(cells: np.ndarray) -> np.ndarray:
    """(N,) uint64 interleaved bits of (N, 3) whole numbers of at most MORTON_BITS bits, the first of each three
    from the first column: positions on a Z-order curve.
    """
    x, y, z = (_spread_bits(column) for column in cells.T.astype(np.uint64))
    return x | y << np.uint64(1) | z << np.uint64(2)


def _spread_bits(values: np.ndarray) -> np.ndarray:
    """Two zero bits between any two of the 21 bits of (N,) uint64."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values = (values | values << np.uint64(shift)) & np.uint64(mask)
    return values


def _others(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The `count` nearest others (N, K) int32 of each point and their distances (N, K) float32: a point need
    not come first among coinciding ones.
    """
    index, count = NeighborIndex(points, np.zeros(3)), min(count, len(points) - 1)
    kept = np.empty((len(points), count), np.int32)
    lengths = np.empty(kept.shape, np.float32)
    for start in range(0, len(points), POINTS_AT_ONCE):
        part = slice(start, start + POINTS_AT_ONCE)
        _drop_self(*index.nearest(points[part], count + 1), start, kept[part], lengths[part])
    return kept, lengths


@numba.njit(cache=True, parallel=True)
def _drop_self(neighbors, distances, first, kept, lengths):
    """See _others; rows are points from `first` on."""
    for i in numba.prange(len(neighbors)):
        position = 0
        for k in range(neighbors.shape[1]):
            if neighbors[i, k] != first + i and position < kept.shape[1]:
                kept[i, position], lengths[i, position] = neighbors[i, k], distances[i, k]
                position += 1


@numba.njit(cache=True, parallel=True)
def _shape(points, normals, neighbors, distances):
    """Curvature (eq. 6, signs aligned as in `neighbors.curvature`) and roughness of each point."""
    count = neighbors.shape[1]
    bend, roughness = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    for i in numba.prange(len(points)):
        x, y, z, away = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
        for k in range(count):
            j = neighbors[i, k]
            cosine = (
                normals[i, 0] * normals[j, 0] + normals[i, 1] * normals[j, 1] + normals[i, 2] * normals[j, 2]
            )
            sign = np.float32(-1) if cosine < 0 else np.float32(1)
            x, y, z = x + sign * normals[j, 0], y + sign * normals[j, 1], z + sign * normals[j, 2]
            away += abs(
                normals[i, 0] * (points[j, 0] - points[i, 0])
                + normals[i, 1] * (points[j, 1] - points[i, 1])
                + normals[i, 2] * (points[j, 2] - points[i, 2])
            )
        if count:
            x, y, z = normals[i, 0] - x / count, normals[i, 1] - y / count, normals[i, 2] - z / count
            bend[i] = np.sqrt(x * x + y * y + z * z)
            roughness[i] = away / count / max(distances[i, count - 1], np.float32(1e-12))
    return bend, roughness


@numba.njit(cache=True)
def _edge(normals, bend, i, j, oriented):
    """Eq. 7, for one edge: alpha (1 - angle / pi) + beta exp(-gamma |difference of curvature|)."""
    cosine = normals[i, 0] * normals[j, 0] + normals[i, 1] * normals[j, 1] + normals[i, 2] * normals[j, 2]
    cosine = min(max(cosine, np.float32(-1)), np.float32(1))
    angle = np.arccos(cosine) if oriented else 2 * np.arccos(abs(cosine))
    return ALPHA * (1 - angle / np.pi) + BETA * np.exp(-GAMMA * abs(bend[i] - bend[j]))


@numba.njit(cache=True)
def _similarities(normals, bend, rows, columns, oriented):
    result = np.empty(len(rows), np.float32)
    for edge in range(len(rows)):
        result[edge] = _edge(normals, bend, rows[edge], columns[edge], oriented)
    return result


@numba.njit(cache=True, parallel=True)
def _cut(neighbors, distances, reach):
    """Neighbors out of reach become -1."""
    for i in numba.prange(len(neighbors)):
        for k in range(neighbors.shape[1]):
            if distances[i, k] > reach[i]:
                neighbors[i, k] = -1


@numba.njit(cache=True)
def _one_way(neighbors, i, k):
    """Does the other end lack this edge?"""
    for m in range(neighbors.shape[1]):
        if neighbors[neighbors[i, k], m] == i:
            return False
    return True


@numba.njit(cache=True)
def _link(neighbors):
    """CSR arrays of the union of both directions of the edges: starts (N + 1,) int64, columns (E,) int32."""
    starts = np.zeros(len(neighbors) + 1, np.int64)
    for i in range(len(neighbors)):
        for k in range(neighbors.shape[1]):
            if neighbors[i, k] >= 0:
                starts[i + 1] += 1
                if _one_way(neighbors, i, k):
                    starts[neighbors[i, k] + 1] += 1
    starts = np.cumsum(starts)
    columns, filled = np.empty(starts[-1], np.int32), starts[:-1].copy()
    for i in range(len(neighbors)):
        for k in range(neighbors.shape[1]):
            if neighbors[i, k] >= 0:
                j = neighbors[i, k]
                columns[filled[i]] = j
                filled[i] += 1
                if _one_way(neighbors, i, k):
                    columns[filled[j]] = i
                    filled[j] += 1
    return starts, columns


@numba.njit(cache=True, parallel=True)
def _weigh(starts, columns, normals, bend, shades, oriented, weights):
    """Eq. 7 times the likeness of colors; symmetric to the bit, since each end computes the same."""
    for i in numba.prange(len(starts) - 1):
        for edge in range(starts[i], starts[i + 1]):
            j, squared = columns[edge], 0.0
            for channel in range(shades.shape[1]):
                squared += (shades[i, channel] - shades[j, channel]) ** 2
            weights[edge] = _edge(normals, bend, i, j, oriented) * np.exp(-squared / (2 * COLOR_WIDTH**2))
