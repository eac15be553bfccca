"""First surfaces of a bare cloud by traversing the voxel grid itself, coarse to fine: blocks, then voxels.

Empty blocks are crossed in one step. The voxels visited are exactly those of a DDA over single voxels
(Amanatides and Woo 1987), because
where a ray crosses a face is computed from the number of the face and never summed up. What a ray hits inside
a voxel is a patch
(`patches`), so ranges are accurate far below the voxel size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sc3d.geometry.cameras import View
from sc3d.geometry.neighbors import NeighborIndex, estimate_normals
from sc3d.geometry.voxel_patches import Patches, surface_patches
from sc3d.geometry.voxel_traversal_kernels import Grid, cast_rays

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
                else np.tile(np.float32([0, 0, 1]), (len(points), 1))
            )
        return cls(surface_patches(points, normals, voxel_size))

    def cast(self, view: View, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `raycast.RayTarget.cast`."""
        found, result = self.patches, np.empty((2, len(directions)), np.float32)
        start = (view.center - found.origin) / found.voxel_size
        cast_rays(
            directions,
            view.cam_from_world,
            start,
            found.voxel_size,
            Grid(*found.lookup, found.shapes),
            result,
        )
        return result[0], result[1]
