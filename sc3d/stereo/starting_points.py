"""Points on depth maps from which training starts."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sc3d.geometry.cameras import View
from sc3d.geometry.plane_sweep import one_per_cube
from sc3d.scene.depth_map import DepthMap

MIN_STEP = 3.0  # px between points of a photo
OVERLAP = 10  # photos that see the same place


class StartingPoints(NamedTuple):
    """points: (M, 3) float64, the views' world; colors: (M, 3) uint8; normals: (M, 3) float64 unit or 0 = unknown"""

    points: np.ndarray
    colors: np.ndarray
    normals: np.ndarray

    @classmethod
    def without_normals(cls, points: np.ndarray, colors: np.ndarray) -> StartingPoints:
        points = np.asarray(points, np.float64).reshape(-1, 3)
        return cls(points, np.asarray(colors).reshape(-1, 3), np.zeros_like(points))

    @classmethod
    def joined(cls, parts: list[StartingPoints]) -> StartingPoints:
        return cls(*(np.concatenate(values) for values in zip(*parts, strict=True)))

    def chosen(self, rows: np.ndarray) -> StartingPoints:
        return StartingPoints(*(values[rows] for values in self))


def points_on_maps(
    views: list[View],
    image: Callable[[int], np.ndarray],
    mask: Callable[[int], np.ndarray | None],
    depth_map: Callable[[int], DepthMap | None],
    budget: int,
) -> StartingPoints:
    """Points on a pixel grid of every photo at the depth of its map, one per cube as large as a grid cell.

    image, mask, depth_map: index to (H, W, 3) uint8, (H, W) bool or None = all, and the map or None, of the view's size
    budget: about how many to return
    """
    num_pixels = sum(view.width * view.height for view in views)
    step = max(MIN_STEP, float(np.sqrt(num_pixels / max(OVERLAP * budget, 1))))
    parts, sizes = [], []
    for index, view in enumerate(views):
        known = depth_map(index)
        if known is not None:
            part, size = _on_grid(view, image(index), mask(index), known, step)
            parts.append(part)
            sizes.append(size)
    if not sum(map(len, sizes)):
        return StartingPoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((0, 3)))
    found, cell = StartingPoints.joined(parts), float(np.median(np.concatenate(sizes)))
    kept = one_per_cube(found.points, cell)
    if len(kept) > budget:  # of a surface, cubes larger by the root
        kept = one_per_cube(found.points, cell * float(np.sqrt(len(kept) / budget)))
    return found.chosen(kept)


def _on_grid(
    view: View, image: np.ndarray, mask: np.ndarray | None, depth_map: DepthMap, step: float
) -> tuple[StartingPoints, np.ndarray]:
    """Starting points of a photo, and the size of a grid cell at each, world units."""
    columns, rows = np.meshgrid(np.arange(step / 2, view.width, step), np.arange(step / 2, view.height, step))
    columns, rows = columns.astype(int).ravel(), rows.astype(int).ravel()
    if mask is not None:
        columns, rows = columns[mask[rows, columns]], rows[mask[rows, columns]]
    depth = depth_map.depth[rows, columns].astype(np.float64)
    chosen = depth > 0
    rows, columns, depth = rows[chosen], columns[chosen], depth[chosen]
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
    rotation = view.cam_from_world[:3, :3]
    points_cam = pixels @ np.linalg.inv(view.matrix).T * depth[:, None]
    normals = depth_map.normals[rows, columns] * (depth_map.depth[rows, columns] > 0)[:, None] / 127.0
    points = (points_cam - view.cam_from_world[:3, 3]) @ rotation
    return StartingPoints(points, image[rows, columns], normals @ rotation), step * depth / view.focal
