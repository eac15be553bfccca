"""Numba kernels that turn Gaussians into screen-space records.

The exponent of a splat is written with the Schur complement of its 2D covariance S instead of its inverse:
with dx, dy = pixel - mean,
    d^T S^-1 d = a u^2 + h dy^2,   u = dx - m dy,   a = Syy / det S,   h = 1 / Syy,   m = Sxy / Syy
which needs two multiplications per pixel, has no cancellation for thin diagonal splats, and gives the pixel
interval of a row at once.

Record of a Gaussian, 16 float32 (64 bytes): mean x, y (px); m; a and h in units of 2^-x (times log2(e) / 2);
log2 opacity; half extents in x and y (px) of the ellipse where alpha falls to 1/255; color (3); normal (3)
and plane distance, camera frame; dy of the right-most point of that ellipse.
Arithmetic is float64 inside: far Gaussians of a large scene keep their place, and it costs nothing in scalar
code.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np

from sc3d.geometry.cameras import View
from sc3d.splatting.gaussians import Gaussians

RECORD = 16
CHUNK = 256  # Gaussians per parallel work item
NEAR = 0.01  # near plane, world units
DILATION = 0.3  # px^2 added to the diagonal of the 2D covariance
MIN_ALPHA = 1.0 / 255.0
LOG2E_HALF = 0.5 * math.log2(math.e)
# standard deviations at which an opaque splat falls to 1/255
_REACH = math.sqrt(2.0 * math.log(255.0)) + 0.01
# half image sizes that a mean may lie outside the image before its Jacobian is clamped: 1.3 tan(fov / 2)
_JACOBIAN_MARGIN = 0.3
_STREAMS = 16  # interleaving of work items, so that threads with contiguous shares get similar work
_SLACK = 1e-3  # extents are this much too large (in log2 alpha), so that rounding never hides a fragment

_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
_C0 = 0.28209479177387814


class GaussianArrays(NamedTuple):
    """The parameters of N Gaussians, shapes as in `Gaussians`, float32 and contiguous."""

    means: np.ndarray
    log_scales: np.ndarray
    quats: np.ndarray
    opacity_logits: np.ndarray
    sh_dc: np.ndarray
    sh_rest: np.ndarray


def gaussian_arrays(gaussians: Gaussians) -> GaussianArrays:
    """The tensors as arrays; memory is shared where they are contiguous."""
    return GaussianArrays(
        *(tensor.detach().contiguous().numpy() for tensor in gaussians.parameters().values())
    )


def camera_array(view: View) -> np.ndarray:
    """(25,) float64: rotation (9, row-major), translation (3), fx, fy, cx, cy, width, height, camera center
    (3), and the limits of x / z (2) and y / z (2) beyond which the Jacobian is that of the limit.
    """
    pose, focal, principal = view.cam_from_world, view.matrix[[0, 1], [0, 1]], view.matrix[:2, 2]
    size = np.array([view.width, view.height], np.float64)
    margin = _JACOBIAN_MARGIN * size / (2 * focal)
    limits = np.stack([-principal / focal - margin, (size - principal) / focal + margin], axis=1)
    return np.concatenate(
        [pose[:3, :3].ravel(), pose[:3, 3], focal, principal, size, view.center, limits.ravel()]
    )


@lru_cache(maxsize=64)
def interleaved(count: int) -> np.ndarray:
    """(count,) int64 permutation: 0, 16, 32, ..., 1, 17, ..."""
    return np.concatenate([np.arange(first, count, _STREAMS, dtype=np.int64) for first in range(_STREAMS)])


def project_view(
    gaussians: GaussianArrays, degree: int, camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Records (N, 16), camera depths (N,) and 3 sigma radii (N,), px; 0 where a Gaussian cannot touch the
    image. camera: `camera_array`
    """
    count = len(gaussians.means)
    records, depths, radii = np.empty((count, RECORD), np.float32), *np.zeros((2, count), np.float32)
    project(gaussians, degree, camera, interleaved(-(-count // CHUNK)), records, depths, radii)
    return records, depths, radii


@numba.njit(cache=True, error_model="numpy")
def _basis(degree, x, y, z, values):
    """Real spherical harmonics of a unit direction, (degree + 1)^2 values."""
    values[0] = _C0
    if degree > 0:
        values[1], values[2], values[3] = -_C1 * y, _C1 * z, -_C1 * x
    if degree > 1:
        values[4], values[5] = _C2[0] * x * y, -_C2[0] * y * z
        values[6] = _C2[1] * (2 * z * z - x * x - y * y)
        values[7], values[8] = -_C2[0] * x * z, _C2[2] * (x * x - y * y)
    if degree > 2:
        values[9], values[10] = -_C3[0] * y * (3 * x * x - y * y), _C3[1] * x * y * z
        values[11] = -_C3[2] * y * (4 * z * z - x * x - y * y)
        values[12] = _C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y)
        values[13] = -_C3[2] * x * (4 * z * z - x * x - y * y)
        values[14], values[15] = _C3[4] * z * (x * x - y * y), -_C3[0] * x * (x * x - 3 * y * y)


@numba.njit(cache=True, error_model="numpy")
def _basis_slopes(degree, x, y, z, slopes):
    """d basis / d (x, y, z), (16, 3); rows beyond the degree are not touched."""
    slopes[0, :] = 0.0
    if degree > 0:
        slopes[1:4, :] = 0.0
        slopes[1, 1], slopes[2, 2], slopes[3, 0] = -_C1, _C1, -_C1
    if degree > 1:
        slopes[4, 0], slopes[4, 1], slopes[4, 2] = _C2[0] * y, _C2[0] * x, 0.0
        slopes[5, 0], slopes[5, 1], slopes[5, 2] = 0.0, -_C2[0] * z, -_C2[0] * y
        slopes[6, 0], slopes[6, 1], slopes[6, 2] = -2 * _C2[1] * x, -2 * _C2[1] * y, 4 * _C2[1] * z
        slopes[7, 0], slopes[7, 1], slopes[7, 2] = -_C2[0] * z, 0.0, -_C2[0] * x
        slopes[8, 0], slopes[8, 1], slopes[8, 2] = 2 * _C2[2] * x, -2 * _C2[2] * y, 0.0
    if degree > 2:
        slopes[9, 0], slopes[9, 1], slopes[9, 2] = -6 * _C3[0] * x * y, -3 * _C3[0] * (x * x - y * y), 0.0
        slopes[10, 0], slopes[10, 1], slopes[10, 2] = _C3[1] * y * z, _C3[1] * x * z, _C3[1] * x * y
        slopes[11, 0], slopes[11, 2] = 2 * _C3[2] * x * y, -8 * _C3[2] * y * z
        slopes[11, 1] = -_C3[2] * (4 * z * z - x * x - 3 * y * y)
        slopes[12, 0], slopes[12, 1] = -6 * _C3[3] * x * z, -6 * _C3[3] * y * z
        slopes[12, 2] = _C3[3] * (6 * z * z - 3 * x * x - 3 * y * y)
        slopes[13, 0] = -_C3[2] * (4 * z * z - 3 * x * x - y * y)
        slopes[13, 1], slopes[13, 2] = 2 * _C3[2] * x * y, -8 * _C3[2] * x * z
        slopes[14, 0], slopes[14, 1], slopes[14, 2] = (
            2 * _C3[4] * x * z,
            -2 * _C3[4] * y * z,
            _C3[4] * (x * x - y * y),
        )
        slopes[15, 0], slopes[15, 1], slopes[15, 2] = -3 * _C3[0] * (x * x - y * y), 6 * _C3[0] * x * y, 0.0


@numba.njit(cache=True, error_model="numpy")
def _mean_cam(means, i, camera):
    x, y, z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
    return (
        camera[0] * x + camera[1] * y + camera[2] * z + camera[9],
        camera[3] * x + camera[4] * y + camera[5] * z + camera[10],
        camera[6] * x + camera[7] * y + camera[8] * z + camera[11],
    )


@numba.njit(cache=True, error_model="numpy")
def _jacobian(x, y, z, camera):
    """The four non-zero entries of d pixel / d mean_cam, with x / z and y / z clamped; and whether each was
    inside its limits.
    """
    inverse = 1.0 / z
    slope_x, slope_y, j00, j11 = x * inverse, y * inverse, camera[12] * inverse, camera[13] * inverse
    limited_x, limited_y = (
        min(max(slope_x, camera[21]), camera[22]),
        min(max(slope_y, camera[23]), camera[24]),
    )
    return j00, j11, -j00 * limited_x, -j11 * limited_y, limited_x == slope_x, limited_y == slope_y


@numba.njit(cache=True, error_model="numpy")
def _axes_cam(quats, i, camera, rotation, axes):
    """rotation (3, 3) world_from_gaussian and axes = cam_from_world @ rotation; returns 1 / |quat|."""
    w, x, y, z = (
        np.float64(quats[i, 0]),
        np.float64(quats[i, 1]),
        np.float64(quats[i, 2]),
        np.float64(quats[i, 3]),
    )
    scale = 1.0 / max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
    )
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = (
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
    )
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )
    for row in range(3):
        for column in range(3):
            axes[row, column] = (
                camera[3 * row] * rotation[0, column]
                + camera[3 * row + 1] * rotation[1, column]
                + camera[3 * row + 2] * rotation[2, column]
            )
    return scale


