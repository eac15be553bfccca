"""Trees on a grid: the canopy height model, its tops, and the crown around each top."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from sc3d.geometry.raster import Raster, close_gaps
from sc3d.instances.regions import disk, renumbered

GAP = 0.5  # gaps of the canopy narrower than about twice this are filled, m
SMOOTHING = 0.4  # standard deviation of the Gaussian that joins the lobes of a crown, m
UNDER = 0.5  # tree points this far below the top of their cell are not canopy, m
MIN_CROWN = 2.0  # m2


def canopy_height(trees: np.ndarray, tops: np.ndarray, ground: np.ndarray, pixel: float) -> np.ndarray:
    """(H, W) float64 height of the canopy above the ground, m; NaN where nothing or something else is on top.

    trees, tops: (H, W) z of the highest tree point, and of the highest point, m, -inf = none; ground: (H,
        W) z of the ground, m; pixel: side of the cells, m
    """
    with np.errstate(invalid="ignore"):  # of cells without points
        canopy = np.isfinite(trees) & (trees >= tops - UNDER)
    cells = np.where(canopy.ravel(), np.arange(trees.size), -1).reshape(trees.shape)
    nearest = close_gaps(cells, round(GAP / pixel))
    return np.where(nearest >= 0, trees.ravel()[nearest] - ground, np.nan)


def split_crowns(canopy: np.ndarray, grid: Raster, min_height: float) -> np.ndarray:
    """(H, W) int32 number of the tree in each cell, 0 = none: the watershed of the smoothed canopy around its
    tops.

    canopy: (H, W) m, NaN = none; min_height: lower plants are not trees, m
    """
    tall = canopy >= min_height
    heights = smoothed(np.where(tall, canopy, 0.0), tall, SMOOTHING / grid.pixel)
    crowns = watershed(heights, tall, grid.pixel)
    kept = np.bincount(crowns.ravel())[crowns] * grid.pixel**2 >= MIN_CROWN
    return renumbered(np.where(kept, crowns, 0))


def smoothed(heights: np.ndarray, known: np.ndarray, sigma: float) -> np.ndarray:
    """(H, W) Gaussian mean over the known cells; 0 elsewhere."""
    weight = ndimage.gaussian_filter(known.astype(np.float64), sigma, mode="constant")
    mean = ndimage.gaussian_filter(np.where(known, heights, 0.0), sigma, mode="constant")
    return np.where(known, mean / np.maximum(weight, 1e-9), 0.0)


def watershed(heights: np.ndarray, tall: np.ndarray, pixel: float) -> np.ndarray:
    """(H, W) int32 number from 1 of the top that each tall cell climbs to, 0 = not tall.

    A cell steps to the highest of its neighbors; from a local maximum on to the highest cell within half the
    usual width of a crown of that height; where there is none, it is a top. heights: (H, W) m; equal heights
    are decided by place.
    """
    # scikit-image's watershed around the same tops: on 11 synthetic sites as many trees (371 of 386) and an
    # IoU of the crowns of 0.598 for 0.596; with noise of 5 cm and 2 % wrong labels 370 trees for 372, 0.594
    # for 0.597; 11 s for 6 s on 9 million cells: not worth another 30 MB
    order = np.lexsort((np.arange(heights.size), np.where(tall, heights, -np.inf).ravel()))
    rank = np.empty(heights.shape, np.int64)
    rank.ravel()[order] = np.arange(heights.size)
    target = ndimage.maximum_filter(rank, 3, mode="nearest")
    rows, columns = np.nonzero(tall & (target == rank))  # local maxima
    radius = np.rint(0.5 * crown_width(heights[rows, columns]) / pixel).astype(np.int64)
    for reach in np.unique(radius):
        here = rows[radius == reach], columns[radius == reach]
        target[here] = _highest_around(rank, *here, int(reach))
    target = order[target.ravel()]
    while True:
        further = target[target]
        if (further == target).all():
            break
        target = further
    return renumbered(np.where(tall, target.reshape(heights.shape) + 1, 0))


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
