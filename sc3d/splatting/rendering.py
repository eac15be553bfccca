"""Differentiable rendering of planar Gaussians: color, alpha, normal and plane distance of a pinhole view in
one pass (eq. 1-3).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from sc3d.geometry.cameras import View
from sc3d.splatting import device
from sc3d.splatting.cpu import projection as kernels_project
from sc3d.splatting.cpu import projection_backward as kernels_backproject
from sc3d.splatting.cpu import rasterization as kernels_raster
from sc3d.splatting.cpu import rasterization_backward as kernels_unraster
from sc3d.splatting.cpu import tile_binning as kernels_bin
from sc3d.splatting.gaussians import Gaussians

# half image sizes that a mean may lie outside the image before its Jacobian is clamped: 1.3 tan(fov / 2)
_JACOBIAN_MARGIN = 0.3
_BLOCKS = 8  # work items of the counting sort
_STREAMS = 16  # interleaving of tiles and chunks, so that threads with contiguous shares get similar work


@dataclass
class ViewStatistics:
    """What one view tells about each Gaussian, for densification and pruning; no gradients.

    weight: (N,) float32 sum over pixels of w_i; after forward
    max_transmittance: (N,) float32 largest transmittance in front of any of its fragments, 0 = never hit;
        after forward
    gradient: (N,) float32 |d loss / d mean2d| in normalized device units: pixel gradient times (W / 2, H /
        2); zero until backward
    absolute_gradient: (N,) float32 the same from sums of absolute per-pixel gradients (AbsGS); zero until
        backward
    """

    weight: Tensor
    max_transmittance: Tensor
    gradient: Tensor
    absolute_gradient: Tensor


@dataclass
class Rendering:
    """One rendered view; w_i = alpha_i T_i is the weight of a fragment. Images may be non-contiguous (stored
    plane by plane).

    color: (H, W, 3) sum w c (+ (1 - A) background)
    alpha: (H, W) A = sum w
    normal: (H, W, 3) sum w n, camera frame, n towards the camera
    plane_distance: (H, W) sum w d, d = |n . mean_cam|, world units
    radii: (N,) float32 three-sigma radius, px; 0 = cannot touch the image; no gradient
    statistics: per-Gaussian sums; the gradients in it are filled by backward()
    """

    color: Tensor
    alpha: Tensor
    normal: Tensor
    plane_distance: Tensor
    radii: Tensor
    statistics: ViewStatistics


@dataclass
class _Frame:
    """What forward leaves for backward, all numpy."""

    camera: np.ndarray
    degree: int
    geometry: bool
    background: np.ndarray
    records: np.ndarray
    visible: np.ndarray
    offsets: np.ndarray
    ranks: np.ndarray
    instances: np.ndarray
    starts: np.ndarray
    order: np.ndarray
    image: np.ndarray


def render(
    gaussians: Gaussians,
    view: View,
    sh_degree: int | None = None,
    background: Tensor | None = None,
    geometry: bool = True,
) -> Rendering:
    """Render Gaussians, differentiable in all five parameter tensors (eq. 1-3; rules in `kernels_project` and
    `kernels_raster`).

    Gaussians on a GPU are rendered there by gsplat, with the differences that `gsplat_backend` lists; images
    and statistics stay on it.

    view: pinhole, in the same local world as the Gaussians; its principal point is honored
    sh_degree: highest active degree, None = all that are stored; colors are clamped at 0 from below
    background: (3,) color seen through what is left of the transmittance, None = black; gets no gradient
    geometry: False leaves `normal` and `plane_distance` zero, which saves a few percent of the time
    raises ValueError for a view with distortion or parameters that are not float32, MissingPackageError on a
    GPU without gsplat
    """
    if not view.camera.is_undistorted():
        raise ValueError(f"{view.name}: only undistorted views can be rendered")
    parameters = (
        gaussians.means,
        gaussians.log_scales,
        gaussians.quats,
        gaussians.opacity_logits,
        gaussians.sh,
    )
    if any(parameter.dtype != torch.float32 for parameter in parameters):
        raise ValueError("Gaussians must be float32 to be rendered")
    stored = int(np.sqrt(gaussians.sh.shape[1])) - 1
    degree = stored if sh_degree is None else min(sh_degree, stored)
    if not device.has_kernels(gaussians.means):
        from sc3d.splatting import gsplat_backend  # it imports this module, and gsplat is optional

        return gsplat_backend.render_gsplat(
            gaussians, view, degree, background, geometry, gsplat_backend.cuda_functions()
        )
    count = len(gaussians)
    statistics = ViewStatistics(*(torch.zeros(count) for _ in range(4)))
    radii = torch.zeros(count)
    shade = np.zeros(3, np.float32) if background is None else background.detach().numpy().astype(np.float32)
    settings = (camera_array(view), degree, geometry, shade, radii, statistics)
    color, normal, plane_distance, alpha = _Render.apply(*parameters, settings)
    return Rendering(
        color.permute(1, 2, 0), alpha, normal.permute(1, 2, 0), plane_distance, radii, statistics
    )


def unbiased_depth(rendering: Rendering, view: View) -> Tensor:
    """Depth of the rendered planes along each pixel's ray: z = D / -(N . r), r = ((u - cx) / fx, (v - cy) /
    fy, 1).

    returns: (H, W) depth z, world units; 0 where nothing was rendered or the plane is seen from behind;
        differentiable
    """
    normal = rendering.normal
    column, row = (slopes.to(normal.device) for slopes in _ray_slopes(view))
    facing = -(normal[..., 0] * column + normal[..., 1] * row[:, None] + normal[..., 2])
    seen = facing > 1e-6
    return torch.where(seen, rendering.plane_distance / torch.where(seen, facing, 1.0), 0.0)


def _ray_slopes(view: View) -> tuple[Tensor, Tensor]:
    """(W,) and (H,) float32 x and y of the rays with z = 1 through the pixel centers."""
    matrix = view.matrix
    column = (np.arange(view.width) + 0.5 - matrix[0, 2]) / matrix[0, 0]
    row = (np.arange(view.height) + 0.5 - matrix[1, 2]) / matrix[1, 1]
    return torch.from_numpy(column.astype(np.float32)), torch.from_numpy(row.astype(np.float32))


def camera_array(view: View) -> np.ndarray:
    """(25,) float64 as `kernels_project.project` wants it."""
    pose, focal, principal = view.cam_from_world, view.matrix[[0, 1], [0, 1]], view.matrix[:2, 2]
    size = np.array([view.width, view.height], np.float64)
    margin = _JACOBIAN_MARGIN * size / (2 * focal)
    limits = np.stack([-principal / focal - margin, (size - principal) / focal + margin], axis=1)
    return np.concatenate(
        [pose[:3, :3].ravel(), pose[:3, 3], focal, principal, size, view.center, limits.ravel()]
    )


@lru_cache(maxsize=64)
def interleaved(count: int) -> np.ndarray:
    """(count,) int64 permutation: 0, 16, 32, ..., 1, 17, ..."""
    return np.concatenate([np.arange(first, count, _STREAMS) for first in range(_STREAMS)])


def _near_to_far(depths: np.ndarray) -> np.ndarray:
    """(M,) indices that sort positive float32 depths; ties by index."""
    keys = depths.view(np.uint32).astype(np.uint64) << np.uint64(32) | np.arange(len(depths), dtype=np.uint64)
    keys.sort()
    return (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)


def sort_into_tiles(camera: np.ndarray, all_records: np.ndarray, depths: np.ndarray) -> tuple:
    """Tile lists: visible (M,) ids, records (M, 16) in depth order, offsets (M + 1,), ranks (P,), instances
    (P,), starts (tiles + 1,).
    """
    width, height = int(camera[16]), int(camera[17])
    visible = np.flatnonzero(depths)
    order, records = (
        _near_to_far(depths[visible]),
        np.empty((len(visible), kernels_project.RECORD), np.float32),
    )
    tiles = -(-width // kernels_bin.TILE) * -(-height // kernels_bin.TILE)
    histograms, starts = np.zeros((_BLOCKS, tiles), np.int32), np.empty(tiles + 1, np.int64)
    offsets = np.zeros(len(visible) + 1, np.int64)
    kernels_bin.count_instances(order, visible, all_records, records, width, height, histograms, offsets[1:])
    np.cumsum(offsets, out=offsets)
    kernels_bin.place_blocks(histograms, starts)
    ranks, instances = np.empty(offsets[-1], np.int32), np.empty(offsets[-1], np.int32)
    kernels_bin.place_instances(order, records, width, height, histograms, offsets, ranks, instances)
    return visible, records, offsets, ranks, instances, starts


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, log_scales, quats, opacity_logits, sh, settings):
        camera, degree, geometry, background, radii, statistics = settings
        arrays = [
            tensor.detach().contiguous().numpy() for tensor in (means, log_scales, quats, opacity_logits, sh)
        ]
        count, width, height = len(means), int(camera[16]), int(camera[17])
        all_records, depths = (
            np.empty((count, kernels_project.RECORD), np.float32),
            np.zeros(count, np.float32),
        )
        chunks = interleaved(-(-count // kernels_project.CHUNK)) if count else np.empty(0, np.int64)
        kernels_project.project(*arrays, degree, camera, chunks, all_records, depths, radii.numpy())
        visible, records, offsets, ranks, instances, starts = sort_into_tiles(camera, all_records, depths)
        image = np.empty((kernels_raster.CHANNELS, height, width), np.float32)
        contributions, order = np.zeros((len(ranks), 2), np.float32), interleaved(len(starts) - 1)
        kernels_raster.rasterize(
            records.reshape(-1), ranks, instances, starts, order, background, geometry, image, contributions
        )
        kernels_raster.collect_contributions(
            visible, offsets, contributions, statistics.weight.numpy(), statistics.max_transmittance.numpy()
        )
        outputs = [torch.from_numpy(image[planes]) for planes in (slice(0, 3), slice(3, 6), 6, 7)]
        # outputs too: autograd then refuses edits in place
        ctx.save_for_backward(means, log_scales, quats, opacity_logits, sh, *outputs)
        ctx.frame = _Frame(
            camera,
            degree,
            geometry,
            background,
            records.reshape(-1),
            visible,
            offsets,
            ranks,
            instances,
            starts,
            order,
            image,
        )
        ctx.statistics = statistics
        ctx.set_materialize_grads(False)
        return tuple(outputs)

    @staticmethod
    def backward(ctx, grad_color, grad_normal, grad_distance, grad_alpha):
        parameters = ctx.saved_tensors[:5]
        frame, statistics = ctx.frame, ctx.statistics
        arrays = [tensor.detach().contiguous().numpy() for tensor in parameters]
        geometry = frame.geometry and not (grad_normal is None and grad_distance is None)
        size = frame.image.shape[1:]
        image_gradients = [
            _plane_array(grad_color, (3, *size)),
            _plane_array(grad_normal, (3, *size) if geometry else (0, 0, 0)),
            _plane_array(grad_distance, size if geometry else (0, 0)),
            _plane_array(grad_alpha, size),
        ]
        gradients = np.zeros(len(frame.ranks) * kernels_project.RECORD, np.float32)
        kernels_unraster.rasterize_backward(
            frame.records,
            frame.ranks,
            frame.instances,
            frame.starts,
            frame.order,
            frame.background,
            geometry,
            frame.image,
            *image_gradients,
            gradients,
        )
        outputs = [torch.zeros_like(tensor, memory_format=torch.contiguous_format) for tensor in parameters]
        kernels_backproject.project_backward(
            frame.visible,
            frame.offsets,
            gradients.reshape(-1, kernels_project.RECORD),
            *arrays,
            frame.degree,
            frame.camera,
            *(output.numpy() for output in outputs),
            statistics.gradient.numpy(),
            statistics.absolute_gradient.numpy(),
        )
        return *outputs, None


def _plane_array(gradient: Tensor | None, shape: tuple[int, ...]) -> np.ndarray:
    return (
        np.zeros(shape, np.float32)
        if gradient is None or 0 in shape
        else gradient.detach().contiguous().numpy()
    )
