"""What the Gaussians look like: from any camera, and beside the photos they were trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from sc3d.geometry.cameras import View
from sc3d.settings.train import TrainSettings
from sc3d.splatting import losses
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.evaluation import depth_map, psnr
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.rendering import render

NUM_ROWS = 6
"""Photos of a contact sheet."""
_TRAINED_ROWS = 2  # of them at least, where photos were held out


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
def rendered(gaussians: Gaussians, view: View, background: tuple[int, int, int] = (0, 0, 0)) -> np.ndarray:
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
    exposure: a, b of the photo (`losses.apply_exposure`); None = what fits it best
    """
    image, target = (
        render(gaussians, view, geometry=False).color.cpu(),
        torch.from_numpy(np.ascontiguousarray(photo)).float() / 255,
    )
    used = torch.ones(photo.shape[:2], dtype=torch.bool) if mask is None else torch.from_numpy(mask)
    fitted = (
        losses.fit_exposure(image[used], target[used])
        if exposure is None
        else torch.as_tensor(exposure, dtype=torch.float32)
    )
    image = losses.apply_exposure(image, fitted)
    depth, _, normals_cam = depth_map(gaussians, view)
    normals = normals_cam @ view.cam_from_world[:3, :3].astype(np.float32)
    return Comparison(view.name, photo, _as_uint8(image), depth, normals, psnr(image[used], target[used]))


def training_rows(
    gaussians: Gaussians, data: TrainingData, settings: TrainSettings, exposures: np.ndarray
) -> list[Comparison]:
    """Up to six photos spread over the flight with what training made of them, held-out ones first.

    exposures: (V, 2) a, b per view as found by training; held-out photos get what fits them best
    """
    rows = []
    for index, held_out in chosen_views(len(data.views), settings):
        exposure = (0.0, 0.0) if not settings.exposure else None if held_out else exposures[index]
        found = compare(gaussians, data.views[index], data.image(index), data.mask(index), exposure)
        rows.append(replace(found, held_out=held_out))
    return rows


def chosen_views(num_views: int, settings: TrainSettings) -> list[tuple[int, bool]]:
    """Index and whether it was held out, of the photos of a contact sheet: evenly spread, held-out ones
    first.
    """
    held_out = settings.held_out(num_views)
    trained = [index for index in range(num_views) if index not in held_out]
    first = _spread(held_out, NUM_ROWS - min(_TRAINED_ROWS, len(trained)))
    return [(index, True) for index in first] + [
        (index, False) for index in _spread(trained, NUM_ROWS - len(first))
    ]


def _spread(items: list[int], count: int) -> list[int]:
    """At most `count` items, evenly spread, the first and the last among them."""
    count = min(count, len(items))
    return (
        [items[position] for position in np.linspace(0, len(items) - 1, count).round().astype(int)]
        if count
        else []
    )


def _as_uint8(image: torch.Tensor) -> np.ndarray:
    return np.ascontiguousarray((image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy())
