"""Ground, low vegetation, high vegetation, building or none of them: by height above the ground, shape and
color. Nothing is learned; every length is in meters, measured or estimated by
`sc3d.segmentation.shape.frame`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.special import expit

from sc3d.errors import InputError
from sc3d.geometry.graph import Graph, build_graph
from sc3d.geometry.ground_filter import RADII, low_objects
from sc3d.geometry.raster import Raster, interpolate

GROUND, LOW_VEGETATION, HIGH_VEGETATION, BUILDING, NONE = range(5)
MIN_POINTS = 100
NEIGHBORS = 16
CELL, MAX_SIDE = 0.5, 4096  # of the raster of the ground: m; cells
WIDEST = (*RADII, 30.0)  # of what may stand on the ground, from small to large, m
USUAL = 70  # per cent of the slopes around that are no steeper than the ground
PITS = (1.0, 2.0)  # half widths of what lies below the ground by mistake, m
FLAT = 0.5  # |cosine| to up of what may be ground: slopes to 60 degrees
# height above the ground from which something stands on it, and from which it is no car or fence; both m, with
# the standard deviations of the heights
STANDS, STANDS_WIDTH = 0.5, 0.15
HIGH, HIGH_WIDTH = 2.0, 0.4
# excess of green over red and blue as a share of all light, where vegetation is as likely as not
GREEN, GREEN_WIDTH = 0.05, 0.02
# mean distance from the tangent plane, over the distance of the farthest neighbor, where leaves are as likely
# as a surface
ROUGH, ROUGH_WIDTH = 0.15, 0.03
SMOOTH = 0.1  # of the same, what may be ground; crowns seen from above are rougher
BUSH, BUSH_WIDTH, AROUND = (
    0.12,
    0.02,
    5.0,
)  # of the same, leaves that are no lawn; of plants this far around, m
LIMIT = 4.0  # of each piece of evidence, log-odds
EVEN = 0.16  # standard deviation of the logarithm of light, beyond which it is more likely leaves than lawn
SPREAD = 3  # times that evidence is shared with the neighbors


@dataclass(frozen=True)
class Thinned:
    """One point per cube. points: (N, 3) mean positions, m, up is z; colors: (N, 3) 0 to 255, None = not
    known; rows: (M,) int cube of each of the M points that went in
    """

    points: np.ndarray
    colors: np.ndarray | None
    rows: np.ndarray

    @classmethod
    def from_points(cls, points: np.ndarray, colors: np.ndarray | None, side: float) -> Thinned:
        """points: (M, 3) m, in any order; colors: (M, 3) uint8 or None; side: of the cubes, m"""
        cubes = np.floor((points - points.min(axis=0)) / side).astype(np.int64)
        sizes = cubes.max(axis=0) + 1
        keys = (cubes[:, 0] * sizes[1] + cubes[:, 1]) * sizes[2] + cubes[:, 2]
        _, rows, counts = np.unique(keys, return_inverse=True, return_counts=True)
        order = np.lexsort(points.T)  # sums depend on it

        def means(values: np.ndarray) -> np.ndarray:
            return np.stack([np.bincount(rows[order], column[order]) / counts for column in values.T], axis=1)

        return cls(means(points), None if colors is None else means(colors.astype(np.float64)), rows)


@dataclass(frozen=True)
class Relief:
    """Ground below points. height: (N,) of each above it, m; grid: of the raster; ground: (H, W) m"""

    height: np.ndarray
    grid: Raster
    ground: np.ndarray


def classify(points: np.ndarray, colors: np.ndarray | None) -> np.ndarray:
    """(N, 5) float32 probabilities of GROUND, LOW_VEGETATION, HIGH_VEGETATION, BUILDING and NONE of them.

    points: (N, 3) m, up is z; colors: (N, 3) 0 to 255, None = not known: then low vegetation is not told from
        the ground, and high vegetation by its roughness alone
    Raises InputError for fewer than MIN_POINTS points.
    """
    require_enough(points)
    graph = build_graph(points, None, NEIGHBORS)
    points = points[graph.order]
    steep, rough = 1 - np.abs(graph.normals[:, 2]), _shared(graph, graph.roughness)
    flat, ruffled, green = steep < 1 - FLAT, rough, None
    relief = find_relief(points, flat & (rough < SMOOTH))
    if colors is not None:  # once more, without the smooth places of woods
        colors = colors[graph.order].astype(np.float64)
        green = _shared(graph, _green_odds(colors))
        leafy = rough + (_shared(graph, _unevenness(graph, colors)) - EVEN) / 2
        plants = expit(green)
        around = _surroundings(points, leafy, plants * (1 - _standing(relief)))
        ruffled = rough + plants * ((leafy + 2 * around) / 3 - rough)
        relief = find_relief(points, flat & (ruffled < SMOOTH))
    result = np.empty((len(points), 5), np.float32)
    result[graph.order] = _combined(points, relief, steep, green, rough, ruffled)
    return result


def require_enough(points: np.ndarray) -> None:
    """InputError for fewer than MIN_POINTS points (N, 3)."""
    if len(points) < MIN_POINTS:
        raise InputError(
            f"the cloud has {len(points)} points: --backend geometry needs at least {MIN_POINTS} to tell shapes apart"
        )


def find_relief(points: np.ndarray, flat: np.ndarray) -> Relief:
    """The ground below points (N, 3), m; flat: (N,) bool, those that may be ground. Without any, the lowest
    point is the ground.
    """
    grid = Raster.around(points, _cell(points))
    lowest = np.full(grid.height * grid.width, np.inf)
    np.minimum.at(lowest, grid.flat_cells(points[flat]), points[flat, 2])
    heights = np.where(np.isfinite(lowest), lowest, np.nan).reshape(grid.shape)
    heights[low_objects(-heights, grid.pixel, PITS)] = np.nan
    known = np.isfinite(heights) & ~low_objects(heights, grid.pixel, WIDEST, USUAL)
    if known.any():
        ground = interpolate(heights, known)
    else:
        ground = np.full(grid.shape, points[:, 2].min())
    places = [(grid.top - points[:, 1]) / grid.pixel - 0.5, (points[:, 0] - grid.left) / grid.pixel - 0.5]
    below = ndimage.map_coordinates(ground, places, order=1, mode="nearest")
    return Relief(points[:, 2] - below, grid, ground)


def _combined(
    points: np.ndarray,
    relief: Relief,
    steep: np.ndarray,
    green: np.ndarray | None,
    rough: np.ndarray,
    ruffled: np.ndarray,
) -> np.ndarray:
    """Probabilities as `classify`. steep: (N,) 0 = level, 1 = upright; green: (N,) log-odds of vegetation;
    rough, ruffled: (N,) roughness, and that of the plants around
    """
    leaves = _odds(rough, ROUGH, ROUGH_WIDTH)
    stands = _standing(relief)
    plant = expit(leaves if green is None else green + leaves / 2)
    low = np.zeros(len(points)) if green is None else expit(green)
    bush = expit((ruffled - BUSH) / BUSH_WIDTH)
    tall = expit((relief.height - HIGH) / HIGH_WIDTH)
    foot = _built_above(points, relief, plant) * expit((steep - 0.7) / 0.1)
    wall, built = np.maximum(tall, foot), stands * (1 - plant)
    return np.stack(
        [
            (1 - stands) * (1 - low),
            (1 - stands) * low * (1 - bush),
            stands * plant + (1 - stands) * low * bush,
            built * wall,
            built * (1 - wall),
        ],
        axis=1,
    ).astype(np.float32)


def _standing(relief: Relief) -> np.ndarray:
    """(N,) probability that a point stands on the ground, and is none of it."""
    return expit((relief.height - STANDS) / STANDS_WIDTH)


def _unevenness(graph: Graph, colors: np.ndarray) -> np.ndarray:
    """(N,) standard deviation of the logarithm of the light of the neighbors; colors: (N, 3) 0 to 255."""
    links = graph.sparse()
    links.data[:] = 1
    light, count = np.log(np.maximum(colors.sum(axis=1), 20.0)), np.diff(graph.starts) + 1
    mean, squared = ((links @ values + values) / count for values in (light, light**2))
    return np.sqrt(np.maximum(squared - mean**2, 0))


def _surroundings(points: np.ndarray, values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(N,) mean of values (N,) around each point, seen from above, those of the points without any around;
    weights: (N,) >= 0
    """
    grid = Raster.around(points, _cell(points))
    cells, size = grid.flat_cells(points), max(3, 2 * round(AROUND / 2 / grid.pixel) + 1)
    sums = [
        ndimage.uniform_filter(
            np.bincount(cells, share, grid.height * grid.width).reshape(grid.shape), size
        ).ravel()
        for share in (weights, weights * values)
    ]
    some = sums[0][cells] > 1e-6
    return np.where(some, sums[1][cells] / np.maximum(sums[0][cells], 1e-6), values)


