"""Slow dense twin of the renderer in plain torch: every pixel against every Gaussian. For tests, in any float
type.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sc3d.geometry.cameras import View, rays
from sc3d.splatting.gaussians import Gaussians

_NEAR, _DILATION, _MARGIN = 0.01, 0.3, 1.3
_MIN_ALPHA, _MAX_ALPHA, _MIN_TRANSMITTANCE = 1.0 / 255.0, 0.99, 1e-4


def render_reference(
    gaussians: Gaussians,
    view: View,
    sh_degree: int | None = None,
    background: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """color (H, W, 3), alpha (H, W), normal (H, W, 3), plane_distance (H, W) as in `render.Rendering`;
    gradients by torch autograd.

    Memory grows with H * W * N: use a few thousand pixels and a few hundred Gaussians.
    """
    order, weights, normals, distances = _fragments(gaussians, view)
    dtype = gaussians.means.dtype
    directions = gaussians.means[order] - torch.tensor(view.center, dtype=dtype)
    colors = (
        0.5 + torch.einsum("nk,nkc->nc", *_basis_and_coefficients(directions, gaussians.sh[order], sh_degree))
    ).clamp_min(0.0)
    alpha = weights.sum(1)
    color = weights @ colors
    if background is not None:
        color = color + (1 - alpha)[:, None] * background.to(dtype)
    size = (view.height, view.width)
    return (
        color.reshape(*size, 3),
        alpha.reshape(size),
        (weights @ normals).reshape(*size, 3),
        (weights @ distances).reshape(size),
    )


def median_depth_reference(gaussians: Gaussians, view: View) -> tuple[Tensor, Tensor]:
    """(H, W) median depth as in `render.Rendering`, 0 = none, by torch autograd; (H, W) bool: it has a derivative,
    as it neither jumps nor has a kink within a 50th of a footprint.

    Bisection finds which fragments lie before, within and behind the footprint; with them, the depth is the
    solution of a linear equation.
    """
    _, weights, normals, distances = _fragments(gaussians, view)
    focal = float(np.sqrt(view.matrix[0, 0] * view.matrix[1, 1]))
    directions, along = rays(view)
    rays_cam = directions @ view.cam_from_world[:3, :3].T / along[:, None]
    inverse = -(torch.from_numpy(rays_cam).to(weights) @ normals.T) / distances

    def passed(depth: Tensor) -> Tensor:
        return focal * (inverse * depth[:, None] - 1) + 0.5

    near, far = torch.full_like(weights[:, 0], 1e-3), torch.full_like(weights[:, 0], 1e6)
    with torch.no_grad():
        for _ in range(80):
            middle = (near * far).sqrt()
            enough = (weights * passed(middle).clamp(0, 1)).sum(1) >= 0.5
            near, far = torch.where(enough, near, middle), torch.where(enough, middle, far)
        place = passed(far)
        behind, within = place <= 0, (place > 0) & (place < 1)
        kinks = torch.where(weights > 0, torch.minimum(place.abs(), (1 - place).abs()), 1).amin(1)
    before = (weights * ~(behind | within)).sum(1)
    share, slope = (weights * within).sum(1), focal * (weights * inverse * within).sum(1)
    found = (far < 1e5) & (share > 0)
    depth = (0.5 - before + (focal - 0.5) * share) / torch.where(found, slope, 1.0)
    size = (view.height, view.width)
    smooth = found & (kinks > 0.02) & (share > 0.01)
    return torch.where(found, depth, 0.0).reshape(size), smooth.reshape(size)


def _fragments(gaussians: Gaussians, view: View) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(M,) Gaussians before the camera, near to far; (H * W, M) weights; their planes, (M, 3) and (M,)."""
    dtype = gaussians.means.dtype
    rotation = torch.tensor(view.cam_from_world[:3, :3], dtype=dtype)
    means_cam = gaussians.means @ rotation.T + torch.tensor(view.cam_from_world[:3, 3], dtype=dtype)
    order = torch.argsort(means_cam[:, 2].detach(), stable=True)
    order = order[means_cam[order, 2].detach() >= _NEAR]
    means_cam = means_cam[order]
    axes = rotation @ rotation_matrices(gaussians.quats[order])
    opacities = torch.sigmoid(gaussians.opacity_logits[order])
    alphas = _alphas(means_cam, axes, gaussians.log_scales[order].exp(), opacities, view)
    reached = torch.cumprod(torch.cat([torch.ones_like(alphas[:, :1]), 1 - alphas], dim=1), dim=1)[:, :-1]
    weights = alphas * torch.where(reached >= _MIN_TRANSMITTANCE, reached, 0.0)
    normals, distances = _planes(means_cam, axes, gaussians.log_scales[order])
    return order, weights, normals, distances


