"""Numba kernels: the reverse of `projection`, from raster gradients of instances to those of parameters."""

from __future__ import annotations

import math

import numba
import numpy as np

from sc3d.splatting.cpu.projection import (
    CHUNK,
    _axes_cam,
    _basis,
    _basis_slopes,
    _color,
    _covariance,
    _jacobian,
    _mean_cam,
    _smallest,
)

# sums over pixels in one raster gradient record; s = d loss / d ln(alpha), w = weight, g = d loss / d output
# channel s, s u, s u^2, s dy, s u dy, s dy^2, |ds/dx|, |ds/dy|, w g (color 3, normal 3, plane distance),
# spare
SUMS = 16


@numba.njit(cache=True, error_model="numpy")
def _total(first, last, gradients, sums):
    """Sum of the records of one Gaussian in the fixed order of its tiles."""
    sums[:] = 0.0
    for instance in range(first, last):
        for k in range(SUMS):
            sums[k] += gradients[instance, k]


@numba.njit(cache=True, error_model="numpy")
def _plane_gradient(sums, axes, axis, x, y, z, grad_axes, grad_mean):
    """Adds the gradient through the normal n = +-axes[:, axis] and the plane distance |n . mean|."""
    sign = -1.0 if axes[0, axis] * x + axes[1, axis] * y + axes[2, axis] * z > 0.0 else 1.0
    mean = (x, y, z)
    for k in range(3):
        grad_axes[k, axis] += sign * (sums[11 + k] - sums[14] * mean[k])
        grad_mean[k] -= sums[14] * sign * axes[k, axis]


@numba.njit(cache=True, error_model="numpy")
def _color_gradient(i, sums, gaussians, degree, camera, basis, slopes, gradients):
    """Gradient of the SH coefficients, and of the mean through the viewing direction. Channels clamped at 0
    have none.
    """
    means, dc, rest = gaussians.means, gaussians.sh_dc, gaussians.sh_rest
    grad_means, grad_dc, grad_rest = gradients.means, gradients.sh_dc, gradients.sh_rest
    dx, dy, dz = means[i, 0] - camera[18], means[i, 1] - camera[19], means[i, 2] - camera[20]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / distance, dy / distance, dz / distance
    _basis(degree, dx, dy, dz, basis)
    _basis_slopes(degree, dx, dy, dz, slopes)
    gx, gy, gz = 0.0, 0.0, 0.0
    for channel in range(3):
        gradient = sums[8 + channel]
        if _color(dc, rest, degree, i, basis, channel) < 0.0:
            continue
        grad_dc[i, channel] = gradient * basis[0]
        for k in range(1, (degree + 1) * (degree + 1)):
            grad_rest[i, k - 1, channel] = gradient * basis[k]
            gx += gradient * rest[i, k - 1, channel] * slopes[k, 0]
            gy += gradient * rest[i, k - 1, channel] * slopes[k, 1]
            gz += gradient * rest[i, k - 1, channel] * slopes[k, 2]
    along = gx * dx + gy * dy + gz * dz
    grad_means[i, 0] += (gx - along * dx) / distance
    grad_means[i, 1] += (gy - along * dy) / distance
    grad_means[i, 2] += (gz - along * dz) / distance


@numba.njit(cache=True, error_model="numpy")
def _quat_gradient(i, quats, scale, g, grad_quats):
    """Gradient of the unnormalized quaternion from g (3, 3), that of the rotation; scale = 1 / |quat|."""
    w, x, y, z = quats[i, 0] * scale, quats[i, 1] * scale, quats[i, 2] * scale, quats[i, 3] * scale
    gw = 2 * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]))
    gx = 2 * (
        y * (g[0, 1] + g[1, 0])
        + z * (g[0, 2] + g[2, 0])
        + w * (g[2, 1] - g[1, 2])
        - 2 * x * (g[1, 1] + g[2, 2])
    )
    gy = 2 * (
        x * (g[0, 1] + g[1, 0])
        + z * (g[1, 2] + g[2, 1])
        + w * (g[0, 2] - g[2, 0])
        - 2 * y * (g[0, 0] + g[2, 2])
    )
    gz = 2 * (
        x * (g[0, 2] + g[2, 0])
        + y * (g[1, 2] + g[2, 1])
        + w * (g[1, 0] - g[0, 1])
        - 2 * z * (g[0, 0] + g[1, 1])
    )
    along = gw * w + gx * x + gy * y + gz * z
    grad_quats[i, 0], grad_quats[i, 1] = (gw - along * w) * scale, (gx - along * x) * scale
    grad_quats[i, 2], grad_quats[i, 3] = (gy - along * y) * scale, (gz - along * z) * scale


@numba.njit(cache=True, error_model="numpy")
def _screen_gradient(sums, a, h, m):
    """Gradient of the 2D mean (x, y) and of Sxx, Sxy, Syy from the pixel sums (see `projection` for a,
    h, m).
    """
    grad_x = a * sums[1]
    grad_y = h * sums[3] - m * grad_x
    grad_a, grad_h, grad_m = -0.5 * sums[2], -0.5 * sums[5], a * sums[4]
    grad_sxx = -a * a * grad_a
    grad_sxy = 2 * a * a * m * grad_a + h * grad_m
    grad_syy = -a * a * m * m * grad_a - h * h * grad_h - m * h * grad_m
    return grad_x, grad_y, grad_sxx, grad_sxy, grad_syy


