"""The height of the bare ground from the points of ground classes, also under buildings and trees."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from sc3d.errors import InputError
from sc3d.geometry.ground_filter import opened
from sc3d.geometry.raster import Raster, interpolate
from sc3d.scene.class_table import ClassTable

CELL = 2.0  # side of the blocks whose median is the ground, m
# ground that stands out of the lowest of this surrounding by more than STEP is a mislabelled roof or crown, m
WINDOW = 15.0
STEP = 1.5
SUPPORT = 0.25  # blocks with less than this share of the usual number of ground points rest on strays


def require_ground(table: ClassTable) -> list[int]:
    """Ids of the ground-like classes of a table; InputError if there are none."""
    ids = table.ground_classes
    if not ids:
        raise InputError(
            "no class is ground by its ASPRS code (2 ground, 3 low vegetation beside trees, 9 water, "
            '10 rail, 11 road): add "asprs" to the classes in classes.json'
        )
    return ids


def ground_height(points: np.ndarray, is_ground: np.ndarray, grid: Raster) -> np.ndarray:
    """(H, W) float64 height of the ground at the cell centers of `grid`, m: block medians, interpolated
    across gaps.

    points: (N, 3) CRS in m; is_ground: (N,) bool, at least one True
    """
    blocks = Raster.around(_corners(grid), CELL)
    ground = points[is_ground]
    cells = blocks.flat_cells(ground)
    count = np.bincount(cells, minlength=blocks.height * blocks.width).reshape(blocks.shape)
    medians = block_medians(cells, ground[:, 2], count.size).reshape(blocks.shape)
    known = count >= SUPPORT * np.median(count[count > 0])
    known &= ~_stands_out(medians, known)
    smooth = interpolate(medians, known)
    centers = grid.centers()
    coordinates = [(blocks.top - centers[:, 1]) / CELL - 0.5, (centers[:, 0] - blocks.left) / CELL - 0.5]
    return ndimage.map_coordinates(smooth, coordinates, order=1, mode="nearest").reshape(grid.shape)


def block_medians(blocks: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """(count,) float64 median of the values (N,) in each block, the lower of the middle two; blocks: (N,)
    int. NaN where a block is empty.
    """
    order = np.lexsort((values, blocks))
    sizes = np.bincount(blocks, minlength=count)
    ends = np.cumsum(sizes)
    medians = np.full(count, np.nan)
    some = sizes > 0
    medians[some] = values[order][(ends - sizes + (sizes - 1) // 2)[some]]
    return medians


def _stands_out(medians: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(H, W) bool blocks higher above an opening of the ground than STEP; the opening flattens hills by
    less.
    """
    size = round(WINDOW / CELL) | 1
    return known & (medians > opened(np.where(known, medians, np.nan), size) + STEP)


def _corners(grid: Raster) -> np.ndarray:
    return np.array(
        [[grid.left, grid.top], [grid.left + grid.width * grid.pixel, grid.top - grid.height * grid.pixel]]
    )
