"""Which object each point belongs to: a map of the objects of every countable class, seen from above, in
passes over the cloud that do not depend on the order of the points or on how many are read at a time.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from sc3d.geometry.raster import Raster
from sc3d.instances.buildings import roof_heights, split_buildings
from sc3d.instances.facades import find_facades
from sc3d.instances.kinds import Kind, countable_kinds, ground_ids
from sc3d.instances.regions import connected_cells, disk, renumbered
from sc3d.instances.terrain import ground_height
from sc3d.instances.trees import canopy_height, split_crowns
from sc3d.scene.class_table import ClassTable

MIN_HEIGHT, MIN_AREA = 2.0, 10.0  # lower buildings and plants are not counted, m; smaller buildings, m2
MIN_PART, PART_GAP = (
    0.5,
    0.3,
)  # parts of other classes: smallest, m2; gaps narrower than about twice this do not part
REACH = 1.0  # points beside an object's cells, up to here, are of it: walls, low branches, m
BLOCKS, CELL, MIN_CELL = (
    128,
    1.5,
    0.05,
)  # blocks along the extent, for the spacing; side of a cell in spacings, and m
MAX_CELLS = 1 << 22  # larger sites get larger cells, so that all arrays stay below a gigabyte

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Chunk:
    """Some points of a cloud. points: (N, 3) m, z up; label: (N,) uint8 ids; sure: (N,) bool, of surface that
    several photos confirm
    """

    points: np.ndarray
    label: np.ndarray
    sure: np.ndarray


Chunks = Callable[[], Iterator[Chunk]]  # reads the cloud from its start


@dataclass(frozen=True)
class Tops:
    """What stands on each cell of a grid, (H, W) each, z in m, -inf = nothing.

    ground: z of the ground; all: highest point; kinds: highest point of each kind, with roofs only those
    above the ground; lows: the lowest point of each kind, inf = nothing; above, roofs: number of points
    above the ground, and of them that are of buildings
    """

    grid: Raster
    ground: np.ndarray
    all: np.ndarray
    kinds: list[np.ndarray]
    lows: list[np.ndarray]
    above: np.ndarray
    roofs: np.ndarray

    @property
    def roof_share(self) -> np.ndarray:
        """Of the points above the ground, those of buildings."""
        return self.roofs / np.maximum(self.above, 1)


@dataclass(frozen=True)
class ObjectMap:
    """regions: of each kind, (H, W) int32 number of the object in each cell, 0 = none; no number is used
    twice.
    why: without a map, the reason
    """

    kinds: Sequence[Kind] = ()
    grid: Raster | None = None
    regions: Sequence[np.ndarray] = ()
    tops: Tops | None = None
    why: str = ""

    def find(self, points: np.ndarray, label: np.ndarray) -> np.ndarray:
        """(N,) uint32 object of each point, 0 = none. points: (N, 3) m; label: (N,) uint8 ids."""
        found = np.zeros(len(points), np.uint32)
        for kind, regions in zip(self.kinds, self.regions, strict=True):
            if self.grid is not None:
                rows = np.flatnonzero(np.isin(label, kind.ids) & self.grid.holds(points))
                found[rows] = regions.ravel()[self.grid.flat_cells(points[rows])]
        return found

    def counts(self, table: ClassTable) -> dict[str, int]:
        """Objects of each kind, by the name of its first class."""
        numbers = [len(np.unique(regions[regions > 0])) for regions in self.regions]
        return {table.name(kind.ids[0]): count for kind, count in zip(self.kinds, numbers, strict=True)}


def map_objects(
    chunks: Chunks,
    table: ClassTable,
    refine: Callable[[Tops, int, Kind, np.ndarray], np.ndarray] | None = None,
) -> ObjectMap:
    """Tell the objects of a cloud apart. refine: what photos say of the regions (H, W) of a kind, from 1."""
    kinds = countable_kinds(table)
    counts, low, high = _survey(chunks)
    kinds = [kind for kind in kinds if counts[list(kind.ids)].any()]
    if not kinds:
        return ObjectMap()
    ground = ground_ids(table, counts)
    if not ground:
        return ObjectMap(why="no point belongs to a ground class, from which heights are measured")
    grid = _grid(chunks, low, high)
    heights = ground_height(*_lowest(chunks, ground, grid), grid)
    tops = measure(chunks, kinds, grid, heights, MIN_HEIGHT)
    regions, used = [], 0
    for number, kind in enumerate(kinds):
        found = split(tops, number, kind)
        found = found if refine is None else refine(tops, number, kind, found)
        regions.append(np.where(found > 0, found + used, 0).astype(np.int32))
        used += int(found.max())
    reached = [_grown(found, REACH / grid.pixel) for found in regions]
    return ObjectMap(kinds, grid, reached, tops)


def split(tops: Tops, number: int, kind: Kind) -> np.ndarray:
    """(H, W) int32 regions from 1 of one of the kinds of `tops`; also of buildings of which only walls
    show.
    """
    covered, heights = cover(tops, number, kind)
    found = split_covered(covered, heights, tops.grid, kind, (MIN_HEIGHT, MIN_AREA))
    if kind.how == "roofs":
        return find_facades(tops.kinds[number], tops.lows[number], found, tops.grid)
    return found


def cover(tops: Tops, number: int, kind: Kind) -> tuple[np.ndarray, np.ndarray]:
    """Cells that a kind covers, gaps closed, (H, W) bool, and its height there, (H, W) m: z, but of crowns
    above the ground; NaN elsewhere.
    """
    grid, highest = tops.grid, tops.kinds[number]
    if kind.how == "roofs":
        return roof_heights(highest, tops.roof_share, grid.pixel)
    if kind.how == "crowns":
        canopy = canopy_height(highest, tops.all, tops.ground, grid.pixel)
        return np.isfinite(canopy), canopy
    covered = close_parts(np.isfinite(highest), grid.pixel)
    nearest = ndimage.distance_transform_edt(
        ~np.isfinite(highest), return_distances=False, return_indices=True
    )
    return covered, np.where(covered, highest[tuple(nearest)], np.nan)


def split_covered(
    covered: np.ndarray, heights: np.ndarray, grid: Raster, kind: Kind, least: tuple[float, float]
) -> np.ndarray:
    """(H, W) int32 regions from 1 of what `cover` returns. least: height of plants, m, and area of
    buildings, m2
    """
    if kind.how == "roofs":
        return split_buildings(covered, heights, grid, least[1])
    return split_crowns(heights, grid, least[0]) if kind.how == "crowns" else split_parts(covered, grid)


def close_parts(occupied: np.ndarray, pixel: float) -> np.ndarray:
    """(H, W) bool the occupied cells (H, W) bool and narrow gaps between them."""
    shape = disk(PART_GAP / pixel)
    margin = len(shape)
    return ndimage.binary_closing(np.pad(occupied, margin), shape)[margin:-margin, margin:-margin] | occupied


def split_parts(covered: np.ndarray, grid: Raster) -> np.ndarray:
    """(H, W) int32 connected parts from 1 of the covered cells (H, W) bool; small ones vanish."""
    parts = connected_cells(covered.astype(np.int32), np.zeros(grid.shape), np.inf)
    large = np.bincount(parts.ravel())[parts] * grid.pixel**2 >= MIN_PART
    return renumbered(np.where(large, parts, 0))


def _survey(chunks: Chunks) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(256,) labelled sure points of each class, and the corners (2,) of the box around them, m."""
    counts, low, high = np.zeros(256, np.int64), np.full(2, np.inf), np.full(2, -np.inf)
    for chunk in chunks():
        kept = chunk.sure & (chunk.label > 0)
        if kept.any():
            counts += np.bincount(chunk.label[kept], minlength=256)
            places = chunk.points[kept, :2]
            low, high = np.minimum(low, places.min(axis=0)), np.maximum(high, places.max(axis=0))
    return counts, low, high


