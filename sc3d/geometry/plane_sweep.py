"""Which planes a photo is swept with, and what its depths are where no plane fits.

Pure geometry: the patches are compared in `splatting.initialization`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sc3d.geometry.cameras import View, in_image, project

NUM_DEPTHS = 64
MIN_SPARSE = 8
TALLEST = 0.4  # of the flying height: nothing stands higher, unless sparse points say so
FARTHEST = 3.0  # in depths of the farthest sparse points: what lies behind is backdrop
Plane = tuple[np.ndarray, float]  # normal (camera frame, towards the camera) and distance


@dataclass(frozen=True)
class SweptView:
    """The view that is swept: pixels (T, 2) and depths (T,) of its sparse points; grid (G, 2) pixels without
    any nearby.
    """

    view: View
    pixels: np.ndarray
    depths: np.ndarray
    grid: np.ndarray

    @classmethod
    def between(
        cls, view: View, points: np.ndarray, mask: np.ndarray | None, step: float
    ) -> SweptView | None:
        """A grid of pixels `step` apart, no nearer to those of the sparse points than that; None where too few
        points are seen, or nothing is empty.

        points: (N, 3) world, that the view sees, as far as it is known; mask: (H, W) bool, False = no grid
        """
        pixels, depths = project(view, points)
        usable = in_image(view, pixels) & (depths > 0)
        if usable.sum() < MIN_SPARSE:
            return None
        columns, rows = (np.arange(step / 2, side, step) for side in (view.width, view.height))
        grid = np.stack(np.meshgrid(columns, rows), 2).reshape(-1, 2)
        if mask is not None:
            grid = grid[mask[grid[:, 1].astype(int), grid[:, 0].astype(int)]]
        if len(grid):
            grid = grid[cKDTree(pixels[usable]).query(grid)[0] > step]
        return cls(view, pixels[usable], depths[usable], grid) if len(grid) else None

    @property
    def rays(self) -> np.ndarray:
        """(G, 3) of the grid, z = 1, camera frame."""
        return _rays(self.view, self.grid)


@dataclass(frozen=True)
class SweepVolume:
    """The space that an aerial scene fills: between two planes with all cameras above.

    up: (3,) unit, world; low, high: heights along it, world units
    """

    up: np.ndarray
    low: float
    high: float

    @classmethod
    def from_points(cls, points: np.ndarray, views: list[View]) -> SweepVolume | None:
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


def sweep_planes(reference: SweptView, volume: SweepVolume | None) -> list[Plane]:
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


def plane_depth(plane: Plane, rays: np.ndarray) -> np.ndarray:
    """(G,) depth at which (G, 3) rays with z = 1 meet a plane; very large where they do not."""
    return plane[1] / np.maximum(-rays @ plane[0], 1e-6)


def _rays(view: View, pixels: np.ndarray) -> np.ndarray:
    """(G, 3) rays of (G, 2) pixels with z = 1, camera frame."""
    return np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(view.matrix).T


def settled(grid: np.ndarray, depth: np.ndarray, good: np.ndarray, step: float) -> np.ndarray:
    """(G,) bool: those of `good` whose depth is within 5 % of at least 2 good ones around them."""
    if good.sum() < 4:
        return np.zeros_like(good)
    gaps, near = cKDTree(grid[good]).query(grid, k=min(9, int(good.sum())))
    alike = (np.abs(depth[good][near] / depth[:, None] - 1) < 0.05) & (gaps < 2.5 * step) & (gaps > 0)
    return good & (alike.sum(1) >= 2)


def interpolated_depth(
    reference: SweptView, swept: np.ndarray, good: np.ndarray, lowest: Plane
) -> np.ndarray:
    """(G,) third quartile of the depths of the 8 nearest known pixels: what no patch matches is more often
    the ground beside a roof than the roof.

    Depths are taken relative to the lowest plane's, which continues the ground to where nothing is known.
    """
    pixels = np.concatenate([reference.pixels, reference.grid[good]])
    depths = np.concatenate([reference.depths, swept[good]])
    relative = depths / plane_depth(lowest, _rays(reference.view, pixels))
    near = cKDTree(pixels).query(reference.grid, k=MIN_SPARSE)[1]
    depth = np.quantile(relative[near], 0.75, axis=1) * plane_depth(lowest, reference.rays)
    return np.minimum(depth, FARTHEST * reference.depths.max())


def one_per_cube(points: np.ndarray, size: float) -> np.ndarray:
    """Rows of the first of the (N, 3) points in every cube of `size`, ascending: photos overlap."""
    cells = np.floor(points / size).astype(np.int64)
    return np.sort(np.unique(cells, axis=0, return_index=True)[1])
