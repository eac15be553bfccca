"""The kernels of `traversal`: one ray through blocks and voxels, in voxel units.

Of crossings at the same time the lower axis comes first, everywhere; that makes the visited voxels those of a DDA over single voxels, to the bit.
What takes the records is inlined, as in `voting_kernels`.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from sc3d.geometry.voxels import AXIS_BITS, BLOCK

NOTHING = -1
BACK = 9.0
STILL = 1e-30  # a component of a direction below this is 0: it crosses no face
NEVER = 1e300  # its inverse
MIXER = 0x9E3779B97F4A7C15  # 2^64 / golden ratio: multiplicative hashing (Knuth)



class Grid(NamedTuple):
    """The patches by block and voxel, for kernels.

    low, high: (3,) int64 first block and one past the last
    table: (T, 2) int64 hash table with open addressing, T a power of two: packed block position (-1 = free), row of the block
    rows: (blocks, 512) int32 number of a voxel among those with patches, or -1; memory of the VoxelBlockGrid
    starts, patches: as in `Patches`
    """

    low: np.ndarray
    high: np.ndarray
    table: np.ndarray
    rows: np.ndarray
    starts: np.ndarray
    patches: np.ndarray


class Ray(NamedTuple):
    """A ray in voxels: origin, unit direction without components below STILL, and its inverse (NEVER for 0)."""

    px: float
    py: float
    pz: float
    dx: float
    dy: float
    dz: float
    ix: float
    iy: float
    iz: float


@numba.njit(cache=True)
def _place(key, size):  # noqa: ANN001, ANN202 - numba kernel, scalars
    return np.int64((np.uint64(key) * np.uint64(MIXER)) >> np.uint64(20)) & (size - 1)


@numba.njit(cache=True)
def insert(table, keys, slots):  # noqa: ANN001, ANN201 - numba kernel
    """Enter packed blocks (B,) and their rows (B,) into the table of a Grid."""
    for k in range(len(keys)):
        place = _place(keys[k], len(table))
        while table[place, 0] != NOTHING:
            place = (place + 1) & (len(table) - 1)
        table[place, 0], table[place, 1] = keys[k], slots[k]


@numba.njit(cache=True, inline="always")
def _find(table, x, y, z):  # noqa: ANN001, ANN202 - numba kernel; row of a block, or -1
    key = ((x << AXIS_BITS | y) << AXIS_BITS) | z
    place = _place(key, len(table))
    while table[place, 0] != NOTHING and table[place, 0] != key:
        place = (place + 1) & (len(table) - 1)
    return table[place, 1]


@numba.njit(cache=True)
def _locate(axis, position, direction, inverse, time, by):  # noqa: ANN001, ANN202 - numba kernel, scalars
    """Voxel of a ray along `axis` after all crossings before that of axis `by` at `time`; of crossings at the same time, the lower axis comes first."""
    start = np.int64(np.floor(position))
    if direction == 0.0:
        return start
    step = np.int64(1) if direction > 0 else np.int64(-1)
    ahead = np.int64(direction > 0)  # from a voxel to the number of the face that it is left by
    moved = max((np.int64(np.floor(position + direction * time)) - start) * step, np.int64(0))  # right up to rounding
    while moved > 0 and not _before((start + step * (moved - 1) + ahead - position) * inverse, axis, time, by):
        moved -= 1
    while _before((start + step * moved + ahead - position) * inverse, axis, time, by):
        moved += 1
    return start + step * moved


@numba.njit(cache=True)
def _before(crossing, axis, time, by):  # noqa: ANN001, ANN202 - numba kernel, scalars
    return crossing < time or (crossing == time and axis < by)


@numba.njit(cache=True)
def _earliest(tx, ty, tz):  # noqa: ANN001, ANN202 - numba kernel, scalars; the axis
    if tx <= ty:
        return 0 if tx <= tz else 2
    return 1 if ty <= tz else 2


@numba.njit(cache=True)
def _entry(low, high, position, direction, inverse):  # noqa: ANN001, ANN202 - numba kernel, scalars in voxels
    """When a ray comes between low and high: -1 = it starts there, infinity = never."""
    start = np.floor(position)
    if low <= start < high:
        return -1.0
    if direction == 0.0 or (direction > 0) != (start < low):
        return np.inf
    return ((low if direction > 0 else high) - position) * inverse


@numba.njit(cache=True, inline="always")
def _hit(grid, ray, voxel, x, y, z):  # noqa: ANN001, ANN202 - numba kernel
    """Range in voxels, infinity = none, and |cosine| of the nearest patch of a voxel at x, y, z; does not depend on the patches' order."""
    patches = grid.patches
    px, py, pz = ray.px - x, ray.py - y, ray.pz - z
    nearest, incidence = np.inf, 0.0
    for k in range(grid.starts[voxel], grid.starts[voxel + 1]):
        slope = ray.dx * patches[k, 3] + ray.dy * patches[k, 4] + ray.dz * patches[k, 5]
        if slope == 0.0:
            continue
        range_ = ((patches[k, 0] - px) * patches[k, 3] + (patches[k, 1] - py) * patches[k, 4] + (patches[k, 2] - pz) * patches[k, 5]) / slope
        if range_ <= 0.0 or range_ > nearest or (range_ == nearest and abs(slope) >= incidence):
            continue
        hx, hy, hz = px + range_ * ray.dx, py + range_ * ray.dy, pz + range_ * ray.dz
        if slope > 0 and (min(hx, hy, hz) < BACK or max(hx, hy, hz) > 1.0 - BACK):
            continue
        if patches[k, 6] <= hx <= patches[k, 9] and patches[k, 7] <= hy <= patches[k, 10] and patches[k, 8] <= hz <= patches[k, 11]:
            nearest, incidence = range_, abs(slope)
    return nearest, incidence


