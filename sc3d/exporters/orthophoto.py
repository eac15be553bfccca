"""Maps from straight above as GeoTIFF: colors, classes with their palette, heights of the surface."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import open3d as o3d

from sc3d.exporters.geotiff import (
    NO_HEIGHT,
    TILE,
    add_overviews,
    category_names,
    enums,
    open_geotiff,
    set_palette,
)
from sc3d.exporters.packages import load
from sc3d.exporters.projected_cloud import BYTES, MapProjection, projected_chunks, read_projected_cloud
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.geometry.raster import Raster, close_gaps, highest_points, spacing_of_all
from sc3d.geometry.raycast import Surface
from sc3d.io.atomic import atomic_path
from sc3d.io.clouds import read_mesh
from sc3d.io.memory_limit import BASE
from sc3d.io.progress import progress
from sc3d.scene.class_table import ClassTable
from sc3d.scene.cloud_parts import read_thinned
from sc3d.scene.labelled_cloud import REACH, spacing_of
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export
from sc3d.tiling.first_surfaces import read_triangles
from sc3d.tiling.memory import fits, memory_of, num_points, surface_bytes

windows = load("rasterio.windows")

COLOR, CLASSES, HEIGHT = "orthophoto.tif", "classes.tif", "height.tif"
NAMES = "classes.tif.aux.xml"  # where GDAL keeps names of categories
GAP = 2  # cells: holes of a bare cloud up to about twice this wide are filled
BORDER = 4 * GAP  # rows around a strip that filling its holes looks at
SAMPLE = 300_000  # points that tell the spacing of a cloud on disk
UNEVEN = 1.5  # times the mean that a strip may need
Parts = Callable[[], Iterator[tuple[np.ndarray, np.ndarray, np.ndarray | None]]]


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / name for name in (COLOR, CLASSES, NAMES, HEIGHT)]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/orthophoto.tif` (RGB and alpha), `classes.tif` (ids, 0 = none, names and palette) and
    `height.tif` (float32 z, CRS), on one grid.
    """
    source = strips_of(scene, settings)
    grid, projection, table = source.grid, source.projection, scene.class_table()
    color, classes, names, height = outputs(scene, settings)
    with (
        atomic_path(color) as color_file,
        atomic_path(classes) as class_file,
        atomic_path(height) as height_file,
    ):
        covered = _fill(source, table, (color_file, class_file, height_file))
        for file, resampling in (
            (color_file, enums.Resampling.average),
            (class_file, enums.Resampling.mode),
            (height_file, enums.Resampling.average),
        ):
            add_overviews(file, resampling)
    with atomic_path(names) as temporary:
        temporary.write_text(category_names(table), encoding="utf-8")
    size = f"{grid.width} x {grid.height} px of {grid.pixel:g} {'m' if projection.unit == 1 else 'units'}"
    return {"size": size, "covered": f"{covered:.1%}", **projection.figures()}


class MeshBelow(NamedTuple):
    """A mesh, looked down at. neighbors: over the points of the cloud; top: z from which rays go down; reach: largest
    distance between surface and point; both in units of the CRS.
    """

    surface: Surface
    neighbors: NeighborIndex
    top: float
    reach: float

    def cast(self, grid: Raster, first_row: int, num_rows: int) -> np.ndarray:
        """(num_rows * W,) float64 z of the mesh under the cell centers, CRS; NaN where rays hit nothing."""
        origin = self.surface.origin
        rays = np.zeros((num_rows * grid.width, 6), np.float32)
        rays[:, :2] = grid.centers(first_row, num_rows) - origin[:2]
        rays[:, 2], rays[:, 5] = self.top - origin[2], -1.0
        distance = self.surface.scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy().astype(np.float64)
        return np.where(np.isfinite(distance), np.float64(rays[0, 2]) - distance + origin[2], np.nan)


