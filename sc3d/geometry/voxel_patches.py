"""What a ray hits inside a voxel: the plane of the voxel's own points, so that ranges are finer than
voxels.

A voxel with few points and few around it is a floater and blocks nothing; an empty one amid the points of a plane
is a gap and gets that plane. Sums are integers relative to the voxel, so patches depend neither on the order of
the points nor on where the world's zero is. In the kernels, loops over k = 0..26 visit a voxel and the 26 around
it; k = 13 is the voxel itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np

from sc3d.geometry.voxels import (
    BLOCK,
    FIXED,
    ORIGIN_SHIFT,
    SIDES,
    NumberedVoxels,
    VoxelIndex,
    find_voxel,
    normal_sides,
    sort_by_voxel,
    voxel_key,
    voxel_position,
)

MIN_POINTS = 3  # in a voxel: never a floater
MIN_SUPPORT = 5  # points in a voxel and the 26 around it; fewer: a floater
# planes reach this far beyond their voxel, in voxels, so that no ray slips through between two of them ...
SLACK = 0.25
MARGIN = 0.25  # ... and this far beyond its outermost points where no voxel goes on
SAME = 0.7  # cosine between normals of one surface
COHERENT = 0.85  # length of the mean normal around a gap
GAP_VOXELS = 3  # voxels around a gap that agree on its plane
# their points' mean is at most this far from the gap, in voxels along the plane: nothing grows beyond an edge
GAP_CENTER = 0.75


@dataclass(frozen=True)
class Patches:
    """What blocks rays in each of V voxels, one patch per side.

    keys: (V,) int64 voxel keys, rising; grid: the voxels, numbered; index: the same for kernels
    shapes: (V, 2, 12) float32 in voxels from the voxel's corner: mean of the points, unit normal, lowest and
        highest corner of a box that clips the plane.
    Mean NaN = no points on this side; normal 0 = the points scatter (leaves, edges): a ray that meets the box
    is stopped beside their mean.
    """

    keys: np.ndarray
    grid: NumberedVoxels
    index: VoxelIndex
    shapes: np.ndarray

    @classmethod
    def from_shapes(
        cls, keys: np.ndarray, shapes: np.ndarray, voxel_size: float, origin: np.ndarray
    ) -> Patches:
        """keys: (V,) int64 voxel keys, rising; shapes: (V, 2, 12), shared; origin: (3,) world zero of the grid."""
        grid = NumberedVoxels.from_keys(keys, voxel_size, origin)
        return cls(keys, grid, grid.index(), shapes)


def patch_origin(low: np.ndarray, voxel_size: float) -> np.ndarray:
    """(3,) world zero of the grid of a cloud whose smallest coordinates are `low` (3,): there is room for the
    voxels around those with points.
    """
    return np.asarray(low, np.float64) - (BLOCK + ORIGIN_SHIFT) * voxel_size


def surface_patches(
    points: np.ndarray, normals: np.ndarray, voxel_size: float, low: np.ndarray | None = None
) -> Patches:
    """The patches of a cloud. points: (N, 3) float64 world, N >= 1; normals: (N, 3) float32 unit, towards the
    outside; low: (3,) of the whole cloud that they are part of, None = their own.
    """
    points, normals = np.ascontiguousarray(points, np.float64), np.ascontiguousarray(normals, np.float32)
    origin = patch_origin(points.min(axis=0) if low is None else low, voxel_size)
    sorting = sort_by_voxel(points, voxel_size, origin)
    sides, flat = normal_sides(normals, sorting)
    keys, order = sorting.keys, sorting.order
    moments, shapes = (
        np.zeros((len(keys), SIDES, 7), np.int64),
        np.full((len(keys), SIDES, 12), np.nan, np.float32),
    )
    positions = points[order]
    positions -= origin
    positions /= voxel_size
    sum_up((positions, normals[order]), sides[order], sorting.starts, keys, moments, shapes)
    del positions
    shapes[~flat, :, 3:6] = 0
    supported = np.empty(len(keys), np.bool_)
    matter, index = Matter(keys, moments, flat), NumberedVoxels.from_keys(keys, voxel_size, origin).index()
    support(matter, index, supported)
    gaps, planes = _gaps(matter, index)
    keys, flat = np.append(keys[supported], gaps), np.append(flat[supported], np.ones(len(gaps), np.bool_))
    rising = np.argsort(keys)
    keys, shapes = keys[rising], np.concatenate([shapes[supported], planes])[rising]
    patches = Patches.from_shapes(keys, shapes, voxel_size, origin)
    widen(keys, patches.index, flat[rising], shapes)
    return patches


def _gaps(matter: Matter, index: VoxelIndex) -> tuple[np.ndarray, np.ndarray]:
    """(G,) keys of the voxels without points that a plane goes through, and its (G, 2, 12) shapes."""
    around = np.zeros((len(matter.keys), 27), np.int64)
    empty_around(matter, index, around)
    keys, counts = np.unique(around[around > 0], return_counts=True)
    keys = keys[counts >= GAP_VOXELS]
    closed, shapes = np.zeros(len(keys), np.bool_), np.full((len(keys), SIDES, 12), np.nan, np.float32)
    close_gaps(matter, index, keys, closed, shapes)
    return keys[closed], shapes[closed]


class Matter(NamedTuple):
    """What is in the V voxels that hold points, for kernels; `index` is their `VoxelIndex` everywhere.

    keys: (V,) int64 voxel keys
    moments: (V, 2, 7) int64 of each side: number of points, sums of their positions (from the voxel's corner,
        in voxels) and normals, in FIXED
    flat: (V,) bool as in `normal_sides`
    """

    keys: np.ndarray
    moments: np.ndarray
    flat: np.ndarray


@numba.njit(parallel=True, cache=True)
def sum_up(vectors, sides, starts, keys, moments, shapes):
    """Fill moments as in Matter and shapes (V, 2, 12) as in `Patches`, with boxes that just hold the points.

    vectors: positions (N, 3) float64 in voxels from the grid's zero, and normals (N, 3) float32; points
        sorted by voxel
    """
    positions, normals = vectors
    for voxel in numba.prange(len(keys)):
        corner = voxel_position(keys[voxel])
        for k in range(starts[voxel], starts[voxel + 1]):
            moment, shape = moments[voxel, sides[k]], shapes[voxel, sides[k]]
            for axis, start in enumerate(corner):
                local = positions[k, axis] - start
                moment[1 + axis] += np.int64(local * FIXED)
                moment[4 + axis] += np.int64(np.float64(normals[k, axis]) * FIXED)
                shape[6 + axis] = min(shape[6 + axis], local) if moment[0] > 0 else local
                shape[9 + axis] = max(shape[9 + axis], local) if moment[0] > 0 else local
            moment[0] += 1
        for side in range(SIDES):
            if moments[voxel, side, 0] > 0:
                _write_plane(moments[voxel, side], shapes[voxel, side])


@numba.njit(parallel=True, cache=True)
def support(matter, index, supported):
    """supported (V,): has a voxel points enough, alone or with those around it?"""
    for voxel in numba.prange(len(matter.keys)):
        x, y, z = voxel_position(matter.keys[voxel])
        num_around = 0
        for k in range(27):
            row = find_voxel(index, x + k % 3 - 1, y + k // 3 % 3 - 1, z + k // 9 - 1)
            num_around += matter.moments[row, :, 0].sum() if row >= 0 else 0
        supported[voxel] = matter.moments[voxel, :, 0].sum() >= MIN_POINTS or num_around >= MIN_SUPPORT


@numba.njit(parallel=True, cache=True)
def empty_around(matter, index, found):
    """found (V, 27): keys of the voxels without points around each flat one, 0 = none."""
    for voxel in numba.prange(len(matter.keys)):
        x, y, z = voxel_position(matter.keys[voxel])
        for k in range(27 if matter.flat[voxel] else 0):
            ax, ay, az = x + k % 3 - 1, y + k // 3 % 3 - 1, z + k // 9 - 1
            if find_voxel(index, ax, ay, az) < 0:
                found[voxel, k] = voxel_key(ax, ay, az)


@numba.njit(parallel=True, cache=True)
def close_gaps(matter, index, keys, closed, shapes):
    """closed (C,): does a voxel without points lie amid points of one plane that crosses it? Then shapes (C,
    2, 12) gets that plane.
    """
    for row in numba.prange(len(keys)):
        total, shape = np.zeros(7, np.int64), shapes[row, 0]
        if (
            _sum_around(matter, index, keys[row], total) < GAP_VOXELS
            or total[0] < MIN_SUPPORT
            or _write_plane(total, shape) < COHERENT
        ):
            continue
        offset, normal = shape[:3].astype(np.float64) - 0.5, shape[3:6].astype(np.float64)
        away = (offset * normal).sum()
        closed[row] = (
            abs(away) <= 0.5 * np.abs(normal).sum() and _length(offset - away * normal) <= GAP_CENTER
        )
        shape[6:9], shape[9:] = -SLACK, 1 + SLACK


@numba.njit(cache=True)
def _sum_around(matter, index, key, total):
    """Add to total (7,) the moments of the flat voxels around `key` whose sides face as the fullest of them
    does; returns the number of sides.
    """
    x, y, z = voxel_position(key)
    rows, reference, most, num = np.full(27, -1, np.int64), np.zeros(3), 0, 0
    for k in range(27):
        row = find_voxel(index, x + k % 3 - 1, y + k // 3 % 3 - 1, z + k // 9 - 1)
        if row < 0 or not matter.flat[row]:
            continue
        rows[k] = row
        for side in range(SIDES):
            if matter.moments[row, side, 0] > most:
                most = matter.moments[row, side, 0]
                reference[:] = matter.moments[row, side, 4:]
    reference /= _length(reference)
    for k in range(27):
        for side in range(SIDES if rows[k] >= 0 else 0):
            moment = matter.moments[rows[k], side]
            if moment[0] == 0 or (moment[4:] * reference).sum() < SAME * _length(moment[4:]):
                continue
            total += moment
            for axis, step in enumerate((k % 3 - 1, k // 3 % 3 - 1, k // 9 - 1)):
                total[1 + axis] += step * FIXED * moment[0]
            num += 1
    return num


@numba.njit(parallel=True, cache=True)
def widen(keys, index, flat, shapes):
    """Let the boxes of shapes (V, 2, 12) reach beyond their points: planes to where the next voxel goes on
    with them, all by a margin.
    """
    for voxel in numba.prange(len(keys)):
        x, y, z = voxel_position(keys[voxel])
        shape = shapes[voxel]
        shape[:, 6:9] -= MARGIN
        shape[:, 9:] += MARGIN
        for k in range(27 if flat[voxel] else 0):
            steps = (k % 3 - 1, k // 3 % 3 - 1, k // 9 - 1)
            if find_voxel(index, x + steps[0], y + steps[1], z + steps[2]) < 0:
                continue
            for axis, step in enumerate(steps):
                if step < 0:
                    shape[:, 6 + axis] = -SLACK
                elif step > 0:
                    shape[:, 9 + axis] = 1 + SLACK


@numba.njit(cache=True)
def _write_plane(total, shape):
    """Write mean position and unit mean normal of moments (7,) to shape (6 or more,); returns the length of
    the mean normal.
    """
    length = _length(total[4:])
    for axis in range(3):
        shape[axis] = total[1 + axis] / FIXED / total[0]
        shape[3 + axis] = total[4 + axis] / length
    return length / FIXED / total[0]


@numba.njit(cache=True)
def _length(vector):
    """Of (3,), at least 1e-9 so that it can divide."""
    return max(np.sqrt(float(vector[0]) ** 2 + float(vector[1]) ** 2 + float(vector[2]) ** 2), 1e-9)
