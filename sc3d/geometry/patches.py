"""What a ray hits inside a voxel: pieces of plane from the voxel's own points, so that ranges are finer than voxels (METHOD section 3).

A voxel with few points and few around it is a floater and blocks nothing; an empty one amid the points of a plane is a gap and gets that plane.
Sums are integers relative to the voxel, so patches depend neither on the order of the points nor on where the world's zero is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sc3d.geometry.patch_kernels import Matter, fill, localise, sum_up
from sc3d.geometry.voxels import AXIS_BITS, BLOCK, ORIGIN_SHIFT, SIDES, VOXELS, normal_sides, sort_by_voxel


@dataclass(frozen=True)
class Patches:
    """Pieces of plane by voxel; of V voxels, voxel v has shapes[starts[v] : starts[v + 1]].

    keys: (V,) int64 voxel keys (`voxel_keys`), rising; starts: (V + 1,) int64
    shapes: (P, 12) float32 in voxels from the voxel's corner: a point of the plane, its unit normal, lowest and highest corner of a box that clips it
    origin: (3,) float64 world position of the grid's zero; voxel_size: world units
    """

    keys: np.ndarray
    starts: np.ndarray
    shapes: np.ndarray
    origin: np.ndarray
    voxel_size: float


def surface_patches(points: np.ndarray, normals: np.ndarray, voxel_size: float) -> Patches:
    """The patches of a cloud. points: (N, 3) float64 world, N >= 1; normals: (N, 3) float32 unit, towards the outside."""
    points, normals = np.ascontiguousarray(points, np.float64), np.ascontiguousarray(normals, np.float32)
    origin = points.min(axis=0) - (2 * BLOCK + ORIGIN_SHIFT) * voxel_size  # room for the blocks around those with points
    sorting = sort_by_voxel(points, voxel_size, origin)
    sides, flat = normal_sides(normals, sorting)
    local, moments = np.empty((len(points), 3), np.float32), np.zeros((len(sorting.keys), SIDES, 7), np.int64)
    localise(points, origin, voxel_size, local)
    sum_up((local, normals), sides, sorting.order, sorting.starts, moments)
    firsts = np.flatnonzero(np.diff(sorting.keys // VOXELS, prepend=-1))
    blocks, block_starts = sorting.keys[firsts] // VOXELS, np.append(firsts, len(sorting.keys))
    matter = Matter(blocks, block_starts, sorting.keys % VOXELS, sorting.order, sorting.starts, local, normals, moments, flat)
    candidates = _with_neighbors(blocks)
    counts = np.zeros((len(candidates), 2), np.int64)
    fill(matter, candidates, counts, np.empty((0, 2), np.int64), np.empty((0, 12), np.float32))
    num_voxels, num_patches = counts.sum(axis=0)
    voxels, shapes = np.empty((num_voxels, 2), np.int64), np.empty((num_patches, 12), np.float32)
    fill(matter, candidates, np.cumsum(counts, axis=0) - counts, voxels, shapes)
    return Patches(voxels[:, 0].copy(), np.append(voxels[:, 1], num_patches), shapes, origin, voxel_size)


def block_positions(blocks: np.ndarray) -> np.ndarray:
    """(B, 3) int32 positions of packed blocks (B,)."""
    return (blocks[:, None] >> np.array([2, 1, 0]) * AXIS_BITS & (1 << AXIS_BITS) - 1).astype(np.int32)


def _with_neighbors(blocks: np.ndarray) -> np.ndarray:
    """The packed blocks (B,) and the 26 around each, rising; positions of blocks with points are at least 2, so 0 is one that ran over."""
    steps = np.array([-1, 0, 1])
    around = (steps[:, None, None] << 2 * AXIS_BITS) + (steps[:, None] << AXIS_BITS) + steps
    found = np.unique(blocks[:, None] + around.ravel())
    return found[(block_positions(found) > 0).all(axis=1)]
