"""The GPU backend of `rendering.render`: gsplat's low-level functions (written against gsplat 1.5.3).

The rules are those of the CPU kernels: near plane 0.01, +0.3 px^2, Jacobian clamp at 1.3 tan(fov / 2) around
the real principal point, pixel centers at +0.5, fragments from alpha 1/255 on. gsplat bins boxes of
min(3.33, sqrt(2 ln(255 opacity))) standard deviations, rounded up to whole pixels; alpha is below 1/255
outside of them, so no fragment is lost. It differs in five ways:
- alpha is limited to 0.999 instead of 0.99;
- a pixel ends before the fragment that would bring its transmittance to 1e-4 instead of after it;
- a Gaussian is visible (radius > 0) if that box touches the image, the CPU's if the box without rounding
  holds a pixel center;
- absolute gradients leave out what comes through the median depth;
- sums are float32 in the order of the GPU's atomic additions: gradients vary in their last digits from run to
  run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from sc3d.errors import MissingPackageError
from sc3d.geometry.cameras import View
from sc3d.splatting.consistency import pixel_rays
from sc3d.splatting.cpu.median_depth import MIN_SLOPE
from sc3d.splatting.device import INSTALL
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.rendered_view import Rendering

TILE = 16
NEAR = 0.01
DILATION = 0.3
MAX_ALPHA = 0.999  # of gsplat
BAND_PIXELS = 65_536  # fragments are listed for so many pixels at once: about 100 MB
HALVINGS = 40  # of the interval that holds a pixel's median depth
_ALL = 1 << 30  # more batches of Gaussians than a tile has


@dataclass(frozen=True)
class Functions:
    """The functions of gsplat that run CUDA kernels, by their names there. Tests put gsplat's pure-torch
    twins in their place.
    """

    fully_fused_projection: Callable
    spherical_harmonics: Callable
    isect_tiles: Callable
    isect_offset_encode: Callable
    rasterize_to_pixels: Callable
    rasterize_to_indices_in_range: Callable


@lru_cache(maxsize=1)
def cuda_functions() -> Functions:
    """gsplat's own functions; the first call may compile its kernels, which takes minutes.

    Raises MissingPackageError if gsplat is not installed or has no kernels and cannot compile them.
    """
    try:
        import gsplat
    except ModuleNotFoundError:
        raise MissingPackageError(INSTALL) from None
    try:
        from gsplat.cuda._backend import _C as kernels
    except Exception as error:  # whatever its build raises
        raise MissingPackageError(
            f"gsplat has no CUDA kernels and cannot compile them ({type(error).__name__}): install a gsplat wheel built for this torch, or the CUDA toolkit (or use --device cpu)"
        ) from None
    if kernels is None:
        raise MissingPackageError(
            "gsplat finds no CUDA toolkit to compile its kernels with: install one (or use --device cpu)"
        )
    return Functions(**{field.name: getattr(gsplat, field.name) for field in fields(Functions)})


@dataclass(frozen=True)
class _Screen:
    """N Gaussians projected into one view, in gsplat's form: a leading dimension of 1 for the view.

    means2d: (1, N, 2) px; conics: (1, N, 3) xx, xy, yy of the inverse covariance, 1 / px^2; opacities: (1, N)
    radii: (1, N, 2) int32 half extents, px; 0 = cannot touch the image, the rest of that row is undefined
    offsets: (1, rows, columns) int32 first entry of each tile in ids
    ids: (P,) int32 Gaussians tile by tile, near to far; size: width, height, px
    """

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    radii: Tensor
    offsets: Tensor
    ids: Tensor
    size: tuple[int, int]

    @property
    def visible(self) -> Tensor:
        """(N,) bool."""
        return (self.radii[0] > 0).all(1)

    @property
    def rasterization(self) -> tuple:
        """The arguments that gsplat's rasterizing functions end with."""
        return *self.size, TILE, self.offsets, self.ids


class GsplatStatistics:
    """`ViewStatistics` computed when asked for: listing all fragments costs about as much as the rendering
    itself, and only training needs it.

    The gradients need `means2d.retain_grad()` before, and read zero until, backward().
    """

    def __init__(self, screen: _Screen, functions: Functions) -> None:
        self._screen, self._functions = screen, functions

    @cached_property
    def _contributions(self) -> tuple[Tensor, Tensor]:
        return contributions(self._screen, self._functions)

    @property
    def weight(self) -> Tensor:
        return self._contributions[0]

    @property
    def max_transmittance(self) -> Tensor:
        return self._contributions[1]

    @property
    def gradient(self) -> Tensor:
        return self._in_ndc(self._screen.means2d.grad if self._screen.means2d.requires_grad else None)

    @property
    def absolute_gradient(self) -> Tensor:
        return self._in_ndc(getattr(self._screen.means2d, "absgrad", None))

    def _in_ndc(self, gradient: Tensor | None) -> Tensor:
        """(N,) length of (1, N, 2) gradients by pixels, in normalized device units."""
        screen = self._screen
        if gradient is None:
            return torch.zeros_like(screen.opacities[0])
        lengths = (gradient[0] * gradient.new_tensor(screen.size) / 2).norm(dim=1)
        return torch.where(screen.visible, lengths, 0)


