"""Maps from straight above as GeoTIFF: colors, classes with their palette, heights of the surface."""

from __future__ import annotations

from dataclasses import dataclass
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
from sc3d.exporters.projected_cloud import BYTES, ProjectedCloud, read_projected_cloud, require_whole
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.geometry.raster import Raster, close_gaps, highest_points, spacing_of_all
from sc3d.geometry.raycast import Surface
from sc3d.io.atomic import atomic_path
from sc3d.io.clouds import read_mesh
from sc3d.io.progress import progress
from sc3d.scene.class_table import ClassTable
from sc3d.scene.labelled_cloud import REACH
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export
from sc3d.tiling.memory import surface_bytes

windows = load("rasterio.windows")

COLOR, CLASSES, HEIGHT = "orthophoto.tif", "classes.tif", "height.tif"
NAMES = "classes.tif.aux.xml"  # where GDAL keeps names of categories
GAP = 2  # cells: holes of a bare cloud up to about twice this wide are filled


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / name for name in (COLOR, CLASSES, NAMES, HEIGHT)]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/orthophoto.tif` (RGB and alpha), `classes.tif` (ids, 0 = none, names and palette) and
    `height.tif` (float32 z, CRS), on one grid.
    """
    require_whole(scene, settings, BYTES, surface_bytes([scene.mesh]))
    projected = read_projected_cloud(scene, settings)
    unit = projected.projection.unit
    pixel = (
        settings.pixel_size
        or round_to_digit(spacing_of_all(projected.points) * unit * (1 if scene.mesh.exists() else 2))
    ) / unit
    grid = Raster.around(projected.points, pixel)
    view = OrthographicView.from_scene(scene, projected, grid)
    table = scene.class_table()
    color, classes, names, height = outputs(scene, settings)
    with (
        atomic_path(color) as color_file,
        atomic_path(classes) as class_file,
        atomic_path(height) as height_file,
    ):
        covered = _fill(view, projected, table, (color_file, class_file, height_file))
        for file, resampling in (
            (color_file, enums.Resampling.average),
            (class_file, enums.Resampling.mode),
            (height_file, enums.Resampling.average),
        ):
            add_overviews(file, resampling)
    with atomic_path(names) as temporary:
        temporary.write_text(category_names(table), encoding="utf-8")
    size = f"{grid.width} x {grid.height} px of {pixel:g} {'m' if unit == 1 else 'units'}"
    return {"size": size, "covered": f"{covered:.1%}", **projected.projection.figures()}


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

    points: (N, 3) float64; highest: (H, W) int64 row of the highest point of each cell, tiny gaps closed, -1
        = none; mesh: None for a bare cloud
    """

    grid: Raster
    points: np.ndarray
    highest: np.ndarray
    mesh: MeshBelow | None = None

    @classmethod
    def from_scene(cls, scene: Scene, projected: ProjectedCloud, grid: Raster) -> OrthographicView:
        """The scene's mesh where there is one; the highest point of each cell where it has holes or does not
        exist.
        """
        points = projected.points
        highest = close_gaps(highest_points(grid, points), GAP)
        if not scene.mesh.exists():
            return cls(grid, points, highest)
        mesh = read_mesh(scene.mesh)
        vertices = projected.projection.to_crs(mesh.vertex.positions.numpy())
        origin = np.round(0.5 * (points.min(axis=0) + points.max(axis=0)))
        surface = Surface.from_mesh(vertices, mesh.triangle.indices.numpy(), origin)
        top, reach = float(vertices[:, 2].max()) + 1.0, REACH * spacing_of_all(points)
        return cls(grid, points, highest, MeshBelow(surface, NeighborIndex(points), top, reach))

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


def _fill(
    view: OrthographicView, projected: ProjectedCloud, table: ClassTable, files: tuple[Path, Path, Path]
) -> float:
    """Write all pixels, strip by strip; returns the share of the cells that have a height."""
    grid, covered = view.grid, 0
    with (
        open_geotiff(files[0], projected.projection, grid, count=4, dtype="uint8", predictor=2) as color,
        open_geotiff(files[1], projected.projection, grid, count=1, dtype="uint8", nodata=0) as classes,
        open_geotiff(
            files[2], projected.projection, grid, count=1, dtype="float32", predictor=3, nodata=NO_HEIGHT
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
        for first_row in progress(range(0, grid.height, TILE), "rendering maps", "strip"):
            num_rows = min(TILE, grid.height - first_row)
            heights, rows = view.render_rows(first_row, num_rows)
            window = windows.Window(0, first_row, grid.width, num_rows)
            color.write(_colors(projected, rows), window=window)
            classes.write(
                np.where(rows >= 0, projected.labels.label[rows], 0).astype(np.uint8), 1, window=window
            )
            height.write(
                np.where(np.isfinite(heights), heights, NO_HEIGHT).astype(np.float32), 1, window=window
            )
            covered += int(np.isfinite(heights).sum())
    return covered / (grid.height * grid.width)


def _colors(projected: ProjectedCloud, rows: np.ndarray) -> np.ndarray:
    """(4, h, w) uint8 red, green, blue, alpha of point rows (h, w); gray for clouds without colors."""
    image = np.full((4, *rows.shape), 128, np.uint8)
    if projected.colors is not None:
        image[:3] = projected.colors[rows].transpose(2, 0, 1)
    image[3] = 255
    image[:, rows < 0] = 0
    return image