@dataclass(frozen=True)
class OrthographicView:
    """A scene straight from above: the first surface under each cell of a grid, and the cloud point that says
    what it is; all in the CRS.

    points: (N, 3) float64; label: (N,) uint8 ids; colors: (N, 3) uint8 RGB or None; highest: (H, W) int64 row
        of the highest point of each cell, tiny gaps closed, -1 = none; mesh: None for a bare cloud
    """

    grid: Raster
    points: np.ndarray
    label: np.ndarray
    colors: np.ndarray | None
    highest: np.ndarray
    mesh: MeshBelow | None = None

    @classmethod
    def of(
        cls,
        grid: Raster,
        cloud: tuple[np.ndarray, np.ndarray, np.ndarray | None],
        mesh: tuple[np.ndarray, np.ndarray] | None,
        spacing: float,
    ) -> OrthographicView:
        """The mesh where there is one; the highest point of each cell where it has holes or does not exist.

        cloud: points, label and colors; mesh: (V, 3) vertices, CRS, and (T, 3) triangles; spacing: of the points
        """
        points = cloud[0]
        highest = close_gaps(highest_points(grid, points), GAP)
        if mesh is None or not len(mesh[1]):
            return cls(grid, *cloud, highest)
        origin = np.round(0.5 * (points.min(axis=0) + points.max(axis=0)))
        surface = Surface.from_mesh(*mesh, origin)
        top, reach = float(mesh[0][:, 2].max()) + 1.0, REACH * spacing
        return cls(grid, *cloud, highest, MeshBelow(surface, NeighborIndex(points), top, reach))

    def render_rows(self, first_row: int, num_rows: int) -> tuple[np.ndarray, np.ndarray]:
        """What some rows of the grid show.

        returns: (num_rows, W) float64 height, CRS, NaN = nothing there; (num_rows, W) int64 row of the point
            that tells color and class, -1 = none near
        """
        rows = self.highest[first_row : first_row + num_rows].copy()
        heights = np.where(rows >= 0, self.points[rows, 2], np.nan)
        if self.mesh is None:
            return heights, rows
        below = self.mesh.cast(self.grid, first_row, num_rows)
        hit = np.isfinite(below)
        centers = np.column_stack([self.grid.centers(first_row, num_rows), below])[hit]
        if len(centers):
            hit = hit.reshape(rows.shape)
            nearest, distance = self.mesh.neighbors.nearest(centers, 1)
            rows[hit] = np.where(distance[:, 0] <= self.mesh.reach, nearest[:, 0], -1)
            heights[hit] = centers[:, 2]
        return heights, rows


def round_to_digit(length: float) -> float:
    """The length rounded to one significant digit."""
    return float(f"{length:.0e}")


class Strips:
    """A scene straight from above in strips of whole rows, of which one is in memory.

    size: rows of a strip, a multiple of TILE; spacing: of the points, CRS; parts: gives points, label and colors of
    each part of the cloud
    """

    def __init__(
        self, scene: Scene, projection: MapProjection, grid: Raster, size: int, spacing: float, parts: Parts
    ) -> None:
        self._scene, self.projection, self.grid = scene, projection, grid
        self._size, self._spacing, self._parts = size, spacing, parts
        self._held: tuple[int, OrthographicView | None, int] | None = None

    def view_of(self, row: int) -> tuple[OrthographicView | None, int]:
        """The view that holds the TILE rows from `row` on, None = no point is there, and its first row."""
        number = row // self._size
        if self._held is None or self._held[0] != number:
            self._held = None  # before the next one takes memory
            self._held = (number, *self._view(number))
        return self._held[1:]

    def _view(self, number: int) -> tuple[OrthographicView | None, int]:
        """Strip `number`, with so many rows around it that its border shows nothing of the cut."""
        whole = self._size >= self.grid.height
        around = 0 if whole else BORDER + int(np.ceil(REACH * self._spacing / self.grid.pixel))
        first = max(0, number * self._size - around)
        last = min(self.grid.height, (number + 1) * self._size + around)
        grid = replace(self.grid, top=self.grid.top - first * self.grid.pixel, height=last - first)
        high, low = grid.top, grid.top - grid.height * grid.pixel

        def inside(y: np.ndarray) -> np.ndarray:
            return np.ones(len(y), bool) if whole else (y <= high) & (y >= low)

        points, label, colors = [], [], []
        for part in self._parts():
            chosen = inside(part[0][:, 1])
            if chosen.any():
                points.append(part[0][chosen])
                label.append(part[1][chosen])
                colors += [] if part[2] is None else [part[2][chosen]]
        if not points:
            return None, first
        cloud = np.concatenate(points), np.concatenate(label), np.concatenate(colors) if colors else None
        return OrthographicView.of(grid, cloud, self._mesh(low, high, whole), self._spacing), first

    def _mesh(self, low: float, high: float, whole: bool) -> tuple[np.ndarray, np.ndarray] | None:
        """Vertices, CRS, and triangles of the mesh between two northings; None without a mesh."""
        if not self._scene.mesh.exists():
            return None
        if whole:
            mesh = read_mesh(self._scene.mesh)
            vertices = self.projection.to_crs(mesh.vertex.positions.numpy())
            return vertices, mesh.triangle.indices.numpy()
        found = [np.empty((0, 3, 3))]
        for triangles in read_triangles(self._scene.mesh):
            corners = self.projection.to_crs(triangles.reshape(-1, 3)).reshape(-1, 3, 3)
            y = corners[..., 1]
            found.append(corners[(y.max(axis=1) >= low) & (y.min(axis=1) <= high)])
        chosen = np.concatenate(found).reshape(-1, 3)
        return chosen, np.arange(len(chosen), dtype=np.int64).reshape(-1, 3)


