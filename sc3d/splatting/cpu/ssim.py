"""SSIM and the image loss 0.8 L1 + 0.2 (1 - SSIM) as fused kernels with an analytic backward pass.

Window 11, sigma 1.5, zero padding, constants 0.01^2 and 0.03^2: the same numbers as an 11 x 11 grouped
convolution. With mx, my, P, Q = blurs of
x, y, x^2 + y^2, x y:   S = A1 A2 / (B1 B2),  A1 = 2 mx my + c1,  A2 = 2 (Q - mx my) + c2,  B1 = mx^2 + my^2 +
c1,  B2 = P - mx^2 - my^2 + c2,
and since the window is symmetric   d sum(S) / dx = blur(dS/dmx) + 2 x blur(dS/dP) + y blur(dS/dQ).
"""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

from sc3d.splatting.cpu.simd import LANES, absolute, fma, load, ramp, splat, store, total, where_at_least

_RADIUS = 5
_HALO = LANES  # columns to the left and right of a block; at least the radius
_ROWS, _COLUMNS = 64, 128  # block of one work item; 11 rows of it stay in the first-level cache
_WIDTH = _COLUMNS + 2 * _HALO
_PLANE = (_ROWS + 2 * _RADIUS) * _WIDTH
_TAPS = np.exp(-0.5 * (np.arange(_RADIUS + 1) / 1.5) ** 2)
WINDOW = (_TAPS / (_TAPS[0] + 2 * _TAPS[1:].sum())).astype(np.float32)
"""Taps of the window from its middle on."""
C1, C2 = 0.01**2, 0.03**2
_W0, _W1, _W2, _W3, _W4, _W5 = WINDOW
_C1, _C2 = np.float32(C1), np.float32(C2)
_ZERO = np.float32(0.0)


