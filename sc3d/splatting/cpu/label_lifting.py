"""Numba kernels: how much of each class every Gaussian shows in a view.

The walk of `kernels_raster` with the same operations, hence the same fragments and weights; instead of
compositing colors it sums the weights w
of a fragment over the pixels of each class. A tile keeps one plane of mask weights per class that occurs in
it, mostly one or two.
"""

from __future__ import annotations

import numba
import numpy as np

from sc3d.splatting.cpu.projection import RECORD
from sc3d.splatting.cpu.rasterization import (
    CHECK,
    LOG2_MIN_ALPHA,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    PLANE,
    STRIDE,
    finished,
    measure_rows,
    open_tile,
)
from sc3d.splatting.cpu.simd import (
    LANES,
    any_at_least,
    exp2,
    fma,
    load,
    minimum,
    ramp,
    splat,
    store,
    total,
    where_at_least,
)
from sc3d.splatting.cpu.tile_binning import TILE

NONE = np.uint8(255)  # a pixel without label; so a view may have 255 classes
_ZERO = np.float32(0.0)


@numba.njit(cache=True, error_model="numpy")
def _lift_tile(
    records, ranks, instances, first, last, origin_x, origin_y, rows, columns, classes, pixels, contributions
):
    """Runs a tile front to back and writes sum(w * mask weight) of each instance and class into contributions
    (P, C).

    classes: (K,) columns of contributions; pixels: planes transmittance and mask weight of each of the K
        classes
    """
    lane, low, high, limit = ramp(), splat(LOG2_MIN_ALPHA), splat(MAX_ALPHA), splat(MIN_TRANSMITTANCE)
    lines, ends = np.empty(3 * TILE, np.float32), np.empty(2 * TILE, np.int32)
    sums = np.empty(classes.shape[0] * LANES, np.float32)
    for entry in range(first, last):
        if (entry - first) % CHECK == CHECK - 1 and finished(pixels):
            return
        base = np.int64(ranks[entry]) * RECORD
        first_row, last_row = measure_rows(records, base, origin_x, origin_y, rows, columns, lines, ends)
        minus_decay = splat(-records[base + 3])
        sums[:] = _ZERO
        for row in range(first_row, last_row + 1):
            column, end, center, peak = (
                np.int64(ends[row]),
                np.int64(ends[TILE + row]),
                lines[TILE + row],
                splat(lines[2 * TILE + row]),
            )
            while column < end:
                place = row * STRIDE + column
                transmittance = load(pixels, place)
                column += LANES
                if not any_at_least(transmittance, limit):
                    continue
                u = lane + splat(np.float32(column - LANES) - center)
                exponent = fma(minus_decay * u, u, peak)
                alpha = where_at_least(
                    exponent, low, where_at_least(transmittance, limit, minimum(exp2(exponent), high))
                )
                w = alpha * transmittance
                store(pixels, place, transmittance - w)
                for k in range(classes.shape[0]):
                    store(
                        sums, k * LANES, fma(w, load(pixels, place + (k + 1) * PLANE), load(sums, k * LANES))
                    )
        for k in range(classes.shape[0]):
            contributions[np.int64(instances[entry]), classes[k]] = total(load(sums, k * LANES))


@numba.njit(cache=True, error_model="numpy")
def _classes_of(columns_image, top, left, rows, columns, slots):
    """Sorted columns that occur in a tile; slots (255,) filled with the place of each in that list."""
    slots[:] = -1
    count = 0
    for row in range(top, top + rows):
        for column in range(left, left + columns):
            if columns_image[row, column] != NONE:
                slots[columns_image[row, column]] = 0
    classes = np.empty(slots.shape[0], np.int64)
    for k in range(slots.shape[0]):
        if slots[k] == 0:
            classes[count], slots[k] = k, count
            count += 1
    return classes[:count]


@numba.njit(cache=True, error_model="numpy", parallel=True)
def lift(records, ranks, instances, starts, order, columns_image, weights, contributions):
    """Sums of all tiles.

    records: (M * 16,) in depth order; ranks, instances: (P,) tile by tile, starts (tiles + 1,); order:
        (tiles,) permutation, for balance
    columns_image: (H, W) uint8 column of contributions that the pixel's class has, NONE = no label; weights:
        (H, W) float32 of the mask
    contributions: (P, C) float32, zero on entry
    """
    height, width = columns_image.shape
    tiles_x = (width + TILE - 1) // TILE
    for item in numba.prange(order.shape[0]):
        tile = order[item]
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        rows, columns = min(TILE, height - top), min(TILE, width - left)
        slots = np.empty(NONE, np.int64)
        classes = _classes_of(columns_image, top, left, rows, columns, slots)
        if starts[tile] < starts[tile + 1] and classes.shape[0] > 0:
            pixels = np.empty((1 + classes.shape[0]) * PLANE, np.float32)
            open_tile(pixels, rows, columns)
            for row in range(rows):
                for column in range(columns):
                    label = columns_image[top + row, left + column]
                    if label != NONE:
                        pixels[(1 + slots[label]) * PLANE + row * STRIDE + column] = weights[
                            top + row, left + column
                        ]
            _lift_tile(
                records,
                ranks,
                instances,
                starts[tile],
                starts[tile + 1],
                np.float32(left),
                np.float32(top),
                rows,
                columns,
                classes,
                pixels,
                contributions,
            )


@numba.njit(cache=True, error_model="numpy", parallel=True)
def collect(visible, offsets, contributions, ids, scale, evidence):
    """Adds the sums of each Gaussian's instances, times `scale` and rounded, to evidence (N, num_ids) int64.

    ids: (C,) column of evidence of each column of contributions. Whole numbers: the order of views does not
        matter.
    """
    for rank in numba.prange(visible.shape[0]):
        for k in range(ids.shape[0]):
            value = 0.0
            for instance in range(offsets[rank], offsets[rank + 1]):
                value += contributions[instance, k]
            evidence[visible[rank], ids[k]] += np.int64(value * scale + 0.5)
