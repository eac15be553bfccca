"""Heights of the ground and of the surface on a grid, from a labelled cloud that is read in parts: memory
for the cells, not for the points.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import reduce

import numpy as np
from scipy import ndimage

from sc3d.errors import InputError
from sc3d.exporters.projected_cloud import MapProjection, projected_chunks
from sc3d.exporters.terrain import CELL, ground_height, require_ground
from sc3d.geometry.ground_filter import low_objects
from sc3d.geometry.raster import Raster, close_gaps, highest_points, interpolate
from sc3d.scene.class_table import ClassTable
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export

PIXEL = 4.0  # side of a cell, in point spacings
MIN_PIXEL = 0.1  # m
NEAR = 0.4  # points of the ground farther from what the ground around says are something else, m
SKIN = 0.2  # the surface of a cell is the mean of the points this far below its highest, m
GAP = 2  # cells: holes of the surface up to about twice this wide are filled
FIXED = 1e4  # heights are summed as whole numbers of 0.1 mm: their order does not matter

logger = logging.getLogger(__name__)

Parts = Callable[[], Iterator[tuple[np.ndarray, np.ndarray]]]


@dataclass(frozen=True)
class LabelledPoints:
    """A labelled cloud to be read several times. parts: gives (N, 3) points, CRS, m, and (N,) uint8 labels
    of each part; low, high: (3,) m; spacing: of the points on the plan, m
    """

    parts: Parts
    projection: MapProjection
    low: np.ndarray
    high: np.ndarray
    spacing: float

    @property
    def usual_pixel(self) -> float:
        """Side of the cells that suits the cloud, m, to one digit."""
        return max(float(f"{PIXEL * self.spacing:.0e}"), MIN_PIXEL)


@dataclass(frozen=True)
class SurfaceGrid:
    """What is on top. height: (H, W) float64 z, m, NaN = no points; label: (H, W) uint8 class of the
    highest point, 0 = none
    """

    grid: Raster
    height: np.ndarray
    label: np.ndarray


@dataclass(frozen=True)
class GroundGrid:
    """The bare ground. height: (H, W) float64 z, m, NaN outside the cloud; distance: (H, W) from the
    nearest cell with points of the ground, m, 0 = measured, NaN outside; dropped: share of the points of
    ground classes that lie too far above or below it
    """

    grid: Raster
    height: np.ndarray
    distance: np.ndarray
    dropped: float


def read_points(scene: Scene, settings: Export) -> LabelledPoints:
    """Bounds and density of the labelled cloud; it is kept if it fits into memory."""
    chunks = projected_chunks(scene, settings)
    first, second = next(chunks), next(chunks, None)
    unit = first.projection.unit

    def parts() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for chunk in [first] if second is None else projected_chunks(scene, settings):
            yield chunk.points * unit, chunk.labels.label

    bounds = [(points.min(axis=0), points.max(axis=0)) for points, _ in parts()]
    low, high = (reduce(kind, ends) for kind, ends in zip((np.minimum, np.maximum), zip(*bounds)))
    return LabelledPoints(parts, first.projection, low, high, _spacing(parts, low, high))


def grid_of(cloud: LabelledPoints, pixel: float) -> Raster:
    """The grid around a cloud; pixel: m, 0 = what suits it."""
    return Raster.around(np.stack([cloud.low, cloud.high]), pixel or cloud.usual_pixel)


def surface_grid(cloud: LabelledPoints, grid: Raster) -> SurfaceGrid:
    """Height and class of what is on top of each cell; points beside the grid are left out."""
    size = grid.height * grid.width
    top, label = np.full(size, -np.inf), np.zeros(size, np.uint8)
    for points, labels in _within(cloud.parts, grid):
        rows = highest_points(grid, points).ravel()
        cells = np.flatnonzero(rows >= 0)
        height, of = points[rows[cells], 2], labels[rows[cells]]
        higher = (height > top[cells]) | ((height == top[cells]) & (of > label[cells]))
        top[cells[higher]], label[cells[higher]] = height[higher], of[higher]
    skin = _Means(grid)
    for points, _ in _within(cloud.parts, grid):
        cells = grid.flat_cells(points)
        skin.add(cells, points[:, 2], points[:, 2] >= top[cells] - SKIN)
    known = np.isfinite(top).reshape(grid.shape)
    rows = close_gaps(np.where(known, np.arange(size).reshape(grid.shape), -1), GAP)
    height = np.where(rows >= 0, skin.means().ravel()[rows], np.nan)
    return SurfaceGrid(grid, height, np.where(rows >= 0, label[rows], 0).astype(np.uint8))


def ground_grid(cloud: LabelledPoints, grid: Raster, table: ClassTable) -> GroundGrid:
    """The ground from the points of ground-like classes, holes interpolated; InputError if no class or no
    point is ground.
    """
    ids = require_ground(table)
    rough, covered = _Means(grid), np.zeros(grid.height * grid.width, bool)
    for points, labels in cloud.parts():
        cells = grid.flat_cells(points)
        covered[cells] = True
        rough.add(cells, points[:, 2], np.isin(labels, ids))
    if not rough.count.any():
        raise InputError("no point belongs to a ground class: label roads or grass too")
    around, slack = _expected(rough, grid)
    fine = _Means(grid)
    for points, labels in cloud.parts():
        cells = grid.flat_cells(points)
        near = np.abs(points[:, 2] - around[cells]) <= slack[cells]
        fine.add(cells, points[:, 2], np.isin(labels, ids) & near)
    return _filled(fine, rough, covered.reshape(grid.shape), grid)


def _filled(fine: _Means, rough: _Means, covered: np.ndarray, grid: Raster) -> GroundGrid:
    heights = fine.means()
    known = np.isfinite(heights)
    if not known.any():
        raise InputError("the points of ground classes lie far apart in height: check the labels")
    inside = _footprint(covered, CELL / grid.pixel)
    height = interpolate(heights, known)
    distance = ndimage.distance_transform_edt(~known) * grid.pixel
    dropped = 1.0 - fine.count[known.ravel()].sum() / rough.count.sum()
    return GroundGrid(
        grid, np.where(inside, height, np.nan), np.where(inside, distance, np.nan), float(dropped)
    )


def _expected(rough: _Means, grid: Raster) -> tuple[np.ndarray, np.ndarray]:
    """(H * W,) height that the ground around each cell says, m, and how far points may lie from it: more on
    slopes.
    """
    means = rough.means()
    known = ((rough.count > 0).reshape(grid.shape) & ~low_objects(means, grid.pixel)).ravel()
    samples = np.column_stack([grid.centers()[known], means.ravel()[known]])
    around = ground_height(samples, np.ones(len(samples), bool), grid)
    if min(grid.shape) < 2:
        return around.ravel(), np.full(around.size, NEAR)
    slope = np.hypot(*np.gradient(around, grid.pixel))
    return around.ravel(), (NEAR + slope * CELL / 2).ravel()


def _footprint(covered: np.ndarray, reach: float) -> np.ndarray:
    """(H, W) bool: cells with points, gaps up to twice `reach` cells wide closed, holes filled."""
    margin = int(reach) + 2
    near = ndimage.distance_transform_edt(~np.pad(covered, margin)) <= reach
    closed = ndimage.distance_transform_edt(np.pad(near, 1, constant_values=False)) > reach
    return ndimage.binary_fill_holes(closed[margin + 1 : -margin - 1, margin + 1 : -margin - 1] | covered)


class _Means:
    """Mean height of the points in each cell, summed up part by part."""

    def __init__(self, grid: Raster) -> None:
        self.shape = grid.shape
        self.count = np.zeros(grid.height * grid.width, np.int64)
        self.sum = np.zeros(grid.height * grid.width)

    def add(self, cells: np.ndarray, heights: np.ndarray, chosen: np.ndarray) -> None:
        """cells: (N,) int64; heights: (N,) m; chosen: (N,) bool, those that count."""
        self.count += np.bincount(cells[chosen], minlength=self.count.size)
        fixed = np.rint(heights[chosen] * FIXED)
        self.sum += np.bincount(cells[chosen], fixed, minlength=self.count.size)

    def means(self) -> np.ndarray:
        """(H, W) float64 m, NaN where there are no points."""
        means = np.full(self.count.size, np.nan)
        np.divide(self.sum / FIXED, self.count, out=means, where=self.count > 0)
        return means.reshape(self.shape)


def _within(parts: Parts, grid: Raster) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The points over a grid."""
    right, bottom = grid.left + grid.width * grid.pixel, grid.top - grid.height * grid.pixel
    for points, labels in parts():
        x, y = points[:, 0], points[:, 1]
        inside = (x >= grid.left) & (x <= right) & (y >= bottom) & (y <= grid.top)
        if inside.any():
            yield (points, labels) if inside.all() else (points[inside], labels[inside])


def _spacing(parts: Parts, low: np.ndarray, high: np.ndarray) -> float:
    """Usual distance of the points on the plan, m: from how many lie in blocks of CELL."""
    blocks = Raster.around(np.stack([low, high]), CELL)
    counts = np.zeros(blocks.height * blocks.width, np.int64)
    for points, _ in parts():
        counts += np.bincount(blocks.flat_cells(points), minlength=counts.size)
    return CELL / float(np.sqrt(np.median(counts[counts > 0])))