@numba.njit(cache=True, inline="always")
def _walk(grid, ray, slot, bx, by, bz, time, side):  # noqa: ANN001, ANN202 - numba kernel
    """First hit inside a block, which the ray enters at `time` by a face of axis `side` (-1 = it starts inside)."""
    x = _locate(0, ray.px, ray.dx, ray.ix, time, side) if side != 0 else bx * BLOCK + (0 if ray.dx > 0 else BLOCK - 1)
    y = _locate(1, ray.py, ray.dy, ray.iy, time, side) if side != 1 else by * BLOCK + (0 if ray.dy > 0 else BLOCK - 1)
    z = _locate(2, ray.pz, ray.dz, ray.iz, time, side) if side != 2 else bz * BLOCK + (0 if ray.dz > 0 else BLOCK - 1)
    ux, uy, uz = x - bx * BLOCK, y - by * BLOCK, z - bz * BLOCK
    tx, ty, tz = (x + (ray.dx >= 0) - ray.px) * ray.ix, (y + (ray.dy >= 0) - ray.py) * ray.iy, (z + (ray.dz >= 0) - ray.pz) * ray.iz
    nearest, incidence = np.inf, 0.0
    while (ux | uy | uz) & ~(BLOCK - 1) == 0:
        voxel = grid.rows[slot, (uz * BLOCK + uy) * BLOCK + ux]
        if voxel >= 0:
            nearest, incidence = _hit(grid, ray, voxel, bx * BLOCK + ux, by * BLOCK + uy, bz * BLOCK + uz)
            if nearest < np.inf:
                break
        axis = _earliest(tx, ty, tz)
        if axis == 0:
            ux += 1 if ray.dx >= 0 else -1
            tx = (bx * BLOCK + ux + (ray.dx >= 0) - ray.px) * ray.ix
        elif axis == 1:
            uy += 1 if ray.dy >= 0 else -1
            ty = (by * BLOCK + uy + (ray.dy >= 0) - ray.py) * ray.iy
        else:
            uz += 1 if ray.dz >= 0 else -1
            tz = (bz * BLOCK + uz + (ray.dz >= 0) - ray.pz) * ray.iz
    return nearest, incidence


