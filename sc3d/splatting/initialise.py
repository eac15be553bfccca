"""More starting points where the sparse points leave parts of the photos empty (trees, lawn, asphalt): a small plane-sweep stereo.

Optimisation moves a Gaussian by little per step, so a tree crown that starts on the ground stays there: starting depth matters.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from sc3d.geometry.cameras import View, in_image, project
from sc3d.splatting import losses
from sc3d.splatting.data import TrainingData

SWEEP_SIZE = 250  # px, longest side of the images compared: 7x7 patches must hold some texture
NUM_DEPTHS = 64
MAX_COST = 0.4  # mean 1 - NCC of the two best neighbours
MIN_SPARSE = 8


@dataclass(frozen=True)
class _Sight:
    """What one view knows: pixels (T, 2) and depths (T,) of its sparse points; grid (G, 2) pixels without any nearby."""

    pixels: np.ndarray
    depths: np.ndarray
    grid: np.ndarray


def fill_points(data: TrainingData, neighbours: list[np.ndarray], budget: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on a pixel grid of every photo, away from sparse points.

    neighbours: per view indices of other views, best first; budget: number of grid points over all photos; fewer remain, as photos overlap
    returns: (M, 3) float64 points, the views' world; (M, 3) uint8 colours. M = 0 where there is nothing to fill.
    Depth: where patches agree with the neighbours' (plane sweep); elsewhere interpolated from what the view knows around the pixel.
    """
    step = max(4.0, np.sqrt(sum(view.width * view.height for view in data.views) / max(budget, 1)))
    greys = [_small_grey(data, index) for index in range(len(data.views))]
    found, colors, sizes = [], [], []
    for index, view in enumerate(data.views):
        sight = _sight(data, index, step)
        if sight is None:
            continue
        swept, cost = _sweep(sight, greys[index], [greys[other] for other in neighbours[index]], view.width)
        good = _settled(sight.grid, swept, cost < MAX_COST, step)
        known = np.concatenate([sight.pixels, sight.grid[good]]), np.concatenate([sight.depths, swept[good]])
        depth = np.where(good, swept, _interpolated(*known, sight.grid))
        rays_cam = np.concatenate([sight.grid, np.ones((len(depth), 1))], 1) @ np.linalg.inv(view.matrix).T
        found.append((rays_cam * depth[:, None] - view.cam_from_world[:3, 3]) @ view.cam_from_world[:3, :3])
        columns, rows = sight.grid.astype(int).T
        colors.append(data.image(index)[rows, columns])
        sizes.append(step * depth / view.focal)
    if not found:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    return _thinned(np.concatenate(found), np.concatenate(colors), float(np.median(np.concatenate(sizes))))


def _small_grey(data: TrainingData, index: int) -> tuple[torch.Tensor, View]:
    view = data.views[index]
    scale = min(1.0, SWEEP_SIZE / max(view.width, view.height))
    small = view.resized(max(8, round(view.width * scale)), max(8, round(view.height * scale)))
    image = cv2.resize(data.image(index), (small.width, small.height), interpolation=cv2.INTER_AREA)
    return losses.to_grey(torch.from_numpy(image).float() / 255), small


def _sight(data: TrainingData, index: int, step: float) -> _Sight | None:
    """None where too few sparse points are seen, or nothing is empty. Without tracks every point in the image counts as seen."""
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
    return _Sight(pixels[usable], depths[usable], grid) if len(grid) else None


def _sweep(sight: _Sight, own: tuple[torch.Tensor, View], others: list[tuple[torch.Tensor, View]], width: int) -> tuple[np.ndarray, np.ndarray]:
    """(G,) depth whose fronto-parallel patches agree best with the two best of the other views; (G,) that mean 1 - NCC, 2 = none."""
    pixels = torch.from_numpy((sight.grid * (own[1].width / width)).astype(np.int64))
    nearest, farthest = np.quantile(sight.depths, [0.01, 0.99]) * [0.6, 1.15]
    normals = torch.tensor([0.0, 0.0, -1.0]).repeat(len(pixels), 1)
    best_cost, best_depth = np.full(len(pixels), 2.0), np.full(len(pixels), np.median(sight.depths))
    for depth in 1 / np.linspace(1 / nearest, 1 / farthest, NUM_DEPTHS):
        costs = []
        for other in others:
            cost, inside = losses.patch_dissimilarity((normals, torch.full((len(pixels),), float(depth))), pixels, own, other)
            costs.append(torch.where(inside, cost, 2.0))
        if costs:
            cost = torch.stack(costs).sort(0).values[:2].mean(0).numpy()
            better = cost < best_cost
            best_cost[better], best_depth[better] = cost[better], depth
    return best_depth, best_cost


def _settled(grid: np.ndarray, depth: np.ndarray, good: np.ndarray, step: float) -> np.ndarray:
    """(G,) bool: those of `good` whose depth is within 5 % of at least 2 good ones around them."""
    if good.sum() < 4:
        return np.zeros_like(good)
    gaps, near = cKDTree(grid[good]).query(grid, k=min(9, int(good.sum())))
    alike = (np.abs(depth[good][near] / depth[:, None] - 1) < 0.05) & (gaps < 2.5 * step) & (gaps > 0)
    return good & (alike.sum(1) >= 2)


def _interpolated(pixels: np.ndarray, depths: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """(G,) third quartile of the depths of the 8 nearest known pixels: what no patch matches is more often the ground beside a roof than the roof."""
    near = cKDTree(pixels).query(grid, k=MIN_SPARSE)[1]
    return np.quantile(depths[near], 0.75, axis=1)


def _thinned(points: np.ndarray, colors: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """One point per cube of `size`: photos overlap."""
    cells = np.floor(points / size).astype(np.int64)
    kept = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    return points[kept], colors[kept]