def strips_of(scene: Scene, settings: Export) -> Strips:
    """The scene in as few strips as fit into memory; one, of the whole, if it can."""
    path = settings.labelled or scene.labelled
    count = num_points(path) if path.exists() else None
    needed = (count or 0) * BYTES + surface_bytes([scene.mesh])
    if count is None or fits(needed, settings):
        projected = read_projected_cloud(scene, settings)
        part = projected.points, projected.labels.label, projected.colors
        bounds, spacing = projected.points, spacing_of_all(projected.points)
        return _strips(scene, settings, projected.projection, bounds, spacing, 1, lambda: iter([part]))
    low, high, projection = np.full(3, np.inf), np.full(3, -np.inf), MapProjection()
    for chunk in projected_chunks(scene, settings):
        low, high = np.minimum(low, chunk.points.min(axis=0)), np.maximum(high, chunk.points.max(axis=0))
        projection = chunk.projection
    some = projection.to_crs(read_thinned(path, SAMPLE).point.positions.numpy())
    spacing = spacing_of(some) * float(np.sqrt(len(some) / count))
    number = int(np.ceil(UNEVEN * needed / max(memory_of(settings) - BASE, 1)))

    def parts() -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray | None]]:
        for chunk in projected_chunks(scene, settings):
            yield chunk.points, chunk.labels.label, chunk.colors

    return _strips(scene, settings, projection, np.stack([low, high]), spacing, number, parts)


def _strips(
    scene: Scene,
    settings: Export,
    projection: MapProjection,
    bounds: np.ndarray,
    spacing: float,
    number: int,
    parts: Parts,
) -> Strips:
    """`number` strips of the grid around the (N, 3) bounds, CRS."""
    unit = projection.unit
    usual = round_to_digit(spacing * unit * (1 if scene.mesh.exists() else 2))
    grid = Raster.around(bounds, (settings.pixel_size or usual) / unit)
    tiles = -(-grid.height // TILE)
    return Strips(scene, projection, grid, TILE * -(-tiles // number), spacing, parts)


def _fill(source: Strips, table: ClassTable, files: tuple[Path, Path, Path]) -> float:
    """Write all pixels, strip by strip; returns the share of the cells that have a height."""
    grid, projection, covered = source.grid, source.projection, 0
    with (
        open_geotiff(files[0], projection, grid, count=4, dtype="uint8", predictor=2) as color,
        open_geotiff(files[1], projection, grid, count=1, dtype="uint8", nodata=0) as classes,
        open_geotiff(
            files[2], projection, grid, count=1, dtype="float32", predictor=3, nodata=NO_HEIGHT
        ) as height,
    ):
        color.colorinterp = [
            enums.ColorInterp.red,
            enums.ColorInterp.green,
            enums.ColorInterp.blue,
            enums.ColorInterp.alpha,
        ]
        set_palette(classes, table)
        for dataset, name in ((classes, "class"), (height, "height of the surface")):
            dataset.set_band_description(1, name)
        rows_done = [*range(0, grid.height, TILE)]
        for first_row in progress(rows_done, "rendering maps", "strip"):
            num_rows = min(TILE, grid.height - first_row)
            view, offset = source.view_of(first_row)
            window = windows.Window(0, first_row, grid.width, num_rows)
            if view is None:
                rows = np.full((num_rows, grid.width), -1)
                heights, labels, colors = np.full(rows.shape, np.nan), np.zeros(1, np.uint8), None
            else:
                heights, rows = view.render_rows(first_row - offset, num_rows)
                labels, colors = view.label, view.colors
            color.write(_colors(colors, rows), window=window)
            classes.write(np.where(rows >= 0, labels[rows], 0).astype(np.uint8), 1, window=window)
            height.write(
                np.where(np.isfinite(heights), heights, NO_HEIGHT).astype(np.float32), 1, window=window
            )
            covered += int(np.isfinite(heights).sum())
    return covered / (grid.height * grid.width)


def _colors(colors: np.ndarray | None, rows: np.ndarray) -> np.ndarray:
    """(4, h, w) uint8 red, green, blue, alpha of point rows (h, w); gray for clouds without colors."""
    image = np.full((4, *rows.shape), 128, np.uint8)
    if colors is not None:
        image[:3] = colors[rows].transpose(2, 0, 1)
    image[3] = 255
    image[:, rows < 0] = 0
    return image
