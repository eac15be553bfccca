"""Losses in torch operations: twins of the kernels in `cpu`, with the same arguments."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sc3d.splatting.consistency import ray_slopes, sample
from sc3d.splatting.cpu.patch_ncc import NOISE, PATCH_RADIUS
from sc3d.splatting.cpu.ssim import C1, C2, WINDOW


def image_loss(image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """`cpu.ssim.image_loss`."""
    x, y = image.permute(2, 0, 1), target.permute(2, 0, 1)
    mx, my, squares, product = _blurred(torch.cat([x, y, x * x + y * y, x * y])).chunk(4)
    means, energy = mx * my, mx * mx + my * my
    similarity = (2 * means + C1) * (2 * (product - means) + C2) / ((energy + C1) * (squares - energy + C2))
    return (1 - ssim_weight) * (x - y).abs().mean() + ssim_weight * (1 - similarity.mean())


def _blurred(planes: Tensor) -> Tensor:
    """(P, H, W) planes under the window, zero outside."""
    taps, radius = planes.new_tensor(np.concatenate([WINDOW[:0:-1], WINDOW])), len(WINDOW) - 1
    down = torch.nn.functional.conv2d(planes[:, None], taps[None, None, :, None], padding=(radius, 0))
    return torch.nn.functional.conv2d(down, taps[None, None, None, :], padding=(0, radius))[:, 0]


def depth_normal_loss(
    normal: Tensor,
    depth: Tensor,
    alpha: Tensor,
    edges: Tensor,
    calibration: tuple[float, float, float, float],
) -> Tensor:
    """`cpu.normal_loss.depth_normal_loss`."""
    depth_normals = normals_from_depth(depth, calibration)
    known = depth_normals.detach().abs().sum(2) > 0
    gap = (alpha.detach()[..., None] * depth_normals - normal).abs().sum(2)
    return ((1 - edges).square() * gap * known).sum() / known.sum().clamp_min(1)


def normals_from_depth(depth: Tensor, calibration: tuple[float, float, float, float]) -> Tensor:
    """(H, W, 3) unit normals, camera frame, towards the camera: cross product of the differences between the
    4 neighbors' points.

    depth: (H, W), 0 = none; calibration: fx fy cx cy, px. Zero at the image border and where one of the four
        has no depth.
    """
    slopes = ray_slopes(depth.shape[1], depth.shape[0], calibration)
    columns, rows = (torch.from_numpy(array).to(depth.device) for array in slopes)
    points = torch.stack([columns * depth, rows[:, None] * depth, depth], 2)
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    known = (depth[1:-1, 2:] > 0) & (depth[1:-1, :-2] > 0) & (depth[2:, 1:-1] > 0) & (depth[:-2, 1:-1] > 0)
    normals = torch.linalg.cross(down, across)
    length = normals.norm(dim=2, keepdim=True)
    known = known[..., None] & (length > 0)
    normals = torch.where(known, normals / torch.where(known, length, 1), 0)
    return torch.nn.functional.pad(normals, (0, 0, 1, 1, 1, 1))


def patch_dissimilarity(
    normals: Tensor, distances: Tensor, pixels: Tensor, grays: tuple[Tensor, Tensor], cameras: np.ndarray
) -> tuple[Tensor, Tensor]:
    """`cpu.patch_ncc.patch_dissimilarity`."""
    gray, other_gray = grays
    steps = torch.arange(-PATCH_RADIUS, PATCH_RADIUS + 1, device=pixels.device)
    offsets = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), 2).reshape(-1, 2)
    patch, limits = pixels[:, None] + offsets, pixels.new_tensor([gray.shape[1] - 1, gray.shape[0] - 1])
    inside = ((patch >= 0) & (patch <= limits)).all(2).all(1)
    patch = patch.clamp_min(0).minimum(limits)
    values = gray[patch[..., 1], patch[..., 0]]
    warped = _warp(patch.float() + 0.5, normals, distances, cameras)
    border = warped.new_tensor([other_gray.shape[1], other_gray.shape[0]]) - 0.5
    inside = inside & ((warped >= 0.5) & (warped <= border)).all(2).all(1)
    other_values = sample(other_gray, warped.reshape(-1, 2)).reshape(values.shape)
    return 1 - normalized_correlation(values, other_values), inside


def normalized_correlation(first: Tensor, second: Tensor) -> Tensor:
    """(M,) NCC of rows of two (M, P) arrays in [0, 1]. Variances below (1/255)^2 count as noise: they pull it
    to 0.
    """
    first, second = first - first.mean(1, keepdim=True), second - second.mean(1, keepdim=True)
    variances = (first.square().mean(1) + NOISE) * (second.square().mean(1) + NOISE)
    return (first * second).mean(1) / variances.sqrt()


def _warp(pixels: Tensor, normals: Tensor, distances: Tensor, cameras: np.ndarray) -> Tensor:
    """(M, P, 2) pixels of one view, each row on its own plane, in the other; far outside where the plane is
    behind.
    """
    (fx, fy, cx, cy), (other_fx, other_fy, other_cx, other_cy) = cameras[:4], cameras[4:8]
    rotation, translation = pixels.new_tensor(cameras[8:17]).reshape(3, 3), pixels.new_tensor(cameras[17:])
    columns, rows = pixels.unbind(2)
    rays = torch.stack([(columns - cx) / fx, (rows - cy) / fy, torch.ones_like(rows)], 2)
    # x' = R x - t (n . x) / d, per pixel up to scale; multiplied by d > 0, which also cancels the scale of N
    # and D.
    along = (rays * normals[:, None]).sum(2, keepdim=True)
    moved = (rays @ rotation.T) * distances[:, None, None] - translation * along
    x, y, depth = moved.unbind(2)
    ahead = depth > 1e-9
    safe = torch.where(ahead, depth, 1)
    warped = torch.stack([x / safe * other_fx + other_cx, y / safe * other_fy + other_cy], 2)
    return torch.where(ahead[..., None], warped, -1e6)
