"""1 - NCC of patches warped by their planes, with its analytic gradient, as one kernel; `gpu.losses` has the
slow twin.

A patch pixel with ray r (z = 1) lands at q = d R r - t (n . r), projected. With gray values a_p of the photo
and b_p sampled at q_p, and g_p = db_p / d(n, d):
    d NCC = sum_p [(a_p - mean a) / (P s) - NCC (b_p - mean b) / (P (var b + e))] g_p,   s = sqrt((var a +
    e)(var b + e)).
A row of a patch is seven of eight lanes; three passes over the rows find where the pixels land, what the
images show there, and the gradient. Each writes what the next one reads.
"""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

from sc3d.splatting.cpu.simd import (
    LANES,
    bits_at_least,
    fma,
    load,
    minimum,
    ramp,
    splat,
    store,
    total,
    truncate,
    where_at_least,
)

PATCH_RADIUS = 3
NOISE = 1 / 255**2
"""variance of gray values that counts as noise"""
_SIDE = 2 * PATCH_RADIUS + 1
_USED = (1 << _SIDE) - 1  # lanes
_CHUNK = 64  # patches per parallel work item
# planes of a row: where in the other image (column, row; its fraction; p0, p1 and 1 / depth), gray values a
# and the four around b; b takes the place of the first of these
_COLUMN, _ROW, _ACROSS, _DOWN, _P0, _P1, _INVERSE, _A, _B = (plane * LANES for plane in range(9))
_PLANES = 12
_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_SHARE = np.float32(1 / _SIDE**2)


def patch_dissimilarity(
    normals: Tensor, distances: Tensor, pixels: Tensor, grays: tuple[Tensor, Tensor], cameras: np.ndarray
) -> tuple[Tensor, Tensor]:
    """(M,) 1 - NCC, differentiable in `normals` (M, 3) and `distances` (M,); (M,) bool: both patches lie
    inside their images.

    pixels: (M, 2) int64 column, row; grays: (H, W) and (h, w)
    cameras: (20,) fx fy cx cy of both views, R (9, row by row) and t (3) from the first to the second camera
        frame
    """
    return _Patches.apply(normals, distances, pixels, grays, cameras)


class _Patches(torch.autograd.Function):
    @staticmethod
    def forward(ctx, normals, distances, pixels, grays, cameras):
        planes = torch.cat([normals.detach(), distances.detach()[:, None]], 1).numpy()
        values, inside = np.empty(len(planes), np.float32), np.empty(len(planes), np.bool_)
        slopes = np.empty((len(planes), 4), np.float32)
        gray, other = (image.detach().contiguous().numpy() for image in grays)
        _compare(
            planes,
            pixels.contiguous().numpy(),
            gray,
            other,
            cameras.astype(np.float32),
            values,
            inside,
            slopes,
        )
        ctx.save_for_backward(torch.from_numpy(slopes))
        inside = torch.from_numpy(inside)
        ctx.mark_non_differentiable(inside)
        return torch.from_numpy(values), inside

    @staticmethod
    def backward(ctx, gradient, _):
        slopes = ctx.saved_tensors[0] * gradient[:, None]
        return slopes[:, :3], slopes[:, 3], None, None, None


