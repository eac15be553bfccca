"""What trained Gaussians show: scores against photos, depth maps."""

from __future__ import annotations

import numpy as np
import torch

from sc3d.geometry.cameras import View
from sc3d.settings.train import TrainSettings
from sc3d.splatting import losses
from sc3d.splatting.cpu.ssim import ssim_loss
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.rendering import render, unbiased_depth


def psnr(image: torch.Tensor, target: torch.Tensor) -> float:
    """Peak signal-to-noise ratio of images in [0, 1], dB; at most 100."""
    error = float((image.clamp(0, 1) - target).square().mean())
    return -10 * float(np.log10(max(error, 1e-10)))


@torch.no_grad()
def score_view(
    gaussians: Gaussians,
    view: View,
    target: torch.Tensor,
    mask: torch.Tensor | None = None,
    fit_exposure: bool = False,
) -> tuple[float, float]:
    """PSNR (dB) and SSIM of a rendered view against its (H, W, 3) photo; outside the (H, W) mask nothing
    counts.

    target, mask: on any device
    fit_exposure: allow the photo its own gain and offset, as in training
    """
    image = render(gaussians, view).color
    target = target.to(image.device)
    used = torch.ones(target.shape[:2], dtype=torch.bool) if mask is None else mask
    used = used.to(image.device)
    if fit_exposure:
        image = losses.apply_exposure(image, losses.fit_exposure(image[used], target[used]))
    image = torch.where(used[..., None], image.clamp(0, 1), target)
    return psnr(image[used], target[used]), 1 - float(ssim_loss(image.contiguous(), target))


def held_out_scores(gaussians: Gaussians, data: TrainingData, settings: TrainSettings) -> dict[str, float]:
    """Mean "psnr" (dB) and "ssim" of the held-out views, whose exposure is fitted to the photo if exposures
    are used; empty without any.
    """
    scores = [
        score_view(gaussians, *data.photo(index), settings.exposure)
        for index in settings.held_out(len(data.views))
    ]
    if not scores:
        return {}
    means = np.mean(scores, axis=0)
    return {"psnr": float(means[0]), "ssim": float(means[1])}


@torch.no_grad()
def depth_map(
    gaussians: Gaussians, view: View, min_alpha: float = 0.5
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surface a view sees.

    returns: (H, W) float32 depth z, world units, 0 where alpha < `min_alpha`; (H, W) alpha;
        (H, W, 3) unit normals, camera frame, towards the camera, 0 where there is no depth
    """
    rendering = render(gaussians, view)
    depth = unbiased_depth(rendering, view)
    present = (rendering.alpha >= min_alpha) & torch.isfinite(depth) & (depth > 0)
    normals = torch.nn.functional.normalize(rendering.normal, dim=2) * present[..., None]
    return torch.where(present, depth, 0).cpu().numpy(), rendering.alpha.cpu().numpy(), normals.cpu().numpy()
