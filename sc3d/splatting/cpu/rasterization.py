"""Numba kernels that composite tiles front to back.

Inside a tile the Gaussian is the outer loop, its rows come next, and runs of 8 pixels between the ends of its
ellipse are the inner one. All pixel state of a tile lives in one small flat buffer, plane after plane, with
rows padded so that a run may start at any column; padding and pixels outside the image have transmittance 0
and so never count. See `projection` for the record and its u, m, a, h.

`rasterization_backward` and `label_lifting` repeat the walk with the functions of this module, so all see the
same fragments.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from sc3d.splatting.cpu.projection import MIN_ALPHA, RECORD
from sc3d.splatting.cpu.simd import (
    LANES,
    any_at_least,
    exp2,
    fma,
    largest,
    load,
    maximum,
    minimum,
    ramp,
    root,
    splat,
    store,
    store_whole,
    total,
    where_at_least,
)
from sc3d.splatting.cpu.tile_binning import ROOM, TILE, first_pixel, last_pixel, tile_frame

MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4
CHANNELS = 8  # color 3, normal 3, plane distance, alpha
STRIDE = TILE + LANES  # floats per row of a plane
PLANE = TILE * STRIDE
CHECK = 16  # instances between two checks whether a tile is finished
LOG2_MIN_ALPHA = np.float32(math.log2(MIN_ALPHA))
_CEIL = np.float32(1.0 - 1e-6)  # truncating x + this rounds up, at worst one pixel early
_HALF, _ZERO, _ONE = np.float32(0.5), np.float32(0.0), np.float32(1.0)


@numba.njit(cache=True, error_model="numpy")
def open_tile(pixels, rows, columns):
    """Transmittance 1 inside the image, 0 in padding; all other planes 0."""
    pixels[:] = _ZERO
    for row in range(rows):
        for column in range(columns):
            pixels[row * STRIDE + column] = _ONE


@numba.njit(cache=True, error_model="numpy")
def finished(pixels):
    """Whether no pixel of the tile lets light through any more."""
    limit = splat(MIN_TRANSMITTANCE)
    for place in range(0, PLANE, LANES):
        if any_at_least(load(pixels, place), limit):
            return False
    return True


@numba.njit(cache=True, error_model="numpy")
def measure_rows(records, base, frame, lines, ends):
    """Where the ellipse of a record meets the 16 pixel rows of a tile; returns first and last row.

    frame: of `tile_frame`
    lines (3 * 16,): dy, center - 0.5 (px, tile frame) and log2 alpha at the center of each row ends (2 *
    16,): first column and one past the last column of each row
    """
    left, top, rows, columns = np.float32(frame[0]), np.float32(frame[1]), frame[2], frame[3]
    mean_y, half_y = records[base + 1] - top, records[base + 7]
    mean_x, slope = splat(records[base] - left - _HALF), splat(records[base + 2])
    minus_decay_y, log_opacity, inverse_decay = (
        splat(-records[base + 4]),
        splat(records[base + 5]),
        splat(_ONE / records[base + 3]),
    )
    for row in range(0, TILE, LANES):
        dy = ramp() + splat(np.float32(row) + _HALF - mean_y)
        peak, center = fma(minus_decay_y * dy, dy, log_opacity), fma(slope, dy, mean_x)
        half = root(maximum((peak + splat(ROOM)) * inverse_decay, splat(_ZERO)))
        store(lines, row, dy)
        store(lines, TILE + row, center)
        store(lines, 2 * TILE + row, peak)
        limit = splat(np.float32(columns))
        store_whole(ends, row, minimum(maximum(center - half + splat(_CEIL), splat(_ZERO)), limit))
        store_whole(ends, TILE + row, minimum(maximum(center + half + splat(_ONE), splat(_ZERO)), limit))
    return first_pixel(mean_y - half_y, rows), last_pixel(mean_y + half_y, rows - 1)


@numba.njit(cache=True, error_model="numpy")
def may_pass(transmittance):
    """Whether any of 8 pixels lets light through."""
    return any_at_least(transmittance, splat(MIN_TRANSMITTANCE))


@numba.njit(cache=True, error_model="numpy")
def log2_alpha(minus_decay, u, peak):
    """log2 alpha of 8 pixels, without its limits."""
    return fma(minus_decay * u, u, peak)


@numba.njit(cache=True, error_model="numpy")
def alpha_of(exponent, transmittance):
    """Alpha of 8 pixels; 0 below 1/255, and where no light comes through."""
    alpha = where_at_least(transmittance, splat(MIN_TRANSMITTANCE), minimum(exp2(exponent), splat(MAX_ALPHA)))
    return where_at_least(exponent, splat(LOG2_MIN_ALPHA), alpha)


@numba.njit(cache=True, error_model="numpy")
def add_to_plane(pixels, place, w, value):
    """Adds w * value to 8 pixels."""
    store(pixels, place, fma(w, value, load(pixels, place)))


@numba.njit(cache=True, error_model="numpy")
def _forward_tile(tiles, tile, frame, geometry, pixels, contributions):
    """Composites one tile into `pixels`; contributions (P, 2): sum of weights and largest transmittance of
    each instance.
    """
    records, lane, low = tiles.records, ramp(), splat(LOG2_MIN_ALPHA)
    lines, ends = np.empty(3 * TILE, np.float32), np.empty(2 * TILE, np.int32)
    first = tiles.starts[tile]
    for entry in range(first, tiles.starts[tile + 1]):
        if (entry - first) % CHECK == CHECK - 1 and finished(pixels):
            return
        base = np.int64(tiles.ranks[entry]) * RECORD
        first_row, last_row = measure_rows(records, base, frame, lines, ends)
        minus_decay = splat(-records[base + 3])
        red, green, blue = splat(records[base + 8]), splat(records[base + 9]), splat(records[base + 10])
        nx, ny, nz = splat(records[base + 11]), splat(records[base + 12]), splat(records[base + 13])
        distance = splat(records[base + 14])
        weight, brightest = splat(_ZERO), splat(_ZERO)
        for row in range(first_row, last_row + 1):
            center, peak = lines[TILE + row], splat(lines[2 * TILE + row])
            column, end = np.int64(ends[row]), np.int64(ends[TILE + row])
            while column < end:
                place = row * STRIDE + column
                u = lane + splat(np.float32(column) - center)
                column += LANES
                transmittance = load(pixels, place)
                if not may_pass(transmittance):
                    continue
                exponent = log2_alpha(minus_decay, u, peak)
                w = alpha_of(exponent, transmittance) * transmittance
                store(pixels, place, transmittance - w)
                weight = weight + w
                brightest = maximum(brightest, where_at_least(exponent, low, transmittance))
                add_to_plane(pixels, place + PLANE, w, red)
                add_to_plane(pixels, place + 2 * PLANE, w, green)
                add_to_plane(pixels, place + 3 * PLANE, w, blue)
                if geometry:
                    add_to_plane(pixels, place + 4 * PLANE, w, nx)
                    add_to_plane(pixels, place + 5 * PLANE, w, ny)
                    add_to_plane(pixels, place + 6 * PLANE, w, nz)
                    add_to_plane(pixels, place + 7 * PLANE, w, distance)
        instance, seen = np.int64(tiles.instances[entry]), largest(brightest)
        contributions[instance, 0] = total(weight)
        contributions[instance, 1] = seen if seen >= MIN_TRANSMITTANCE else _ZERO


@numba.njit(cache=True, error_model="numpy", parallel=True)
def rasterize(tiles, background, geometry, image, contributions):
    """Composites all tiles.

    tiles: `TileLists`; background: (3,); image: (8, H, W) filled with color, normal, plane distance, alpha
    contributions: (P, 2) filled with sum of weights and largest transmittance of each instance, zero on entry
    """
    height, width = image.shape[1], image.shape[2]
    for item in numba.prange(tiles.order.shape[0]):
        tile = tiles.order[item]
        frame = tile_frame(tile, width, height)
        left, top, rows, columns = frame
        pixels = np.empty(CHANNELS * PLANE, np.float32)
        open_tile(pixels, rows, columns)
        _forward_tile(tiles, tile, frame, geometry, pixels, contributions)
        for row in range(rows):
            for column in range(columns):
                place, y, x = row * STRIDE + column, top + row, left + column
                for channel in range(3):
                    color = pixels[place + (channel + 1) * PLANE]
                    image[channel, y, x] = color + pixels[place] * background[channel]
                for channel in range(3, 7):
                    image[channel, y, x] = pixels[place + (channel + 1) * PLANE]
                image[7, y, x] = _ONE - pixels[place]


@numba.njit(cache=True, error_model="numpy", parallel=True)
def collect_contributions(tiles, contributions, weight, max_transmittance):
    """Per Gaussian: sum of its instances' weights and largest transmittance; rows of invisible Gaussians are
    not touched.
    """
    visible, offsets = tiles.visible, tiles.offsets
    for rank in numba.prange(visible.shape[0]):
        total_weight, largest_seen = 0.0, _ZERO
        for instance in range(offsets[rank], offsets[rank + 1]):
            total_weight += contributions[instance, 0]
            largest_seen = max(largest_seen, contributions[instance, 1])
        weight[visible[rank]], max_transmittance[visible[rank]] = total_weight, largest_seen