def rotation_matrices(quats: Tensor) -> Tensor:
    """(N, 3, 3) rotations of (N, 4) wxyz quaternions, which are normalized first."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
            2 * (x * y + w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z - w * x),
            2 * (x * z - w * y),
            2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        ],
        dim=1,
    ).reshape(-1, 3, 3)


def _alphas(means_cam: Tensor, axes: Tensor, scales: Tensor, opacities: Tensor, view: View) -> Tensor:
    """(H * W, N) alpha of every Gaussian at every pixel center, 0 below 1/255."""
    dtype, matrix = means_cam.dtype, view.matrix
    focal, principal = (
        torch.tensor([matrix[0, 0], matrix[1, 1]], dtype=dtype),
        torch.tensor([matrix[0, 2], matrix[1, 2]], dtype=dtype),
    )
    size = torch.tensor([view.width, view.height], dtype=dtype)
    depth = means_cam[:, 2:]
    slopes = means_cam[:, :2] / depth
    margin = (_MARGIN - 1) * size / (2 * focal)
    limited = torch.maximum(
        torch.minimum(slopes, (size - principal) / focal + margin), -principal / focal - margin
    )
    jacobian = torch.zeros(len(means_cam), 2, 3, dtype=dtype)
    jacobian[:, 0, 0], jacobian[:, 1, 1] = (focal / depth).unbind(1)
    jacobian[:, :, 2] = -focal * limited / depth
    rows = jacobian @ (axes * scales[:, None, :])
    covariance = rows @ rows.transpose(1, 2) + _DILATION * torch.eye(2, dtype=dtype)
    columns, lines = torch.meshgrid(
        torch.arange(view.width) + 0.5, torch.arange(view.height) + 0.5, indexing="xy"
    )
    pixels = torch.stack([columns, lines], dim=2).reshape(-1, 1, 2).to(dtype)
    offsets = pixels - (slopes * focal + principal)
    power = torch.einsum("pni,nij,pnj->pn", offsets, torch.linalg.inv(covariance), offsets)
    alphas = (opacities * torch.exp(-0.5 * power)).clamp_max(_MAX_ALPHA)
    return torch.where(alphas >= _MIN_ALPHA, alphas, 0.0)


def _planes(means_cam: Tensor, axes: Tensor, log_scales: Tensor) -> tuple[Tensor, Tensor]:
    """(N, 3) normals towards the camera and (N,) plane distances, camera frame."""
    index = log_scales.detach().argmin(dim=1)
    normals = axes[torch.arange(len(axes)), :, index]
    facing = (normals * means_cam).sum(1)
    return torch.where(facing > 0, -1.0, 1.0)[:, None] * normals, facing.abs()


def _basis_and_coefficients(directions: Tensor, sh: Tensor, sh_degree: int | None) -> tuple[Tensor, Tensor]:
    """(N, K) real spherical harmonics of directions (N, 3), and the (N, K, 3) active coefficients."""
    stored = int(np.sqrt(sh.shape[1])) - 1
    degree = stored if sh_degree is None else min(sh_degree, stored)
    x, y, z = torch.nn.functional.normalize(directions, dim=1).unbind(1)
    a, b, c = 0.4886025119029199, 1.0925484305920792, 0.31539156525252005
    values = [
        torch.full_like(x, 0.28209479177387814),
        -a * y,
        a * z,
        -a * x,
        b * x * y,
        -b * y * z,
        c * (2 * z * z - x * x - y * y),
        -b * x * z,
        b / 2 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    active = (degree + 1) ** 2
    return torch.stack(values[:active], dim=1), sh[:, :active]
