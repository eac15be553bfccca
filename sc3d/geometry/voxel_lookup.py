"""Which row belongs to a voxel, inside kernels: the blocks and voxels of `voxels`, coarse to fine.

Open3D's hash map of blocks cannot be asked from a kernel, so the blocks are entered once more in a table that
can.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from sc3d.geometry.voxels import AXIS_BITS, BLOCK, VOXELS

NOTHING = -1
MIXER = 0x9E3779B97F4A7C15  # 2^64 / golden ratio: multiplicative hashing (Knuth)
AXIS_MASK = (1 << AXIS_BITS) - 1


class VoxelLookup(NamedTuple):
    """Rows of V voxels.

    table: (T, 2) int64 hash table with open addressing, T a power of two: packed block position (-1 = free),
        row of the block
    rows: (B, 512) int32 row of each voxel of a block, or -1
    low, high: (3,) int64 first block and one past the last
    """

    table: np.ndarray
    rows: np.ndarray
    low: np.ndarray
    high: np.ndarray


def voxel_lookup(keys: np.ndarray) -> VoxelLookup:
    """keys: (V,) int64 voxel keys (`voxels.voxel_keys`), each once; voxel k gets row k."""
    blocks, block_of_voxel = np.unique(keys // VOXELS, return_inverse=True)
    table = np.full((1 << int(2 * len(blocks)).bit_length(), 2), NOTHING, np.int64)
    _enter(table, blocks)
    rows = np.full((len(blocks), VOXELS), NOTHING, np.int32)
    rows[block_of_voxel, keys % VOXELS] = np.arange(len(keys), dtype=np.int32)
    positions = blocks[:, None] >> np.array([2, 1, 0]) * AXIS_BITS & AXIS_MASK
    low, high = (
        (positions.min(axis=0), positions.max(axis=0) + 1) if len(blocks) else np.zeros((2, 3), np.int64)
    )
    return VoxelLookup(table, rows, low, high)


@numba.njit(cache=True)
def _place(block, size):
    return np.int64((np.uint64(block) * np.uint64(MIXER)) >> np.uint64(20)) & (size - 1)


@numba.njit(cache=True)
def _enter(table, blocks):
    """Arrays as in VoxelLookup."""
    for row in range(len(blocks)):
        place = _place(blocks[row], len(table))
        while table[place, 0] != NOTHING:
            place = (place + 1) & (len(table) - 1)
        table[place, 0], table[place, 1] = blocks[row], row


@numba.njit(cache=True, inline="always")
def find_block(table, x, y, z):
    """Row of the block at x, y, z (blocks), or -1."""
    block = ((x << AXIS_BITS | y) << AXIS_BITS) | z
    place = _place(block, len(table))
    while table[place, 0] != NOTHING and table[place, 0] != block:
        place = (place + 1) & (len(table) - 1)
    return table[place, 1]


@numba.njit(cache=True)
def find_voxel(lookup, x, y, z):
    """Row of the voxel at x, y, z >= 0 (voxels), or -1."""
    block = find_block(lookup.table, x // BLOCK, y // BLOCK, z // BLOCK)
    return (
        lookup.rows[block, ((z % BLOCK) * BLOCK + y % BLOCK) * BLOCK + x % BLOCK] if block >= 0 else NOTHING
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
