"""The kernels of `patches`: what is in each voxel, which voxels block, and with which planes.

Loops over k = 0..26 visit a voxel and the 26 around it; k = 13 is the voxel itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from sc3d.geometry.voxels import AXIS_BITS, BLOCK, FIXED, SIDES, VOXELS

MIN_POINTS = 3  # in a voxel: never a floater; of a side: enough for a plane of its own
MIN_SUPPORT = 5  # points in a voxel and the 26 around it; fewer: a floater
SLACK = 0.4  # planes reach this far beyond their voxel, in voxels, so that no ray slips through between two of them ...
MARGIN = 0.25  # ... and this far beyond its outermost points where there is no voxel with points to go on in
SCATTERED, COPLANAR = 0.3, 0.6  # half width, in voxels, of a point's own patch where normals scatter: leaves, and points in the plane of voxels around (corners)
MAX_AWAY = 0.15  # from a plane to a point in it, in voxels
SAME, ALIKE = 0.7, 0.9  # cosine between normals of one surface, and of one plane
COHERENT = 0.85  # length of the mean normal of a plane's points
GAP_VOXELS = 3  # sides of voxels around a gap that agree on its plane
GAP_CENTRE = 0.75  # their points' mean is at most this far from the gap, in voxels along the plane: nothing grows beyond an edge
WINDOW = BLOCK + 2  # a block and the voxels around it
LAYER = WINDOW * WINDOW


class Matter(NamedTuple):
    """What is in the V voxels that hold points, for kernels.

    blocks: (B,) int64 packed positions, rising; block_starts: (B + 1,) int64 first voxel of each; places: (V,) int64 voxel within its block
    order: (N,) int64 points by voxel; starts: (V + 1,) int64; local: (N, 3) float32 positions in voxels from the voxel's corner; normals: (N, 3) float32
    moments: (V, 2, 7) int64 of each side: number of points, sums of their positions and normals in FIXED; flat: (V,) bool as in `normal_sides`
    """

    blocks: np.ndarray
    block_starts: np.ndarray
    places: np.ndarray
    order: np.ndarray
    starts: np.ndarray
    local: np.ndarray
    normals: np.ndarray
    moments: np.ndarray
    flat: np.ndarray


@numba.njit(parallel=True, cache=True)
def localise(points, origin, voxel_size, local):  # noqa: ANN001, ANN201 - numba kernel, arrays as in Matter
    for row in numba.prange(len(points)):
        for axis in range(3):
            position = (points[row, axis] - origin[axis]) / voxel_size
            local[row, axis] = position - np.floor(position)


@numba.njit(parallel=True, cache=True)
def sum_up(vectors, sides, order, starts, moments):  # noqa: ANN001, ANN201 - numba kernel, arrays as in Matter; vectors: positions and normals
    local, normals = vectors
    for voxel in numba.prange(len(starts) - 1):
        for k in range(starts[voxel], starts[voxel + 1]):
            row = order[k]
            side = sides[row]
            moments[voxel, side, 0] += 1
            for axis in range(3):
                moments[voxel, side, 1 + axis] += np.int64(np.float64(local[row, axis]) * FIXED)
                moments[voxel, side, 4 + axis] += np.int64(np.float64(normals[row, axis]) * FIXED)


@numba.njit(parallel=True, cache=True)
def fill(matter, candidates, first, voxels, shapes):  # noqa: ANN001, ANN201 - numba kernel
    """Patches of each candidate block (C,), from rows `first` (C, 2) of voxels (key, first patch) and shapes on; if there is no room, `first` gets their number."""
    write = len(voxels) > 0
    for row in numba.prange(len(candidates)):
        window = np.full(WINDOW**3, -1, np.int64)
        _look(matter, candidates[row], window)
        voxel, patch = first[row]
        if window.max() < 0:
            continue
        for place in range(VOXELS):
            at = (place // (BLOCK * BLOCK) + 1) * LAYER + (place // BLOCK % BLOCK + 1) * WINDOW + place % BLOCK + 1
            found = _gap(matter.moments, window, at, shapes[patch:]) if window[at] < 0 else _occupied(matter, window, at, shapes[patch:])
            if found > 0:
                if write:
                    voxels[voxel, 0], voxels[voxel, 1] = candidates[row] * VOXELS + place, patch
                voxel, patch = voxel + 1, patch + found
        if not write:
            first[row, 0], first[row, 1] = voxel, patch


@numba.njit(cache=True)
def _look(matter, block, window):  # noqa: ANN001, ANN202 - numba kernel
    """Fill window (WINDOW^3,), x innermost, with the rows of a block's voxels and of those around it; -1 stays where there are no points."""
    for k in range(27):
        dx, dy, dz = k // 9 - 1, k // 3 % 3 - 1, k % 3 - 1
        key = block + (dx << 2 * AXIS_BITS) + (dy << AXIS_BITS) + dz
        found = np.searchsorted(matter.blocks, key)
        if found == len(matter.blocks) or matter.blocks[found] != key:
            continue
        for voxel in range(matter.block_starts[found], matter.block_starts[found + 1]):
            place = matter.places[voxel]
            x, y, z = place % BLOCK + dx * BLOCK + 1, place // BLOCK % BLOCK + dy * BLOCK + 1, place // (BLOCK * BLOCK) + dz * BLOCK + 1
            if min(x, y, z) >= 0 and max(x, y, z) < WINDOW:
                window[z * LAYER + y * WINDOW + x] = voxel