def render_gpu(
    gaussians: Gaussians, view: View, sh_degree: int, background: Tensor | None, geometry: bool, median: bool
) -> Rendering:
    """`rendering.render` with checked arguments. sh_degree: at most the stored one"""
    functions = cuda_functions()
    screen = project(gaussians, view, functions)
    differentiable = screen.means2d.requires_grad
    if differentiable:
        screen.means2d.retain_grad()
    features = _features(gaussians, view, sh_degree, geometry, functions)
    splats = screen.means2d, screen.conics, features[None], screen.opacities
    image, alpha = functions.rasterize_to_pixels(*splats, *screen.rasterization, absgrad=differentiable)
    image, alpha = image[0], alpha[0, ..., 0]
    color = image[..., :3]
    if background is not None:
        color = color + (1 - alpha)[..., None] * background.detach().to(color)
    if geometry:
        normal, plane_distance = image[..., 3:6], image[..., 6]
    else:
        normal, plane_distance = torch.zeros_like(color), torch.zeros_like(alpha)
    depth = median_depth(screen, (features[:, 3:6], features[:, 6]), view, functions) if median else None
    statistics = GsplatStatistics(screen, functions)
    return Rendering(color, alpha, normal, plane_distance, _three_sigma(screen), statistics, depth)


def project(gaussians: Gaussians, view: View, functions: Functions) -> _Screen:
    """The Gaussians on the screen, differentiable, and the tile lists."""
    means, opacities, size = gaussians.means, gaussians.opacities, (view.width, view.height)
    pose, matrix = (means.new_tensor(array)[None] for array in (view.cam_from_world, view.matrix))
    splats, rules = (means, None, gaussians.quats, gaussians.scales), {"eps2d": DILATION, "near_plane": NEAR}
    radii, means2d, depths, conics, _ = functions.fully_fused_projection(
        *splats, pose, matrix, *size, **rules, opacities=opacities.detach()
    )
    columns, rows = (-(-length // TILE) for length in size)
    _, keys, ids = functions.isect_tiles(means2d.detach(), radii, depths.detach(), TILE, columns, rows)
    offsets = functions.isect_offset_encode(keys, 1, columns, rows)
    return _Screen(means2d, conics, opacities[None], radii, offsets, ids, size)


def contributions(screen: _Screen, functions: Functions) -> tuple[Tensor, Tensor]:
    """(N,) sum of each Gaussian's weights, and (N,) largest transmittance in front of its fragments, 0 =
    none; no gradients.
    """
    weight, largest = torch.zeros_like(screen.opacities[0]), torch.zeros_like(screen.opacities[0])
    with torch.no_grad():
        for ids, pixels in _fragments(screen, functions):
            alphas = _alphas(screen, ids, pixels)
            reached = transmittances(alphas, pixels)
            weight.index_add_(0, ids, alphas * reached)
            largest.scatter_reduce_(0, ids, reached, "amax")
    return weight, largest


def median_depth(screen: _Screen, planes: tuple[Tensor, Tensor], view: View, functions: Functions) -> Tensor:
    """(H, W) twin of `cpu.median_depth`: bisection tells which fragments lie before, within and behind the
    footprint of the solution; with them, it is that of a linear equation, which autograd differentiates.

    planes: (N, 3) normals and (N,) plane distances, camera frame
    """
    normals, distances = planes
    rays, focal = (
        pixel_rays(view, normals.device).reshape(-1, 3),
        math.sqrt(view.matrix[0, 0] * view.matrix[1, 1]),
    )
    depth = torch.zeros_like(rays[:, 0])
    for ids, pixels in _fragments(screen, functions):
        alphas = _alphas(screen, ids, pixels)
        weights = alphas * transmittances(alphas, pixels)
        inverse = -(normals[ids] * rays[pixels]).sum(1) / distances[ids].clamp_min(1e-30)
        depth = depth + _half_depth(weights, inverse, pixels, depth.detach(), focal)
    return depth.reshape(view.height, view.width)


def _half_depth(weights: Tensor, inverse: Tensor, pixels: Tensor, like: Tensor, focal: float) -> Tensor:
    """(P,) depth of the pixels of M fragments, 0 = none. weights, inverse depths, pixels: (M,); like: (P,)"""

    def total(values: Tensor) -> Tensor:
        return torch.zeros_like(like).index_add(0, pixels, values)

    with torch.no_grad():
        near, far = torch.full_like(like, 1 / NEAR), torch.zeros_like(like)
        found = total(weights * (inverse > 0)) >= 0.5
        for _ in range(HALVINGS):
            middle = 0.5 * (near + far)
            place = focal * (inverse / middle[pixels] - 1) + 0.5
            enough = total(weights * place.clamp(0, 1)) >= 0.5
            near, far = torch.where(enough, near, middle), torch.where(enough, middle, far)
        place = focal * (inverse / (0.5 * (near + far))[pixels] - 1) + 0.5
        within, before = (place > 0) & (place < 1), place >= 1
    share, slope = total(weights * within), focal * total(weights * within * inverse)
    # where the depth jumps from one surface to another, it has no gradient
    smooth = found & (share >= MIN_SLOPE) & (slope > 0)
    depth = (0.5 - total(weights * before) + (focal - 0.5) * share) / torch.where(smooth, slope, 1)
    return torch.where(smooth, depth, torch.where(found, 1 / (0.5 * (near + far)), 0))


def _fragments(screen: _Screen, functions: Functions) -> Iterator[tuple[Tensor, Tensor]]:
    """(M,) Gaussians and (M,) pixels of all fragments by bands of rows, pixel by pixel and near to far.

    gsplat lists those of a whole image, but a pixel that starts with transmittance 0 has none.
    """
    splats = [tensor.detach() for tensor in (screen.means2d, screen.conics, screen.opacities)]
    width, height = screen.size
    rows = max(1, BAND_PIXELS // width)
    for top in range(0, height if len(screen.ids) else 0, rows):
        band = splats[0].new_zeros(1, height, width)
        band[:, top : top + rows] = 1
        ids, pixels, _ = functions.rasterize_to_indices_in_range(
            0, _ALL, band, *splats, *screen.rasterization
        )
        yield ids, pixels


def _alphas(screen: _Screen, ids: Tensor, pixels: Tensor) -> Tensor:
    """(M,) alpha of fragments, differentiable."""
    width = screen.size[0]
    offsets = torch.stack([pixels % width, pixels // width], 1) + 0.5 - screen.means2d[0, ids]
    alphas = screen.opacities[0, ids] * torch.exp(-0.5 * _squared_distance(offsets, screen.conics[0, ids]))
    return alphas.clamp_max(MAX_ALPHA)


def transmittances(alphas: Tensor, pixels: Tensor) -> Tensor:
    """(M,) product of 1 - alpha over the fragments before each one in its pixel. alphas: (M,); pixels: (M,)
    equal ones side by side.
    """
    logs = torch.log1p(-alphas.double())
    before = logs.cumsum(0) - logs
    starts = torch.ones_like(pixels, dtype=torch.bool)
    starts[1:] = pixels[1:] != pixels[:-1]
    return (before - before[starts][starts.cumsum(0) - 1]).exp().to(alphas)


def _squared_distance(offsets: Tensor, conics: Tensor) -> Tensor:
    """(M,) Mahalanobis distance squared of (M, 2) offsets from the mean, px."""
    (x, y), (xx, xy, yy) = offsets.unbind(1), conics.unbind(1)
    return xx * x * x + 2 * xy * x * y + yy * y * y


def _features(
    gaussians: Gaussians, view: View, sh_degree: int, geometry: bool, functions: Functions
) -> Tensor:
    """(N, 7) what a fragment adds: color, normal (camera frame, towards the camera), plane distance; (N, 3)
    without geometry.
    """
    means = gaussians.means
    directions = means - means.new_tensor(view.center)
    colors = (functions.spherical_harmonics(sh_degree, directions, gaussians.sh) + 0.5).clamp_min(0)
    if not geometry:
        return colors
    pose = means.new_tensor(view.cam_from_world)
    normals_cam, means_cam = gaussians.normals @ pose[:3, :3].T, means @ pose[:3, :3].T + pose[:3, 3]
    facing = (normals_cam * means_cam).sum(1, keepdim=True)
    return torch.cat([colors, torch.where(facing > 0, -normals_cam, normals_cam), facing.abs()], 1)


@torch.no_grad()
def _three_sigma(screen: _Screen) -> Tensor:
    """(N,) three standard deviations along the longer axis, px; 0 where not visible."""
    xx, xy, yy = screen.conics[0].unbind(1)
    determinant = xx * yy - xy * xy
    # of the covariance: its diagonal is that of the conic, swapped, over the determinant
    middle = 0.5 * (xx + yy) / determinant
    radius = 3 * (middle + (middle * middle - 1 / determinant).clamp_min(0).sqrt()).sqrt()
    return torch.where(screen.visible, radius, 0)
