"""The CPU backend of `rendering.render`: the kernels of this package in order, forward and backward."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from sc3d.geometry.cameras import View
from sc3d.splatting.cpu import (
    median_depth,
    projection,
    projection_backward,
    rasterization,
    rasterization_backward,
    tile_binning,
)
from sc3d.splatting.cpu.projection import RECORD, GaussianArrays, camera_array, gaussian_arrays
from sc3d.splatting.cpu.rasterization_backward import ImageGradients
from sc3d.splatting.cpu.tile_binning import TileLists
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.rendered_view import Rendering


def render_cpu(
    gaussians: Gaussians, view: View, sh_degree: int, background: Tensor | None, geometry: bool, median: bool
) -> Rendering:
    """`rendering.render` with checked arguments. sh_degree: at most the stored one"""
    shade = np.zeros(3, np.float32) if background is None else background.detach().numpy().astype(np.float32)
    frame = _Frame(camera_array(view), sh_degree, geometry, median, shade)
    color, normal, plane_distance, alpha, *depth = _Render.apply(frame, *gaussians.parameters().values())
    color, normal = color.permute(1, 2, 0), normal.permute(1, 2, 0)
    return Rendering(color, alpha, normal, plane_distance, frame.radii, frame.statistics, *depth)


@dataclass(frozen=True)
class KernelStatistics:
    """`ViewStatistics` that the kernels fill."""

    weight: Tensor
    max_transmittance: Tensor
    gradient: Tensor
    absolute_gradient: Tensor


@dataclass
class _Frame:
    """What a view is rendered with; `forward` adds what `backward` and the caller need."""

    camera: np.ndarray
    degree: int
    geometry: bool
    median: bool
    background: np.ndarray
    tiles: TileLists = field(init=False)
    image: np.ndarray = field(init=False)
    radii: Tensor = field(init=False)
    statistics: KernelStatistics = field(init=False)


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx, frame, *parameters):
        gaussians = gaussian_arrays(Gaussians(*parameters))
        width, height = int(frame.camera[16]), int(frame.camera[17])
        records, depths, radii = projection.project_view(gaussians, frame.degree, frame.camera)
        frame.tiles = tiles = tile_binning.sort_into_tiles((width, height), records, depths)
        frame.image = np.empty((rasterization.CHANNELS, height, width), np.float32)
        contributions = np.zeros((len(tiles.ranks), 2), np.float32)
        rasterization.rasterize(tiles, frame.background, frame.geometry, frame.image, contributions)
        statistics = KernelStatistics(*torch.zeros(4, len(radii)))
        rasterization.collect_contributions(
            tiles, contributions, statistics.weight.numpy(), statistics.max_transmittance.numpy()
        )
        frame.radii, frame.statistics = torch.from_numpy(radii), statistics
        outputs = [torch.from_numpy(frame.image[planes]) for planes in (slice(0, 3), slice(3, 6), 6, 7)]
        if frame.median:
            depth = np.zeros((height, width), np.float32)
            median_depth.solve(tiles, frame.camera, frame.image, depth)
            outputs.append(torch.from_numpy(depth))
        ctx.save_for_backward(*parameters, *outputs)  # outputs too: autograd then refuses edits in place
        ctx.frame = frame
        ctx.set_materialize_grads(False)
        return tuple(outputs)

    @staticmethod
    def backward(ctx, color, normal, plane_distance, alpha, depth=None):
        frame, parameters = ctx.frame, ctx.saved_tensors[:6]
        geometry = frame.geometry and not (normal is None and plane_distance is None)
        size = frame.image.shape[1:]
        image_gradients = ImageGradients(
            _plane_array(color, (3, *size)),
            _plane_array(normal, (3, *size) if geometry else (0, 0, 0)),
            _plane_array(plane_distance, size if geometry else (0, 0)),
            _plane_array(alpha, size),
        )
        sums = np.zeros(len(frame.tiles.ranks) * RECORD, np.float32)
        rasterization_backward.rasterize_backward(
            frame.tiles, frame.background, geometry, frame.image, image_gradients, sums
        )
        if depth is not None:
            found = ctx.saved_tensors[-1].numpy()
            median_depth.backward(frame.tiles, frame.camera, found, _plane_array(depth, size), sums)
        outputs = [torch.zeros_like(tensor, memory_format=torch.contiguous_format) for tensor in parameters]
        projection_backward.project_backward(
            frame.tiles,
            sums.reshape(-1, RECORD),
            gaussian_arrays(Gaussians(*parameters)),
            frame.degree,
            frame.camera,
            GaussianArrays(*(output.numpy() for output in outputs)),
            frame.statistics.gradient.numpy(),
            frame.statistics.absolute_gradient.numpy(),
        )
        return None, *outputs


def _plane_array(gradient: Tensor | None, shape: tuple[int, ...]) -> np.ndarray:
    if gradient is None or 0 in shape:
        return np.zeros(shape, np.float32)
    return gradient.detach().contiguous().numpy()