@numba.njit(cache=True, inline="always")
def _trace(grid, ray):  # noqa: ANN001, ANN202 - numba kernel
    """First hit of a ray: range in voxels, infinity = none, and |cosine|."""
    lx, ly, lz = grid.low[0], grid.low[1], grid.low[2]
    hx, hy, hz = grid.high[0], grid.high[1], grid.high[2]
    ex = _entry(lx * BLOCK, hx * BLOCK, ray.px, ray.dx, ray.ix)
    ey = _entry(ly * BLOCK, hy * BLOCK, ray.py, ray.dy, ray.iy)
    ez = _entry(lz * BLOCK, hz * BLOCK, ray.pz, ray.dz, ray.iz)
    time, side = max(ex, ey, ez), -1  # the last axis to come between the bounds, of equal ones the highest
    nearest, incidence = np.inf, 0.0
    if time == np.inf:
        return nearest, incidence
    if time >= 0.0:
        side = 2 if ez == time else (1 if ey == time else 0)
    bx = _locate(0, ray.px, ray.dx, ray.ix, time, side) // BLOCK if side != 0 else (lx if ray.dx > 0 else hx - 1)
    by = _locate(1, ray.py, ray.dy, ray.iy, time, side) // BLOCK if side != 1 else (ly if ray.dy > 0 else hy - 1)
    bz = _locate(2, ray.pz, ray.dz, ray.iz, time, side) // BLOCK if side != 2 else (lz if ray.dz > 0 else hz - 1)
    tx = ((bx + (ray.dx >= 0)) * BLOCK - ray.px) * ray.ix
    ty = ((by + (ray.dy >= 0)) * BLOCK - ray.py) * ray.iy
    tz = ((bz + (ray.dz >= 0)) * BLOCK - ray.pz) * ray.iz
    while lx <= bx < hx and ly <= by < hy and lz <= bz < hz:
        slot = _find(grid.table, bx, by, bz)
        if slot != NOTHING:
            nearest, incidence = _walk(grid, ray, slot, bx, by, bz, time, side)
            if nearest < np.inf:
                break
        side = _earliest(tx, ty, tz)
        if side == 0:
            time = tx
            bx += 1 if ray.dx >= 0 else -1
            tx = ((bx + (ray.dx >= 0)) * BLOCK - ray.px) * ray.ix
        elif side == 1:
            time = ty
            by += 1 if ray.dy >= 0 else -1
            ty = ((by + (ray.dy >= 0)) * BLOCK - ray.py) * ray.iy
        else:
            time = tz
            bz += 1 if ray.dz >= 0 else -1
            tz = ((bz + (ray.dz >= 0)) * BLOCK - ray.pz) * ray.iz
    return nearest, incidence


@numba.njit(cache=True)
def _ray(start, x, y, z):  # noqa: ANN001, ANN202 - numba kernel
    x, y, z = x if abs(x) >= STILL else 0.0, y if abs(y) >= STILL else 0.0, z if abs(z) >= STILL else 0.0
    return Ray(start[0], start[1], start[2], x, y, z, 1 / x if x != 0 else NEVER, 1 / y if y != 0 else NEVER, 1 / z if z != 0 else NEVER)


@numba.njit(parallel=True, cache=True)
def cast_rays(directions, cam_from_world, start, voxel_size, grid, result):  # noqa: ANN001, ANN201 - numba kernel
    """Fill result (2, K): range in world units and |cosine| of the first hit along directions (K, 3), camera frame; start: (3,) voxels of the grid."""
    for k in numba.prange(len(directions)):
        x, y, z = np.float64(directions[k, 0]), np.float64(directions[k, 1]), np.float64(directions[k, 2])
        result[0, k], result[1, k] = np.inf, 0.0
        if not np.isfinite(x + y + z):
            continue
        dx = x * cam_from_world[0, 0] + y * cam_from_world[1, 0] + z * cam_from_world[2, 0]
        dy = x * cam_from_world[0, 1] + y * cam_from_world[1, 1] + z * cam_from_world[2, 1]
        dz = x * cam_from_world[0, 2] + y * cam_from_world[1, 2] + z * cam_from_world[2, 2]
        nearest, incidence = _trace(grid, _ray(start, dx, dy, dz))
        result[0, k], result[1, k] = nearest * voxel_size, incidence
