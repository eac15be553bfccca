"""What trained Gaussians show: pictures, scores against photos, depth maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from sc3d.geometry.cameras import View
from sc3d.geometry.shown import Witnesses
from sc3d.scene.held_out import SAME_DEPTH, SECTOR, HeldOutPhoto
from sc3d.settings.common import DepthMode
from sc3d.settings.train import TrainSettings
from sc3d.splatting import losses
from sc3d.splatting.consistency import pixel_rays
from sc3d.splatting.cpu.steady_sums import steady_mean
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.rendering import render, surface_depth


@dataclass(frozen=True)
class Comparison:
    """A photo, and the Gaussians seen by its camera.

    photo, rendered: (H, W, 3) uint8 RGB; the rendering has the photo's exposure
    depth: (H, W) float32 z, world units; 0 = nothing there
    normals: (H, W, 3) float32 unit, world, towards the camera; 0 = nothing there
    psnr: of the rendering, dB; held_out: the photo was not trained on
    """

    name: str
    photo: np.ndarray
    rendered: np.ndarray
    depth: np.ndarray
    normals: np.ndarray
    psnr: float
    held_out: bool = False


@torch.no_grad()
def picture(gaussians: Gaussians, view: View, background: tuple[int, int, int] = (0, 0, 0)) -> np.ndarray:
    """(H, W, 3) uint8 RGB of a pinhole view in the Gaussians' local frame; background: RGB uint8 where
    nothing is.
    """
    shade = torch.tensor(background, dtype=torch.float32) / 255
    return _as_uint8(render(gaussians, view, background=shade, geometry=False).color)


@torch.no_grad()
def compare(
    gaussians: Gaussians,
    view: View,
    photo: np.ndarray,
    mask: np.ndarray | None = None,
    exposure: Sequence[float] | None = None,
) -> Comparison:
    """Render the view of a photo and put the two side by side.

    view: pinhole, local frame; photo: (H, W, 3) uint8 RGB; mask: (H, W) bool, False does not count for the
        PSNR
    exposure: of the photo (`losses.apply_exposure`); None = the gain and offset that fit it best
    """
    image = render(gaussians, view, geometry=False).color.cpu()
    target = torch.from_numpy(np.ascontiguousarray(photo)).float() / 255
    used = torch.ones(photo.shape[:2], dtype=torch.bool) if mask is None else torch.from_numpy(mask)
    if exposure is None:
        fitted = losses.fit_exposure(image[used], target[used])
    else:
        fitted = torch.as_tensor(exposure, dtype=torch.float32)
    image = losses.apply_exposure(image, fitted)
    depth, _, normals_cam = depth_map(gaussians, view)
    normals = normals_cam @ view.cam_from_world[:3, :3].astype(np.float32)
    return Comparison(view.name, photo, _as_uint8(image), depth, normals, psnr(image[used], target[used]))


def psnr(image: torch.Tensor, target: torch.Tensor) -> float:
    """Peak signal-to-noise ratio of images in [0, 1], dB; at most 100."""
    return -10 * float(np.log10(max(float(steady_mean((image.clamp(0, 1) - target).square())), 1e-10)))


@torch.no_grad()
def held_out_scores(gaussians: Gaussians, data: TrainingData, settings: TrainSettings) -> list[HeldOutPhoto]:
    """What the Gaussians make of every view that was not trained on, those of the sector last."""
    split, tracks = data.held_out(settings), data.sightings
    trained = [data.views[index] for index in split.trained]
    witnesses = Witnesses(trained, [tracks[index] for index in split.trained], data.points)
    rows = []
    for index in [*split.every_nth, *split.sector]:
        view, target, mask = data.photo(index, device=gaussians.means.device)
        used = torch.ones_like(target[..., 0], dtype=torch.bool) if mask is None else mask
        seen, depth = witnesses.pixels(view, tracks[index]), witnesses.depth(view, tracks[index])
        stereo, rendering = data.depth_map(index), render(gaussians, view)
        if stereo is not None:
            seen, depth = seen & ~stereo.sky, stereo.confirmed(1)
        inside = used & torch.from_numpy(seen).to(used.device)
        expected = torch.where(inside, torch.from_numpy(depth).to(used.device), 0)
        agrees = (surface_depth(rendering, view) - expected).abs() < SAME_DEPTH * expected
        rows.append(
            HeldOutPhoto(
                view.name,
                SECTOR if index in split.sector else f"every {settings.test_every}",
                *_likeness(rendering.color, target, used, settings.exposure != "none"),
                _share(inside, used) or 0.0,
                *_likeness(rendering.color, target, inside, settings.exposure != "none"),
                _share(agrees & (rendering.alpha >= 0.5), expected > 0),
            )
        )
    return rows


def _likeness(
    image: torch.Tensor, target: torch.Tensor, used: torch.Tensor, exposure: bool
) -> tuple[float | None, float | None]:
    """PSNR (dB) and SSIM of the used pixels, (H, W) bool, with the gain and offset that fit these; None of none."""
    if not used.any():
        return None, None
    if exposure:
        image = losses.apply_exposure(image, losses.fit_exposure(image[used], target[used]))
    image = torch.where(used[..., None], image.clamp(0, 1), target).contiguous()
    difference = float(losses.image_loss(image, target, 1.0)) / float(used.float().mean())
    return psnr(image[used], target[used]), 1 - difference


def _share(part: torch.Tensor, whole: torch.Tensor) -> float | None:
    return float(part.sum() / whole.sum()) if whole.any() else None


@torch.no_grad()
def depth_map(
    gaussians: Gaussians, view: View, mode: DepthMode = "blended"
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surface a view sees.

    returns: (H, W) float32 depth z, world units, 0 where alpha < 0.5; (H, W) alpha; (H, W, 3) unit normals,
        camera frame, towards the camera, 0 where there is no depth
    """
    rendering = render(gaussians, view, depth_mode=mode)
    depth = surface_depth(rendering, view)
    present = (rendering.alpha >= 0.5) & torch.isfinite(depth) & (depth > 0)
    normals = torch.nn.functional.normalize(rendering.normal, dim=2) * present[..., None]
    return torch.where(present, depth, 0).cpu().numpy(), rendering.alpha.cpu().numpy(), normals.cpu().numpy()


def facing_depth(
    gaussians: Gaussians, view: View, max_angle: float, mode: DepthMode
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) float32 depth of `depth_map`, 0 where ray and normal are more than `max_angle` degrees apart,
    and (H, W, 3) its normals.
    """
    depth, _, normals_cam = depth_map(gaussians, view, mode)
    rays_cam = torch.nn.functional.normalize(pixel_rays(view), dim=2).numpy()
    facing = -(normals_cam * rays_cam).sum(axis=2) > np.cos(np.deg2rad(max_angle))
    return np.where(facing, depth, 0).astype(np.float32), normals_cam


def _as_uint8(image: torch.Tensor) -> np.ndarray:
    return np.ascontiguousarray((image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy())
