"""Does the depth of one view agree with another's? Round trip of pixels through both depth maps."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sc3d.geometry.cameras import View

OtherDepths = list[tuple[np.ndarray, View]]
"""(h, w) float32 depth maps, 0 = none, of any sizes, with their views."""


def pinhole(view: View) -> tuple[float, float, float, float]:
    """(fx, fy, cx, cy) of an undistorted view, px."""
    return view.matrix[0, 0], view.matrix[1, 1], view.matrix[0, 2], view.matrix[1, 2]


def ray_slopes(
    width: int, height: int, calibration: tuple[float, float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """(W,) and (H,) float32 x and y of the rays with z = 1 through the pixel centers, computed in float64."""
    fx, fy, cx, cy = calibration
    columns, rows = (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy
    return columns.astype(np.float32), rows.astype(np.float32)


def pixel_rays(view: View, device: torch.device | str = "cpu") -> Tensor:
    """(H, W, 3) rays ((u - cx) / fx, (v - cy) / fy, 1) of the pixel centers, camera frame: a pixel's point is
    depth * ray.
    """
    fx, fy, cx, cy = pinhole(view)
    columns = (torch.arange(view.width, dtype=torch.float32, device=device) + 0.5 - cx) / fx
    rows = (torch.arange(view.height, dtype=torch.float32, device=device) + 0.5 - cy) / fy
    columns, rows = columns.expand(view.height, -1), rows[:, None].expand(-1, view.width)
    return torch.stack([columns, rows, torch.ones_like(columns)], 2)


def relative_pose(view: View, other: View, device: torch.device | str = "cpu") -> tuple[Tensor, Tensor]:
    """(3, 3) and (3,) float32 of other_from_view between the camera frames; composed in float64."""
    rotation = other.cam_from_world[:3, :3] @ view.cam_from_world[:3, :3].T
    translation = other.cam_from_world[:3, 3] - rotation @ view.cam_from_world[:3, 3]
    parts = [torch.from_numpy(part.astype(np.float32)).to(device) for part in (rotation, translation)]
    return parts[0], parts[1]


def sample(image: Tensor, pixels: Tensor) -> Tensor:
    """(N,) bilinear values of an (H, W) image at (N, 2) pixel coordinates; differentiable in both; clamped to
    the border.
    """
    size = pixels.new_tensor([image.shape[1], image.shape[0]])
    grid = (2 * pixels / size - 1)[None, None]
    return torch.nn.functional.grid_sample(
        image[None, None], grid, padding_mode="border", align_corners=False
    )[0, 0, 0]


def reprojection_error(
    points_cam: Tensor, view: View, other_depth: Tensor, other: View
) -> tuple[Tensor, Tensor]:
    """phi: how far a pixel lands from itself after going to the other view's surface and back.

    points_cam: (N, 3) surface points of pixels of `view`, in its camera frame, depth > 0
    other_depth: (h, w) depth of `other`; 0 = none
    returns: (N,) phi, px of `view`, differentiable in both depths; (N,) bool: the pixel is seen by `other`
        and has a depth there
    """
    rotation, translation = relative_pose(view, other, points_cam.device)
    points_other = points_cam @ rotation.T + translation
    in_front = points_other[:, 2] > 1e-6
    pixels = _project(points_other, other)
    column, row = pixels.unbind(1)
    inside = (pixels >= 0.5).all(1) & (column <= other.width - 0.5) & (row <= other.height - 0.5)
    pixels = torch.where((in_front & inside)[:, None], pixels, 0.5)
    has_depth = other_depth > 0
    # 1 / depth is linear in the pixel on a plane, depth is not: so a plane is interpolated exactly.
    inverse = sample(torch.where(has_depth, 1 / torch.where(has_depth, other_depth, 1), 0), pixels)
    valid = in_front & inside & (sample(has_depth.float(), pixels.detach()) > 0.999)
    fx, fy, cx, cy = pinhole(other)
    ray = torch.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, torch.ones_like(inverse)], 1)
    back = (ray / torch.where(valid, inverse, 1)[:, None] - translation) @ rotation
    valid = valid & (back[:, 2] > 1e-6)
    gap = torch.where(valid[:, None], _project(back, view) - _project(points_cam, view), 0)
    return (gap.square().sum(1) + 1e-12).sqrt(), valid


def consistent(depth: np.ndarray, view: View, others: OtherDepths, *limits: float) -> list[np.ndarray]:
    """(H, W) uint8 per limit, px: in how many views a pixel's depth (H, W), 0 = none, has phi below it."""
    counts = [np.zeros(depth.shape, np.uint8) for _ in limits]
    points_cam = _surface_points(depth, view)
    for other_depth, other in others:
        error, valid = reprojection_error(points_cam, view, torch.from_numpy(other_depth), other)
        for count, limit in zip(counts, limits, strict=True):
            count[depth > 0] += (valid & (error < limit)).numpy()
    return counts


def _surface_points(depth: np.ndarray, view: View) -> Tensor:
    """(N, 3) points of the pixels that have a depth, camera frame."""
    known = torch.from_numpy(depth)
    return (pixel_rays(view) * known[..., None])[known > 0]


def _project(points_cam: Tensor, view: View) -> Tensor:
    fx, fy, cx, cy = pinhole(view)
    depth = points_cam[:, 2].clamp_min(1e-6)
    return torch.stack([points_cam[:, 0] / depth * fx + cx, points_cam[:, 1] / depth * fy + cy], 1)