@numba.njit(cache=True, error_model="numpy")
def _smallest(log_scales, i):
    axis = 0
    if log_scales[i, 1] < log_scales[i, axis]:
        axis = 1
    if log_scales[i, 2] < log_scales[i, axis]:
        axis = 2
    return axis


@numba.njit(cache=True, error_model="numpy")
def _covariance(axes, scales, j00, j11, j02, j12, rows):
    """Fills rows (2, 3), T = J axes diag(scales), and returns Sxx, Sxy, Syy of T T^T + dilation."""
    for k in range(3):
        rows[0, k] = (j00 * axes[0, k] + j02 * axes[2, k]) * scales[k]
        rows[1, k] = (j11 * axes[1, k] + j12 * axes[2, k]) * scales[k]
    sxx = rows[0, 0] * rows[0, 0] + rows[0, 1] * rows[0, 1] + rows[0, 2] * rows[0, 2] + DILATION
    sxy = rows[0, 0] * rows[1, 0] + rows[0, 1] * rows[1, 1] + rows[0, 2] * rows[1, 2]
    syy = rows[1, 0] * rows[1, 0] + rows[1, 1] * rows[1, 1] + rows[1, 2] * rows[1, 2] + DILATION
    return sxx, sxy, syy


@numba.njit(cache=True, error_model="numpy")
def _touches(center, half, size):
    """Whether [center - half, center + half] holds a pixel center 0.5, 1.5, ... size - 0.5; False for NaN."""
    low, high = center - half, center + half
    return (
        low <= size - 0.5
        and high >= 0.5
        and math.ceil(max(low, 0.5) - 0.5) <= math.floor(min(high, size - 0.5) - 0.5)
    )


