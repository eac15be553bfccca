"""A sparse field of voxels on Open3D's `VoxelBlockGrid`: integer counts in voxels near points.

Two levels: blocks of BLOCK^3 voxels in a hash map, and the voxels of each block. A voxel has two sides, told apart by the
normals of its points, so that a wall thinner than a voxel keeps what was seen on either face.
Counts are integers: sums of integers do not depend on the order of views, points or threads, and fields merge by addition.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d

BLOCK = 8
SIDES = 2


class VoxelField:
    """Counts of C channels for every voxel side.

    grid: VoxelBlockGrid with attribute `votes` (blocks, 8, 8, 8, SIDES * C) int32
    voxel_size: world units; origin: (3,) float64 world position of the grid's zero
    """

    def __init__(self, grid: o3d.t.geometry.VoxelBlockGrid, voxel_size: float, origin: np.ndarray, num_channels: int) -> None:
        self.grid, self.voxel_size, self.origin, self.num_channels = grid, voxel_size, np.asarray(origin, np.float64), num_channels

    @classmethod
    def around(cls, points: np.ndarray, voxel_size: float, num_channels: int) -> VoxelField:
        """An empty field with all blocks that hold one of the (N, 3) points."""
        origin = np.round(points.min(axis=0)) - 1.0
        blocks = np.unique(_voxel_keys(points, origin, voxel_size) // BLOCK, axis=0)
        grid = o3d.t.geometry.VoxelBlockGrid(("votes",), (o3d.core.int32,), ((SIDES * num_channels,),), voxel_size, BLOCK, max(len(blocks), 1))
        grid.hashmap().activate(o3d.core.Tensor(blocks.astype(np.int32)))
        return cls(grid, voxel_size, origin, num_channels)

    @property
    def votes(self) -> np.ndarray:
        """(cells, C) int32 view of the counts, shared with the grid; row = what `find` returns."""
        return self.grid.attribute("votes").numpy().reshape(-1, self.num_channels)

    def find(self, points: np.ndarray, sides: np.ndarray | None = None) -> np.ndarray:
        """(N,) int64 cell of each (N, 3) point; -1 where there is no block. sides: (N,) 0 or 1; None = side 0."""
        keys = _voxel_keys(points, self.origin, self.voxel_size)
        blocks, block_of_point = np.unique(keys // BLOCK, axis=0, return_inverse=True)
        slots, found = self.grid.hashmap().find(o3d.core.Tensor(blocks.astype(np.int32)))
        slots = np.where(found.numpy(), slots.numpy().astype(np.int64), -1)[block_of_point.ravel()]
        inside = keys % BLOCK  # the grid's own order in memory: z outermost, x innermost
        cells = (slots * BLOCK**3 + (inside[:, 2] * BLOCK + inside[:, 1]) * BLOCK + inside[:, 0]) * SIDES
        if sides is not None:
            cells = cells + sides
        return np.where(slots >= 0, cells, -1)

    def merge(self, other: VoxelField) -> None:
        """Add the counts of another field of the same origin, voxel size and channels."""
        if (other.voxel_size, other.num_channels) != (self.voxel_size, self.num_channels) or (other.origin != self.origin).any():
            raise ValueError("only fields with the same origin, voxel size and channels can be merged")
        keys = other.grid.hashmap().key_tensor()[other.grid.hashmap().active_buf_indices().to(o3d.core.int64)]
        self.grid.hashmap().activate(keys)
        slots = self.grid.hashmap().find(keys)[0].numpy()
        theirs = other.grid.attribute("votes").numpy()[other.grid.hashmap().active_buf_indices().numpy()]
        self.grid.attribute("votes").numpy()[slots] += theirs

    def save(self, path: Path) -> None:
        """Write the grid with `VoxelBlockGrid.save` (npz)."""
        self.grid.save(str(path))


def normal_sides(points: np.ndarray, normals: np.ndarray, origin: np.ndarray, voxel_size: float) -> np.ndarray:
    """(N,) uint8 side of each point in its voxel: 0 where its normal points along the voxel's main normal axis, else 1.

    The axis is the largest eigenvector of sum n n^T of the voxel's points, its sign fixed by its largest component.
    """
    _, voxel_of_point = np.unique(_voxel_keys(points, origin, voxel_size), axis=0, return_inverse=True)
    voxel_of_point = voxel_of_point.ravel()
    order = np.lexsort((normals[:, 2], normals[:, 1], normals[:, 0], voxel_of_point))  # fixed order of summation
    outer = np.einsum("ni,nj->nij", normals[order].astype(np.float64), normals[order]).reshape(-1, 9)
    starts = np.flatnonzero(np.diff(voxel_of_point[order], prepend=-1))
    axes = np.linalg.eigh(np.add.reduceat(outer, starts).reshape(-1, 3, 3))[1][:, :, 2]
    largest = np.take_along_axis(axes, np.abs(axes).argmax(axis=1)[:, None], axis=1)
    axes = axes * np.sign(largest)
    return (np.einsum("ij,ij->i", normals, axes[voxel_of_point]) < -0.1).astype(np.uint8)


def _voxel_keys(points: np.ndarray, origin: np.ndarray, voxel_size: float) -> np.ndarray:
    return np.floor((np.asarray(points, np.float64) - origin) / voxel_size).astype(np.int64)
