"""Trees on a grid: the canopy height model, its tops, and the crown around each top."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from sc3d.exporters.packages import load
from sc3d.exporters.regions import disk, renumbered
from sc3d.geometry.raster import Raster, close_gaps, highest_points

segmentation = load("skimage.segmentation")

GAP = 0.5  # gaps of the canopy narrower than about twice this are filled, m
SMOOTHING = 0.4  # standard deviation of the Gaussian that joins the lobes of a crown, m
UNDER = 0.5  # tree points this far below the top of their cell are not canopy, m
MIN_CROWN = 2.0  # m2


def canopy_height(points: np.ndarray, is_tree: np.ndarray, ground: np.ndarray, grid: Raster) -> np.ndarray:
    """(H, W) float64 height of the canopy above the ground, m; NaN where nothing or something else is on top.

    points: (N, 3) m; is_tree: (N,) bool; ground: (H, W) z of the ground, m
    """
    top, trees = highest_points(grid, points), highest_points(grid, points, is_tree)
    canopy = (trees >= 0) & (points[trees, 2] >= points[top, 2] - UNDER)
    rows = close_gaps(np.where(canopy, trees, -1), round(GAP / grid.pixel))
    return np.where(rows >= 0, points[rows, 2] - ground, np.nan)


def split_crowns(canopy: np.ndarray, grid: Raster, min_height: float) -> np.ndarray:
    """(H, W) int32 number of the tree in each cell, 0 = none.

    canopy: (H, W) m, NaN = none; min_height: lower plants are not trees, m
    """
    tall = canopy >= min_height
    crowns = grow_crowns(
        smoothed(np.where(tall, canopy, 0.0), tall, SMOOTHING / grid.pixel), tall, grid.pixel
    )
    kept = np.bincount(crowns.ravel())[crowns] * grid.pixel**2 >= MIN_CROWN
    return renumbered(np.where(kept, crowns, 0))


def smoothed(heights: np.ndarray, known: np.ndarray, sigma: float) -> np.ndarray:
    """(H, W) Gaussian mean over the known cells; 0 elsewhere."""
    weight = ndimage.gaussian_filter(known.astype(np.float64), sigma, mode="constant")
    mean = ndimage.gaussian_filter(np.where(known, heights, 0.0), sigma, mode="constant")
    return np.where(known, mean / np.maximum(weight, 1e-9), 0.0)


def grow_crowns(heights: np.ndarray, tall: np.ndarray, pixel: float) -> np.ndarray:
    """(H, W) int32 number from 1 of the tree of each tall cell, by the watershed of the canopy around its tops;
    0 = not tall, or a speck beside a crown that is higher.

    heights: (H, W) m; pixel: side of the cells, m
    """
    return segmentation.watershed(-heights, tree_tops(heights, tall, pixel), connectivity=2, mask=tall)


def tree_tops(heights: np.ndarray, tall: np.ndarray, pixel: float) -> np.ndarray:
    """(H, W) int32 1, 2, ... at the tall cells that are the highest within half the usual width of a crown of
    their height, 0 elsewhere; equal heights are decided by place.
    """
    order = np.lexsort((np.arange(heights.size), np.where(tall, heights, -np.inf).ravel()))
    rank = np.empty(heights.shape, np.int64)
    rank.ravel()[order] = np.arange(heights.size)
    rows, columns = np.nonzero(tall & (ndimage.maximum_filter(rank, 3, mode="nearest") == rank))
    radius = np.rint(0.5 * crown_width(heights[rows, columns]) / pixel).astype(np.int64)
    is_top = np.zeros(len(rows), bool)
    for reach in np.unique(radius):
        here = radius == reach
        cells = rows[here], columns[here]
        is_top[here] = _highest_around(rank, *cells, int(reach)) == rank[cells]
    tops = np.zeros(heights.shape, np.int32)
    tops[rows[is_top], columns[is_top]] = np.arange(1, is_top.sum() + 1)
    return tops


def crown_width(heights: np.ndarray) -> np.ndarray:
    """Usual width of the crown of a tree of some height, both in m: 2.5 + 0.009 h^2 (Popescu and Wynne 2004,
    for mixed stands).
    """
    return 2.51503 + 0.00901 * heights**2


def _highest_around(rank: np.ndarray, rows: np.ndarray, columns: np.ndarray, reach: int) -> np.ndarray:
    """(K,) largest rank within `reach` cells of each of K cells."""
    around = np.argwhere(disk(reach)) - reach
    near_rows = np.clip(rows[:, None] + around[:, 0], 0, rank.shape[0] - 1)
    near_columns = np.clip(columns[:, None] + around[:, 1], 0, rank.shape[1] - 1)
    return rank[near_rows, near_columns].max(axis=1)