@numba.njit(cache=True, error_model="numpy")
def _color(sh_dc, sh_rest, degree, i, basis, channel):
    value = 0.5 + basis[0] * sh_dc[i, channel]
    for k in range(1, (degree + 1) * (degree + 1)):
        value += basis[k] * sh_rest[i, k - 1, channel]
    return value


class _Scratch(NamedTuple):
    rotation: np.ndarray
    axes: np.ndarray
    scales: np.ndarray
    rows: np.ndarray
    basis: np.ndarray


@numba.njit(cache=True, error_model="numpy")
def _near_image(i, means, log_scales, camera):
    """Whether a sphere around Gaussian i may touch the image: asked before any expensive work."""
    x, y, z = _mean_cam(means, i, camera)
    if not z >= NEAR:
        return False
    j00, j11, j02, j12, _, _ = _jacobian(x, y, z, camera)
    mean_x, mean_y = j00 * x + camera[14], j11 * y + camera[15]
    bound = _REACH * math.exp(max(log_scales[i, 0], log_scales[i, 1], log_scales[i, 2]))
    half_x, half_y = bound * (j00 + abs(j02)) + _REACH, bound * (j11 + abs(j12)) + _REACH
    across = mean_x + half_x > 0.0 and mean_x - half_x < camera[16]
    return across and mean_y + half_y > 0.0 and mean_y - half_y < camera[17]