@numba.njit(parallel=True, cache=True, error_model="numpy")
def _compare(planes, pixels, gray, other, camera, values, inside, slopes):
    """Fill values, inside and slopes (d value / d (n, d)) patch by patch; a patch that leaves an image has
    value 1 and slope 0.
    """
    count, radius = len(planes), PATCH_RADIUS
    for item in numba.prange((count + _CHUNK - 1) // _CHUNK):
        work = np.zeros(_SIDE * _PLANES * LANES, np.float32)
        for patch in range(item * _CHUNK, min(count, (item + 1) * _CHUNK)):
            column, row = pixels[patch, 0], pixels[patch, 1]
            values[patch], slopes[patch] = _ONE, _ZERO
            within = radius <= column < gray.shape[1] - radius and radius <= row < gray.shape[0] - radius
            inside[patch] = within and _land(planes[patch], column, row, other, camera, work)
            if inside[patch]:
                _fetch(column, row, gray, other, work)
                values[patch] = _correlate(column, row, camera, work, slopes[patch])


@numba.njit(cache=True, error_model="numpy")
def _rays(column, row, step, camera):
    """x of the rays of the eight pixels of a patch row, and their common y."""
    first = np.float32(column - PATCH_RADIUS) + _HALF - camera[2]
    y = (np.float32(row + step - PATCH_RADIUS) + _HALF - camera[3]) / camera[1]
    return (ramp() + splat(first)) * splat(_ONE / camera[0]), y


@numba.njit(cache=True, error_model="numpy")
def _land(plane, column, row, other, camera, work):
    """Where the pixels of a patch land; False if one does not land in the other image."""
    limit = splat(np.float32(1e-9))
    low, distance, one, last = splat(_HALF), splat(plane[3]), splat(_ONE), splat(np.float32(_SIDE - 1))
    right, bottom = np.float32(other.shape[1]) - _HALF, np.float32(other.shape[0]) - _HALF
    for step in range(_SIDE):
        place = step * _PLANES * LANES
        x, y = _rays(column, row, step, camera)
        along = fma(splat(plane[0]), x, splat(plane[1] * y + plane[2]))
        q0 = (
            fma(splat(camera[8]), x, splat(camera[9] * y + camera[10])) * distance - splat(camera[17]) * along
        )
        q1 = (
            fma(splat(camera[11]), x, splat(camera[12] * y + camera[13])) * distance
            - splat(camera[18]) * along
        )
        q2 = (
            fma(splat(camera[14]), x, splat(camera[15] * y + camera[16])) * distance
            - splat(camera[19]) * along
        )
        inverse = one / q2
        p0, p1 = q0 * inverse, q1 * inverse
        u, v = fma(p0, splat(camera[4]), splat(camera[6])), fma(p1, splat(camera[5]), splat(camera[7]))
        met = bits_at_least(q2, limit) & bits_at_least(u, low) & bits_at_least(v, low)
        met &= bits_at_least(splat(right), u) & bits_at_least(splat(bottom), v)
        if met & _USED != _USED:
            return False
        u, v = u - low, v - low
        left = truncate(minimum(u, splat(right - _HALF - _ONE)))
        top = truncate(minimum(v, splat(bottom - _HALF - _ONE)))
        store(work, place + _COLUMN, left)
        store(work, place + _ROW, top)
        store(work, place + _ACROSS, u - left)
        store(work, place + _DOWN, v - top)
        # the eighth lane is none of the patch's, and may be anything
        store(work, place + _P0, where_at_least(last, ramp(), p0))
        store(work, place + _P1, where_at_least(last, ramp(), p1))
        store(work, place + _INVERSE, where_at_least(last, ramp(), inverse))
    return True


@numba.njit(cache=True, error_model="numpy")
def _fetch(column, row, gray, other, work):
    """The gray values of a patch and the four around each pixel that it landed on."""
    for step in range(_SIDE):
        for lane in range(_SIDE):
            place = step * _PLANES * LANES + lane
            left, top = np.int64(work[place + _COLUMN]), np.int64(work[place + _ROW])
            work[place + _A] = gray[row + step - PATCH_RADIUS, column + lane - PATCH_RADIUS]
            work[place + _B] = other[top, left]
            work[place + _B + LANES] = other[top, left + 1]
            work[place + _B + 2 * LANES] = other[top + 1, left]
            work[place + _B + 3 * LANES] = other[top + 1, left + 1]


@numba.njit(cache=True, error_model="numpy")
def _correlate(column, row, camera, work, slope):
    """1 - NCC of a patch whose values are there; fills slope (4,)."""
    sum_a = sum_b = sum_aa = sum_bb = sum_ab = zero = splat(_ZERO)
    for step in range(_SIDE):
        place = step * _PLANES * LANES
        across, b00, b10 = (
            load(work, place + _ACROSS),
            load(work, place + _B),
            load(work, place + _B + 2 * LANES),
        )
        upper, lower = load(work, place + _B + LANES) - b00, load(work, place + _B + 3 * LANES) - b10
        above, below, down = fma(across, upper, b00), fma(across, lower, b10), load(work, place + _DOWN)
        a, b = (
            load(work, place + _A),
            where_at_least(splat(np.float32(_SIDE - 1)), ramp(), fma(down, below - above, above)),
        )
        store(work, place + _B, b)
        store(
            work,
            place + _B + LANES,
            where_at_least(splat(np.float32(_SIDE - 1)), ramp(), fma(down, lower - upper, upper)),
        )
        store(
            work, place + _B + 2 * LANES, where_at_least(splat(np.float32(_SIDE - 1)), ramp(), below - above)
        )
        sum_a, sum_b, sum_aa = sum_a + a, sum_b + b, fma(a, a, sum_aa)
        sum_bb, sum_ab = fma(b, b, sum_bb), fma(a, b, sum_ab)
    mean_a, mean_b = total(sum_a) * _SHARE, total(sum_b) * _SHARE
    var_a = max(total(sum_aa) * _SHARE - mean_a * mean_a, _ZERO) + np.float32(NOISE)
    var_b = max(total(sum_bb) * _SHARE - mean_b * mean_b, _ZERO) + np.float32(NOISE)
    scale = _ONE / np.sqrt(var_a * var_b)
    ncc = (total(sum_ab) * _SHARE - mean_a * mean_b) * scale
    by_a, by_b = splat(_SHARE * scale), splat(_SHARE * ncc / var_b)
    g0 = g1 = g2 = g3 = zero
    t0, t1, t2 = splat(camera[17]), splat(camera[18]), splat(camera[19])
    for step in range(_SIDE):
        place = step * _PLANES * LANES
        x, y = _rays(column, row, step, camera)
        gain = (load(work, place + _B) - splat(mean_b)) * by_b - (
            load(work, place + _A) - splat(mean_a)
        ) * by_a
        gain = gain * load(work, place + _INVERSE)
        c0 = load(work, place + _B + LANES) * splat(camera[4]) * gain
        c1 = load(work, place + _B + 2 * LANES) * splat(camera[5]) * gain
        c2 = zero - fma(c0, load(work, place + _P0), c1 * load(work, place + _P1))
        by_along = zero - fma(c0, t0, fma(c1, t1, c2 * t2))
        r0 = fma(splat(camera[8]), x, splat(camera[9] * y + camera[10]))
        r1 = fma(splat(camera[11]), x, splat(camera[12] * y + camera[13]))
        r2 = fma(splat(camera[14]), x, splat(camera[15] * y + camera[16]))
        g0, g1, g2 = fma(by_along, x, g0), fma(by_along, splat(y), g1), g2 + by_along
        g3 = fma(c0, r0, fma(c1, r1, fma(c2, r2, g3)))
    slope[0], slope[1], slope[2], slope[3] = total(g0), total(g1), total(g2), total(g3)
    return _ONE - ncc
