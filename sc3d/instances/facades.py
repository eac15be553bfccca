"""Buildings of which only walls show, as from a street: strips of cells too narrow for a roof."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from sc3d.geometry.raster import Raster
from sc3d.instances.buildings import STEP
from sc3d.instances.regions import connected_cells, disk, renumbered

GAP = 0.4  # gaps of a wall narrower than about twice this are closed, m
BESIDE = 3.0  # walls this near to a roof are its own, or cut off by a crown, m
MIN_LENGTH, MIN_RISE = 2.0, 2.0  # of a wall that stands for a building, m


def find_facades(tops: np.ndarray, lows: np.ndarray, buildings: np.ndarray, grid: Raster) -> np.ndarray:
    """(H, W) int32 the buildings numbered from 1, and those of which only walls show, split where their
    tops part.

    tops: (H, W) z of the highest building point above the ground, m, -inf = none; lows: of the lowest, inf
    = none
    """
    far = (
        ndimage.distance_transform_edt(buildings == 0) * grid.pixel > BESIDE
        if buildings.any()
        else np.ones(grid.shape, bool)
    )
    walls = np.isfinite(tops) & far
    if not walls.any():
        return buildings
    shape = disk(GAP / grid.pixel)
    margin = len(shape)
    closed = ndimage.binary_closing(np.pad(walls, margin), shape)[margin:-margin, margin:-margin] | walls
    nearest = tuple(ndimage.distance_transform_edt(~walls, return_distances=False, return_indices=True))
    strips = ndimage.label(closed, np.ones((3, 3)))[0]
    # a wall is as high as its highest points along a meter: ledges and windows are no steps
    width = max(1, round(1.0 / grid.pixel)) | 1
    heights = ndimage.maximum_filter(np.where(walls, tops, -np.inf)[nearest], width)
    parts = connected_cells(np.where(closed, strips, 0), heights, STEP)
    rises = ndimage.maximum(tops, parts, np.arange(parts.max() + 1)) - ndimage.minimum(
        lows, parts, np.arange(parts.max() + 1)
    )
    kept = (rises[parts] >= MIN_RISE) & (_lengths(parts, grid.pixel)[parts] >= MIN_LENGTH) & (parts > 0)
    return renumbered(np.where(buildings > 0, buildings, np.where(kept, parts + buildings.max(), 0)))


def _lengths(parts: np.ndarray, pixel: float) -> np.ndarray:
    """(P + 1,) m along the longer side of the box around each part."""
    boxes = ndimage.find_objects(parts)
    return np.array(
        [0.0] + [max(side.stop - side.start for side in box) * pixel if box else 0.0 for box in boxes]
    )
