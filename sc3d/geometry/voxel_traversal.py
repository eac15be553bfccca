"""First surfaces of a bare cloud by traversing a voxel grid, coarse to fine: blocks, then voxels.

Empty blocks are crossed in one step. The voxels visited are exactly those of a DDA over single voxels (Amanatides
and Woo 1987), to the bit, because where a ray crosses a face is computed from the number of the face and never
summed up, and of crossings at the same time the lower axis comes first, everywhere. What a ray hits inside a voxel
is a patch (`voxel_patches`), so ranges are accurate far below the voxel size.

The kernels work in voxel units. What takes the records is inlined, as in `labelling.voting`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np

from sc3d.geometry.cameras import View
from sc3d.geometry.neighbors import NeighborIndex, estimate_normals
from sc3d.geometry.voxel_patches import Patches, surface_patches
from sc3d.geometry.voxels import BLOCK, NOTHING, SIDES, find_block

STILL = 1e-30  # a component of a direction below this is 0: it crosses no face
NEVER = 1e300  # its inverse
NORMAL_NEIGHBORS = 9  # of a point, itself included


@dataclass(frozen=True)
class VoxelSurface:
    """A cloud that blocks rays; a `raycast.RayTarget`."""

    patches: Patches

    @classmethod
    def from_cloud(cls, points: np.ndarray, normals: np.ndarray | None, voxel_size: float) -> VoxelSurface:
        """Planes through the points of each voxel, gaps closed.

        points: (N, 3) float64 world, N >= 1; normals: (N, 3) float32 unit or None = estimated. Lone points
            (floaters) block nothing.
        voxel_size: world units; 2 to 3 point spacings
        """
        if normals is None:
            neighbors, _ = NeighborIndex(points).nearest(points, NORMAL_NEIGHBORS)
            normals = (
                estimate_normals(points, neighbors)
                if neighbors.shape[1] > 3
                else np.tile(np.array([0, 0, 1], np.float32), (len(points), 1))
            )
        return cls(surface_patches(points, normals, voxel_size))

    def cast(self, view: View, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `raycast.RayTarget.cast`."""
        result, grid = np.empty((2, len(directions)), np.float32), self.patches.grid
        start, patches = (
            (view.center - grid.origin) / grid.voxel_size,
            PatchGrid(*self.patches.index, self.patches.shapes),
        )
        cast_rays(directions, view.cam_from_world, start, grid.voxel_size, patches, result)
        return result[0], result[1]


class PatchGrid(NamedTuple):
    """The patches by block and voxel: the fields of a `VoxelIndex`, and `shapes` as in `Patches`. Flat, because
    numba passes no nested records to parallel loops.
    """

    table: np.ndarray
    numbers: np.ndarray
    low: np.ndarray
    high: np.ndarray
    shapes: np.ndarray


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
def _locate(axis, position, direction, inverse, time, by):
    """Voxel of a ray along `axis` after all crossings before that of axis `by` at `time`; of crossings at the
    same time, the lower axis comes first.
    """
    start = np.int64(np.floor(position))
    if direction == 0.0:
        return start
    step = np.int64(1) if direction > 0 else np.int64(-1)
    ahead = np.int64(direction > 0)  # from a voxel to the number of the face that it is left by
    # right up to rounding
    moved = max((np.int64(np.floor(position + direction * time)) - start) * step, np.int64(0))
    while moved > 0 and not _before(
        (start + step * (moved - 1) + ahead - position) * inverse, axis, time, by
    ):
        moved -= 1
    while _before((start + step * moved + ahead - position) * inverse, axis, time, by):
        moved += 1
    return start + step * moved


@numba.njit(cache=True)
def _before(crossing, axis, time, by):
    return crossing < time or (crossing == time and axis < by)


@numba.njit(cache=True)
def _earliest(tx, ty, tz):
    """The axis."""
    if tx <= ty:
        return 0 if tx <= tz else 2
    return 1 if ty <= tz else 2


@numba.njit(cache=True)
def _entry(low, high, position, direction, inverse):
    """When a ray comes between low and high: -1 = it starts there, infinity = never."""
    start = np.floor(position)
    if low <= start < high:
        return -1.0
    if direction == 0.0 or (direction > 0) != (start < low):
        return np.inf
    return ((low if direction > 0 else high) - position) * inverse


