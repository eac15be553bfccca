"""The terms of the training loss: functions on tensors, each a scalar.

Rendered maps are sums over a pixel's Gaussians: N = sum w n (camera frame, towards the camera), D = sum w d,
A = sum w. The plane of a pixel is N . x + D = 0, whose scale cancels. Where tensors are on the CPU, kernels
compute the expensive terms; elsewhere their twins in `gpu.losses`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from sc3d.geometry.cameras import View
from sc3d.splatting import device
from sc3d.splatting.consistency import pinhole, pixel_rays, relative_pose, reprojection_error
from sc3d.splatting.cpu import normal_loss, patch_ncc, ssim
from sc3d.splatting.cpu.steady_sums import per_row, steady_mean
from sc3d.splatting.gpu import losses as gpu_losses
from sc3d.splatting.rendered_view import Rendering

GRAY = (0.299, 0.587, 0.114)
FAR_OFF = 0.1  # relative depth error that counts no more: one of the two is wrong
EXPOSURE_SIZES = {"none": 2, "gain": 2, "affine": 12}
"""numbers that a photo has, see `apply_exposure`"""
PIXELS_PER_PATCH = 4
"""the geometric term looks at this many times more pixels than the photometric one"""


@dataclass(frozen=True)
class Neighbor:
    """The other view of a pair. gray: (h, w) in [0, 1]; depth: (h, w), 0 = none, not differentiated."""

    view: View
    gray: torch.Tensor
    depth: torch.Tensor


def apply_exposure(image: torch.Tensor, exposure: torch.Tensor) -> torch.Tensor:
    """A photo's brightness or colors against the scene's: exp(a) image + b, or (I + M) color + t of every pixel.

    image: (..., 3); exposure: (2,) a, b, or (12,) the rows of (M | t), on any device; zeros change nothing
    """
    exposure = exposure.to(image.device)
    if len(exposure) == EXPOSURE_SIZES["gain"]:
        return per_row(exposure[0].exp(), image) * image + per_row(exposure[1], image)
    planes, changed = image.unbind(-1), []
    for plane, row in zip(planes, exposure.reshape(3, 4), strict=True):
        parts = [per_row(each, plane) * other for each, other in zip(row, planes, strict=False)]
        changed.append(plane + sum(parts) + per_row(row[3], plane))
    return torch.stack(changed).movedim(0, -1)  # plane by plane


def fit_exposure(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """(2,) the exposure that brings `image` closest to `target` (least squares), for photos that were not
    trained on.
    """
    mean_image, mean_target = steady_mean(image), steady_mean(target)
    covariance = steady_mean((image - mean_image) * (target - mean_target))
    gain = covariance / steady_mean((image - mean_image).square()).clamp_min(1e-12)
    gain = gain.clamp(0.25, 4.0)
    return torch.stack([gain.log(), mean_target - gain * mean_image])


def image_loss(image: torch.Tensor, target: torch.Tensor, ssim_weight: float = 0.2) -> torch.Tensor:
    """(1 - ssim_weight) mean |image - target| + ssim_weight (1 - mean SSIM) of (H, W, 3) images in [0, 1];
    differentiable in `image` only.

    Fastest for float32 images stored plane by plane, as `render` and `TrainingData.photo` return them.
    """
    kernels = ssim if device.has_kernels(image) else gpu_losses
    return kernels.image_loss(image, target, ssim_weight)


def flatten_loss(log_scales: torch.Tensor, visible: torch.Tensor, extent: float) -> torch.Tensor:
    """Mean smallest scale of the visible Gaussians relative to the scene: it presses them into discs.

    log_scales: (N, 3); visible: (N,) bool; extent: E, world units
    """
    chosen = log_scales[visible]
    # min, not amin: of equal scales only one may shrink, or a sphere would stay a sphere
    return steady_mean(chosen.min(1).values.exp()) / extent if len(chosen) else log_scales.sum() * 0


def single_view_normal_loss(
    rendering: Rendering, depth: torch.Tensor, view: View, target: torch.Tensor
) -> torch.Tensor:
    """Rendered normals against those of the rendered depth, (H, W), away from the edges of the photo `target`
    (H, W, 3).
    """
    depth, edges = torch.where(rendering.alpha > 0.5, depth, 0), image_edges(target)
    kernels = normal_loss if device.has_kernels(depth) else gpu_losses
    return kernels.depth_normal_loss(rendering.normal, depth, rendering.alpha, edges, pinhole(view))


def multi_view_losses(
    rendering: Rendering,
    depth: torch.Tensor,
    source: tuple[torch.Tensor, View],
    neighbor: Neighbor,
    draw: tuple[int, torch.Generator],
) -> tuple[torch.Tensor, torch.Tensor]:
    """Geometric and photometric loss of random pixels.

    depth: (H, W) unbiased depth of `rendering`; source: its (H, W) gray photo and view
    draw: number of patches, random generator
    """
    num_patches, generator = draw
    present = torch.nonzero(((rendering.alpha > 0.5) & (depth > 0)).reshape(-1))[:, 0]
    count = min(PIXELS_PER_PATCH * num_patches, len(present))
    chosen = torch.randint(max(len(present), 1), (count,), generator=generator)
    chosen = present[chosen.to(present.device)]
    view = source[1]
    points_cam = pixel_rays(view, depth.device).reshape(-1, 3)[chosen] * depth.reshape(-1)[chosen, None]
    error, valid = reprojection_error(points_cam, view, neighbor.depth, neighbor.view)
    near = torch.nonzero(valid & (error.detach() < 1))[:num_patches, 0]
    if not len(near):
        return depth.sum() * 0, depth.sum() * 0
    picked = chosen[near]
    planes = rendering.normal.reshape(-1, 3)[picked], rendering.plane_distance.reshape(-1)[picked]
    pixels = torch.stack([picked % view.width, picked // view.width], 1)
    weights = torch.exp(-error[near].detach())
    photometric = photometric_loss(planes, pixels, weights, source, (neighbor.gray, neighbor.view))
    return geometric_loss(error, valid), photometric


def geometric_loss(error: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Mean of phi exp(-phi) over the pixels with phi < 1 px; the weight exp(-phi) is not differentiated.

    error, valid: (N,) from `reprojection_error`
    """
    used = valid & (error.detach() < 1)
    if not used.any():
        return error.sum() * 0
    return steady_mean(error[used] * torch.exp(-error[used].detach()))


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
    return steady_mean(weights.detach()[used] * dissimilarity[used])


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
    kernels = patch_ncc if device.has_kernels(planes[0]) else gpu_losses
    pose = [part.numpy().ravel() for part in relative_pose(source[1], other[1])]
    cameras = np.concatenate([pinhole(source[1]), pinhole(other[1]), *pose])
    return kernels.patch_dissimilarity(*planes, pixels, (source[0], other[0]), cameras)


def depth_loss(depth: torch.Tensor, alpha: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """Mean of |log depth - log known|, at most FAR_OFF, over the pixels that show both.

    depth, alpha: (H, W) of a rendering; known: (H, W), 0 = none, not differentiated
    """
    used = (alpha > 0.5) & (depth > 0) & (known > 0)
    if not used.any():
        return depth.sum() * 0
    return steady_mean((depth[used] / known[used]).log().abs().clamp_max(FAR_OFF))


def image_edges(image: torch.Tensor) -> torch.Tensor:
    """(H, W) gradient magnitude of an (H, W, 3) image, divided by its maximum: 1 at the strongest edge."""
    padded = torch.nn.functional.pad(to_gray(image)[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    across, down = padded[1:-1, 2:] - padded[1:-1, :-2], padded[2:, 1:-1] - padded[:-2, 1:-1]
    gradient = (across.square() + down.square()).sqrt()
    return gradient / gradient.max().clamp_min(1e-12)


def to_gray(image: torch.Tensor) -> torch.Tensor:
    """(H, W) luma of an (H, W, 3) image."""
    return image @ image.new_tensor(GRAY)