@numba.njit(cache=True)
def _occupied(matter, window, at, shapes):  # noqa: ANN001, ANN202 - numba kernel
    """Number of patches of a voxel that holds points, written if there is room: a plane per side if its normals keep to an axis, else a patch per point."""
    voxel, moments = window[at], matter.moments
    first, last = matter.starts[voxel], matter.starts[voxel + 1]
    low, high = np.full(3, 1 + SLACK), np.full(3, -SLACK)
    for k in range(first, last):
        for axis in range(3):
            low[axis] = min(low[axis], matter.local[matter.order[k], axis] - MARGIN)
            high[axis] = max(high[axis], matter.local[matter.order[k], axis] + MARGIN)
    if _surroundings(moments, window, at, low, high) < MIN_SUPPORT and last - first < MIN_POINTS:
        return 0
    if not matter.flat[voxel]:
        for k in range(first, min(last, first + len(shapes))):
            point, normal = matter.local[matter.order[k]], matter.normals[matter.order[k]]
            half = COPLANAR if _coplanar(matter, window, at, point, normal) else SCATTERED
            shapes[k - first, :3], shapes[k - first, 3:6], shapes[k - first, 6:9], shapes[k - first, 9:] = point, normal, point - half, point + half
        return last - first
    num, total = 0, np.empty(7, np.int64)
    for side in range(SIDES):
        if moments[voxel, side, 0] == 0:
            continue
        if len(shapes) > 0:
            total[:] = moments[voxel, side]
            _plane(total, shapes[num])
            if total[0] < MIN_POINTS:
                _add_around(moments, window, at, shapes[num, 3:6].copy(), total)
                _plane(total, shapes[num])
            shapes[num, 6:9], shapes[num, 9:] = low, high
        num += 1
    return num


@numba.njit(cache=True)
def _surroundings(moments, window, at, low, high):  # noqa: ANN001, ANN202 - numba kernel
    """Number of points in a voxel and around it; low, high (3,): a box, moved to the voxel's faces where there are points beyond them."""
    count = 0
    for k in range(27):
        dx, dy, dz = k % 3 - 1, k // 3 % 3 - 1, k // 9 - 1
        voxel = window[at + dz * LAYER + dy * WINDOW + dx]
        if voxel < 0:
            continue
        count += moments[voxel, 0, 0] + moments[voxel, 1, 0]
        for axis, step in enumerate((dx, dy, dz)):
            if step < 0:
                low[axis] = -SLACK
            elif step > 0:
                high[axis] = 1 + SLACK
    return count


