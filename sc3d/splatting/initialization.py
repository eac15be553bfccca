"""More starting points where the sparse points leave parts of the photos empty (trees, lawn, asphalt): a
small plane-sweep stereo.

Optimization moves a Gaussian by little per step, so a tree crown that starts on the ground stays there:
starting depth matters.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from sc3d.geometry.cameras import View, in_image, project
from sc3d.splatting import losses
from sc3d.splatting.dataset import TrainingData

SWEEP_SIZE = 250  # px, longest side of the images compared: 7x7 patches must hold some texture
NUM_DEPTHS = 64
MAX_COST = 0.5  # mean 1 - NCC of the two best neighbors
AROUND = 5  # grid points whose costs are averaged
MIN_SPARSE = 8
TALLEST = 0.4  # of the flying height: nothing stands higher, unless sparse points say so
FARTHEST = 3.0  # in depths of the farthest sparse points: what lies behind is backdrop


@dataclass(frozen=True)
class _Sight:
    """What one view knows: pixels (T, 2) and depths (T,) of its sparse points; grid (G, 2) pixels without any
    nearby.
    """

    pixels: np.ndarray
    depths: np.ndarray
    grid: np.ndarray


@dataclass(frozen=True)
class _Layer:
    """The layer of space that an aerial scene fills: between two planes with all cameras above.

    up: (3,) unit, world; low, high: heights along it, world units
    """

    up: np.ndarray
    low: float
    high: float

    @classmethod
    def from_points(cls, points: np.ndarray, views: list[View]) -> _Layer | None:
        """The layer of the sparse points, across the mean viewing direction; None if a camera is not above
        it: then it is no flight.
        """
        up = -np.sum([view.cam_from_world[2, :3] for view in views], axis=0)
        up = up / np.maximum(np.linalg.norm(up), 1e-12)
        low, high = np.quantile(points @ up, [0.02, 0.995])
        altitude = min(view.center @ up for view in views) - low
        # crowns have few sparse points, so the highest of those is no limit
        high = max(high + 0.1 * (high - low), low + TALLEST * altitude)
        return cls(up, low - 0.02 * altitude, high) if high < low + 0.8 * altitude else None

    def plane(self, view: View, height: float) -> tuple[np.ndarray, float]:
        """Normal (camera frame, towards the camera) and distance of the horizontal plane at a height."""
        return view.cam_from_world[:3, :3] @ self.up, float(view.center @ self.up - height)


def fill_points(
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
    layer = _Layer.from_points(np.asarray(data.points, np.float64), data.views)
    found, colors, sizes = [], [], []
    for index, view in enumerate(data.views):
        sight = _sight(data, index, step)
        if sight is None:
            continue
        planes = _planes(sight, view, layer)
        swept, cost = _sweep(
            sight.grid, planes, grays[index], [grays[other] for other in neighbors[index]], view
        )
        good = _settled(sight.grid, swept, cost < MAX_COST, step)
        known = np.concatenate([sight.pixels, sight.grid[good]]), np.concatenate([sight.depths, swept[good]])
        lowest = planes[0] if layer else (np.array([0.0, 0.0, -1.0]), 1.0)
        relative = _interpolated(known[0], known[1] / _plane_depth(lowest, view, known[0]), sight.grid)
        depth = np.where(
            good,
            swept,
            np.minimum(relative * _plane_depth(lowest, view, sight.grid), FARTHEST * sight.depths.max()),
        )
        rays_cam = _rays(view, sight.grid)
        found.append((rays_cam * depth[:, None] - view.cam_from_world[:3, 3]) @ view.cam_from_world[:3, :3])
        columns, rows = sight.grid.astype(int).T
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


def _sight(data: TrainingData, index: int, step: float) -> _Sight | None:
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
    return _Sight(pixels[usable], depths[usable], grid) if len(grid) else None


def _planes(sight: _Sight, view: View, layer: _Layer | None) -> list[tuple[np.ndarray, float]]:
    """NUM_DEPTHS planes to try, farthest first: horizontal ones through the layer, else fronto-parallel ones
    around the sparse depths.
    """
    if layer is None:
        nearest, farthest = np.quantile(sight.depths, [0.01, 0.99]) * [0.6, 1.15]
        return [
            (np.array([0.0, 0.0, -1.0]), depth)
            for depth in 1 / np.linspace(1 / farthest, 1 / nearest, NUM_DEPTHS)
        ]
    height = view.center @ layer.up
    return [
        layer.plane(view, height - below)
        for below in 1 / np.linspace(1 / (height - layer.low), 1 / (height - layer.high), NUM_DEPTHS)
    ]


def _plane_depth(plane: tuple[np.ndarray, float], view: View, pixels: np.ndarray) -> np.ndarray:
    """(G,) depth at which the rays of (G, 2) pixels meet a plane; very large where they do not."""
    return plane[1] / np.maximum(-_rays(view, pixels) @ plane[0], 1e-6)


def _rays(view: View, pixels: np.ndarray) -> np.ndarray:
    """(G, 3) rays of (G, 2) pixels with z = 1, camera frame."""
    return np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(view.matrix).T


def _sweep(
    grid: np.ndarray,
    planes: list[tuple[np.ndarray, float]],
    own: tuple[torch.Tensor, View],
    others: list[tuple[torch.Tensor, View]],
    view: View,
) -> tuple[np.ndarray, np.ndarray]:
    """(G,) depth of the plane whose patches agree best with the two best of the other views; (G,) that mean 1
    - NCC, 2 = none.
    """
    pixels = torch.from_numpy((grid * (own[1].width / view.width)).astype(np.int64))
    around = cKDTree(grid).query(grid, k=min(AROUND, len(grid)))[1].reshape(len(grid), -1)
    best_cost, best_depth = np.full(len(pixels), 2.0), np.ones(len(pixels))
    for plane in planes if others else []:
        normals = torch.from_numpy(plane[0].astype(np.float32)).expand(len(pixels), 3).contiguous()
        costs = []
        for other in others:
            cost, inside = losses.patch_dissimilarity(
                (normals, torch.full((len(pixels),), plane[1])), pixels, own, other
            )
            costs.append(torch.where(inside, cost, 2.0))
        cost = torch.stack(costs).sort(0).values[:2].mean(0).numpy()
        cost = cost[around].mean(axis=1)  # leaves in the wind: one patch says little
        better = cost < best_cost
        best_cost[better], best_depth[better] = cost[better], _plane_depth(plane, view, grid)[better]
    return best_depth, best_cost


def _settled(grid: np.ndarray, depth: np.ndarray, good: np.ndarray, step: float) -> np.ndarray:
    """(G,) bool: those of `good` whose depth is within 5 % of at least 2 good ones around them."""
    if good.sum() < 4:
        return np.zeros_like(good)
    gaps, near = cKDTree(grid[good]).query(grid, k=min(9, int(good.sum())))
    alike = (np.abs(depth[good][near] / depth[:, None] - 1) < 0.05) & (gaps < 2.5 * step) & (gaps > 0)
    return good & (alike.sum(1) >= 2)


def _interpolated(pixels: np.ndarray, relative: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """(G,) third quartile of the depths of the 8 nearest known pixels: what no patch matches is more often
    the ground beside a roof than the roof.

    relative: depths relative to the lowest plane's, which continues the ground to where nothing is known
    """
    near = cKDTree(pixels).query(grid, k=MIN_SPARSE)[1]
    return np.quantile(relative[near], 0.75, axis=1)


def _thinned(points: np.ndarray, colors: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """One point per cube of `size`: photos overlap."""
    cells = np.floor(points / size).astype(np.int64)
    kept = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    return points[kept], colors[kept]
