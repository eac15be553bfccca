"""The single-view normal loss with its analytic gradient as two passes over the image.

`gpu.losses` has the slow twin.

With a, b the differences of the 4 neighbors' points across and down, m = b x a, n = m / |m| and residual
signs s = sign(A n - N):
    dL/dm = (I - n n^T) (w A s) / |m|,   dL/da = dL/dm x b,   dL/db = a x dL/dm,   and each point is its depth
    times a fixed ray.
"""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

from sc3d.splatting.consistency import ray_slopes


def depth_normal_loss(
    normal: Tensor,
    depth: Tensor,
    alpha: Tensor,
    edges: Tensor,
    calibration: tuple[float, float, float, float],
) -> Tensor:
    """mean (1 - g)^2 |A N_depth - N|_1; differentiable in `normal` (H, W, 3) and `depth` (H, W), 0 = none.

    alpha, edges: (H, W); calibration: fx fy cx cy, px
    """
    return _NormalLoss.apply(normal, depth, alpha, edges, calibration)


class _NormalLoss(torch.autograd.Function):
    """The gradient is computed along with the value: a loss is a scalar, so backward only scales it."""

    @staticmethod
    def forward(ctx, normal, depth, alpha, edges, calibration):
        height, width = depth.shape
        planes = normal.detach().permute(2, 0, 1).contiguous().numpy()
        flat = (tensor.detach().contiguous().numpy() for tensor in (depth, alpha, edges))
        depth_array, alpha_array, edge_array = flat
        columns, rows = ray_slopes(width, height, calibration)
        normal_slope, depth_slope = torch.zeros(3, height, width), torch.zeros(height, width)
        pulls, sums = np.zeros((height, width, 6), np.float32), np.zeros((height, 2))
        _compare(
            planes, depth_array, alpha_array, edge_array, columns, rows, normal_slope.numpy(), pulls, sums
        )
        _gather(pulls, columns, rows, depth_slope.numpy())
        total, known = sums.sum(0)
        ctx.save_for_backward(normal_slope, depth_slope)
        ctx.known = max(known, 1.0)
        return normal.new_tensor(total / ctx.known)

    @staticmethod
    def backward(ctx, gradient):
        normal_slope, depth_slope = (slope * (gradient / ctx.known) for slope in ctx.saved_tensors)
        return normal_slope.permute(1, 2, 0), depth_slope, None, None, None


@numba.njit(parallel=True, cache=True, fastmath={"contract", "nsz", "arcp", "reassoc"}, error_model="numpy")
def _compare(normal, depth, alpha, edges, columns, rows, normal_slope, pulls, sums):
    """Per pixel: residual into `sums`, its slope by N, and by the differences a (pulls 0..2) and b (pulls
    3..5).
    """
    height, width = depth.shape
    for i in numba.prange(1, height - 1):
        for j in range(1, width - 1):
            left, right, up, low = depth[i, j - 1], depth[i, j + 1], depth[i - 1, j], depth[i + 1, j]
            if left > 0 and right > 0 and up > 0 and low > 0:
                a0, a1, a2 = (
                    columns[j + 1] * right - columns[j - 1] * left,
                    rows[i] * (right - left),
                    right - left,
                )
                b0, b1, b2 = columns[j] * (low - up), rows[i + 1] * low - rows[i - 1] * up, low - up
                m0, m1, m2 = b1 * a2 - b2 * a1, b2 * a0 - b0 * a2, b0 * a1 - b1 * a0
                square = m0 * m0 + m1 * m1 + m2 * m2
                if square > 0:
                    inverse = np.float32(1) / np.sqrt(square)
                    n0, n1, n2 = m0 * inverse, m1 * inverse, m2 * inverse
                    opacity, weight = alpha[i, j], (np.float32(1) - edges[i, j]) ** 2
                    r0, r1, r2 = (
                        opacity * n0 - normal[0, i, j],
                        opacity * n1 - normal[1, i, j],
                        opacity * n2 - normal[2, i, j],
                    )
                    sums[i, 0] += weight * (abs(r0) + abs(r1) + abs(r2))
                    sums[i, 1] += 1
                    s0, s1, s2 = weight * np.sign(r0), weight * np.sign(r1), weight * np.sign(r2)
                    normal_slope[0, i, j], normal_slope[1, i, j], normal_slope[2, i, j] = -s0, -s1, -s2
                    along = s0 * n0 + s1 * n1 + s2 * n2
                    scale = opacity * inverse
                    g0, g1, g2 = (
                        (s0 - along * n0) * scale,
                        (s1 - along * n1) * scale,
                        (s2 - along * n2) * scale,
                    )
                    pull = pulls[i, j]
                    pull[0], pull[1], pull[2] = g1 * b2 - g2 * b1, g2 * b0 - g0 * b2, g0 * b1 - g1 * b0
                    pull[3], pull[4], pull[5] = a1 * g2 - a2 * g1, a2 * g0 - a0 * g2, a0 * g1 - a1 * g0


@numba.njit(parallel=True, cache=True)
def _gather(pulls, columns, rows, depth_slope):
    """d loss / d depth: a point is the right end of its left neighbor's difference, and so on."""
    height, width = depth_slope.shape
    for i in numba.prange(height):
        for j in range(width):
            p0 = p1 = p2 = np.float32(0)
            if j > 0:
                p0, p1, p2 = p0 + pulls[i, j - 1, 0], p1 + pulls[i, j - 1, 1], p2 + pulls[i, j - 1, 2]
            if j < width - 1:
                p0, p1, p2 = p0 - pulls[i, j + 1, 0], p1 - pulls[i, j + 1, 1], p2 - pulls[i, j + 1, 2]
            if i > 0:
                p0, p1, p2 = p0 + pulls[i - 1, j, 3], p1 + pulls[i - 1, j, 4], p2 + pulls[i - 1, j, 5]
            if i < height - 1:
                p0, p1, p2 = p0 - pulls[i + 1, j, 3], p1 - pulls[i + 1, j, 4], p2 - pulls[i + 1, j, 5]
            depth_slope[i, j] = p0 * columns[j] + p1 * rows[i] + p2
