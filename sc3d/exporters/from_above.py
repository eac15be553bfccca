"""A scene straight from above: the first surface under each cell of a grid, and the cloud point that says
what it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d

from sc3d.exporters.projected_cloud import PlacedCloud
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.geometry.raster import Raster, close_gaps, highest_points, spacing_of_all
from sc3d.geometry.raycast import Surface
from sc3d.io.clouds import read_mesh
from sc3d.scene.labelled_cloud import REACH
from sc3d.scene.scene import Scene

GAP = 2  # cells: holes of a bare cloud up to about twice this wide are filled


@dataclass(frozen=True)
class FromAbove:
    """What is looked at, in the CRS.

    points: (N, 3) float64; highest: (H, W) int64 row of the highest point of each cell, tiny gaps closed, -1
        = none
    surface, index: of the mesh, and over the points; None for a bare cloud
    start: z from which rays go down; reach: largest distance between surface and point, both in units of the
        CRS
    """

    grid: Raster
    points: np.ndarray
    highest: np.ndarray
    surface: Surface | None
    index: NeighborIndex | None
    start: float
    reach: float

    @classmethod
    def build(cls, scene: Scene, placed: PlacedCloud, grid: Raster) -> FromAbove:
        """The scene's mesh where there is one; the highest point of each cell where it has holes or does not
        exist.
        """
        points = placed.points
        highest = close_gaps(highest_points(grid, points), GAP)
        if not scene.mesh.exists():
            return cls(grid, points, highest, None, None, 0.0, 0.0)
        mesh = read_mesh(scene.mesh)
        vertices = placed.placement.points(mesh.vertex.positions.numpy())
        inside = points.min(axis=0), points.max(axis=0)
        origin = np.round(0.5 * (inside[0] + inside[1]))
        surface = Surface.from_mesh(vertices, mesh.triangle.indices.numpy(), origin)
        return cls(
            grid,
            points,
            highest,
            surface,
            NeighborIndex(points),
            float(vertices[:, 2].max()) + 1.0,
            REACH * spacing_of_all(points),
        )

    def look(self, first_row: int, num_rows: int) -> tuple[np.ndarray, np.ndarray]:
        """A strip of the grid.

        returns: (num_rows, W) float64 height, CRS, NaN = nothing there; (num_rows, W) int64 row of the point
            that tells color and class, -1 = none near
        """
        rows = self.highest[first_row : first_row + num_rows].copy()
        heights = np.where(rows >= 0, self.points[rows, 2], np.nan)
        if self.surface is None:
            return heights, rows
        below = self._cast(first_row, num_rows)
        hit = np.isfinite(below).reshape(rows.shape)
        centers = np.concatenate([self.grid.centers(first_row, num_rows), below[:, None]], axis=1)[
            hit.ravel()
        ]
        if len(centers):
            nearest, distance = self.index.nearest(centers, 1)
            rows[hit] = np.where(distance[:, 0] <= self.reach, nearest[:, 0], -1)
            heights[hit] = centers[:, 2]
        return heights, rows

    def _cast(self, first_row: int, num_rows: int) -> np.ndarray:
        """(num_rows * W,) float64 z of the mesh under the cell centers, CRS; NaN where rays hit nothing."""
        rays = np.zeros((num_rows * self.grid.width, 6), np.float32)
        rays[:, :2] = self.grid.centers(first_row, num_rows) - self.surface.origin[:2]
        rays[:, 2], rays[:, 5] = self.start - self.surface.origin[2], -1.0
        distance = self.surface.scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy().astype(np.float64)
        return np.where(
            np.isfinite(distance), np.float64(rays[0, 2]) - distance + self.surface.origin[2], np.nan
        )
