"""What the training benchmark runs on: Gaussians over a ground, two overlapping views, and their photos."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, in_image, local_origin, look_at, pinhole_view, project, undistorted
from sc3d.geometry.view_selection import neighbor_views
from sc3d.scene.scene import SparseModel
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.rendering import render
from tools.benchmark.fragments import count_fragments

FRAGMENTS = 23.0  # contributing, per pixel
VISIBLE_SHARE = 0.2  # of the Gaussians, in one view
_THINNESS = 0.1  # smallest scale of a Gaussian, relative to the others: as flat as trained ones
_FULL_SIZE = (1986, 1116)  # of the synthetic photos, px


@dataclass(frozen=True)
class TrainingGround:
    """Surface points (P, 3) in a local world frame, their colors (P, 3) uint8, and two views that overlap,
    at full size.
    """

    points: np.ndarray
    colors: np.ndarray
    views: tuple[View, View]


@dataclass(frozen=True)
class Workload:
    """Flat Gaussians on the ground, two pinhole views at the size to be timed, and per view an (H, W, 3)
    uint8 photo.
    """

    gaussians: Gaussians
    views: tuple[View, View]
    photos: tuple[np.ndarray, np.ndarray]

    @property
    def name(self) -> str:
        return f"{len(self.gaussians) / 1000:g} k @ {self.views[0].width}x{self.views[0].height}"


def synthetic_ground(num_points: int = 20_000, seed: int = 0) -> TrainingGround:
    """Rolling ground seen almost straight down, so wide that one view shows a fifth of it."""
    rng = np.random.default_rng(seed)
    height, focal = 50.0, 0.8 * _FULL_SIZE[0]
    footprint = height**2 * _FULL_SIZE[0] * _FULL_SIZE[1] / focal**2
    half = np.sqrt(footprint / VISIBLE_SHARE) / 2
    x, y = rng.uniform(-half, half, (2, num_points))
    points = np.stack([x, y, 1.5 * np.sin(0.15 * x) * np.cos(0.11 * y)], 1)
    colors = (
        127
        + 80 * np.stack([np.sin(0.9 * x + 0.4 * y), np.sin(0.7 * y - 0.5 * x), np.cos(0.6 * x)], 1)
        + rng.normal(0, 15, (num_points, 3))
    )
    numbers = (focal, focal, _FULL_SIZE[0] / 2, _FULL_SIZE[1] / 2)
    views = [
        pinhole_view(
            f"view_{index}.png",
            _FULL_SIZE,
            numbers,
            look_at(np.array([side, -3.0, height]), np.array([side / 2, 0.0, 0.0])),
        )
        for index, side in enumerate((-5.0, 5.0))
    ]
    return TrainingGround(points, colors.clip(0, 255).astype(np.uint8), tuple(views))


def ground_of(model: SparseModel) -> TrainingGround:
    """Sparse points of a COLMAP model; the view that sees nearest to a fifth of them, and its best neighbor.
    InputError for too small models.
    """
    if len(model.views) < 2 or len(model.points) < 100:
        raise InputError(
            f"the scene has {len(model.views)} photos and {len(model.points)} sparse points: the benchmark needs 2 and 100"
        )
    origin = local_origin(model.views)
    views, points = [undistorted(view.shifted(origin)) for view in model.views], model.points - origin
    shares = [in_image(view, project(view, points)[0]).mean() for view in views]
    first = int(np.argmin(np.abs(np.array(shares) - VISIBLE_SHARE)))
    second = int(neighbor_views(model.tracks, points, np.stack([view.center for view in views]))[first][0])
    named = [replace(views[index], name=f"view_{row}.png") for row, index in enumerate((first, second))]
    return TrainingGround(points, model.colors, tuple(named))


def build_workload(ground: TrainingGround, num_gaussians: int, max_size: int, seed: int = 0) -> Workload:
    """Spread Gaussians over a ground and scale them until a view has `FRAGMENTS` contributing fragments per
    pixel.

    Opacities are exp-normal around 0.27. The photos are renderings with noise, so that gradients are those of
    a fit that still goes on.
    """
    rng = np.random.default_rng(seed)
    gaussians = _spread(ground, num_gaussians, rng)
    views = tuple(undistorted(view, max_size) for view in ground.views)
    for _ in range(8):
        ratio = FRAGMENTS / max(count_fragments(gaussians, views[0])[0], 1e-3)
        gaussians = replace(gaussians, log_scales=gaussians.log_scales + 0.5 * np.log(ratio))
        if abs(ratio - 1) < 0.02:
            break
    return Workload(gaussians, views, tuple(_photo(gaussians, view, rng) for view in views))


def _spread(ground: TrainingGround, count: int, rng: np.random.Generator) -> Gaussians:
    """Means between points and their neighbors, evenly over the surface; scales from the distances among
    them, first axis across the surface.
    """
    gaps, near = cKDTree(ground.points).query(ground.points, 7)
    area = np.minimum(gaps[:, -1], np.quantile(gaps[:, -1], 0.95)) ** 2
    chosen = rng.choice(len(ground.points), count, p=area / area.sum())
    other = near[chosen, rng.integers(1, 7, count)]
    means = ground.points[chosen] + rng.random((count, 1)) * (ground.points[other] - ground.points[chosen])
    means = means + rng.normal(0, 0.02, (count, 3)) * gaps[chosen, 1:].mean(1)[:, None]
    gaussians = Gaussians.from_points(means, ground.colors[chosen])
    stretch = rng.normal(0, 0.3, (count, 3)) + [np.log(_THINNESS), 0.0, 0.0]
    log_scales = gaussians.log_scales + torch.from_numpy(stretch).float()
    return replace(
        gaussians, log_scales=log_scales, opacity_logits=torch.from_numpy(rng.normal(-1, 1, count)).float()
    )


@torch.no_grad()
def _photo(gaussians: Gaussians, view: View, rng: np.random.Generator) -> np.ndarray:
    color = render(gaussians, view, geometry=False).color.numpy()
    return (255 * color + rng.normal(0, 12, color.shape)).clip(0, 255).astype(np.uint8)
