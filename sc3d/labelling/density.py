"""How much matter there is at a point: weights inside a voxel, so that floaters have next to no say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numba
import numpy as np

from sc3d.geometry.neighbors import NeighborIndex
from sc3d.geometry.voxels import VoxelOrder, sort_by_voxel

NEAREST = 12  # Gaussians that count at a point
POINTS_AT_ONCE = 200_000
FULL = 1023  # fixed point of the densest point of a voxel


@dataclass(frozen=True)
class GaussianField:
    """Planar Gaussians in the world.

    means: (G, 3) float64; rotations: (G, 3, 3) float32, columns = axes; scales: (G, 3) float32 standard
        deviations; opacities: (G,) float32
    """

    means: np.ndarray
    rotations: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], origin: np.ndarray) -> GaussianField:
        """From what `io.splats` reads; origin: (3,) world position of the local frame's zero."""
        from scipy.spatial.transform import Rotation  # here: every `sc3d label` would wait 0.2 s for it
        from scipy.special import expit

        rotations = Rotation.from_quat(arrays["quats"][:, [1, 2, 3, 0]]).as_matrix().astype(np.float32)
        means, scales = arrays["means"].astype(np.float64) + origin, np.exp(arrays["log_scales"])
        return cls(means, rotations, scales, expit(arrays["opacity_logits"]))


def gaussian_density(points: np.ndarray, gaussians: GaussianField, voxel_size: float) -> np.ndarray:
    """(N,) float32 sum_i o_i N(p; mu_i, Sigma_i) at (N, 3) world points over the NEAREST Gaussians.

    N has peak 1, not volume 1, because a planar Gaussian has hardly any volume; for the same reason scales
    are at least a quarter of a voxel.
    """
    index = NeighborIndex(gaussians.means)
    result = np.empty(len(points), np.float32)
    for start in range(0, len(points), POINTS_AT_ONCE):
        part = slice(start, start + POINTS_AT_ONCE)
        near, _ = index.nearest(points[part], NEAREST)
        local = (points[part, None] - gaussians.means[near]).astype(np.float32)
        along = np.einsum("nkij,nki->nkj", gaussians.rotations[near], local) / np.maximum(
            gaussians.scales[near], voxel_size / 4
        )
        result[part] = (gaussians.opacities[near] * np.exp(-0.5 * (along**2).sum(axis=2))).sum(axis=1)
    return result


def kernel_density(points: np.ndarray, voxel_size: float, origin: np.ndarray | None = None) -> np.ndarray:
    """(N,) float32 for clouds without Gaussians: a Gaussian of half a voxel around the mean of the (N, 3)
    points in each voxel; origin: of `sort_by_voxel`.
    """
    sorting = sort_by_voxel(points, voxel_size, origin)
    result = np.empty(len(points), np.float32)
    _around_mean(np.ascontiguousarray(points, np.float64), sorting.order, sorting.starts, voxel_size, result)
    return result


def voxel_shares(density: np.ndarray, sorting: VoxelOrder) -> np.ndarray:
    """(N,) uint16 weight of each point in its voxel, fixed point: the densest point has FULL. density: (N,)
    float32, the points' own order.
    """
    ordered = density[sorting.order]
    largest = np.maximum.reduceat(ordered, sorting.starts[:-1])
    share = ordered / np.repeat(np.maximum(largest, 1e-30), np.diff(sorting.starts))
    result = np.empty(len(density), np.uint16)
    result[sorting.order] = np.round(share * FULL)
    return result


@numba.njit(parallel=True, cache=True)
def _around_mean(points, order, starts, voxel_size, result):
    """Arrays as in VoxelOrder."""
    for voxel in numba.prange(len(starts) - 1):
        first = order[starts[voxel]]
        count = starts[voxel + 1] - starts[voxel]
        mean = np.zeros(3)
        for axis in range(3):
            # integers, relative to a corner of the voxel: the sum does not depend on the order of the points
            total = 0
            low = points[first, axis]
            for k in range(starts[voxel], starts[voxel + 1]):
                low = min(low, points[order[k], axis])
            for k in range(starts[voxel], starts[voxel + 1]):
                total += np.int64((points[order[k], axis] - low) / voxel_size * (1 << 30))
            mean[axis] = low + total / (1 << 30) / count * voxel_size
        for k in range(starts[voxel], starts[voxel + 1]):
            squared = 0.0
            for axis in range(3):
                squared += (points[order[k], axis] - mean[axis]) ** 2
            result[order[k]] = np.exp(-2 * squared / voxel_size**2)
