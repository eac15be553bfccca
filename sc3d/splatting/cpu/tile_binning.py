"""Numba kernels that sort records into tiles of 16 x 16 px: which Gaussians touch which tile, front to back.

An *instance* is a (Gaussian, tile) pair. Instances are numbered Gaussian by Gaussian, so that what each of
them sums up can be added per Gaussian in a fixed order, whatever the number of threads. Only tiles that the
ellipse of alpha >= 1/255 really touches are listed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from sc3d.splatting.cpu.projection import MIN_ALPHA, interleaved

TILE = 16
# log2 alpha above 1/255; half the slack of the extents in `projection`
ROOM = np.float32(-math.log2(MIN_ALPHA) + 5e-4)
_BLOCKS = 8  # work items of the counting sort
_HALF, _ZERO, _ONE = np.float32(0.5), np.float32(0.0), np.float32(1.0)


class TileLists(NamedTuple):
    """What touches which tile: P instances of M visible Gaussians.

    visible: (M,) Gaussian ids; offsets: (M + 1,) first instance of each; records: (M * 16,) near to far
    ranks, instances: (P,) tile by tile and near to far, row in `records` and number; starts: (tiles + 1,)
    order: (tiles,) permutation in which threads share the tiles
    """

    visible: np.ndarray
    offsets: np.ndarray
    records: np.ndarray
    ranks: np.ndarray
    instances: np.ndarray
    starts: np.ndarray
    order: np.ndarray


def sort_into_tiles(size: tuple[int, int], all_records: np.ndarray, depths: np.ndarray) -> TileLists:
    """Tile lists of the records (N, 16) with a depth above 0. size: width, height, px"""
    width, height = size
    visible = np.flatnonzero(depths)
    order, records = _near_to_far(depths[visible]), np.empty((len(visible), all_records.shape[1]), np.float32)
    tiles = -(-width // TILE) * -(-height // TILE)
    histograms, starts = np.zeros((_BLOCKS, tiles), np.int32), np.empty(tiles + 1, np.int64)
    offsets = np.zeros(len(visible) + 1, np.int64)
    count_instances(order, visible, all_records, records, width, height, histograms, offsets[1:])
    np.cumsum(offsets, out=offsets)
    place_blocks(histograms, starts)
    ranks, instances = np.empty(offsets[-1], np.int32), np.empty(offsets[-1], np.int32)
    place_instances(order, records, width, height, histograms, offsets, ranks, instances)
    return TileLists(visible, offsets, records.reshape(-1), ranks, instances, starts, interleaved(tiles))


def _near_to_far(depths: np.ndarray) -> np.ndarray:
    """(M,) indices that sort positive float32 depths; ties by index."""
    keys = depths.view(np.uint32).astype(np.uint64) << np.uint64(32) | np.arange(len(depths), dtype=np.uint64)
    keys.sort()
    return (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)


@numba.njit(cache=True, error_model="numpy")
def first_pixel(low, limit):
    """Smallest pixel index >= 0 whose center is >= low, at most limit."""
    place = min(max(low - _HALF, _ZERO), np.float32(limit))
    whole = np.int64(place)
    # math.ceil would be a library call in the innermost loops
    return whole + np.int64(np.float32(whole) < place)


@numba.njit(cache=True, error_model="numpy")
def last_pixel(high, limit):
    """Largest pixel index <= limit whose center is <= high, at least -1."""
    return np.int64(min(max(high + _HALF, _ZERO), np.float32(limit) + _ONE)) - 1


@numba.njit(cache=True, error_model="numpy")
def tile_frame(tile, width, height):
    """Left, top, rows and columns of a tile, px."""
    tiles_x = (width + TILE - 1) // TILE
    left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
    return left, top, min(TILE, height - top), min(TILE, width - left)


@numba.njit(cache=True, error_model="numpy")
def _tile_rows(record, height):
    """First and last tile row that the ellipse of a record touches."""
    return first_pixel(record[1] - record[7], height) // TILE, last_pixel(
        record[1] + record[7], height - 1
    ) // TILE


@numba.njit(cache=True, error_model="numpy")
def _tile_columns(record, tile_row, width, height):
    """First and last tile column that the ellipse touches between the first and last pixel center of a tile
    row; empty if first > last.
    """
    mean_y, half_y, extreme = record[1], record[7], record[15]
    top = max(np.float32(tile_row * TILE) + _HALF - mean_y, -half_y)
    bottom = min(np.float32(min((tile_row + 1) * TILE, height)) - _HALF - mean_y, half_y)
    if top > bottom:
        return 1, 0
    right, left = min(max(extreme, top), bottom), min(max(-extreme, top), bottom)
    room = record[5] + ROOM
    high = record[0] + record[2] * right + math.sqrt(max(room - record[4] * right * right, _ZERO) / record[3])
    low = record[0] + record[2] * left - math.sqrt(max(room - record[4] * left * left, _ZERO) / record[3])
    first, last = first_pixel(low, width), last_pixel(high, width - 1)
    if first > last:
        return 1, 0
    return first // TILE, last // TILE


@numba.njit(cache=True, error_model="numpy", parallel=True)
def count_instances(near_to_far, visible, all_records, records, width, height, histograms, counts):
    """Copies records (M, 16) in depth order; counts tiles per Gaussian, and Gaussians per tile in each of
    several blocks of the depth order.

    near_to_far: (M,) order of visible (M,), the ids of all_records that matter
    counts: (M,) in the order of `visible`; histograms: (blocks, tiles), zero on entry
    """
    blocks, tiles_x = histograms.shape[0], (width + TILE - 1) // TILE
    size = (near_to_far.shape[0] + blocks - 1) // blocks
    for block in numba.prange(blocks):
        for rank in range(block * size, min(near_to_far.shape[0], (block + 1) * size)):
            source, record = visible[near_to_far[rank]], records[rank]
            for k in range(record.shape[0]):
                record[k] = all_records[source, k]
            count = 0
            first_row, last_row = _tile_rows(record, height)
            for row in range(first_row, last_row + 1):
                first, last = _tile_columns(record, row, width, height)
                for column in range(first, last + 1):
                    histograms[block, row * tiles_x + column] += 1
                count += max(last - first + 1, 0)
            counts[near_to_far[rank]] = count


@numba.njit(cache=True, error_model="numpy")
def place_blocks(histograms, starts):
    """Turns counts (blocks, tiles) into each block's first place in each tile, tile by tile; starts (tiles +
    1,).
    """
    place = 0
    for tile in range(histograms.shape[1]):
        starts[tile] = place
        for block in range(histograms.shape[0]):
            count = histograms[block, tile]
            histograms[block, tile] = place
            place += count
    starts[histograms.shape[1]] = place


@numba.njit(cache=True, error_model="numpy", parallel=True)
def place_instances(near_to_far, records, width, height, histograms, offsets, ranks, instances):
    """Counting sort: for each tile, front to back, the row in `records` and the number of each instance.

    offsets: (M + 1,) first instance of each visible Gaussian; histograms: from `place_blocks`, used up
    """
    blocks, tiles_x = histograms.shape[0], (width + TILE - 1) // TILE
    size = (near_to_far.shape[0] + blocks - 1) // blocks
    for block in numba.prange(blocks):
        for rank in range(block * size, min(near_to_far.shape[0], (block + 1) * size)):
            instance = offsets[near_to_far[rank]]
            first_row, last_row = _tile_rows(records[rank], height)
            for row in range(first_row, last_row + 1):
                first, last = _tile_columns(records[rank], row, width, height)
                for column in range(first, last + 1):
                    place = histograms[block, row * tiles_x + column]
                    histograms[block, row * tiles_x + column] = place + 1
                    ranks[place], instances[place] = rank, instance
                    instance += 1
