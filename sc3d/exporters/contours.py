"""Contour lines of the ground, as a GeoPackage."""

from __future__ import annotations

import logging
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import open3d as o3d
from scipy import ndimage

from sc3d.errors import InputError
from sc3d.exporters.height_grids import GroundGrid
from sc3d.exporters.packages import load
from sc3d.exporters.projected_cloud import MapProjection
from sc3d.geometry.raster import Raster
from sc3d.io.atomic import atomic_path

if TYPE_CHECKING:
    import shapely
else:
    shapely = load("shapely")

INTERVALS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
LINES = 25  # about as many levels at most, unless an interval is given
MAX_LEVELS = 2000
MAJOR = 5  # every so many levels a line is drawn bold
SMOOTHING = 1.0  # standard deviation of the Gaussian that takes the noise out of the lines, m
SHORT = 5.0  # shorter rings and ends are noise, m
STRIP = 512  # rows of cells whose lines are traced at a time

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Contour:
    """A line of equal height. line: CRS; elevation: units of the CRS; major: one of every MAJOR levels;
    interpolated: share of the line where no ground was measured.
    """

    line: shapely.LineString
    elevation: float
    major: bool
    interpolated: float


def interval_for(heights: np.ndarray, unit: float) -> float:
    """Interval, units of the CRS, that gives at most about LINES levels; heights: (H, W) m, NaN = none."""
    relief = float(np.nanmax(heights) - np.nanmin(heights)) / unit
    return next((interval for interval in INTERVALS if relief / interval <= LINES), INTERVALS[-1])


def trace_contours(ground: GroundGrid, interval: float, unit: float) -> list[Contour]:
    """The lines at multiples of the interval, from low to high; interval, unit: m per unit, units of the
    CRS.
    """
    heights = _smooth(ground.height, SMOOTHING / ground.grid.pixel) / unit
    low, high = np.nanmin(heights), np.nanmax(heights)
    levels = np.arange(np.ceil(low / interval), np.floor(high / interval) + 1).astype(np.int64)
    if len(levels) > MAX_LEVELS:
        raise InputError(
            f"--contour-interval {interval:g} gives {len(levels)} levels over {high - low:.0f}: choose a larger one"
        )
    found, short = [], 0
    for level, pieces in _segments(heights, levels, interval).items():
        # a level that the ground only touches has none
        merged = shapely.line_merge(shapely.multilinestrings(np.array(pieces).reshape(-1, 2, 2)))
        for line in shapely.get_parts(merged):
            if line.length * ground.grid.pixel < SHORT:
                short += 1
                continue
            found.append(_contour(line, level, interval, ground, unit))
    if short:
        logger.info("contours: %d lines shorter than %g m left out", short, SHORT)
    return found


def write_contours(path: Path, contours: list[Contour], projection: MapProjection) -> None:
    """One layer `contours`; elevation in units of the CRS, or the scene's meters without one."""
    raw = load("pyogrio.raw")
    logging.getLogger("pyogrio").setLevel(logging.WARNING)  # it reports every layer
    columns = [
        np.array([line.elevation for line in contours], np.float64),
        np.array([line.major for line in contours], bool),
        np.array([line.interpolated for line in contours], np.float64),
    ]
    geometry = np.array([shapely.to_wkb(line.line) for line in contours], object)
    crs = projection.crs.to_wkt() if projection.crs else None
    with atomic_path(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="'crs' was not provided")  # the export has said so
        options = {"driver": "GPKG", "geometry_type": "LineString", "crs": crs, "layer": "contours"}
        raw.write(str(temporary), geometry, columns, ["elevation", "major", "interpolated"], **options)


def _smooth(heights: np.ndarray, sigma: float) -> np.ndarray:
    """(H, W) Gaussian mean over the known cells; NaN stays."""
    known = np.isfinite(heights)
    middle = float(np.mean(heights[known]))
    sums = ndimage.gaussian_filter(np.where(known, heights - middle, 0.0), sigma, mode="nearest")
    weights = ndimage.gaussian_filter(known.astype(np.float64), sigma, mode="nearest")
    return np.where(known, sums / np.maximum(weights, 1e-9) + middle, np.nan)


def _segments(heights: np.ndarray, levels: np.ndarray, interval: float) -> dict[int, list[np.ndarray]]:
    """Pieces (2, 2) of each level's lines in columns and rows of cell centers, strip by strip."""
    pieces: dict[int, list[np.ndarray]] = {int(level): [] for level in levels}
    for first in range(0, max(heights.shape[0] - 1, 0), STRIP):
        strip = heights[first : first + STRIP + 1]
        mesh = _mesh(strip / interval, first)
        if mesh is None or not len(levels):
            continue
        lines = mesh.slice_plane([0, 0, 0], [0, 0, 1], levels.astype(np.float64).tolist())
        if "indices" not in lines.line:
            continue
        ends = lines.point.positions.numpy()[lines.line.indices.numpy()]
        for level, piece in zip(np.rint(ends[:, 0, 2]).astype(np.int64), ends[:, :, :2]):
            pieces[int(level)].append(piece)
    return pieces


def _mesh(heights: np.ndarray, first: int) -> o3d.t.geometry.TriangleMesh | None:
    """Two triangles between each four cells that all have a height; None if there are none."""
    rows, columns = np.mgrid[first : first + heights.shape[0], : heights.shape[1]].astype(np.float64)
    known = np.isfinite(heights)
    whole = known[:-1, :-1] & known[:-1, 1:] & known[1:, 1:] & known[1:, :-1]
    if not whole.any():
        return None
    # a vertex right on a level would break the lines there
    off = np.where(np.abs(heights - np.rint(heights)) < 1e-6, np.rint(heights) + 1e-6, heights)
    index = np.arange(heights.size).reshape(heights.shape)
    a, b, c, d = (index[part][whole] for part in _corners())
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices = np.stack([columns, rows, np.where(known, off, 0.0)], axis=-1).reshape(-1, 3)
    return o3d.t.geometry.TriangleMesh(o3d.core.Tensor(vertices), o3d.core.Tensor(triangles))


def _corners() -> list[tuple[slice, slice]]:
    first, last = slice(None, -1), slice(1, None)
    return [(first, first), (first, last), (last, last), (last, first)]


def _contour(
    line: shapely.LineString, level: int, interval: float, ground: GroundGrid, unit: float
) -> Contour:
    """line: columns and rows of cell centers."""
    places = np.rint(shapely.get_coordinates(line)).astype(np.int64)
    distance = ground.distance[places[:, 1], places[:, 0]]
    moved = shapely.transform(line, lambda corners: _to_crs(corners, ground.grid, unit))
    elevation = round(level * interval, 9)
    return Contour(moved, elevation, level % MAJOR == 0, round(float((distance > 0).mean()), 3))


def _to_crs(corners: np.ndarray, grid: Raster, unit: float) -> np.ndarray:
    x = grid.left + (corners[:, 0] + 0.5) * grid.pixel
    y = grid.top - (corners[:, 1] + 0.5) * grid.pixel
    return np.stack([x, y], axis=1) / unit