@numba.njit(cache=True)
def _gap(moments, window, at, shapes):  # noqa: ANN001, ANN202 - numba kernel
    """1 if a voxel without points lies amid points of one plane that crosses it, else 0; its patch is written if there is room."""
    reference, most, voxels = np.zeros(3), 0, 0
    for k in range(27):
        voxel = window[at + (k // 9 - 1) * LAYER + (k // 3 % 3 - 1) * WINDOW + k % 3 - 1]
        voxels += voxel >= 0
        for side in range(SIDES if voxel >= 0 else 0):
            if moments[voxel, side, 0] > most:
                most = moments[voxel, side, 0]
                for axis in range(3):
                    reference[axis] = moments[voxel, side, 4 + axis]
    if voxels < GAP_VOXELS:
        return 0
    total, plane = np.zeros(7, np.int64), np.empty(6, np.float32)
    if _add_around(moments, window, at, reference / _length(reference), total) < GAP_VOXELS or total[0] < MIN_SUPPORT or _plane(total, plane) < COHERENT:
        return 0
    offset, normal = plane[:3].astype(np.float64) - 0.5, plane[3:].astype(np.float64)
    away = (offset * normal).sum()
    if abs(away) > 0.5 * np.abs(normal).sum() or _length(offset - away * normal) > GAP_CENTRE:
        return 0
    if len(shapes) > 0:
        shapes[0, :6], shapes[0, 6:9], shapes[0, 9:] = plane, -SLACK, 1 + SLACK
    return 1


@numba.njit(cache=True)
def _coplanar(matter, window, at, point, normal):  # noqa: ANN001, ANN202 - numba kernel
    """Whether a point (3,) in a voxel lies in the plane of at least two sides of flat voxels around it and faces as they do."""
    num, face = 0, np.empty(6, np.float32)
    for k in range(27):
        dx, dy, dz = k % 3 - 1, k // 3 % 3 - 1, k // 9 - 1
        voxel = window[at + dz * LAYER + dy * WINDOW + dx]
        if voxel < 0 or not matter.flat[voxel]:
            continue
        for side in range(SIDES):
            if matter.moments[voxel, side, 0] == 0:
                continue
            _plane(matter.moments[voxel, side], face)
            away = (dx + face[0] - point[0]) * normal[0] + (dy + face[1] - point[1]) * normal[1] + (dz + face[2] - point[2]) * normal[2]
            num += abs(away) < MAX_AWAY and face[3] * normal[0] + face[4] * normal[1] + face[5] * normal[2] >= ALIKE
    return num >= 2


@numba.njit(cache=True)
def _add_around(moments, window, at, normal, total):  # noqa: ANN001, ANN202 - numba kernel
    """Add to total (7,) the moments of the sides of the 26 voxels around one that face as `normal` (3,); returns how many."""
    num = 0
    for k in range(27):
        dx, dy, dz = k % 3 - 1, k // 3 % 3 - 1, k // 9 - 1
        voxel = window[at + dz * LAYER + dy * WINDOW + dx]
        for side in range(SIDES if voxel >= 0 and k != 13 else 0):
            count, facing = moments[voxel, side, 0], moments[voxel, side, 4:]
            if count == 0 or facing[0] * normal[0] + facing[1] * normal[1] + facing[2] * normal[2] < SAME * _length(facing):
                continue
            for axis, step in enumerate((dx, dy, dz)):
                total[1 + axis] += moments[voxel, side, 1 + axis] + step * FIXED * count
                total[4 + axis] += facing[axis]
            total[0] += count
            num += 1
    return num


@numba.njit(cache=True)
def _plane(total, shape):  # noqa: ANN001, ANN202 - numba kernel
    """Write mean position and unit mean normal of moments (7,) to shape (6 or more,); returns the length of the mean normal."""
    length = _length(total[4:])
    for axis in range(3):
        shape[axis] = total[1 + axis] / FIXED / total[0]
        shape[3 + axis] = total[4 + axis] / length
    return length / FIXED / total[0]


@numba.njit(cache=True)
def _length(vector):  # noqa: ANN001, ANN202 - numba kernel; (3,), at least 1e-9 so that it can divide
    return max(np.sqrt(float(vector[0]) ** 2 + float(vector[1]) ** 2 + float(vector[2]) ** 2), 1e-9)