def _grid(chunks: Chunks, low: np.ndarray, high: np.ndarray) -> Raster:
    """Cells a little wider than the points of the box from `low` to `high` (2,), m, lie apart, as most of its
    blocks have them.
    """
    corners = np.array([low, high])
    blocks = Raster.around(corners, max(float((high - low).max()) / BLOCKS, MIN_CELL))
    counts = np.zeros(blocks.height * blocks.width, np.int64)
    for chunk in chunks():
        kept = chunk.sure & (chunk.label > 0)
        counts += np.bincount(blocks.flat_cells(chunk.points[kept]), minlength=len(counts))
    spacing = blocks.pixel / np.sqrt(np.median(counts[counts > 0]))
    least = np.sqrt(np.prod(high - low + blocks.pixel) / MAX_CELLS)
    return Raster.around(corners, float(f"{max(CELL * spacing, MIN_CELL, least):.3g}"))


def _lowest(chunks: Chunks, ground: list[int], grid: Raster) -> tuple[np.ndarray, np.ndarray]:
    """The lowest point of the ground's classes in each cell, at its center: (K, 3) m, and (K,) True."""
    lowest = np.full(grid.height * grid.width, np.inf)
    for chunk in chunks():
        kept = chunk.sure & np.isin(chunk.label, ground)
        np.minimum.at(lowest, grid.flat_cells(chunk.points[kept]), chunk.points[kept, 2])
    some = np.isfinite(lowest)
    return np.column_stack([grid.centers()[some], lowest[some]]), np.ones(int(some.sum()), bool)


def measure(
    chunks: Chunks, kinds: Sequence[Kind], grid: Raster, ground: np.ndarray, min_height: float
) -> Tops:
    """What the sure points of a cloud leave on the cells of a grid. ground: (H, W) z of the ground, m;
    min_height: lower is not above the ground, m
    """
    size = grid.height * grid.width
    highest = np.full((len(kinds) + 1, size), -np.inf)
    lows, counts = np.full((len(kinds), size), np.inf), np.zeros((2, size), np.int64)
    for chunk in chunks():
        kept = chunk.sure & grid.holds(chunk.points)
        points, label = chunk.points[kept], chunk.label[kept]
        cells = grid.flat_cells(points)
        tall_enough = points[:, 2] >= ground.ravel()[cells] + min_height
        np.maximum.at(highest[-1], cells, points[:, 2])
        counts[0] += np.bincount(cells[tall_enough], minlength=size)
        for number, kind in enumerate(kinds):
            chosen = np.isin(label, kind.ids)
            np.minimum.at(lows[number], cells[chosen], points[chosen, 2])
            if kind.how == "roofs":
                chosen &= tall_enough
                counts[1] += np.bincount(cells[chosen], minlength=size)
            np.maximum.at(highest[number], cells[chosen], points[chosen, 2])
    tall, low = (list(values.reshape(-1, *grid.shape)) for values in (highest, lows))
    above, roofs = counts.reshape(2, *grid.shape)
    return Tops(grid, ground, tall[-1], tall[:-1], low, above, roofs)


def _grown(regions: np.ndarray, reach: float) -> np.ndarray:
    """(H, W) int32 the regions, and cells within `reach` cells of one, which are of the nearest."""
    if not regions.any():
        return regions
    distance, nearest = ndimage.distance_transform_edt(regions == 0, return_indices=True)
    return np.where(distance <= reach, regions[tuple(nearest)], 0).astype(np.int32)
