"""The ground: rolling terrain, roads as signed-offset rasters, paved rectangles, and the mesh of it all."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from sc3d.synthetic.mesh import GRASS, GROUND, MeshBuilder

HALF_ROAD = 3.0  # carriageway, m from the center line
HALF_PAVED = 4.5  # including pavements
RASTER_STEP = 0.5
# m inside of level edges: the hills end over the first, whatever is left (pads, curbs) over the second
RIM, EDGE = 15.0, 3.0
DRIVEWAY, PARKING = 0, 1


@dataclass
class Ground:
    """The ground surface as functions of x, y.

    extent: side of the square site, centered on the origin, m
    rasters: (2 * roads, n, n) float32: offset to the left of each center line and length along it, m; [row =
        y, column = x]
    half: half the side of the rasters, m
    rects: (R, 7) float64 paved rectangles: x, y, cos yaw, sin yaw, half length, half width, DRIVEWAY or
        PARKING
    pads: levelled building plots: x, y, yaw, half length, half width, height
    level_edges: the ground comes down to height 0 at the edges of the site, so that sites fit together
    """

    extent: float
    rasters: np.ndarray
    half: float
    center_lines: list[np.ndarray]
    hills: np.ndarray
    rects: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))
    pads: list[tuple[float, ...]] = field(default_factory=list)
    level_edges: bool = False

    def road_offsets(self, xy: np.ndarray) -> np.ndarray:
        """(N, roads) signed distance of (N, 2) points to each center line, m."""
        return np.stack([self._sample(2 * i, xy)[0] for i in range(len(self.center_lines))], 1)

    def height(self, xy: np.ndarray) -> np.ndarray:
        """(N,) height of the ground at (N, 2) points, m: hills, levelled across roads and under buildings."""
        height, on_road = self._graded_height(xy)
        for x, y, yaw, half_length, half_width, level in self.pads:
            outside = rect_distance(xy, (x, y, np.cos(yaw), np.sin(yaw), half_length + 1.0, half_width + 1.0))
            weight = _fade(outside, 0.0, 4.0) * (1.0 - on_road)
            height = height + weight * (level - height)
        return height * self._inside(xy, EDGE)

    def _graded_height(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        height, on_road = self._hill_height(xy), np.zeros(len(xy))
        for i, (lengths, profile) in enumerate(self._profiles):
            offset, along = self._sample(2 * i, xy)
            weight = _fade(np.abs(offset), HALF_PAVED + 0.5, 11.0)
            height = height + weight * (np.interp(along, lengths, profile) - height)
            height -= 0.1 * _fade(np.abs(offset), HALF_ROAD, HALF_ROAD + 0.7)
            on_road = np.maximum(on_road, _fade(np.abs(offset), HALF_PAVED, HALF_PAVED + 4.0))
        return height, on_road

    @cached_property
    def _profiles(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Lengths along each center line and heights there."""
        profiles: list[tuple[np.ndarray, np.ndarray]] = []
        for line in self.center_lines:
            profile = self._hill_height(line)
            # a later road takes the level of an earlier one where they cross
            for j, (lengths, level) in enumerate(profiles):
                other, where = self._sample(2 * j, line)
                profile += _fade(np.abs(other), HALF_PAVED + 1.0, 18.0) * (
                    np.interp(where, lengths, level) - profile
                )
            profiles.append((_lengths(line), profile))
        return profiles

    def _hill_height(self, xy: np.ndarray) -> np.ndarray:
        phase = xy @ self.hills[:, :2].T + self.hills[:, 2]
        return np.sin(phase) @ self.hills[:, 3] * self._inside(xy, RIM)

    def _inside(self, xy: np.ndarray, width: float) -> np.ndarray | float:
        """(N,) 0 at level edges and beyond, 1 from `width` m inside on; 1 everywhere without level edges."""
        return 1.0 - _fade(self.extent / 2 - np.abs(xy).max(1), 0.0, width) if self.level_edges else 1.0

    def _sample(self, layer: int, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bilinear samples of two neighboring raster layers."""
        n = self.rasters.shape[1]
        cell = np.clip((xy + self.half) / RASTER_STEP, 0, n - 1.001)
        low = cell.astype(np.int64)
        fx, fy = (cell - low).T
        column, row = low.T
        out = []
        for raster in self.rasters[layer : layer + 2].astype(np.float64):
            top = raster[row, column] * (1 - fx) + raster[row, column + 1] * fx
            bottom = raster[row + 1, column] * (1 - fx) + raster[row + 1, column + 1] * fx
            out.append(top * (1 - fy) + bottom * fy)
        return out[0], out[1]


def plan_ground(extent: float, rng: np.random.Generator, level_edges: bool = False) -> Ground:
    """Hills, a curved road from west to east and a straight one that crosses it."""
    reach = 3.0 * extent
    wave = rng.uniform(0.07, 0.10) * extent
    phase, shift = rng.uniform(0, 2 * np.pi), rng.uniform(-0.05, 0.05) * extent
    x = np.arange(-reach, reach, 0.25)
    curved = np.stack([x, shift + wave * np.sin(2 * np.pi * x / (1.1 * extent) + phase)], 1)
    turn, cross = rng.uniform(-0.15, 0.15), rng.uniform(-0.12, 0.12) * extent
    straight = np.stack([cross - np.sin(turn) * x, np.cos(turn) * x], 1)
    angles = rng.uniform(0, 2 * np.pi, 6)
    wave_lengths = np.geomspace(160.0, 28.0, 6)
    # fmt: off
    hills = np.stack([np.cos(angles) * 2 * np.pi / wave_lengths, np.sin(angles) * 2 * np.pi / wave_lengths,
                      rng.uniform(0, 2 * np.pi, 6), 0.009 * wave_lengths], 1)
    # fmt: on
    half = extent
    lines = [curved, straight]
    ticks = np.arange(-half, half + RASTER_STEP / 2, RASTER_STEP)
    grid = np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2)
    layers = [layer for line in lines for layer in _road_coordinates(line, grid)]
    rasters = np.stack(layers).reshape(2 * len(lines), len(ticks), len(ticks)).astype(np.float32)
    return Ground(extent, rasters, half, lines, hills, level_edges=level_edges)


def plan_street(extent: float, rng: np.random.Generator) -> Ground:
    """Nearly level ground and a straight road along the x axis."""
    x = np.arange(-3.0 * extent, 3.0 * extent, 0.25)
    line = np.stack([x, np.zeros_like(x)], 1)
    ticks = np.arange(-extent, extent + RASTER_STEP / 2, RASTER_STEP)
    along, offset = np.meshgrid(ticks, ticks)
    angles, wave_lengths = rng.uniform(0, 2 * np.pi, 4), np.array([90.0, 37.0, 11.0, 4.3])
    # fmt: off
    hills = np.stack([np.cos(angles) * 2 * np.pi / wave_lengths, np.sin(angles) * 2 * np.pi / wave_lengths,
                      rng.uniform(0, 2 * np.pi, 4), [0.3, 0.12, 0.06, 0.03]], 1)
    # fmt: on
    rasters = np.stack([offset, along - x[0]]).astype(np.float32)
    return Ground(extent, rasters, extent, [line], hills)


def add_ground(builder: MeshBuilder, ground: Ground) -> None:
    """Mesh the ground: 0.75 m cells on the site, growing outwards to the horizon."""
    inner = np.arange(-0.55 * ground.extent, 0.55 * ground.extent + 0.01, 0.75)
    outer = inner[-1] + np.cumsum(0.75 * 1.07 ** np.arange(1, 120))
    outer = outer[outer < 12 * ground.extent]
    ticks = np.concatenate([-outer[::-1], inner, outer])
    grid = np.stack(np.meshgrid(ticks, ticks), -1)
    height = ground.height(grid.reshape(-1, 2)).reshape(grid.shape[:2])
    points = np.concatenate([grid, height[..., None]], -1)
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    corners = np.stack([np.stack([a, b, c], -2), np.stack([a, c, d], -2)], 2).reshape(-1, 3, 3)
    builder.add(corners, (GROUND, GRASS, 0), np.ones(3))


def rect_distance(xy: np.ndarray, rect: tuple[float, ...] | np.ndarray) -> np.ndarray:
    """(N,) distance of (N, 2) points to a rectangle (x, y, cos yaw, sin yaw, half length, half width, ...);
    negative inside, m.
    """
    x, y, cos, sin, half_length, half_width = rect[:6]
    dx, dy = xy[:, 0] - x, xy[:, 1] - y
    along, across = np.abs(cos * dx + sin * dy) - half_length, np.abs(cos * dy - sin * dx) - half_width
    return np.hypot(np.maximum(along, 0), np.maximum(across, 0)) + np.minimum(np.maximum(along, across), 0)


def _road_coordinates(line: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offset to the left of a densely sampled center line and length along it."""
    tangents = np.gradient(line, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    nearest = cKDTree(line).query(points)[1]
    delta, tangent = points - line[nearest], tangents[nearest]
    along = _lengths(line)[nearest] + (delta * tangent).sum(1)
    return tangent[:, 0] * delta[:, 1] - tangent[:, 1] * delta[:, 0], along


def _lengths(line: np.ndarray) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def _fade(distance: np.ndarray, full: float, none: float) -> np.ndarray:
    """1 up to distance `full`, 0 from `none` on, smooth between."""
    t = np.clip((none - distance) / (none - full), 0, 1)
    return t * t * (3 - 2 * t)