def _cell(points: np.ndarray) -> float:
    """Side of the cells of the raster below points (N, 3), m."""
    return max(CELL, float(np.ptp(points[:, :2], axis=0).max()) / MAX_SIDE)


def _built_above(points: np.ndarray, relief: Relief, plant: np.ndarray) -> np.ndarray:
    """(N,) share of the high points within a cell of each point, seen from above, that are no plants."""
    tall = relief.height > HIGH + HIGH_WIDTH
    cells, size = relief.grid.flat_cells(points[tall]), relief.grid.height * relief.grid.width
    count, built = (
        ndimage.uniform_filter(np.bincount(cells, weights, size).reshape(relief.grid.shape), 3).ravel()
        for weights in (np.ones(len(cells)), 1 - plant[tall])
    )
    here = relief.grid.flat_cells(points)
    return built[here] / np.maximum(count[here], 1 / 9)


def _green_odds(colors: np.ndarray) -> np.ndarray:
    """(N,) log-odds of vegetation from colors (N, 3)."""
    light = np.maximum(colors.sum(axis=1), 1.0)
    return _odds((2 * colors[:, 1] - colors[:, 0] - colors[:, 2]) / light, GREEN, GREEN_WIDTH)


def _odds(values: np.ndarray, middle: float, width: float) -> np.ndarray:
    return np.clip((values - middle) / width, -LIMIT, LIMIT)


def _shared(graph: Graph, values: np.ndarray) -> np.ndarray:
    """Values (N,) as the mean over the neighbors, several times over."""
    weights = graph.sparse()
    total = np.asarray(weights.sum(axis=1)).ravel() + 1
    for _ in range(SPREAD):
        values = (weights @ values + values) / total
    return values
