"""Differentiable rendering of planar Gaussians: color, alpha, normal and plane distance of a pinhole view in
one pass (eq. 1-3).
"""

from __future__ import annotations

import torch
from torch import Tensor

from sc3d.geometry.cameras import View
from sc3d.settings.common import DepthMode
from sc3d.splatting import device
from sc3d.splatting.consistency import pinhole, ray_slopes
from sc3d.splatting.cpu.backend import render_cpu
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.gpu.gsplat_backend import render_gpu
from sc3d.splatting.rendered_view import Rendering


def render(
    gaussians: Gaussians,
    view: View,
    sh_degree: int | None = None,
    background: Tensor | None = None,
    geometry: bool = True,
    depth_mode: DepthMode = "blended",
) -> Rendering:
    """Render Gaussians, differentiable in all their tensors (eq. 1-3; rules in `cpu.projection` and
    `cpu.rasterization`).

    Gaussians on a GPU are rendered there by gsplat, with the differences that `gpu.gsplat_backend` lists;
    images and statistics stay on it.

    view: pinhole, in the same local world as the Gaussians; its principal point is honored
    sh_degree: highest active degree, None = all that are stored; colors are clamped at 0 from below
    background: (3,) color seen through what is left of the transmittance, None = black; gets no gradient
    geometry: False leaves `normal` and `plane_distance` zero, which saves a few percent of the time
    depth_mode: what `surface_depth` will ask for; median costs time of its own and needs geometry
    raises ValueError for a view with distortion or parameters that are not float32, MissingPackageError on a
    GPU without gsplat
    """
    if not view.camera.is_undistorted():
        raise ValueError(f"{view.name}: only undistorted views can be rendered")
    if any(tensor.dtype != torch.float32 for tensor in gaussians.parameters().values()):
        raise ValueError("Gaussians must be float32 to be rendered")
    degree = gaussians.sh_degree if sh_degree is None else min(sh_degree, gaussians.sh_degree)
    backend, median = (
        render_cpu if device.has_kernels(gaussians.means) else render_gpu,
        depth_mode == "median",
    )
    return backend(gaussians, view, degree, background, geometry, geometry and median)


def surface_depth(rendering: Rendering, view: View) -> Tensor:
    """(H, W) depth z of the mode that the view was rendered with, world units, 0 = none; differentiable."""
    return unbiased_depth(rendering, view) if rendering.median_depth is None else rendering.median_depth


def unbiased_depth(rendering: Rendering, view: View) -> Tensor:
    """Depth of the rendered planes along each pixel's ray: z = D / -(N . r), r = ((u - cx) / fx, (v - cy) /
    fy, 1).

    returns: (H, W) depth z, world units; 0 where nothing was rendered or the plane is seen from behind;
        differentiable
    """
    normal = rendering.normal
    slopes = ray_slopes(view.width, view.height, pinhole(view))
    column, row = (torch.from_numpy(array).to(normal.device) for array in slopes)
    facing = -(normal[..., 0] * column + normal[..., 1] * row[:, None] + normal[..., 2])
    seen = facing > 1e-6
    return torch.where(seen, rendering.plane_distance / torch.where(seen, facing, 1.0), 0.0)
