"""More starting points where the sparse points leave parts of the photos empty (forest, lawn, asphalt)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from sc3d.geometry.cameras import View, in_image, project

NEIGHBOURS = 8


def fill_points(
    views: list[View], image: Callable[[int], np.ndarray], points: np.ndarray, tracks: list[np.ndarray] | None, budget: int
) -> tuple[np.ndarray, np.ndarray]:
    """Points on a pixel grid of every photo, away from sparse points, at a depth interpolated from those seen there.

    image: view index to (H, W, 3) uint8; points: (N, 3) sparse points, the views' world; tracks: per view rows of `points`, None = all in the image
    budget: number of grid points over all photos; fewer remain, as photos overlap
    returns: (M, 3) float64 points; (M, 3) uint8 colours. M = 0 where there is nothing to fill.
    """
    step = max(4.0, np.sqrt(sum(view.width * view.height for view in views) / max(budget, 1)))
    found, colors, sizes = [], [], []
    for index, view in enumerate(views):
        seen = points if tracks is None else points[tracks[index]]
        pixels, depth = project(view, seen)
        usable = in_image(view, pixels) & (depth > 0)
        if usable.sum() < NEIGHBOURS:
            continue
        grid = _grid(view, step)
        gaps, near = cKDTree(pixels[usable]).query(grid, k=NEIGHBOURS)
        empty = gaps[:, 0] > step
        weights = 1 / gaps[empty] ** 2
        # 1 / depth is linear in the pixel on a plane.
        inverse = (weights / depth[usable][near[empty]]).sum(1) / weights.sum(1)
        rays_cam = np.concatenate([grid[empty], np.ones((empty.sum(), 1))], 1) @ np.linalg.inv(view.matrix).T
        points_cam = rays_cam / inverse[:, None]
        found.append((points_cam - view.cam_from_world[:3, 3]) @ view.cam_from_world[:3, :3])
        columns, rows = grid[empty].astype(int).T
        colors.append(image(index)[rows, columns])
        sizes.append(step / (inverse * view.focal))
    if not found or not sum(map(len, found)):
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    return _thinned(np.concatenate(found), np.concatenate(colors), float(np.median(np.concatenate(sizes))))


def _grid(view: View, step: float) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(step / 2, view.width, step), np.arange(step / 2, view.height, step))
    return np.stack([columns.ravel(), rows.ravel()], 1)


def _thinned(points: np.ndarray, colors: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """One point per cube of `size`: photos overlap."""
    cells = np.floor(points / size).astype(np.int64)
    kept = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    return points[kept], colors[kept]