def image_loss(image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """(1 - ssim_weight) mean |image - target| + ssim_weight (1 - mean SSIM) of two (H, W, 3) images;
    differentiable in `image` only; fastest for float32 images stored plane by plane.
    """
    return _ImageLoss.apply(image, target, 1.0 - ssim_weight, ssim_weight)


class _ImageLoss(torch.autograd.Function):
    """The gradient is computed along with the value: a loss is a scalar, so backward only scales it."""

    @staticmethod
    def forward(ctx, image, target, l1_weight, ssim_weight):
        x, y = _planes(image), _planes(target)
        channels, height, width = x.shape
        blocks = (channels, -(-height // _ROWS), -(-width // _COLUMNS))
        slopes = np.empty((3, channels, height, blocks[2] * _COLUMNS), np.float32)
        sums = np.empty((blocks[0] * blocks[1] * blocks[2], 2))
        _similarity(x, y, blocks, slopes, sums)
        difference, similarity = sums.sum(axis=0) / x.size
        if ctx.needs_input_grad[0]:
            gradient = torch.empty(channels, height, width)
            _similarity_slope(
                x,
                y,
                blocks,
                slopes,
                np.float32(l1_weight / x.size),
                np.float32(-ssim_weight / x.size),
                gradient.numpy(),
            )
            ctx.save_for_backward(gradient)
        return image.new_tensor(l1_weight * difference + ssim_weight * (1.0 - similarity))

    @staticmethod
    def backward(ctx, grad_loss):
        (gradient,) = ctx.saved_tensors
        return (gradient * grad_loss).permute(1, 2, 0), None, None, None


def _planes(image: Tensor) -> np.ndarray:
    """(H, W, C) -> (C, H, W) contiguous float32; no copy if it is stored like that."""
    return image.detach().permute(2, 0, 1).float().contiguous().numpy()


@numba.njit(cache=True, error_model="numpy")
def _blur(buffer, place, step):
    """11 taps around `place`, `step` floats apart."""
    result = splat(_W0) * load(buffer, place)
    result = fma(splat(_W1), load(buffer, place - step) + load(buffer, place + step), result)
    result = fma(splat(_W2), load(buffer, place - 2 * step) + load(buffer, place + 2 * step), result)
    result = fma(splat(_W3), load(buffer, place - 3 * step) + load(buffer, place + 3 * step), result)
    result = fma(splat(_W4), load(buffer, place - 4 * step) + load(buffer, place + 4 * step), result)
    return fma(splat(_W5), load(buffer, place - 5 * step) + load(buffer, place + 5 * step), result)


@numba.njit(cache=True, error_model="numpy")
def _fill(plane, width, top, left, buffer, offset):
    """Copies rows and columns of a block with its halo, zero outside the image."""
    height = plane.shape[0]
    first, last = max(left - _HALO, 0), min(left + _COLUMNS + _HALO, width)
    for row in range(_ROWS + 2 * _RADIUS):
        y, base = top + row - _RADIUS, offset + row * _WIDTH
        if y < 0 or y >= height:
            buffer[base : base + _WIDTH] = _ZERO
        else:
            shift = base - (left - _HALO)
            buffer[base : shift + first] = _ZERO
            buffer[shift + first : shift + last] = plane[y, first:last]
            buffer[shift + last : base + _WIDTH] = _ZERO


@numba.njit(cache=True, error_model="numpy")
def _block(item, blocks):
    """Channel, first row and first column of a work item."""
    return item // (blocks[1] * blocks[2]), item // blocks[2] % blocks[1] * _ROWS, item % blocks[2] * _COLUMNS


@numba.njit(cache=True, error_model="numpy")
def _similarity_block(buffer, lines, flat, place, plane_size, stride, rows, columns):
    """Rows of one block: writes the slopes to `flat` from `place`; returns sums of |x - y| and of S."""
    one, two, c1, c2 = splat(1.0), splat(2.0), splat(_C1), splat(_C2)
    difference, similarity = 0.0, 0.0
    for row in range(rows):
        base = (row + _RADIUS) * _WIDTH
        for column in range(0, _WIDTH, LANES):
            for plane in range(4):
                store(lines, plane * _WIDTH + column, _blur(buffer, plane * _PLANE + base + column, _WIDTH))
        row_difference, row_similarity = splat(_ZERO), splat(_ZERO)
        for column in range(0, columns, LANES):
            here = _HALO + column
            mean_x, mean_y = _blur(lines, here, 1), _blur(lines, here + _WIDTH, 1)
            squares, product = _blur(lines, here + 2 * _WIDTH, 1), _blur(lines, here + 3 * _WIDTH, 1)
            mean_product, mean_squares = mean_x * mean_y, fma(mean_x, mean_x, mean_y * mean_y)
            a1, a2 = fma(two, mean_product, c1), fma(two, product - mean_product, c2)
            b1, b2 = mean_squares + c1, squares - mean_squares + c2
            inverse = one / (b1 * b2)
            value = a1 * a2 * inverse
            inverse_b2 = b1 * inverse
            target = place + row * stride + column
            store(
                flat,
                target,
                two * fma(mean_y * (a2 - a1), inverse, value * mean_x * (inverse_b2 - b2 * inverse)),
            )
            store(flat, target + plane_size, splat(_ZERO) - value * inverse_b2)
            store(flat, target + 2 * plane_size, two * a1 * inverse)
            inside, left = splat(np.float32(columns - 1 - column)), ramp()
            row_similarity = row_similarity + where_at_least(inside, left, value)
            apart = absolute(load(buffer, base + here) - load(buffer, base + here + _PLANE))
            row_difference = row_difference + where_at_least(inside, left, apart)
        difference += total(row_difference)
        similarity += total(row_similarity)
    return difference, similarity


@numba.njit(cache=True, error_model="numpy", parallel=True)
def _similarity(x, y, blocks, slopes, sums):
    """slopes (3, C, H, padded W): dS/dmx, dS/dP, dS/dQ; sums (items, 2): sums of |x - y| and of S."""
    channels, height, width = x.shape
    flat, stride = slopes.reshape(-1), slopes.shape[3]
    for item in numba.prange(sums.shape[0]):
        channel, top, left = _block(item, blocks)
        buffer, lines = np.empty(4 * _PLANE, np.float32), np.empty(4 * _WIDTH, np.float32)
        _fill(x[channel], width, top, left, buffer, 0)
        _fill(y[channel], width, top, left, buffer, _PLANE)
        for place in range(0, _PLANE, LANES):
            a, b = load(buffer, place), load(buffer, place + _PLANE)
            store(buffer, place + 2 * _PLANE, fma(a, a, b * b))
            store(buffer, place + 3 * _PLANE, a * b)
        rows, columns = min(_ROWS, height - top), min(_COLUMNS, width - left)
        sums[item, 0], sums[item, 1] = _similarity_block(
            buffer,
            lines,
            flat,
            (channel * height + top) * stride + left,
            channels * height * stride,
            stride,
            rows,
            columns,
        )


@numba.njit(cache=True, error_model="numpy")
def _slope_block(buffer, lines, line, l1_weight, ssim_weight, gradient, top, left, rows, columns):
    """Rows of one block of the gradient; buffer planes: the three slopes, x, y."""
    one, tiny = splat(1.0), splat(1e-37)
    absolute_weight, weight = splat(l1_weight), splat(ssim_weight)
    for row in range(rows):
        base = (row + _RADIUS) * _WIDTH
        for column in range(0, _WIDTH, LANES):
            for plane in range(3):
                store(lines, plane * _WIDTH + column, _blur(buffer, plane * _PLANE + base + column, _WIDTH))
        for column in range(0, columns, LANES):
            here = _HALO + column
            x, y = load(buffer, 3 * _PLANE + base + here), load(buffer, 4 * _PLANE + base + here)
            slope = fma(
                x + x,
                _blur(lines, here + _WIDTH, 1),
                fma(y, _blur(lines, here + 2 * _WIDTH, 1), _blur(lines, here, 1)),
            )
            sign = where_at_least(x - y, tiny, one) - where_at_least(y - x, tiny, one)
            store(line, column, fma(weight, slope, absolute_weight * sign))
        gradient[top + row, left : left + columns] = line[:columns]


@numba.njit(cache=True, error_model="numpy", parallel=True)
def _similarity_slope(x, y, blocks, slopes, l1_weight, ssim_weight, gradient):
    """gradient (C, H, W) = l1_weight sign(x - y) + ssim_weight d sum(S) / dx."""
    height, width = x.shape[1], x.shape[2]
    for item in numba.prange(blocks[0] * blocks[1] * blocks[2]):
        channel, top, left = _block(item, blocks)
        buffer, lines, line = (
            np.empty(5 * _PLANE, np.float32),
            np.empty(3 * _WIDTH, np.float32),
            np.empty(_COLUMNS, np.float32),
        )
        for plane in range(3):
            _fill(slopes[plane, channel], width, top, left, buffer, plane * _PLANE)
        _fill(x[channel], width, top, left, buffer, 3 * _PLANE)
        _fill(y[channel], width, top, left, buffer, 4 * _PLANE)
        rows, columns = min(_ROWS, height - top), min(_COLUMNS, width - left)
        _slope_block(buffer, lines, line, l1_weight, ssim_weight, gradient[channel], top, left, rows, columns)
