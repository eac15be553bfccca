"""First surfaces of a bare cloud by traversing the voxel grid itself, coarse to fine: blocks of Open3D's `VoxelBlockGrid`, then voxels.

Empty blocks are crossed in one step. The voxels visited are exactly those of a DDA over single voxels (Amanatides and Woo 1987), because
where a ray crosses a face is computed from the number of the face and never summed up. What a ray hits inside a voxel is a patch
(`patches`), so ranges are accurate far below the voxel size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d

from sc3d.geometry.cameras import View
from sc3d.geometry.neighbors import NeighborIndex, estimate_normals
from sc3d.geometry.patches import Patches, block_positions, surface_patches
from sc3d.geometry.traversal_kernels import NOTHING, Grid, cast_rays, insert
from sc3d.geometry.voxels import BLOCK, VOXELS

NORMAL_NEIGHBORS = 9  # of a point, itself included


@dataclass(frozen=True)
class VoxelSurface:
    """A cloud that blocks rays; a `raycast.RayTarget`.

    field: VoxelBlockGrid with attribute `patch` (blocks, 8, 8, 8, 1) int32, the `rows` of grid
    origin: (3,) float64 world position of its zero; voxel_size: world units
    """

    field: o3d.t.geometry.VoxelBlockGrid
    grid: Grid
    origin: np.ndarray
    voxel_size: float

    @classmethod
    def from_cloud(cls, points: np.ndarray, normals: np.ndarray | None, voxel_size: float) -> VoxelSurface:
        """Planes through the points of each voxel, gaps closed.

        points: (N, 3) float64 world, N >= 1; normals: (N, 3) float32 unit or None = estimated. Lone points (floaters) block nothing.
        voxel_size: world units; 2 to 3 point spacings
        """
        if normals is None:
            neighbors, _ = NeighborIndex(points).nearest(points, NORMAL_NEIGHBORS)
            normals = estimate_normals(points, neighbors) if neighbors.shape[1] > 3 else np.tile(np.float32([0, 0, 1]), (len(points), 1))
        return cls.of(surface_patches(points, normals, voxel_size))

    @classmethod
    def of(cls, found: Patches) -> VoxelSurface:
        """The surface of patches that are there already."""
        keys, block_of_voxel = np.unique(found.keys // VOXELS, return_inverse=True)
        blocks = block_positions(keys)
        field = o3d.t.geometry.VoxelBlockGrid(("patch",), (o3d.core.int32,), ((1,),), found.voxel_size, BLOCK, max(len(keys), 1))
        slots = field.hashmap().activate(o3d.core.Tensor(blocks))[0].numpy().astype(np.int64)
        rows = field.attribute("patch").numpy().reshape(-1, VOXELS)
        rows[:] = NOTHING
        rows[slots[block_of_voxel], found.keys % VOXELS] = np.arange(len(found.keys))
        table = np.full((1 << int(2 * len(keys)).bit_length(), 2), NOTHING, np.int64)
        insert(table, keys, slots)
        low, high = (blocks.min(axis=0), blocks.max(axis=0) + 1) if len(blocks) else np.zeros((2, 3))
        return cls(field, Grid(low.astype(np.int64), high.astype(np.int64), table, rows, found.starts, found.shapes), found.origin, found.voxel_size)

    def cast(self, view: View, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `raycast.RayTarget.cast`."""
        result = np.empty((2, len(directions)), np.float32)
        cast_rays(directions, view.cam_from_world, (view.centre - self.origin) / self.voxel_size, self.voxel_size, self.grid, result)
        return result[0], result[1]
