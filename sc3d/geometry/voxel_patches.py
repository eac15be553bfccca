"""What a ray hits inside a voxel: the plane of the voxel's own points, so that ranges are finer than voxels
(METHOD section 3).

A voxel with few points and few around it is a floater and blocks nothing; an empty one amid the points of a
plane is a gap and gets that plane.
Sums are integers relative to the voxel, so patches depend neither on the order of the points nor on where the
world's zero is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sc3d.geometry.voxel_lookup import VoxelLookup, voxel_lookup
from sc3d.geometry.voxel_patch_kernels import (
    GAP_VOXELS,
    Matter,
    close_gaps,
    empty_around,
    sum_up,
    support,
    widen,
)
from sc3d.geometry.voxels import BLOCK, ORIGIN_SHIFT, SIDES, normal_sides, sort_by_voxel


@dataclass(frozen=True)
class Patches:
    """What blocks rays in each of V voxels, one patch per side.

    keys: (V,) int64 voxel keys (`voxel_keys`), rising; lookup: their rows
    shapes: (V, 2, 12) float32 in voxels from the voxel's corner: mean of the points, unit normal, lowest and
        highest corner of a box that clips the plane.
    Mean NaN = no points on this side; normal 0 = the points scatter (leaves, edges): a ray that meets the box
    is stopped beside their mean.
    origin: (3,) float64 world position of the grid's zero; voxel_size: world units
    """

    keys: np.ndarray
    lookup: VoxelLookup
    shapes: np.ndarray
    origin: np.ndarray
    voxel_size: float


def surface_patches(points: np.ndarray, normals: np.ndarray, voxel_size: float) -> Patches:
    """The patches of a cloud. points: (N, 3) float64 world, N >= 1; normals: (N, 3) float32 unit, towards the
    outside.
    """
    points, normals = np.ascontiguousarray(points, np.float64), np.ascontiguousarray(normals, np.float32)
    # room for the voxels around those with points
    origin = points.min(axis=0) - (BLOCK + ORIGIN_SHIFT) * voxel_size
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
    matter, lookup = Matter(keys, moments, flat), voxel_lookup(keys)
    support(matter, lookup, supported)
    gaps, planes = _gaps(matter, lookup)
    keys, flat = np.append(keys[supported], gaps), np.append(flat[supported], np.ones(len(gaps), np.bool_))
    rising = np.argsort(keys)
    keys, shapes = keys[rising], np.concatenate([shapes[supported], planes])[rising]
    lookup = voxel_lookup(keys)
    widen(keys, lookup, flat[rising], shapes)
    return Patches(keys, lookup, shapes, origin, voxel_size)


def _gaps(matter: Matter, lookup: VoxelLookup) -> tuple[np.ndarray, np.ndarray]:
    """(G,) keys of the voxels without points that a plane goes through, and its (G, 2, 12) shapes."""
    around = np.zeros((len(matter.keys), 27), np.int64)
    empty_around(matter, lookup, around)
    keys, counts = np.unique(around[around > 0], return_counts=True)
    keys = keys[counts >= GAP_VOXELS]
    closed, shapes = np.zeros(len(keys), np.bool_), np.full((len(keys), SIDES, 12), np.nan, np.float32)
    close_gaps(matter, lookup, keys, closed, shapes)
    return keys[closed], shapes[closed]
