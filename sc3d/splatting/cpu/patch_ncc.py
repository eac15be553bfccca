"""1 - NCC of patches warped by their planes, with its analytic gradient, as one kernel; `gpu.losses` has the
slow twin.

A patch pixel with ray r (z = 1) lands at q = d R r - t (n . r), projected. With gray values a_p of the photo
and b_p sampled at q_p, and g_p = db_p / d(n, d), all sums that NCC and its gradient need are gathered in one
pass:
    d NCC = sum_p [(a_p - mean a) / (P s) - NCC (b_p - mean b) / (P (var b + e))] g_p,   s = sqrt((var a +
    e)(var b + e)).
"""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

PATCH_RADIUS = 3  # the kernel's 3, 7 and 49
NOISE = 1 / 255**2
"""variance of gray values that counts as noise"""


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


@numba.njit(parallel=True, cache=True, fastmath=True)
def _compare(planes, pixels, gray, other, camera, values, inside, slopes):
    """Fill values, inside and slopes (d value / d (n, d)) patch by patch; a patch that leaves an image has
    value 1 and slope 0.
    """
    for patch in numba.prange(len(planes)):
        column, row = pixels[patch, 0], pixels[patch, 1]
        values[patch] = 1
        slopes[patch] = 0
        within = 3 <= column < gray.shape[1] - 3 and 3 <= row < gray.shape[0] - 3
        inside[patch] = within and _compare_one(
            planes[patch], column, row, gray, other, camera, values[patch:], slopes[patch]
        )


@numba.njit(cache=True, fastmath=True, inline="always")
def _compare_one(plane, column, row, gray, other, camera, value, slope):
    n0, n1, n2, distance = plane[0], plane[1], plane[2], plane[3]
    t0, t1, t2 = camera[17], camera[18], camera[19]
    one, half = np.float32(1), np.float32(0.5)
    right, bottom = np.float32(other.shape[1]) - half, np.float32(other.shape[0]) - half
    sum_a = sum_b = sum_aa = sum_bb = sum_ab = np.float32(0)
    g0 = g1 = g2 = g3 = ag0 = ag1 = ag2 = ag3 = bg0 = bg1 = bg2 = bg3 = np.float32(0)
    for step in range(49):
        i, j = row + step // 7 - 3, column + step % 7 - 3
        x = (np.float32(j) + half - camera[2]) / camera[0]
        y = (np.float32(i) + half - camera[3]) / camera[1]
        r0 = camera[8] * x + camera[9] * y + camera[10]
        r1 = camera[11] * x + camera[12] * y + camera[13]
        r2 = camera[14] * x + camera[15] * y + camera[16]
        along = n0 * x + n1 * y + n2
        q2 = r2 * distance - t2 * along
        if q2 <= np.float32(1e-9):
            return False
        p0, p1 = (r0 * distance - t0 * along) / q2, (r1 * distance - t1 * along) / q2
        u, v = p0 * camera[4] + camera[6], p1 * camera[5] + camera[7]
        if not (half <= u <= right and half <= v <= bottom):
            return False
        left, top = min(int(u - half), other.shape[1] - 2), min(int(v - half), other.shape[0] - 2)
        fu, fv = u - half - np.float32(left), v - half - np.float32(top)
        b00, b01, b10, b11 = (
            other[top, left],
            other[top, left + 1],
            other[top + 1, left],
            other[top + 1, left + 1],
        )
        a, b = gray[i, j], (one - fv) * (b00 + fu * (b01 - b00)) + fv * (b10 + fu * (b11 - b10))
        c0 = ((one - fv) * (b01 - b00) + fv * (b11 - b10)) * camera[4] / q2
        c1 = ((one - fu) * (b10 - b00) + fu * (b11 - b01)) * camera[5] / q2
        c2 = -(c0 * p0 + c1 * p1)
        by_along = -(c0 * t0 + c1 * t1 + c2 * t2)
        d0, d1, d2, d3 = by_along * x, by_along * y, by_along, c0 * r0 + c1 * r1 + c2 * r2
        sum_a, sum_b, sum_aa, sum_bb, sum_ab = (
            sum_a + a,
            sum_b + b,
            sum_aa + a * a,
            sum_bb + b * b,
            sum_ab + a * b,
        )
        g0, g1, g2, g3 = g0 + d0, g1 + d1, g2 + d2, g3 + d3
        ag0, ag1, ag2, ag3 = ag0 + a * d0, ag1 + a * d1, ag2 + a * d2, ag3 + a * d3
        bg0, bg1, bg2, bg3 = bg0 + b * d0, bg1 + b * d1, bg2 + b * d2, bg3 + b * d3
    share = one / np.float32(49)
    mean_a, mean_b = sum_a * share, sum_b * share
    var_a = max(sum_aa * share - mean_a * mean_a, np.float32(0)) + np.float32(NOISE)
    var_b = max(sum_bb * share - mean_b * mean_b, np.float32(0)) + np.float32(NOISE)
    scale = one / np.sqrt(var_a * var_b)
    ncc = (sum_ab * share - mean_a * mean_b) * scale
    value[0] = one - ncc
    by_a, by_b = share * scale, share * ncc / var_b
    slope[0] = (bg0 - mean_b * g0) * by_b - (ag0 - mean_a * g0) * by_a
    slope[1] = (bg1 - mean_b * g1) * by_b - (ag1 - mean_a * g1) * by_a
    slope[2] = (bg2 - mean_b * g2) * by_b - (ag2 - mean_a * g2) * by_a
    slope[3] = (bg3 - mean_b * g3) * by_b - (ag3 - mean_a * g3) * by_a
    return True
