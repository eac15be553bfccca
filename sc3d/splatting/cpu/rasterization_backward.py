"""Numba kernels: the reverse of `rasterization`, from image gradients to sums over the pixels of instances.

Tiles are walked front to back again: the part of the loss that lies behind a fragment is what the finished
image holds minus what has passed so far, so no list of fragments has to be kept. Each instance writes sums of
its own, which `projection_backward` adds per Gaussian.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from sc3d.splatting.cpu.projection import LOG2E_HALF, RECORD
from sc3d.splatting.cpu.rasterization import (
    CHANNELS,
    CHECK,
    MAX_ALPHA,
    PLANE,
    STRIDE,
    alpha_of,
    finished,
    log2_alpha,
    may_pass,
    measure_rows,
    open_tile,
)
from sc3d.splatting.cpu.simd import LANES, absolute, fma, load, ramp, splat, store, sums, where_at_least
from sc3d.splatting.cpu.tile_binning import TILE, tile_frame

_LOG2_MAX_ALPHA = np.float32(math.log2(MAX_ALPHA))
_SCALE = np.float32(LOG2E_HALF)  # a and h of a record are in these units
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


class ImageGradients(NamedTuple):
    """d loss / d image: color and normal (3, H, W), plane_distance and alpha (H, W). normal and
    plane_distance are read with geometry only.
    """

    color: np.ndarray
    normal: np.ndarray
    plane_distance: np.ndarray
    alpha: np.ndarray


@numba.njit(cache=True, error_model="numpy")
def _backward_tile(tiles, tile, frame, geometry, pixels, gradients):
    """Runs a tile front to back again; writes the pixel sums of each instance (`projection_backward.SUMS`).

    pixels: planes transmittance; rest = sum_c g_c (output_c of the fragments still to come); g of alpha,
        color 3, normal 3, plane distance.
    With t = transmittance in front of the fragment:  d loss / d ln(alpha) = w g.f - alpha / (1 - alpha)
    rest_behind,  w = alpha t.
    """
    records, lane, zero, one = tiles.records, ramp(), splat(_ZERO), splat(_ONE)
    minus_clamp = splat(-_LOG2_MAX_ALPHA)
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
        s_sum, su_sum, suu_sum, sy_sum, suy_sum, syy_sum, x_sum, y_sum = (
            zero, zero, zero, zero, zero, zero, zero, zero
        )  # fmt: skip
        red_sum, green_sum, blue_sum, nx_sum, ny_sum, nz_sum, d_sum = zero, zero, zero, zero, zero, zero, zero
        # m, a and h
        slope, to_x, to_y = records[base + 2], records[base + 3] / _SCALE, records[base + 4] / _SCALE
        for row in range(first_row, last_row + 1):
            center, peak = lines[TILE + row], splat(lines[2 * TILE + row])
            column, end = np.int64(ends[row]), np.int64(ends[TILE + row])
            s_row, su_row = zero, zero
            dy = lines[row]
            tilt, lift = splat(-to_x * slope), splat(to_y * dy)
            while column < end:
                place = row * STRIDE + column
                u = lane + splat(np.float32(column) - center)
                column += LANES
                transmittance = load(pixels, place)
                if not may_pass(transmittance):
                    continue
                exponent = log2_alpha(minus_decay, u, peak)
                alpha = alpha_of(exponent, transmittance)
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
                    product = fma(g, nx, product)
                    g = load(pixels, place + 7 * PLANE)
                    ny_sum = fma(w, g, ny_sum)
                    product = fma(g, ny, product)
                    g = load(pixels, place + 8 * PLANE)
                    nz_sum = fma(w, g, nz_sum)
                    product = fma(g, nz, product)
                    g = load(pixels, place + 9 * PLANE)
                    d_sum = fma(w, g, d_sum)
                    product = fma(g, distance, product)
                gain = w * product
                rest = load(pixels, place + PLANE) - gain
                store(pixels, place + PLANE, rest)
                s = gain - alpha * rest / (one - alpha)
                # no gradient where alpha was cut to 0.99
                s = where_at_least(zero - exponent, minus_clamp, s)
                su = s * u
                s_row = s_row + s
                su_row = su_row + su
                suu_sum = fma(su, u, suu_sum)
                x_sum = x_sum + absolute(su)
                y_sum = y_sum + absolute(fma(tilt, su, lift * s))
            height = splat(dy)
            s_sum, su_sum = s_sum + s_row, su_sum + su_row
            sy_sum, suy_sum = fma(height, s_row, sy_sum), fma(height, su_row, suy_sum)
            syy_sum = fma(height * height, s_row, syy_sum)
        place = np.int64(tiles.instances[entry]) * RECORD
        x_sum = x_sum * splat(to_x)
        store(gradients, place, sums(s_sum, su_sum, suu_sum, sy_sum, suy_sum, syy_sum, x_sum, y_sum))
        place += LANES
        store(gradients, place, sums(red_sum, green_sum, blue_sum, nx_sum, ny_sum, nz_sum, d_sum, zero))


@numba.njit(cache=True, error_model="numpy")
def _load_gradients(pixels, frame, background, geometry, image, gradients):
    """Fills the planes that `_backward_tile` wants from the image and its gradients."""
    left, top, rows, columns = frame
    open_tile(pixels, rows, columns)
    for row in range(rows):
        for column in range(columns):
            place, y, x = row * STRIDE + column, top + row, left + column
            rest, grad_alpha = gradients.alpha[y, x] * image[7, y, x], gradients.alpha[y, x]
            for channel in range(3):
                g = gradients.color[channel, y, x]
                pixels[place + (3 + channel) * PLANE] = g
                rest += g * (image[channel, y, x] - background[channel])
                grad_alpha -= g * background[channel]
            if geometry:
                for channel in range(3):
                    g = gradients.normal[channel, y, x]
                    pixels[place + (6 + channel) * PLANE] = g
                    rest += g * image[3 + channel, y, x]
                pixels[place + 9 * PLANE] = gradients.plane_distance[y, x]
                rest += gradients.plane_distance[y, x] * image[6, y, x]
            pixels[place + PLANE], pixels[place + 2 * PLANE] = rest, grad_alpha


@numba.njit(cache=True, error_model="numpy", parallel=True)
def rasterize_backward(tiles, background, geometry, image, image_gradients, gradients):
    """Reverse of `rasterize`: fills gradients (P * 16,), zero on entry. image_gradients: `ImageGradients`"""
    height, width = image.shape[1], image.shape[2]
    for item in numba.prange(tiles.order.shape[0]):
        tile = tiles.order[item]
        if tiles.starts[tile] < tiles.starts[tile + 1]:
            frame = tile_frame(tile, width, height)
            pixels = np.empty((CHANNELS + 2) * PLANE, np.float32)
            _load_gradients(pixels, frame, background, geometry, image, image_gradients)
            _backward_tile(tiles, tile, frame, geometry, pixels, gradients)