@numba.njit(cache=True, error_model="numpy")
def _project_one(i, gaussians, degree, camera, scratch, records):
    """Fills the record of Gaussian i, which is near the image; returns (depth, 3 sigma radius in px), both 0
    if it cannot touch the image.
    """
    rotation, axes, scales, rows, basis = scratch
    means, log_scales = gaussians.means, gaussians.log_scales
    x, y, z = _mean_cam(means, i, camera)
    j00, j11, j02, j12, _, _ = _jacobian(x, y, z, camera)
    mean_x, mean_y = j00 * x + camera[14], j11 * y + camera[15]
    log_opacity = -math.log2(np.float32(1.0) + math.exp(-gaussians.opacity_logits[i]))
    room = log_opacity - math.log2(MIN_ALPHA) + _SLACK
    if not room > _SLACK:
        return 0.0, 0.0
    _axes_cam(gaussians.quats, i, camera, rotation, axes)
    for k in range(3):
        scales[k] = math.exp(log_scales[i, k])
    sxx, sxy, syy = _covariance(axes, scales, j00, j11, j02, j12, rows)
    determinant = sxx * syy - sxy * sxy
    half_x, half_y = math.sqrt(room / LOG2E_HALF * sxx), math.sqrt(room / LOG2E_HALF * syy)
    if not (
        determinant > 0.0
        and math.isfinite(determinant)
        and _touches(mean_x, half_x, camera[16])
        and _touches(mean_y, half_y, camera[17])
    ):
        return 0.0, 0.0
    distance = math.sqrt(x * x + y * y + z * z)
    if degree > 0:
        dx, dy, dz = means[i, 0] - camera[18], means[i, 1] - camera[19], means[i, 2] - camera[20]
        _basis(degree, dx / distance, dy / distance, dz / distance, basis)
    axis = _smallest(log_scales, i)
    facing = axes[0, axis] * x + axes[1, axis] * y + axes[2, axis] * z
    sign = -1.0 if facing > 0.0 else 1.0
    records[i, 0], records[i, 1], records[i, 2] = mean_x, mean_y, sxy / syy
    records[i, 3], records[i, 4], records[i, 5] = (
        LOG2E_HALF * syy / determinant,
        LOG2E_HALF / syy,
        log_opacity,
    )
    records[i, 6], records[i, 7], records[i, 15] = half_x, half_y, half_x * sxy / sxx
    for k in range(3):
        records[i, 8 + k] = max(_color(gaussians.sh_dc, gaussians.sh_rest, degree, i, basis, k), 0.0)
        records[i, 11 + k] = sign * axes[k, axis]
    records[i, 14] = abs(facing)
    middle = 0.5 * (sxx + syy)
    return z, 3.0 * math.sqrt(middle + math.sqrt(max(middle * middle - determinant, 0.0)))


@numba.njit(cache=True, error_model="numpy", parallel=True)
def project(gaussians, degree, camera, order, records, depths, radii):
    """Fills what `project_view` returns; depths and radii are zero on entry. order: permutation of the
    chunks.
    """
    count, means, log_scales = depths.shape[0], gaussians.means, gaussians.log_scales
    for item in numba.prange(order.shape[0]):
        scratch = _Scratch(
            np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty((2, 3)), np.full(16, _C0)
        )
        for i in range(order[item] * CHUNK, min(count, (order[item] + 1) * CHUNK)):
            if _near_image(i, means, log_scales, camera):
                depths[i], radii[i] = _project_one(i, gaussians, degree, camera, scratch, records)