@numba.njit(cache=True, error_model="numpy")
def _projection_gradient(
    screen, rows, axes, scales, jacobian, x, y, z, camera, grad_axes, grad_log_scales, grad_mean
):
    """Reverse of the 2D mean and covariance: adds to grad_axes (3, 3), grad_log_scales (3,) and grad_mean
    (3,), camera frame.
    """
    grad_x, grad_y, grad_sxx, grad_sxy, grad_syy = screen
    j00, j11, j02, j12, free_x, free_y = jacobian
    g00, g11, g02, g12 = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        first = 2 * grad_sxx * rows[0, k] + grad_sxy * rows[1, k]
        second = 2 * grad_syy * rows[1, k] + grad_sxy * rows[0, k]
        grad_log_scales[k] = first * rows[0, k] + second * rows[1, k]
        first, second = first * scales[k], second * scales[k]
        g00 += first * axes[0, k]
        g11 += second * axes[1, k]
        g02 += first * axes[2, k]
        g12 += second * axes[2, k]
        grad_axes[0, k], grad_axes[1, k], grad_axes[2, k] = (
            j00 * first,
            j11 * second,
            j02 * first + j12 * second,
        )
    grad_mean[0] = j00 * grad_x
    grad_mean[1] = j11 * grad_y
    grad_mean[2] = -(j00 * x * grad_x + j11 * y * grad_y + j00 * g00 + j11 * g11 + j02 * g02 + j12 * g12) / z
    if free_x:  # the Jacobian follows x only inside its limits
        grad_mean[0] -= j00 / z * g02
        grad_mean[2] += j00 * x / (z * z) * g02
    if free_y:
        grad_mean[1] -= j11 / z * g12
        grad_mean[2] += j11 * y / (z * z) * g12


@numba.njit(cache=True, error_model="numpy", parallel=True)
def project_backward(
    tiles, sums_of_instances, gaussians, degree, camera, gradients, lengths, absolute_lengths
):
    """Fills the rows of visible Gaussians in their gradients and in the two densification statistics, all
    zero on entry.

    tiles: `TileLists`; sums_of_instances: (P, 16) raster gradients; gradients: `GaussianArrays`
    lengths, absolute_lengths: (N,) length of the gradient by the 2D mean, NDC units, and the same from
        absolute gradients of pixels
    """
    visible, offsets = tiles.visible, tiles.offsets
    means, log_scales = gaussians.means, gaussians.log_scales
    # numba drops writes to a record's arrays in the body of prange
    grad_means, grad_log_scales, grad_logits = gradients.means, gradients.log_scales, gradients.opacity_logits
    count = visible.shape[0]
    for item in numba.prange((count + CHUNK - 1) // CHUNK):
        rotation, axes, scales, rows = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty((2, 3))
        grad_axes, grad_rotation, grad_scales, grad_mean = (
            np.empty((3, 3)),
            np.empty((3, 3)),
            np.empty(3),
            np.empty(3),
        )
        basis, slopes, sums = np.empty(16), np.empty((16, 3)), np.empty(SUMS)
        for rank in range(item * CHUNK, min(count, (item + 1) * CHUNK)):
            i = visible[rank]
            _total(offsets[rank], offsets[rank + 1], sums_of_instances, sums)
            x, y, z = _mean_cam(means, i, camera)
            jacobian = _jacobian(x, y, z, camera)
            scale = _axes_cam(gaussians.quats, i, camera, rotation, axes)
            for k in range(3):
                scales[k] = math.exp(log_scales[i, k])
            sxx, sxy, syy = _covariance(
                axes, scales, jacobian[0], jacobian[1], jacobian[2], jacobian[3], rows
            )
            screen = _screen_gradient(sums, syy / (sxx * syy - sxy * sxy), 1.0 / syy, sxy / syy)
            _projection_gradient(
                screen, rows, axes, scales, jacobian, x, y, z, camera, grad_axes, grad_scales, grad_mean
            )
            _plane_gradient(sums, axes, _smallest(log_scales, i), x, y, z, grad_axes, grad_mean)
            for row in range(3):
                grad_log_scales[i, row] = grad_scales[row]
                grad_means[i, row] = (
                    camera[row] * grad_mean[0]
                    + camera[3 + row] * grad_mean[1]
                    + camera[6 + row] * grad_mean[2]
                )
                for k in range(3):
                    grad_rotation[row, k] = (
                        camera[row] * grad_axes[0, k]
                        + camera[3 + row] * grad_axes[1, k]
                        + camera[6 + row] * grad_axes[2, k]
                    )
            _quat_gradient(i, gaussians.quats, scale, grad_rotation, gradients.quats)
            _color_gradient(i, sums, gaussians, degree, camera, basis, slopes, gradients)
            grad_logits[i] = sums[0] / (1.0 + math.exp(gaussians.opacity_logits[i]))
            lengths[i] = math.hypot(screen[0] * camera[16] * 0.5, screen[1] * camera[17] * 0.5)
            absolute_lengths[i] = math.hypot(sums[6] * camera[16] * 0.5, sums[7] * camera[17] * 0.5)