@numba.njit(cache=True, inline="always")
def _hit(shapes, ray, voxel, x, y, z):
    """Range in voxels, infinity = none, and |cosine| of the nearer patch of a voxel at x, y, z; shapes as in
    `Patches`.
    """
    px, py, pz = ray.px - x, ray.py - y, ray.pz - z
    nearest, incidence = np.inf, 0.0
    for side in range(SIDES):
        if np.isnan(shapes[voxel, side, 0]):
            continue
        ax, ay, az = (
            (shapes[voxel, side, 6] - px) * ray.ix,
            (shapes[voxel, side, 7] - py) * ray.iy,
            (shapes[voxel, side, 8] - pz) * ray.iz,
        )
        bx, by, bz = (
            (shapes[voxel, side, 9] - px) * ray.ix,
            (shapes[voxel, side, 10] - py) * ray.iy,
            (shapes[voxel, side, 11] - pz) * ray.iz,
        )
        enter, leave = max(min(ax, bx), min(ay, by), min(az, bz)), min(max(ax, bx), max(ay, by), max(az, bz))
        nx, ny, nz = (
            np.float64(shapes[voxel, side, 3]),
            np.float64(shapes[voxel, side, 4]),
            np.float64(shapes[voxel, side, 5]),
        )
        mx, my, mz = shapes[voxel, side, 0] - px, shapes[voxel, side, 1] - py, shapes[voxel, side, 2] - pz
        if nx == 0.0 and ny == 0.0 and nz == 0.0:
            slope = 1.0
            range_ = max(enter, min(leave, mx * ray.dx + my * ray.dy + mz * ray.dz))
        else:
            slope = ray.dx * nx + ray.dy * ny + ray.dz * nz
            range_ = (mx * nx + my * ny + mz * nz) / slope if slope != 0.0 else np.inf
        if 0.0 < range_ < nearest and enter <= range_ <= leave:
            nearest, incidence = range_, abs(slope)
    return nearest, incidence


@numba.njit(cache=True, inline="always")
def _walk(grid, ray, slot, bx, by, bz, time, side):
    """First hit inside a block, which the ray enters at `time` by a face of axis `side` (-1 = it starts
    inside).
    """
    x = (
        _locate(0, ray.px, ray.dx, ray.ix, time, side)
        if side != 0
        else bx * BLOCK + (0 if ray.dx > 0 else BLOCK - 1)
    )
    y = (
        _locate(1, ray.py, ray.dy, ray.iy, time, side)
        if side != 1
        else by * BLOCK + (0 if ray.dy > 0 else BLOCK - 1)
    )
    z = (
        _locate(2, ray.pz, ray.dz, ray.iz, time, side)
        if side != 2
        else bz * BLOCK + (0 if ray.dz > 0 else BLOCK - 1)
    )
    ux, uy, uz = x - bx * BLOCK, y - by * BLOCK, z - bz * BLOCK
    tx, ty, tz = (
        (x + (ray.dx >= 0) - ray.px) * ray.ix,
        (y + (ray.dy >= 0) - ray.py) * ray.iy,
        (z + (ray.dz >= 0) - ray.pz) * ray.iz,
    )
    nearest, incidence = np.inf, 0.0
    while (ux | uy | uz) & ~(BLOCK - 1) == 0:
        voxel = grid.numbers[slot, (uz * BLOCK + uy) * BLOCK + ux]
        if voxel >= 0:
            nearest, incidence = _hit(
                grid.shapes, ray, voxel, bx * BLOCK + ux, by * BLOCK + uy, bz * BLOCK + uz
            )
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
def _trace(grid, ray):
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
    bx = (
        _locate(0, ray.px, ray.dx, ray.ix, time, side) // BLOCK
        if side != 0
        else (lx if ray.dx > 0 else hx - 1)
    )
    by = (
        _locate(1, ray.py, ray.dy, ray.iy, time, side) // BLOCK
        if side != 1
        else (ly if ray.dy > 0 else hy - 1)
    )
    bz = (
        _locate(2, ray.pz, ray.dz, ray.iz, time, side) // BLOCK
        if side != 2
        else (lz if ray.dz > 0 else hz - 1)
    )
    tx = ((bx + (ray.dx >= 0)) * BLOCK - ray.px) * ray.ix
    ty = ((by + (ray.dy >= 0)) * BLOCK - ray.py) * ray.iy
    tz = ((bz + (ray.dz >= 0)) * BLOCK - ray.pz) * ray.iz
    while lx <= bx < hx and ly <= by < hy and lz <= bz < hz:
        slot = find_block(grid.table, bx, by, bz)
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
def _ray(start, x, y, z):
    x, y, z = x if abs(x) >= STILL else 0.0, y if abs(y) >= STILL else 0.0, z if abs(z) >= STILL else 0.0
    return Ray(
        start[0],
        start[1],
        start[2],
        x,
        y,
        z,
        1 / x if x != 0 else NEVER,
        1 / y if y != 0 else NEVER,
        1 / z if z != 0 else NEVER,
    )


@numba.njit(parallel=True, cache=True)
def cast_rays(directions, cam_from_world, start, voxel_size, grid, result):
    """Fill result (2, K): range in world units and |cosine| of the first hit along directions (K, 3), camera
    frame; start: (3,) voxels of the grid.
    """
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
