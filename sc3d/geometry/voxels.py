"""A sparse grid of voxels on Open3D's `VoxelBlockGrid`: blocks of BLOCK^3 voxels in a hash map (coarse level), and
the voxels of each block (fine level).

A voxel has two sides, told apart by the normals of its points, so that a wall thinner than a voxel keeps what was
seen on either face. Counts are integers: sums of integers do not depend on the order of views, points or threads,
and grids merge by addition.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import open3d as o3d

BLOCK = 8
SIDES = 2
VOXELS = BLOCK**3  # of a block
AXIS_BITS = 18  # of a block's position along one axis; three of them and a voxel's 9 bits make one int64
AXIS_MASK = (1 << AXIS_BITS) - 1
# of a voxel, below the smallest coordinate: irrational, so that points on a regular grid do not lie on voxel faces
ORIGIN_SHIFT = 0.381966
# share of the main axis in the squared normals of a voxel's points; below it they scatter (leaves, corners) and
# have no two sides
FLAT = 0.75
FIXED = 1 << 20  # products of unit normals as integers
NOTHING = -1
MIXER = 0x9E3779B97F4A7C15  # 2^64 / golden ratio: multiplicative hashing (Knuth)
AROUND = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], np.int32)


class VoxelIndex(NamedTuple):
    """A `NumberedVoxels` for kernels, which cannot ask Open3D's hash map: its blocks once more, in a table.

    table: (T, 2) int64 open addressing, T a power of two: packed block position (-1 = free), slot of the block
    numbers: (slots, 512) int32 number of each voxel of a block, or -1
    low, high: (3,) int64 first block and one past the last
    """

    table: np.ndarray
    numbers: np.ndarray
    low: np.ndarray
    high: np.ndarray


class VoxelGrid:
    """An attribute for every voxel in the blocks that hold one of the given voxels.

    grid: VoxelBlockGrid with one attribute (slots, 8, 8, 8, channels); a block's slot is its row there
    voxel_size: world units; origin: (3,) float64 world position of the grid's zero
    """

    ATTRIBUTE = "value"
    DTYPE = o3d.core.int32

    def __init__(self, grid: o3d.t.geometry.VoxelBlockGrid, voxel_size: float, origin: np.ndarray) -> None:
        self.grid, self.voxel_size, self.origin = grid, voxel_size, np.asarray(origin, np.float64)

    @classmethod
    def activate(cls, keys: np.ndarray, voxel_size: float, origin: np.ndarray, num_channels: int):
        """A grid of zeros with all blocks of the (V,) int64 voxel keys (`voxel_keys`), rising."""
        blocks = keys // VOXELS
        positions = unpack_blocks(blocks[np.flatnonzero(np.diff(blocks, prepend=-1))])
        channels, count = ((num_channels,),), max(len(positions), 1)
        grid = o3d.t.geometry.VoxelBlockGrid(
            (cls.ATTRIBUTE,), (cls.DTYPE,), channels, voxel_size, BLOCK, count
        )
        grid.hashmap().activate(o3d.core.Tensor(positions))
        return cls(grid, voxel_size, origin)

    @property
    def values(self) -> np.ndarray:
        """(slots, 512, channels) view of the attribute, shared with the grid."""
        values = self.grid.attribute(self.ATTRIBUTE).numpy()
        return values.reshape(len(values), VOXELS, -1)

    def slots(self, positions: np.ndarray) -> np.ndarray:
        """(B,) int64 slot of each block at (B, 3) int32 positions, in blocks from the origin; -1 = not in the grid."""
        if not len(positions):
            return np.zeros(0, np.int64)
        slots, found = self.grid.hashmap().find(o3d.core.Tensor(np.ascontiguousarray(positions, np.int32)))
        return np.where(found.numpy(), slots.numpy().astype(np.int64), NOTHING)

    def blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """(B,) int64 slots of all blocks and their (B, 3) int32 positions, ordered by position: z, y, x."""
        slots = self.grid.hashmap().active_buf_indices().numpy().astype(np.int64)
        positions = self.grid.hashmap().key_tensor().numpy()[slots]
        order = np.lexsort(positions.T)
        return slots[order], positions[order]

    def neighbors(self) -> np.ndarray:
        """(slots, 27) int64 slots of the blocks around each block, in the order of AROUND; -1 = none there."""
        slots, positions = self.blocks()
        result = np.full((len(self.values), len(AROUND)), NOTHING)
        result[slots] = self.slots((positions[:, None] + AROUND).reshape(-1, 3)).reshape(-1, len(AROUND))
        return result

    def find_voxels(self, keys: np.ndarray) -> np.ndarray:
        """(N,) int64 voxel of each voxel key, 512 x slot + place in the block; -1 where there is no block."""
        blocks, block_of_key = np.unique(keys // VOXELS, return_inverse=True)
        slots = self.slots(unpack_blocks(blocks))[block_of_key.ravel()]
        return np.where(slots >= 0, slots * VOXELS + keys % VOXELS, NOTHING)


class NumberedVoxels(VoxelGrid):
    """Some voxels, each with a number. attribute `number`: (slots, 8, 8, 8, 1) int32, -1 = none of them."""

    ATTRIBUTE = "number"

    @classmethod
    def from_keys(cls, keys: np.ndarray, voxel_size: float, origin: np.ndarray) -> NumberedVoxels:
        """keys: (V,) int64 voxel keys (`voxel_keys`), rising; voxel k gets number k."""
        grid = cls.activate(keys, voxel_size, origin, 1)
        grid.values[:] = NOTHING
        grid.values.reshape(-1)[grid.find_voxels(keys)] = np.arange(len(keys), dtype=np.int32)
        return grid

    def index(self) -> VoxelIndex:
        """The same for kernels (`find_block`, `find_voxel`)."""
        slots, positions = self.blocks()
        table = np.full((1 << int(2 * len(slots)).bit_length(), 2), NOTHING, np.int64)
        _enter(table, pack_blocks(positions.astype(np.int64)), slots)
        low, high = (positions.min(axis=0), positions.max(axis=0) + 1) if len(slots) else np.zeros((2, 3))
        return VoxelIndex(table, self.values[:, :, 0], low.astype(np.int64), high.astype(np.int64))


class LabelGrid(VoxelGrid):
    """The label field: counts of C channels for every side of every voxel. Its rows are what votes are added to.

    attribute `votes`: (slots, 8, 8, 8, SIDES * C) int32
    """

    ATTRIBUTE = "votes"

    @classmethod
    def from_voxels(cls, voxels: VoxelOrder, num_channels: int) -> LabelGrid:
        """An empty field with all blocks of points that are sorted already."""
        return cls.activate(voxels.keys, voxels.voxel_size, voxels.origin, SIDES * num_channels)

    @property
    def votes(self) -> np.ndarray:
        """(rows, C) int32 view of the counts, shared with the grid; row = what `find` returns."""
        values = self.values
        return values.reshape(-1, values.shape[2] // SIDES)

    def find(self, points: np.ndarray, sides: np.ndarray | None = None) -> np.ndarray:
        """(N,) int64 row of each (N, 3) world point; -1 where there is no block. sides: (N,) 0 or 1; None = side 0."""
        keys = voxel_keys(points, self.origin, self.voxel_size)
        voxels = self.find_voxels(np.maximum(keys, 0))
        return np.where(
            (keys >= 0) & (voxels >= 0), voxels * SIDES + (0 if sides is None else sides), NOTHING
        )

    def add(self, rows: np.ndarray, counts: np.ndarray) -> None:
        """Add (N, C) counts at (N,) rows, of which some may be the same."""
        np.add.at(self.votes, rows, counts)

    def merge(self, other: LabelGrid) -> None:
        """Add the counts of another field of the same origin, voxel size and channels."""
        same = (other.voxel_size, other.votes.shape[1]) == (self.voxel_size, self.votes.shape[1])
        if not same or (other.origin != self.origin).any():
            raise ValueError("only fields with the same origin, voxel size and channels can be merged")
        theirs, positions = other.blocks()
        self.grid.hashmap().activate(o3d.core.Tensor(positions))
        self.values[self.slots(positions)] += other.values[theirs]

    def save(self, path: Path, class_ids: np.ndarray | None = None) -> None:
        """Write an npz that `VoxelBlockGrid.load` reads, blocks ordered by position. Not by `VoxelBlockGrid.save`,
        which ends the process if the disk is full. class_ids: as in `file_header`
        """
        slots, positions = self.blocks()
        votes = self.grid.attribute(self.ATTRIBUTE).numpy()[slots]
        arrays = {"value_000": votes, "key": positions, **file_header(self.voxel_size, class_ids)}
        np.savez(path, **arrays)


def file_header(voxel_size: float, class_ids: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """What `VoxelBlockGrid.load` reads in the file of a label field beside `key` (B, 3) and `value_000`.

    class_ids: (C,) uint8 class of each channel, kept as `class_ids`, which Open3D does not read, unless these are
        0, 1, 2, ...
    """
    ids = {} if class_ids is None or len(class_ids) > class_ids[-1] else {"class_ids": class_ids}
    return ids | {
        "attr_name_votes": np.zeros(1, np.int32),
        "CPU:0": np.zeros((), np.uint8),
        "block_resolution": np.array([BLOCK], np.int64),
        "voxel_size": np.array([voxel_size], np.float32),
    }


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
    return _key_of(np.ascontiguousarray(points, np.float64), np.asarray(origin, np.float64), voxel_size)


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
def _key_of(points, origin, voxel_size):
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
        keys[row] = voxel_key(x, y, z)
    return keys


def unpack_blocks(blocks: np.ndarray) -> np.ndarray:
    """(B, 3) int32 block positions of packed ones (B,)."""
    packed = [blocks >> 2 * AXIS_BITS, blocks >> AXIS_BITS & AXIS_MASK, blocks & AXIS_MASK]
    return np.stack(packed, axis=1).astype(np.int32)


def pack_blocks(positions: np.ndarray) -> np.ndarray:
    """(B,) int64 packed block positions of (B, 3) int64 ones."""
    return (positions[:, 0] << AXIS_BITS | positions[:, 1]) << AXIS_BITS | positions[:, 2]


@numba.njit(cache=True)
def _place(block, size):
    return np.int64((np.uint64(block) * np.uint64(MIXER)) >> np.uint64(20)) & (size - 1)


@numba.njit(cache=True)
def _enter(table, blocks, slots):
    """Fill the table of a `VoxelIndex`."""
    for k in range(len(blocks)):
        place = _place(blocks[k], len(table))
        while table[place, 0] != NOTHING:
            place = (place + 1) & (len(table) - 1)
        table[place, 0], table[place, 1] = blocks[k], slots[k]


@numba.njit(cache=True, inline="always")
def find_block(table, x, y, z):
    """Slot of the block at x, y, z (blocks), or -1."""
    block = ((x << AXIS_BITS | y) << AXIS_BITS) | z
    place = _place(block, len(table))
    while table[place, 0] != NOTHING and table[place, 0] != block:
        place = (place + 1) & (len(table) - 1)
    return table[place, 1]


@numba.njit(cache=True)
def find_voxel(index, x, y, z):
    """Number of the voxel at x, y, z >= 0 (voxels), or -1."""
    block = find_block(index.table, x // BLOCK, y // BLOCK, z // BLOCK)
    return (
        index.numbers[block, ((z % BLOCK) * BLOCK + y % BLOCK) * BLOCK + x % BLOCK] if block >= 0 else NOTHING
    )


@numba.njit(cache=True)
def voxel_key(x, y, z):
    """Key of the voxel at x, y, z >= 0 (voxels)."""
    return (
        ((((x // BLOCK << AXIS_BITS | y // BLOCK) << AXIS_BITS) | z // BLOCK) * VOXELS)
        + ((z % BLOCK) * BLOCK + y % BLOCK) * BLOCK
        + x % BLOCK
    )


@numba.njit(cache=True)
def voxel_position(key):
    """Returns x, y, z in voxels."""
    block, place = key // VOXELS, key % VOXELS
    x, y, z = block >> 2 * AXIS_BITS, block >> AXIS_BITS & AXIS_MASK, block & AXIS_MASK
    return x * BLOCK + place % BLOCK, y * BLOCK + place // BLOCK % BLOCK, z * BLOCK + place // (BLOCK * BLOCK)


def voxel_positions(keys: np.ndarray) -> np.ndarray:
    """(K, 3) int64, in voxels, of voxel keys (K,)."""
    place = keys % VOXELS
    inside = [place % BLOCK, place // BLOCK % BLOCK, place // (BLOCK * BLOCK)]
    return unpack_blocks(keys // VOXELS).astype(np.int64) * BLOCK + np.stack(inside, axis=1)


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
