"""The terms of the training loss (METHOD section 1): pure functions on tensors, each a scalar.

Rendered maps are sums over a pixel's Gaussians: N = sum w n (camera frame, towards the camera), D = sum w d,
A = sum w.
The plane of a pixel is N . x + D = 0, whose scale cancels.
"""

from __future__ import annotations

import numpy as np
import torch

from sc3d.geometry.cameras import View
from sc3d.splatting import device
from sc3d.splatting.consistency import pinhole, pixel_rays, relative_pose, sample
from sc3d.splatting.cpu import normal_loss as kernels_normals
from sc3d.splatting.cpu import patch_ncc as kernels_patches

PATCH_RADIUS = 3
GRAY = (0.299, 0.587, 0.114)


def apply_exposure(image: torch.Tensor, exposure: torch.Tensor) -> torch.Tensor:
    """exp(a) image + b: a photo's brightness against the scene's. exposure: (2,) a, b, on any device; zeros
    change nothing.
    """
    exposure = exposure.to(image.device)
    return exposure[0].exp() * image + exposure[1]


def fit_exposure(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """(2,) the exposure that brings `image` closest to `target` (least squares), for photos that were not
    trained on.
    """
    mean_image, mean_target = image.mean(), target.mean()
    gain = ((image - mean_image) * (target - mean_target)).mean() / (
        image - mean_image
    ).square().mean().clamp_min(1e-12)
    gain = gain.clamp(0.25, 4.0)
    return torch.stack([gain.log(), mean_target - gain * mean_image])


def flatten_loss(log_scales: torch.Tensor, visible: torch.Tensor, extent: float) -> torch.Tensor:
    """Mean smallest scale of the visible Gaussians relative to the scene: it presses them into discs.

    log_scales: (N, 3); visible: (N,) bool; extent: E, world units
    """
    chosen = log_scales[visible]
    # min, not amin: of equal scales only one may shrink, or a sphere would stay a sphere
    return chosen.min(1).values.exp().mean() / extent if len(chosen) else log_scales.sum() * 0


def image_edges(image: torch.Tensor) -> torch.Tensor:
    """(H, W) gradient magnitude of an (H, W, 3) image, divided by its maximum: 1 at the strongest edge."""
    gray = to_gray(image)
    padded = torch.nn.functional.pad(gray[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    gradient = (
        (padded[1:-1, 2:] - padded[1:-1, :-2]).square() + (padded[2:, 1:-1] - padded[:-2, 1:-1]).square()
    ).sqrt()
    return gradient / gradient.max().clamp_min(1e-12)


def normals_from_depth(depth: torch.Tensor, view: View) -> torch.Tensor:
    """(H, W, 3) unit normals, camera frame, towards the camera: cross product of the differences between the
    4 neighbors' points.

    depth: (H, W), 0 = none. Zero at the image border and where one of the four has no depth.
    """
    points = pixel_rays(view, depth.device) * depth[..., None]
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    known = (depth[1:-1, 2:] > 0) & (depth[1:-1, :-2] > 0) & (depth[2:, 1:-1] > 0) & (depth[:-2, 1:-1] > 0)
    normals = torch.linalg.cross(down, across)
    length = normals.norm(dim=2, keepdim=True)
    known = known[..., None] & (length > 0)
    normals = torch.where(
        known, normals / torch.where(known, length, torch.ones_like(length)), torch.zeros_like(normals)
    )
    return torch.nn.functional.pad(normals, (0, 0, 1, 1, 1, 1))


def depth_normal_loss(
    normal: torch.Tensor, depth: torch.Tensor, alpha: torch.Tensor, edges: torch.Tensor, view: View
) -> torch.Tensor:
    """`normal_loss` against `normals_from_depth` of a depth map, (H, W), 0 = none; differentiable in `normal`
    and `depth`.
    """
    if device.has_kernels(normal):
        return kernels_normals.depth_normal_loss(normal, depth, alpha, edges, pinhole(view))
    return normal_loss(normal, normals_from_depth(depth, view), alpha, edges)


def normal_loss(
    normal: torch.Tensor, depth_normals: torch.Tensor, alpha: torch.Tensor, edges: torch.Tensor
) -> torch.Tensor:
    """(1 - g)^2 |A N_depth - N|_1, mean over the pixels where N_depth is known.

    normal: (H, W, 3) N; depth_normals: (H, W, 3) `normals_from_depth`; alpha: (H, W) A; edges: (H, W) g,
        `image_edges`
    """
    known = depth_normals.detach().abs().sum(2) > 0
    gap = (alpha.detach()[..., None] * depth_normals - normal).abs().sum(2)
    return ((1 - edges).square() * gap * known).sum() / known.sum().clamp_min(1)


def geometric_loss(error: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Mean of phi exp(-phi) over the pixels with phi < 1 px; the weight exp(-phi) is not differentiated.

    error, valid: (N,) from `reprojection_error`
    """
    used = valid & (error.detach() < 1)
    if not used.any():
        return error.sum() * 0
    return (error[used] * torch.exp(-error[used].detach())).mean()


def photometric_loss(
    planes: tuple[torch.Tensor, torch.Tensor],
    pixels: torch.Tensor,
    weights: torch.Tensor,
    source: tuple[torch.Tensor, View],
    other: tuple[torch.Tensor, View],
) -> torch.Tensor:
    """Patches around pixels must look the same after their plane's homography carried them into another view.

    planes: (M, 3) N and (M,) D of the pixels; pixels: (M, 2) int64 column, row; weights: (M,) exp(-phi), not
        differentiated
    source, other: gray (H, W) images in [0, 1] with their views
    returns: weighted mean of 1 - NCC over the patches with 1 - NCC < 0.9
    """
    dissimilarity, inside = patch_dissimilarity(planes, pixels, source, other)
    used = inside & (dissimilarity.detach() < 0.9)
    if not used.any():
        return dissimilarity.sum() * 0
    return (weights.detach()[used] * dissimilarity[used]).mean()


def patch_dissimilarity(
    planes: tuple[torch.Tensor, torch.Tensor],
    pixels: torch.Tensor,
    source: tuple[torch.Tensor, View],
    other: tuple[torch.Tensor, View],
) -> tuple[torch.Tensor, torch.Tensor]:
    """1 - NCC of 7x7 patches warped by H = K_n (R - t n^T / d) K_r^-1; arguments as in `photometric_loss`.

    returns: (M,) in [0, 2], about 1 where there is no texture; (M,) bool: both patches lie inside their
        images
    """
    if not device.has_kernels(planes[0]):
        return patch_dissimilarity_reference(planes, pixels, source, other)
    rotation, translation = relative_pose(source[1], other[1])
    cameras = np.concatenate(
        [pinhole(source[1]), pinhole(other[1]), rotation.numpy().ravel(), translation.numpy()]
    )
    return kernels_patches.patch_dissimilarity(*planes, pixels, (source[0], other[0]), cameras)


def patch_dissimilarity_reference(
    planes: tuple[torch.Tensor, torch.Tensor],
    pixels: torch.Tensor,
    source: tuple[torch.Tensor, View],
    other: tuple[torch.Tensor, View],
) -> tuple[torch.Tensor, torch.Tensor]:
    """`patch_dissimilarity` in plain torch: for GPUs, and for tests of the kernel."""
    (gray, view), (other_gray, other_view) = source, other
    steps = torch.arange(-PATCH_RADIUS, PATCH_RADIUS + 1, device=pixels.device)
    offsets = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), 2).reshape(-1, 2)
    patch = pixels[:, None] + offsets
    limits = pixels.new_tensor([view.width - 1, view.height - 1])
    inside = ((patch >= 0) & (patch <= limits)).all(2).all(1)
    patch = patch.clamp_min(0).minimum(limits)
    values = gray[patch[..., 1], patch[..., 0]]
    warped = _warp(patch.float() + 0.5, planes, view, other_view)
    border = warped.new_tensor([other_view.width, other_view.height]) - 0.5
    inside = inside & ((warped >= 0.5) & (warped <= border)).all(2).all(1)
    other_values = sample(other_gray, warped.reshape(-1, 2)).reshape(values.shape)
    return 1 - normalized_correlation(values, other_values), inside


def normalized_correlation(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """(M,) NCC of rows of two (M, P) arrays in [0, 1]. Variances below (1/255)^2 count as noise: they pull it
    to 0.
    """
    first, second = first - first.mean(1, keepdim=True), second - second.mean(1, keepdim=True)
    noise = 1 / 255**2
    return (first * second).mean(1) / (
        (first.square().mean(1) + noise) * (second.square().mean(1) + noise)
    ).sqrt()


def to_gray(image: torch.Tensor) -> torch.Tensor:
    """(H, W) luma of an (H, W, 3) image."""
    return image @ image.new_tensor(GRAY)


def _warp(
    pixels: torch.Tensor, planes: tuple[torch.Tensor, torch.Tensor], view: View, other: View
) -> torch.Tensor:
    """(M, P, 2) pixels of `view`, each row on its own plane, in `other`; far outside where the plane is
    behind.
    """
    normal, distance = planes
    rotation, translation = relative_pose(view, other, pixels.device)
    fx, fy, cx, cy = pinhole(view)
    rays = torch.stack(
        [(pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy, torch.ones_like(pixels[..., 0])], 2
    )
    # x' = R x - t (n . x) / d, per pixel up to scale; multiplied by d > 0, which also cancels the scale of N
    # and D.
    along = (rays * normal[:, None]).sum(2, keepdim=True)
    moved = (rays @ rotation.T) * distance[:, None, None] - translation * along
    depth = moved[..., 2]
    ahead = depth > 1e-9
    safe = torch.where(ahead, depth, torch.ones_like(depth))
    fx, fy, cx, cy = pinhole(other)
    warped = torch.stack([moved[..., 0] / safe * fx + cx, moved[..., 1] / safe * fy + cy], 2)
    return torch.where(ahead[..., None], warped, torch.full_like(warped, -1e6))
