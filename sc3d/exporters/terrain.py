"""The height of the bare ground from the points of ground classes, also under buildings and trees."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from sc3d.errors import InputError
from sc3d.geometry.raster import Raster, interpolate
from sc3d.scene.class_table import ClassTable

LOW, MEDIUM, HIGH = 3, 4, 5  # ASPRS codes of vegetation
GROUND = (2, LOW, 9, 10, 11)  # of ground, low vegetation, water, rail, road
CELL = 2.0  # side of the blocks whose median is the ground, m
# ground that stands out of the lowest of this surrounding by more than STEP is a mislabelled roof or crown, m
WINDOW = 15.0
STEP = 1.5
RADII = (1.0, 2.0, 4.0, 8.0, 15.0)  # of what may stand on the ground, from small to large, m
SLOPE, BUMP = 0.05, 0.2  # of the ground itself: m per m, beside the slope around; m
SUPPORT = 0.25  # blocks with less than this share of the usual number of ground points rest on strays


def tree_codes(table: ClassTable) -> set[int]:
    """ASPRS codes of trees: medium and high vegetation; low if no class has those."""
    codes = {entry.asprs for entry in table}
    return {MEDIUM, HIGH} if {MEDIUM, HIGH} & codes else {LOW}


def ground_classes(table: ClassTable) -> list[int]:
    """Ids of the ground-like classes, by their ASPRS codes."""
    wanted = set(GROUND) - tree_codes(table)
    return [entry.id for entry in table if entry.asprs in wanted]


def require_ground(table: ClassTable) -> list[int]:
    """The same; InputError if there are none."""
    ids = ground_classes(table)
    if not ids:
        raise InputError(
            "no class is ground by its ASPRS code (2 ground, 3 low vegetation beside trees, 9 water, 10 rail, "
            '11 road): add "asprs" to the classes in classes.json'
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


def low_objects(heights: np.ndarray, pixel: float) -> np.ndarray:
    """(H, W) bool: cells that stand on the ground, as cars, hedges and roofs that were labelled as ground
    do: the simple morphological filter of Pingel et al. (2013), which allows for the slope around.

    heights: (H, W) m, NaN = none; pixel: side of the cells, m
    """
    left = heights.copy()
    for radius in RADII:
        opened = _opened(left, 2 * round(radius / pixel) + 1)
        allowed = SLOPE + _steepest(opened, radius, pixel)
        left[left > opened + BUMP + radius * allowed] = np.nan
    return np.isfinite(heights) & np.isnan(left)


def _steepest(opened: np.ndarray, radius: float, pixel: float) -> np.ndarray:
    """(H, W) steepest slope of an opened surface (H, W), m per m, within reach of the flat tops that an
    opening by `radius`, m, leaves.
    """
    if min(opened.shape) < 2:
        return np.zeros(opened.shape)
    filled = interpolate(opened, np.isfinite(opened))
    smooth = ndimage.gaussian_filter(filled, min(radius / 2, CELL) / pixel, mode="nearest")
    slope = np.hypot(*np.gradient(smooth, pixel))
    return ndimage.maximum_filter(slope, 4 * round(radius / pixel) + 1, mode="nearest")


def _opened(heights: np.ndarray, size: int) -> np.ndarray:
    """(H, W) the opening by a square of `size` cells; NaN counts nowhere, and stays where all around is
    NaN.
    """
    low = ndimage.grey_erosion(np.where(np.isfinite(heights), heights, np.inf), (size, size), mode="nearest")
    high = ndimage.grey_dilation(np.where(np.isfinite(low), low, -np.inf), (size, size), mode="nearest")
    return np.where(np.isfinite(high), high, np.nan)


def _stands_out(medians: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(H, W) bool blocks higher above an opening of the ground than STEP; the opening flattens hills by
    less.
    """
    size = round(WINDOW / CELL) | 1
    return known & (medians > _opened(np.where(known, medians, np.nan), size) + STEP)


def _corners(grid: Raster) -> np.ndarray:
    return np.array(
        [[grid.left, grid.top], [grid.left + grid.width * grid.pixel, grid.top - grid.height * grid.pixel]]
    )
