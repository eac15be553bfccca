"""Numba kernels: the reverse of `kernels_raster`, from image gradients to sums over the pixels of each
instance.

Tiles are walked front to back again: the part of the loss that lies behind a fragment is what the finished
image holds minus what has passed so far,
so no list of fragments has to be kept. Each instance writes sums of its own, which `kernels_backproject` adds
per Gaussian.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from sc3d.splatting.cpu.projection import LOG2E_HALF, RECORD
from sc3d.splatting.cpu.rasterization import (
    CHANNELS,
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
    absolute,
    any_at_least,
    exp2,
    fma,
    load,
    minimum,
    ramp,
    splat,
    store,
    sums,
    where_at_least,
)
from sc3d.splatting.cpu.tile_binning import TILE

_LOG2_MAX_ALPHA = np.float32(math.log2(MAX_ALPHA))
_SCALE = np.float32(LOG2E_HALF)  # a and h of a record are in these units
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@numba.njit(cache=True, error_model="numpy")
def _backward_tile(
    records, ranks, instances, first, last, origin_x, origin_y, rows, columns, geometry, pixels, gradients
):
    """Runs a tile front to back again and writes the pixel sums of each instance
    (`kernels_backproject.SUMS`).

    pixels: planes transmittance; rest = sum_c g_c (output_c of the fragments still to come); g of alpha,
        color 3, normal 3, plane distance.
    With t = transmittance in front of the fragment:  d loss / d ln(alpha) = w g.f - alpha / (1 - alpha)
    rest_behind,  w = alpha t.
    """
    lane, low, high, limit = ramp(), splat(LOG2_MIN_ALPHA), splat(MAX_ALPHA), splat(MIN_TRANSMITTANCE)
    minus_clamp, one = splat(-_LOG2_MAX_ALPHA), splat(_ONE)
    lines, ends = np.empty(3 * TILE, np.float32), np.empty(2 * TILE, np.int32)
    for entry in range(first, last):
        if (entry - first) % CHECK == CHECK - 1 and finished(pixels):
            return
        base = np.int64(ranks[entry]) * RECORD
        first_row, last_row = measure_rows(records, base, origin_x, origin_y, rows, columns, lines, ends)
        minus_decay = splat(-records[base + 3])
        red, green, blue = splat(records[base + 8]), splat(records[base + 9]), splat(records[base + 10])
        normal_x, normal_y, normal_z = (
            splat(records[base + 11]),
            splat(records[base + 12]),
            splat(records[base + 13]),
        )
        distance = splat(records[base + 14])
        s_sum, su_sum, suu_sum, sy_sum, suy_sum, syy_sum = (
            splat(_ZERO),
            splat(_ZERO),
            splat(_ZERO),
            splat(_ZERO),
            splat(_ZERO),
            splat(_ZERO),
        )
        x_sum, y_sum, red_sum, green_sum, blue_sum = (
            splat(_ZERO),
            splat(_ZERO),
            splat(_ZERO),
            splat(_ZERO),
            splat(_ZERO),
        )
        nx_sum, ny_sum, nz_sum, d_sum = splat(_ZERO), splat(_ZERO), splat(_ZERO), splat(_ZERO)
        # m, a and h
        slope, to_x, to_y = records[base + 2], records[base + 3] / _SCALE, records[base + 4] / _SCALE
        for row in range(first_row, last_row + 1):
            column, end, center, peak = (
                np.int64(ends[row]),
                np.int64(ends[TILE + row]),
                lines[TILE + row],
                splat(lines[2 * TILE + row]),
            )
            s_row, su_row = splat(_ZERO), splat(_ZERO)
            dy = lines[row]
            tilt, lift = splat(-to_x * slope), splat(to_y * dy)
            while column < end:
                place = row * STRIDE + column
                transmittance = load(pixels, place)
                if not any_at_least(transmittance, limit):
                    column += LANES
                    continue
                u = lane + splat(np.float32(column) - center)
                exponent = fma(minus_decay * u, u, peak)
                alpha = where_at_least(
                    exponent, low, where_at_least(transmittance, limit, minimum(exp2(exponent), high))
                )
                w = alpha * transmittance
                store(pixels, place, transmittance - w)
                g = load(pixels, place + 3 * PLANE)
                red_sum = fma(w, g, red_sum)
                product = fma(g, red, load(pixels, place + 2 * PLANE))
                g = load(pixels, place + 4 * PLANE)
                green_sum = fma(w, g, green_sum)
                product = fma(g, green, product)
                g = load(pixels, place + 5 * PLANE)
                blue_sum = fma(w, g, blue_sum)
                product = fma(g, blue, product)
                if geometry:
                    g = load(pixels, place + 6 * PLANE)
                    nx_sum = fma(w, g, nx_sum)
                    product = fma(g, normal_x, product)
                    g = load(pixels, place + 7 * PLANE)
                    ny_sum = fma(w, g, ny_sum)
                    product = fma(g, normal_y, product)
                    g = load(pixels, place + 8 * PLANE)
                    nz_sum = fma(w, g, nz_sum)
                    product = fma(g, normal_z, product)
                    g = load(pixels, place + 9 * PLANE)
                    d_sum = fma(w, g, d_sum)
                    product = fma(g, distance, product)
                gain = w * product
                rest = load(pixels, place + PLANE) - gain
                store(pixels, place + PLANE, rest)
                s = gain - alpha * rest / (one - alpha)
                # no gradient where alpha was cut to 0.99
                s = where_at_least(splat(_ZERO) - exponent, minus_clamp, s)
                su = s * u
                s_row = s_row + s
                su_row = su_row + su
                suu_sum = fma(su, u, suu_sum)
                x_sum = x_sum + absolute(su)
                y_sum = y_sum + absolute(fma(tilt, su, lift * s))
                column += LANES
            height = splat(dy)
            s_sum, su_sum, sy_sum, suy_sum = (
                s_sum + s_row,
                su_sum + su_row,
                fma(height, s_row, sy_sum),
                fma(height, su_row, suy_sum),
            )
            syy_sum = fma(height * height, s_row, syy_sum)
        instance = np.int64(instances[entry]) * RECORD
        store(
            gradients,
            instance,
            sums(s_sum, su_sum, suu_sum, sy_sum, suy_sum, syy_sum, x_sum * splat(to_x), y_sum),
        )
        store(
            gradients,
            instance + LANES,
            sums(red_sum, green_sum, blue_sum, nx_sum, ny_sum, nz_sum, d_sum, splat(_ZERO)),
        )


@numba.njit(cache=True, error_model="numpy")
def _load_gradients(
    pixels,
    top,
    left,
    rows,
    columns,
    background,
    geometry,
    image,
    grad_color,
    grad_normal,
    grad_distance,
    grad_alpha,
):
    """Fills the planes that `_backward_tile` wants from the image and its gradients."""
    open_tile(pixels, rows, columns)
    for row in range(rows):
        for column in range(columns):
            place, y, x = row * STRIDE + column, top + row, left + column
            rest, grad_a = grad_alpha[y, x] * image[7, y, x], grad_alpha[y, x]
            for channel in range(3):
                g = grad_color[channel, y, x]
                pixels[place + (3 + channel) * PLANE] = g
                rest += g * (image[channel, y, x] - background[channel])
                grad_a -= g * background[channel]
            if geometry:
                for channel in range(3):
                    g = grad_normal[channel, y, x]
                    pixels[place + (6 + channel) * PLANE] = g
                    rest += g * image[3 + channel, y, x]
                pixels[place + 9 * PLANE] = grad_distance[y, x]
                rest += grad_distance[y, x] * image[6, y, x]
            pixels[place + PLANE], pixels[place + 2 * PLANE] = rest, grad_a


@numba.njit(cache=True, error_model="numpy", parallel=True)
def rasterize_backward(
    records,
    ranks,
    instances,
    starts,
    order,
    background,
    geometry,
    image,
    grad_color,
    grad_normal,
    grad_distance,
    grad_alpha,
    gradients,
):
    """Reverse of `rasterize`: fills gradients (P * 16,), zero on entry, from d loss / d outputs.

    grad_color: (3, H, W); grad_normal (3, H, W) and grad_distance (H, W) are read only if `geometry`;
        grad_alpha: (H, W)
    """
    height, width = image.shape[1], image.shape[2]
    tiles_x = (width + TILE - 1) // TILE
    for item in numba.prange(order.shape[0]):
        tile = order[item]
        if starts[tile] < starts[tile + 1]:
            left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
            rows, columns = min(TILE, height - top), min(TILE, width - left)
            pixels = np.empty((CHANNELS + 2) * PLANE, np.float32)
            _load_gradients(
                pixels,
                top,
                left,
                rows,
                columns,
                background,
                geometry,
                image,
                grad_color,
                grad_normal,
                grad_distance,
                grad_alpha,
            )
            _backward_tile(
                records,
                ranks,
                instances,
                starts[tile],
                starts[tile + 1],
                np.float32(left),
                np.float32(top),
                rows,
                columns,
                geometry,
                pixels,
                gradients,
            )
