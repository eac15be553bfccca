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
def _add_channel(pixels, place, w, value, total, product):
    """Of 8 pixels of one channel with gradient g: total + w g, the fragment's sum, and product + g f, f = value."""
    g = load(pixels, place)
    return fma(w, g, total), fma(g, value, product)


@numba.njit(cache=True, error_model="numpy")
def alpha_gradient(pixels, place, gain, alpha, exponent):
    """d loss / d ln(alpha) of 8 pixels, with gain = w g.f; takes it out of what is still to come."""
    rest = load(pixels, place + PLANE) - gain
    store(pixels, place + PLANE, rest)
    gradient = gain - alpha * rest / (splat(_ONE) - alpha)
    # no gradient where alpha was cut to 0.99
    return where_at_least(splat(_ZERO) - exponent, splat(-_LOG2_MAX_ALPHA), gradient)


@numba.njit(cache=True, error_model="numpy")
def _values(records, base):
    """What a fragment shows, for 8 pixels each: color 3, normal 3, plane distance."""
    red, green, blue = splat(records[base + 8]), splat(records[base + 9]), splat(records[base + 10])
    nx, ny, nz = splat(records[base + 11]), splat(records[base + 12]), splat(records[base + 13])
    return red, green, blue, nx, ny, nz, splat(records[base + 14])


@numba.njit(cache=True, error_model="numpy")
def _backward_tile(tiles, tile, frame, geometry, pixels, gradients):
    """Runs a tile front to back again; writes the pixel sums of each instance (`projection_backward.SUMS`).

    pixels: planes transmittance; rest = sum_c g_c (output_c of the fragments still to come); g of alpha,
        color 3, normal 3, plane distance.
    With t = transmittance in front of the fragment:  d loss / d ln(alpha) = w g.f - alpha / (1 - alpha)
    rest_behind,  w = alpha t.
    """
    records, lane, zero, first = tiles.records, ramp(), splat(_ZERO), tiles.starts[tile]
    lines, ends = np.empty(3 * TILE, np.float32), np.empty(2 * TILE, np.int32)
    for entry in range(first, tiles.starts[tile + 1]):
        if (entry - first) % CHECK == CHECK - 1 and finished(pixels):
            return
        base = np.int64(tiles.ranks[entry]) * RECORD
        first_row, last_row = measure_rows(records, base, frame, lines, ends)
        minus_decay = splat(-records[base + 3])
        red, green, blue, nx, ny, nz, distance = _values(records, base)
        s_sum = su_sum = suu_sum = sy_sum = suy_sum = syy_sum = x_sum = y_sum = zero
        red_sum = green_sum = blue_sum = nx_sum = ny_sum = nz_sum = d_sum = zero
        slope, to_x, to_y = (
            records[base + 2],
            records[base + 3] / _SCALE,
            records[base + 4] / _SCALE,
        )  # m, a, h
        tilt = splat(-to_x * slope)
        for row in range(first_row, last_row + 1):
            center, peak, s_row, su_row = lines[TILE + row], splat(lines[2 * TILE + row]), zero, zero
            column, end = np.int64(ends[row]), np.int64(ends[TILE + row])
            height, lift = splat(lines[row]), splat(to_y * lines[row])
            while column < end:
                place = row * STRIDE + column
                u = lane + splat(np.float32(column) - center)
                column += LANES
                transmittance = load(pixels, place)
                if not may_pass(transmittance):
                    continue
                exponent = log2_alpha(minus_decay, u, peak)
                alpha = alpha_of(exponent, transmittance)
                w, product = alpha * transmittance, load(pixels, place + 2 * PLANE)
                store(pixels, place, transmittance - w)
                red_sum, product = _add_channel(pixels, place + 3 * PLANE, w, red, red_sum, product)
                green_sum, product = _add_channel(pixels, place + 4 * PLANE, w, green, green_sum, product)
                blue_sum, product = _add_channel(pixels, place + 5 * PLANE, w, blue, blue_sum, product)
                if geometry:
                    nx_sum, product = _add_channel(pixels, place + 6 * PLANE, w, nx, nx_sum, product)
                    ny_sum, product = _add_channel(pixels, place + 7 * PLANE, w, ny, ny_sum, product)
                    nz_sum, product = _add_channel(pixels, place + 8 * PLANE, w, nz, nz_sum, product)
                    d_sum, product = _add_channel(pixels, place + 9 * PLANE, w, distance, d_sum, product)
                s = alpha_gradient(pixels, place, w * product, alpha, exponent)
                su = s * u
                s_row, su_row, suu_sum = s_row + s, su_row + su, fma(su, u, suu_sum)
                x_sum = x_sum + absolute(su)
                y_sum = y_sum + absolute(fma(tilt, su, lift * s))
            s_sum, su_sum, syy_sum = s_sum + s_row, su_sum + su_row, fma(height * height, s_row, syy_sum)
            sy_sum, suy_sum = fma(height, s_row, sy_sum), fma(height, su_row, suy_sum)
        place, x_sum = np.int64(tiles.instances[entry]) * RECORD, x_sum * splat(to_x)
        moments = sums(s_sum, su_sum, suu_sum, sy_sum, suy_sum, syy_sum, x_sum, y_sum)
        store(gradients, place, moments)
        shown = sums(red_sum, green_sum, blue_sum, nx_sum, ny_sum, nz_sum, d_sum, zero)
        store(gradients, place + LANES, shown)


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
