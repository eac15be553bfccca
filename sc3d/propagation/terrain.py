"""Relief of a cloud: height above the ground around, roughness and slope of each point. Parts of a cloud get
what the whole would.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import map_coordinates, minimum_filter

from sc3d.geometry.graph import Graph
from sc3d.propagation.quantile_sketch import QuantileSketch

CELL = 4.0  # cell of the ground raster, point spacings
WINDOWS = (9, 33)  # the ground is the lowest point within windows of this many cells
MAX_CELLS = 4096  # per side of the raster
GROUND_LEAN = 30.0  # degrees: a main direction of normals farther from the cameras' up is that of a wall
NUM_FEATURES = 2 + len(WINDOWS)


@dataclass(frozen=True)
class NormalStatistics:
    """Which way the surfaces of a cloud face. products: (3, 3), sums: (3,) int64 of its unit normals, in
    fixed point; spacings: of its points.
    """

    products: np.ndarray
    sums: np.ndarray
    spacings: QuantileSketch

    @classmethod
    def from_normals(cls, normals: np.ndarray, spacings: np.ndarray) -> NormalStatistics:
        """normals: (N, 3) float32; spacings: (N,) float32 world units."""
        fixed = np.rint(normals.astype(np.float64) * 1024).astype(np.int64)
        return cls(fixed.T @ fixed, fixed.sum(axis=0), QuantileSketch.from_values(spacings))

    @classmethod
    def merge(cls, parts: list[NormalStatistics]) -> NormalStatistics:
        return cls(
            np.sum([part.products for part in parts], axis=0),
            np.sum([part.sums for part in parts], axis=0),
            QuantileSketch.merge([part.spacings for part in parts]),
        )


@dataclass(frozen=True)
class GroundModel:
    """A frame and a raster over it. Up is the main direction of the normals if that is near the cameras' up,
    as it is over ground of any slope; else, as before a facade, the cameras' up itself.

    low: (3,) world corner of the cloud; up: (3,); axes: (3, 2); corner: (2,) of the raster, in the frame;
        cell, spacing: world units; shape: of the raster
    """

    low: np.ndarray
    up: np.ndarray
    axes: np.ndarray
    corner: np.ndarray
    cell: float
    spacing: float
    shape: tuple[int, int]

    @classmethod
    def from_statistics(
        cls,
        lean: NormalStatistics,
        low: np.ndarray,
        high: np.ndarray,
        camera_up: np.ndarray | None = None,
        cell: float | None = None,
    ) -> GroundModel:
        """low, high: (3,) corners of the whole cloud, world; camera_up: (3,) unit, None = not known: then the
        main direction of the normals is taken; cell: of the raster, world units, None = by the spacing
        """
        axes = np.linalg.eigh(lean.products.astype(np.float64))[1][:, ::-1]
        up = axes[:, 0]
        leaning = lean.sums @ up
        up = up * np.sign(
            leaning if abs(leaning) > 1e-9 * lean.spacings.counts.sum() * 1024 else up[np.abs(up).argmax()]
        )
        if camera_up is not None and abs(up @ camera_up) < np.cos(np.radians(GROUND_LEAN)):
            up = camera_up
            axes = np.linalg.svd(up[None])[2].T
        corners = (
            np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) @ axes[:, 1:]
        )
        spacing = float(lean.spacings.quantiles(np.array([0.5]))[0])
        extent = corners.max(axis=0) - corners.min(axis=0)
        cell = max(CELL * spacing if cell is None else cell, float(extent.max()) / MAX_CELLS, 1e-12)
        return cls(
            low,
            up,
            axes[:, 1:],
            corners.min(axis=0),
            cell,
            spacing,
            (int(extent[0] // cell) + 1, int(extent[1] // cell) + 1),
        )

    def place(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N, 2) position on the raster, cells, and (N,) height, world units, of points (N, 3)."""
        local = points - self.low
        flat = np.einsum("ni,ij->nj", local, self.axes)
        flat -= self.corner
        flat /= self.cell
        return flat, np.einsum("ni,i->n", local, self.up)

    def lowest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K,) int64 cells of the raster that hold points, and (K,) float64 the lowest height in each."""
        flat, height = self.place(points)
        cells = flat.astype(np.int64).clip(0, np.array(self.shape) - 1)
        cells = cells[:, 0] * self.shape[1] + cells[:, 1]
        order = np.argsort(cells, kind="stable")
        starts = np.flatnonzero(np.diff(cells[order], prepend=-1))
        return cells[order][starts], np.minimum.reduceat(height[order], starts)

    def grounds(self, parts: list[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
        """Height of the ground on the raster, one per window, from `lowest` of all parts."""
        raster = np.full(self.shape[0] * self.shape[1], np.inf)
        for cells, heights in parts:
            raster[cells] = np.minimum(raster[cells], heights)
        bottom, image = raster[np.isfinite(raster)].min(), raster.reshape(self.shape)
        filtered = (minimum_filter(image, window) for window in WINDOWS)
        return [np.where(np.isfinite(ground), ground, bottom) for ground in filtered]

    def features(self, graph: Graph, points: np.ndarray, grounds: list[np.ndarray]) -> np.ndarray:
        """(N, 4) float32: roughness, cosine of the slope, height above the ground of each window (spacings).
        points: (N, 3), in the order of the graph.
        """
        flat, height = self.place(points)
        flat -= 0.5
        features = np.empty((len(points), NUM_FEATURES), np.float32)
        features[:, 0], features[:, 1] = (
            graph.roughness,
            np.einsum("ni,i->n", graph.normals, self.up.astype(np.float32)),
        )
        for column, ground in enumerate(grounds, 2):
            below = map_coordinates(ground, flat.T, order=1, mode="nearest")  # bilinear: no steps on slopes
            features[:, column] = (height - below) / max(self.spacing, 1e-12)
        return features


@dataclass(frozen=True)
class Scale:
    """Sizes that another site's relief was measured with. cell: of the ground raster; unit: of heights; both in
    world units.
    """

    cell: float
    unit: float


def terrain_of(
    graph: Graph, points: np.ndarray, camera_up: np.ndarray | None = None, cell: float | None = None
) -> GroundModel:
    """The frame and raster of a whole cloud; points: (N, 3) world, in the order of the graph; camera_up: (3,),
    None = not known; cell: of the raster, world units, None = by the spacing of the points
    """
    return GroundModel.from_statistics(
        NormalStatistics.from_normals(graph.normals, graph.spacings),
        points.min(axis=0),
        points.max(axis=0),
        camera_up,
        cell,
    )


def relief_features(
    graph: Graph, points: np.ndarray, camera_up: np.ndarray | None = None, scale: Scale | None = None
) -> np.ndarray:
    """(N, 4) float32 features of a whole cloud, as `terrain_of` takes it; scale: None = the cloud's own, with
    heights in point spacings
    """
    terrain = terrain_of(graph, points, camera_up, None if scale is None else scale.cell)
    if scale is not None:
        terrain = replace(terrain, spacing=scale.unit)
    return terrain.features(graph, points, terrain.grounds([terrain.lowest(points)]))
