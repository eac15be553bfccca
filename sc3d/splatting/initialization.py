"""Where training starts: Gaussians at the sparse points, and at points between them from a small plane sweep.

Sparse points leave parts of the photos empty (trees, lawn, asphalt), and optimization moves a Gaussian by
little per step, so a tree crown that starts on the ground stays there: starting depth matters.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from sc3d.geometry.cameras import View, in_image, project
from sc3d.settings.train import TrainSettings
from sc3d.splatting import losses
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.gaussians import Gaussians

SWEEP_SIZE = 250  # px, longest side of the images compared: 7x7 patches must hold some texture
NUM_DEPTHS = 64
MAX_COST = 0.5  # mean 1 - NCC of the two best neighbors
AROUND = 5  # grid points whose costs are averaged
MIN_SPARSE = 8
TALLEST = 0.4  # of the flying height: nothing stands higher, unless sparse points say so
FARTHEST = 3.0  # in depths of the farthest sparse points: what lies behind is backdrop
Plane = tuple[np.ndarray, float]
"""Normal (camera frame, towards the camera) and distance."""


@dataclass(frozen=True)
class _Reference:
    """The view that is swept: pixels (T, 2) and depths (T,) of its sparse points; grid (G, 2) pixels without
    any nearby.
    """

    view: View
    pixels: np.ndarray
    depths: np.ndarray
    grid: np.ndarray


@dataclass(frozen=True)
class _SweepVolume:
    """The space that an aerial scene fills: between two planes with all cameras above.

    up: (3,) unit, world; low, high: heights along it, world units
    """

    up: np.ndarray
    low: float
    high: float

    @classmethod
    def from_points(cls, points: np.ndarray, views: list[View]) -> _SweepVolume | None:
        """That of the sparse points, across the mean viewing direction; None if a camera is not above it:
        then it is no flight.
        """
        up = -np.sum([view.cam_from_world[2, :3] for view in views], axis=0)
        up = up / np.maximum(np.linalg.norm(up), 1e-12)
        low, high = np.quantile(points @ up, [0.02, 0.995])
        altitude = min(view.center @ up for view in views) - low
        # crowns have few sparse points, so the highest of those is no limit
        high = max(high + 0.1 * (high - low), low + TALLEST * altitude)
        return cls(up, low - 0.02 * altitude, high) if high < low + 0.8 * altitude else None


def initial_gaussians(
    data: TrainingData, neighbors: list[np.ndarray], settings: TrainSettings, generator: torch.Generator
) -> Gaussians:
    """Gaussians at the sparse points and, with `fill`, between them; a random choice if they are too many."""
    points, colors = np.asarray(data.points, np.float64), np.asarray(data.colors)
    if settings.fill:
        more, more_colors = plane_sweep_points(data, neighbors, settings.max_gaussians // 4)
        points, colors = np.concatenate([points, more]), np.concatenate([colors, more_colors])
    if len(points) > settings.max_gaussians:
        order = torch.randperm(len(points), generator=generator)
        chosen = order[: settings.max_gaussians].sort().values.numpy()
        points, colors = points[chosen], colors[chosen]
    return Gaussians.from_points(points, colors, settings.sh_degree)


def plane_sweep_points(
    data: TrainingData, neighbors: list[np.ndarray], budget: int
) -> tuple[np.ndarray, np.ndarray]:
    """Points on a pixel grid of every photo, away from sparse points.

    neighbors: per view indices of other views, best first; budget: number of grid points over all photos;
        fewer remain, as photos overlap
    returns: (M, 3) float64 points, the views' world; (M, 3) uint8 colors. M = 0 where there is nothing to
        fill.
    Depth: where patches agree with the neighbors' (plane sweep); elsewhere interpolated from what the view
        knows around the pixel.
    """
    masks = map(data.mask, range(len(data.views)))
    num_pixels = sum(
        view.width * view.height if mask is None else int(mask.sum())
        for view, mask in zip(data.views, masks, strict=True)
    )
    step = max(4.0, np.sqrt(num_pixels / max(budget, 1)))
    grays = [_small_gray(data, index) for index in range(len(data.views))]
    volume = _SweepVolume.from_points(np.asarray(data.points, np.float64), data.views)
    found, colors, sizes = [], [], []
    for index, view in enumerate(data.views):
        reference = _reference(data, index, step)
        if reference is None:
            continue
        planes = _planes(reference, volume)
        swept, cost = _sweep(reference, planes, grays[index], [grays[other] for other in neighbors[index]])
        good = _settled(reference.grid, swept, cost < MAX_COST, step)
        lowest = planes[0] if volume else (np.array([0.0, 0.0, -1.0]), 1.0)
        depth = np.where(good, swept, _interpolated(reference, swept, good, lowest))
        points_cam = _rays(view, reference.grid) * depth[:, None]
        found.append((points_cam - view.cam_from_world[:3, 3]) @ view.cam_from_world[:3, :3])
        columns, rows = reference.grid.astype(int).T
        colors.append(data.image(index)[rows, columns])
        sizes.append(step * depth / view.focal)
    if not found:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    return _thinned(np.concatenate(found), np.concatenate(colors), float(np.median(np.concatenate(sizes))))


def _small_gray(data: TrainingData, index: int) -> tuple[torch.Tensor, View]:
    view = data.views[index]
    scale = min(1.0, SWEEP_SIZE / max(view.width, view.height))
    small = view.resized(max(8, round(view.width * scale)), max(8, round(view.height * scale)))
    image = cv2.resize(data.image(index), (small.width, small.height), interpolation=cv2.INTER_AREA)
    return losses.to_gray(torch.from_numpy(image).float() / 255), small


def _reference(data: TrainingData, index: int, step: float) -> _Reference | None:
    """None where too few sparse points are seen, or nothing is empty. Without tracks every point in the image
    counts as seen.
    """
    view, points = data.views[index], np.asarray(data.points, np.float64)
    pixels, depths = project(view, points if data.tracks is None else points[data.tracks[index]])
    usable = in_image(view, pixels) & (depths > 0)
    if usable.sum() < MIN_SPARSE:
        return None
    columns, rows = np.meshgrid(np.arange(step / 2, view.width, step), np.arange(step / 2, view.height, step))
    grid = np.stack([columns.ravel(), rows.ravel()], 1)
    mask = data.mask(index)
    if mask is not None:
        grid = grid[mask[grid[:, 1].astype(int), grid[:, 0].astype(int)]]
    if len(grid):
        grid = grid[cKDTree(pixels[usable]).query(grid)[0] > step]
    return _Reference(view, pixels[usable], depths[usable], grid) if len(grid) else None


def _planes(reference: _Reference, volume: _SweepVolume | None) -> list[Plane]:
    """NUM_DEPTHS planes to try, farthest first: horizontal ones through the volume, else fronto-parallel ones
    around the sparse depths.
    """
    if volume is None:
        nearest, farthest = np.quantile(reference.depths, [0.01, 0.99]) * [0.6, 1.15]
        depths = 1 / np.linspace(1 / farthest, 1 / nearest, NUM_DEPTHS)
        return [(np.array([0.0, 0.0, -1.0]), depth) for depth in depths]
    view = reference.view
    height, normal = view.center @ volume.up, view.cam_from_world[:3, :3] @ volume.up
    below = 1 / np.linspace(1 / (height - volume.low), 1 / (height - volume.high), NUM_DEPTHS)
    return [(normal, distance) for distance in below.tolist()]


def _plane_depth(plane: Plane, rays: np.ndarray) -> np.ndarray:
    """(G,) depth at which (G, 3) rays with z = 1 meet a plane; very large where they do not."""
    return plane[1] / np.maximum(-rays @ plane[0], 1e-6)


def _rays(view: View, pixels: np.ndarray) -> np.ndarray:
    """(G, 3) rays of (G, 2) pixels with z = 1, camera frame."""
    return np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(view.matrix).T


def _sweep(
    reference: _Reference,
    planes: list[Plane],
    own: tuple[torch.Tensor, View],
    others: list[tuple[torch.Tensor, View]],
) -> tuple[np.ndarray, np.ndarray]:
    """(G,) depth of the plane whose patches agree best with the two best of the other views; (G,) that mean 1
    - NCC, 2 = none.
    """
    grid, rays = reference.grid, _rays(reference.view, reference.grid)
    pixels = torch.from_numpy((grid * (own[1].width / reference.view.width)).astype(np.int64))
    around = cKDTree(grid).query(grid, k=min(AROUND, len(grid)))[1].reshape(len(grid), -1)
    best_cost, best_depth = np.full(len(pixels), 2.0), np.ones(len(pixels))
    for plane in planes if others else []:
        normals = torch.from_numpy(plane[0].astype(np.float32)).expand(len(pixels), 3).contiguous()
        distances, costs = torch.full((len(pixels),), plane[1]), []
        for other in others:
            cost, inside = losses.patch_dissimilarity((normals, distances), pixels, own, other)
            costs.append(torch.where(inside, cost, 2.0))
        cost = torch.stack(costs).sort(0).values[:2].mean(0).numpy()
        cost = cost[around].mean(axis=1)  # leaves in the wind: one patch says little
        better = cost < best_cost
        best_cost[better], best_depth[better] = cost[better], _plane_depth(plane, rays)[better]
    return best_depth, best_cost


def _settled(grid: np.ndarray, depth: np.ndarray, good: np.ndarray, step: float) -> np.ndarray:
    """(G,) bool: those of `good` whose depth is within 5 % of at least 2 good ones around them."""
    if good.sum() < 4:
        return np.zeros_like(good)
    gaps, near = cKDTree(grid[good]).query(grid, k=min(9, int(good.sum())))
    alike = (np.abs(depth[good][near] / depth[:, None] - 1) < 0.05) & (gaps < 2.5 * step) & (gaps > 0)
    return good & (alike.sum(1) >= 2)


def _interpolated(reference: _Reference, swept: np.ndarray, good: np.ndarray, lowest: Plane) -> np.ndarray:
    """(G,) third quartile of the depths of the 8 nearest known pixels: what no patch matches is more often
    the ground beside a roof than the roof.

    Depths are taken relative to the lowest plane's, which continues the ground to where nothing is known.
    """
    pixels = np.concatenate([reference.pixels, reference.grid[good]])
    depths = np.concatenate([reference.depths, swept[good]])
    view = reference.view
    relative = depths / _plane_depth(lowest, _rays(view, pixels))
    near = cKDTree(pixels).query(reference.grid, k=MIN_SPARSE)[1]
    depth = np.quantile(relative[near], 0.75, axis=1) * _plane_depth(lowest, _rays(view, reference.grid))
    return np.minimum(depth, FARTHEST * reference.depths.max())


def _thinned(points: np.ndarray, colors: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """One point per cube of `size`: photos overlap."""
    cells = np.floor(points / size).astype(np.int64)
    kept = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    return points[kept], colors[kept]
