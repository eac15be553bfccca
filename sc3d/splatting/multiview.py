"""The surface terms of one training step, put together from `losses` and `consistency`."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from sc3d.geometry.cameras import View
from sc3d.splatting import losses
from sc3d.splatting.consistency import pixel_rays, reprojection_error
from sc3d.splatting.rendering import Rendering

PIXELS_PER_PATCH = 4
"""the geometric term looks at this many times more pixels than the photometric one"""


@dataclass(frozen=True)
class Neighbor:
    """The other view of a pair. gray: (h, w) in [0, 1]; depth: (h, w), 0 = none, not differentiated."""

    view: View
    gray: torch.Tensor
    depth: torch.Tensor


def single_view_normal_loss(
    rendering: Rendering, depth: torch.Tensor, view: View, target: torch.Tensor
) -> torch.Tensor:
    """Rendered normals against those of the rendered depth, (H, W), away from the edges of the photo `target`
    (H, W, 3).
    """
    depth = torch.where(rendering.alpha > 0.5, depth, 0)
    return losses.depth_normal_loss(
        rendering.normal, depth, rendering.alpha, losses.image_edges(target), view
    )


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
    chosen = torch.randint(
        max(len(present), 1), (min(PIXELS_PER_PATCH * num_patches, len(present)),), generator=generator
    )
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
    photometric = losses.photometric_loss(
        planes, pixels, torch.exp(-error[near].detach()), source, (neighbor.gray, neighbor.view)
    )
    return losses.geometric_loss(error, valid), photometric
