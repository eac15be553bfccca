"""A sparse field of voxels on Open3D's `VoxelBlockGrid`: integer counts in voxels near points.

Two levels: blocks of BLOCK^3 voxels in a hash map, and the voxels of each block. A voxel has two sides, told
apart by the
normals of its points, so that a wall thinner than a voxel keeps what was seen on either face.
Counts are integers: sums of integers do not depend on the order of views, points or threads, and fields merge
by addition.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
import open3d as o3d

BLOCK = 8
SIDES = 2
VOXELS = BLOCK**3  # of a block
AXIS_BITS = 18  # of a block's position along one axis; three of them and a voxel's 9 bits make one int64
# of a voxel, below the smallest coordinate: irrational, so that points on a regular grid do not lie on voxel
# faces
ORIGIN_SHIFT = 0.381966
# share of the main axis in the squared normals of a voxel's points; below it they scatter (leaves, corners)
# and have no two sides
FLAT = 0.75
FIXED = 1 << 20  # products of unit normals as integers


class LabelGrid:
    """Counts of C channels for every voxel side.

    grid: VoxelBlockGrid with attribute `votes` (blocks, 8, 8, 8, SIDES * C) int32
    voxel_size: world units; origin: (3,) float64 world position of the grid's zero
    """

    def __init__(
        self, grid: o3d.t.geometry.VoxelBlockGrid, voxel_size: float, origin: np.ndarray, num_channels: int
    ) -> None:
        self.grid, self.voxel_size, self.origin, self.num_channels = (
            grid,
            voxel_size,
            np.asarray(origin, np.float64),
            num_channels,
        )

    @classmethod
    def around(cls, points: np.ndarray, voxel_size: float, num_channels: int) -> LabelGrid:
        """An empty field with all blocks that hold one of the (N, 3) points."""
        return cls.from_voxels(sort_by_voxel(points, voxel_size), num_channels)

    @classmethod
    def from_voxels(cls, sorting: VoxelOrder, num_channels: int) -> LabelGrid:
        """An empty field with all blocks of points that are sorted already."""
        keys = sorting.keys // VOXELS
        blocks = _unpack(keys[np.flatnonzero(np.diff(keys, prepend=-1))])
        grid = o3d.t.geometry.VoxelBlockGrid(
            ("votes",),
            (o3d.core.int32,),
            ((SIDES * num_channels,),),
            sorting.voxel_size,
            BLOCK,
            max(len(blocks), 1),
        )
        grid.hashmap().activate(o3d.core.Tensor(blocks))
        return cls(grid, sorting.voxel_size, sorting.origin, num_channels)

    @property
    def votes(self) -> np.ndarray:
        """(cells, C) int32 view of the counts, shared with the grid; row = what `find` returns."""
        return self.grid.attribute("votes").numpy().reshape(-1, self.num_channels)

    def find(self, points: np.ndarray, sides: np.ndarray | None = None) -> np.ndarray:
        """(N,) int64 cell of each (N, 3) point; -1 where there is no block. sides: (N,) 0 or 1; None = side
        0.
        """
        keys = voxel_keys(points, self.origin, self.voxel_size)
        cells = self.find_keys(np.maximum(keys, 0))
        return np.where((keys >= 0) & (cells >= 0), cells if sides is None else cells + sides, -1)

    def find_keys(self, keys: np.ndarray) -> np.ndarray:
        """(N,) int64 cell, side 0, of each voxel key (`voxel_keys`); -1 where there is no block."""
        blocks, block_of_key = np.unique(keys // VOXELS, return_inverse=True)
        slots, found = self.grid.hashmap().find(o3d.core.Tensor(_unpack(blocks)))
        slots = np.where(found.numpy(), slots.numpy().astype(np.int64), -1)[block_of_key.ravel()]
        return np.where(slots >= 0, (slots * VOXELS + keys % VOXELS) * SIDES, -1)

    def block_positions(self, blocks: np.ndarray) -> np.ndarray:
        """(B, 3) int32 positions, in blocks from the origin, of packed block keys (B,)."""
        return _unpack(blocks)

    def block_votes(self, blocks: np.ndarray) -> np.ndarray:
        """(B, 8, 8, 8, SIDES * C) int32 counts of packed block keys (B,), which must be in the field."""
        votes = self.grid.attribute("votes").numpy()
        return (
            votes[self.grid.hashmap().find(o3d.core.Tensor(_unpack(blocks)))[0].numpy()]
            if len(blocks)
            else votes[:0]
        )

    def merge(self, other: LabelGrid) -> None:
        """Add the counts of another field of the same origin, voxel size and channels."""
        if (other.voxel_size, other.num_channels) != (self.voxel_size, self.num_channels) or (
            other.origin != self.origin
        ).any():
            raise ValueError("only fields with the same origin, voxel size and channels can be merged")
        keys = other.grid.hashmap().key_tensor()[other.grid.hashmap().active_buf_indices().to(o3d.core.int64)]
        self.grid.hashmap().activate(keys)
        slots = self.grid.hashmap().find(keys)[0].numpy()
        theirs = other.grid.attribute("votes").numpy()[other.grid.hashmap().active_buf_indices().numpy()]
        self.grid.attribute("votes").numpy()[slots] += theirs

    def save(self, path: Path) -> None:
        """Write an npz that `VoxelBlockGrid.load` reads, blocks ordered by position. Not by
        `VoxelBlockGrid.save`, which ends the process if the disk is full.
        """
        slots = self.grid.hashmap().active_buf_indices().numpy()
        keys = self.grid.hashmap().key_tensor().numpy()[slots]
        order = np.lexsort(keys.T)
        np.savez(
            path,
            **{
                "value_000": self.grid.attribute("votes").numpy()[slots[order]],
                "key": keys[order],
                "attr_name_votes": np.zeros(1, np.int32),
                "CPU:0": np.uint8(0),
                "block_resolution": np.int64([BLOCK]),
                "voxel_size": np.float32([self.voxel_size]),
            },
        )


@dataclass(frozen=True)
class VoxelOrder:
    """N points sorted by block and voxel, so that the V voxels that hold points are contiguous.

    origin: (3,) world position of the grid's zero; voxel_size: world units
    order: (N,) int64 rows of the points; starts: (V + 1,) int64, voxel v holds order[starts[v] : starts[v +
        1]]
    keys: (V,) int64 voxel keys, rising
    """

    origin: np.ndarray
    voxel_size: float
    order: np.ndarray
    starts: np.ndarray
    keys: np.ndarray


def sort_by_voxel(points: np.ndarray, voxel_size: float, origin: np.ndarray | None = None) -> VoxelOrder:
    """Sort (N, 3) world points by voxel. origin: (3,), None = a little below the points, so that moved or
    scaled worlds fall into the same voxels.
    """
    if origin is None:
        origin = voxel_origin(points.min(axis=0), voxel_size)
    keys = voxel_keys(points, origin, voxel_size)
    if len(keys) and keys.min() < 0:
        raise ValueError(
            f"voxels of {voxel_size} are too small for the extent of the points: more than {BLOCK << AXIS_BITS} along an axis"
        )
    order = np.argsort(keys)
    keys = keys[order]
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    return VoxelOrder(
        np.asarray(origin, np.float64), voxel_size, order, np.append(first, len(keys)), keys[first]
    )


def voxel_origin(low: np.ndarray, voxel_size: float) -> np.ndarray:
    """(3,) world position of the zero of a grid over points whose smallest coordinates are `low` (3,)."""
    return np.asarray(low, np.float64) - ORIGIN_SHIFT * voxel_size


def voxel_keys(points: np.ndarray, origin: np.ndarray, voxel_size: float) -> np.ndarray:
    """(N,) int64 block and voxel of each (N, 3) world point in one number; -1 beyond the grid.

    The voxels of a block follow one another in the grid's own order in memory: z outermost, x innermost.
    """
    return _pack(np.ascontiguousarray(points, np.float64), np.asarray(origin, np.float64), voxel_size)


def normal_sides(normals: np.ndarray, sorting: VoxelOrder) -> tuple[np.ndarray, np.ndarray]:
    """Which face of its voxel each point lies on.

    normals: (N, 3) float32 unit, in the points' own order
    returns: (N,) uint8, 0 where the normal points along the voxel's main normal axis, else 1; (V,) bool
        voxels whose normals keep to an axis.
    The axis is the largest eigenvector of sum n n^T of the voxel's points, its sign fixed by its largest
    component.
    """
    sides, flat = np.empty(len(normals), np.uint8), np.empty(len(sorting.keys), np.bool_)
    _split_sides(normals, sorting.order, sorting.starts, sides, flat)
    return sides, flat


@numba.njit(parallel=True, cache=True)
def _pack(points, origin, voxel_size):
    """Arrays as in voxel_keys."""
    keys = np.empty(len(points), np.int64)
    for row in numba.prange(len(points)):
        x = np.int64(np.floor((points[row, 0] - origin[0]) / voxel_size))
        y = np.int64(np.floor((points[row, 1] - origin[1]) / voxel_size))
        z = np.int64(np.floor((points[row, 2] - origin[2]) / voxel_size))
        limit = BLOCK << AXIS_BITS
        if min(x, y, z) < 0 or max(x, y, z) >= limit:
            keys[row] = -1
            continue
        block = (((x // BLOCK) << AXIS_BITS | y // BLOCK) << AXIS_BITS) | z // BLOCK
        keys[row] = block * VOXELS + ((z % BLOCK) * BLOCK + y % BLOCK) * BLOCK + x % BLOCK
    return keys


def _unpack(blocks: np.ndarray) -> np.ndarray:
    """(B, 3) int32 block positions of packed ones (B,)."""
    mask = (1 << AXIS_BITS) - 1
    return np.stack([blocks >> 2 * AXIS_BITS, blocks >> AXIS_BITS & mask, blocks & mask], axis=1).astype(
        np.int32
    )


@numba.njit(parallel=True, cache=True)
def _split_sides(normals, order, starts, sides, flat):
    """Arrays as in normal_sides."""
    for voxel in numba.prange(len(starts) - 1):
        xx = xy = xz = yy = yz = zz = 0  # integers: the sums do not depend on the order of the points
        for k in range(starts[voxel], starts[voxel + 1]):
            x, y, z = (
                np.float64(normals[order[k], 0]),
                np.float64(normals[order[k], 1]),
                np.float64(normals[order[k], 2]),
            )
            xx += np.int64(x * x * FIXED)
            xy += np.int64(x * y * FIXED)
            xz += np.int64(x * z * FIXED)
            yy += np.int64(y * y * FIXED)
            yz += np.int64(y * z * FIXED)
            zz += np.int64(z * z * FIXED)
        x, y, z = main_axis(
            np.float64(xx), np.float64(xy), np.float64(xz), np.float64(yy), np.float64(yz), np.float64(zz)
        )
        along = xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)
        flat[voxel] = along >= FLAT * (xx + yy + zz)
        for k in range(starts[voxel], starts[voxel + 1]):
            row = order[k]
            sides[row] = (
                flat[voxel] and normals[row, 0] * x + normals[row, 1] * y + normals[row, 2] * z < -0.1
            )


@numba.njit(cache=True)
def main_axis(xx, xy, xz, yy, yz, zz):
    """Largest eigenvector of a symmetric positive 3 x 3 matrix, given by its upper half; its largest
    component is positive.

    Squared 6 times, the matrix is the projector on it up to the 64th power of the eigenvalues' ratio.
    """
    for _ in range(6):
        trace = max(xx + yy + zz, 1e-300)
        xx, xy, xz, yy, yz, zz = xx / trace, xy / trace, xz / trace, yy / trace, yz / trace, zz / trace
        xx, xy, xz, yy, yz, zz = (
            xx * xx + xy * xy + xz * xz,
            xx * xy + xy * yy + xz * yz,
            xx * xz + xy * yz + xz * zz,
            xy * xy + yy * yy + yz * yz,
            xy * xz + yy * yz + yz * zz,
            xz * xz + yz * yz + zz * zz,
        )
    x, y, z = xx, xy, xz  # the column with the largest diagonal
    if yy > xx and yy >= zz:
        x, y, z = xy, yy, yz
    elif zz > xx:
        x, y, z = xz, yz, zz
    length = max(np.sqrt(x * x + y * y + z * z), 1e-300)
    largest = x
    if abs(y) > abs(largest):
        largest = y
    if abs(z) > abs(largest):
        largest = z
    length = -length if largest < 0 else length
    return x / length, y / length, z / length
