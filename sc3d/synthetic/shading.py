"""Sun and sky on the textured world: color and label of surface points."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from sc3d.scene import class_table
from sc3d.synthetic.close_up import facade_color
from sc3d.synthetic.mesh import (
    BRICK,
    FLAT_ROOF,
    GLASS,
    GROUND,
    LEAF,
    NO_CLASS,
    PLAIN,
    PLASTER,
    ROAD,
    TILES,
    WALL,
)
from sc3d.synthetic.texture import (
    LAWN,
    flat_roof_color,
    fractal_noise,
    ground_color,
    ground_kind,
    random01,
    tile_color,
    wall_color,
)

SUN = np.array([-0.48, -0.42, 0.77]) / np.linalg.norm([-0.48, -0.42, 0.77])  # direction to the sun, world
SKY = np.array([0.55, 0.68, 0.85], np.float32)


def display(light: np.ndarray, exposure: float = 1.0, noise: np.ndarray | float = 0.0) -> np.ndarray:
    """uint8 display values of linear light, any shape; highlights slightly compressed; `noise` is added in
    display values.
    """
    light = np.maximum(exposure * light, 0.0)
    return np.clip(np.round(255.0 * (light / (1.0 + 0.12 * light)) ** (1 / 2.2) + noise), 0, 255).astype(
        np.uint8
    )


@njit(cache=True)
def albedo(
    point: np.ndarray,
    column: np.ndarray,
    ints: np.ndarray,
    fp: float,
    half: float,
    rasters: np.ndarray,
    rects: np.ndarray,
) -> tuple[float, float, float]:
    """Linear RGB of one surface point; `column` is its triangle's float row, `fp` the footprint of the
    sample, m.
    """
    material, seed = ints[0], 1000 + 37 * ints[2]
    if material == GROUND:
        return ground_color(point[0], point[1], fp, half, rasters, rects)
    dx, dy, dz = point[0] - column[0], point[1] - column[1], point[2] - column[2]
    u = dx * column[3] + dy * column[4] + dz * column[5]
    v = dx * column[6] + dy * column[7] + dz * column[8]
    tint = (np.float64(column[12]), np.float64(column[13]), np.float64(column[14]))
    if material == WALL:
        return wall_color(u, v, column[15], column[16], seed, tint, fp)
    if material >= PLASTER:
        seed += int(31 * (column[0] + column[1]) + 17 * column[2])  # each window and wall has its own
        return facade_color(material, u, v, (column[15], column[16]), seed, tint, fp)
    seed += int(90 * (column[3] + 2.0 * column[4]))  # each face of a roof has tiles of its own
    if material == TILES:
        return tile_color(u, v, column[15], column[16], seed, tint, fp)
    if material == FLAT_ROOF:
        return flat_roof_color(u, v, seed, tint, fp)
    light = 1.0
    if material == LEAF:
        light = 1.0 + 0.45 * fractal_noise(point[0] + point[2], point[1] - 0.7 * point[2], seed, 0.35, 2, fp)
    elif material == BRICK:
        light = 1.0 + 0.5 * (random01(np.floor(u / 0.3), np.floor(v / 0.15), seed) - 0.5) * min(1.0, 0.2 / fp)
    elif material == PLAIN:
        light = 1.0 + 0.25 * fractal_noise(u, v, seed, 0.8, 3, fp)
    elif material != GLASS:
        light = 1.0 + 0.1 * fractal_noise(u, v, seed, 1.0, 3, fp)
    return tint[0] * light, tint[1] * light, tint[2] * light


@njit(cache=True, parallel=True)
def shade(
    points: np.ndarray,
    triangles: np.ndarray,
    lit: np.ndarray,
    footprints: np.ndarray,
    floats: np.ndarray,
    ints: np.ndarray,
    half: float,
    rasters: np.ndarray,
    rects: np.ndarray,
    sun: np.ndarray,
) -> np.ndarray:
    """Linear light of surface points.

    points: (N, 3) float32 world; triangles: (N,) int64 index, -1 = sky; lit: (N,) uint8, 1 = the sun is not
        hidden
    footprints: (N,) float32 size of a sample on the surface, m; floats, ints: tables of `MeshBuilder.finish`
    half, rasters, rects: of `Ground`; sun: (3,) direction to it
    returns: (N, 3) float32 RGB
    """
    out = np.empty((len(points), 3), np.float32)
    for n in prange(len(points)):
        t = triangles[n]
        if t < 0:
            out[n, 0], out[n, 1], out[n, 2] = SKY[0], SKY[1], SKY[2]
            continue
        r, g, b = albedo(points[n], floats[t], ints[t], max(footprints[n], 1e-3), half, rasters, rects)
        nx, ny, nz = floats[t, 9], floats[t, 10], floats[t, 11]
        facing = nx * sun[0] + ny * sun[1] + nz * sun[2]
        if ints[t, 0] == LEAF:
            facing = 0.25 + 0.75 * facing  # light shines through leaves
        direct = max(facing, 0.0) * lit[n]
        sky = 0.5 + 0.5 * nz
        out[n, 0] = max(r, 0.002) * (1.95 * direct + 0.33 * sky + 0.10)
        out[n, 1] = max(g, 0.002) * (1.85 * direct + 0.37 * sky + 0.09)
        out[n, 2] = max(b, 0.002) * (1.65 * direct + 0.46 * sky + 0.07)
    return out


def truth_labels(labels: np.ndarray, points: np.ndarray, triangles: np.ndarray, site: float) -> np.ndarray:
    """(N,) uint8 truth of surface points: their `surface_labels` (N,), but `scene.class_table.OTHER` for sky
    and for what is no class on the site (half side `site`, m); 0, not judged, is left outside of the site.
    """
    outside = (triangles >= 0) & (np.abs(points[:, :2]).max(axis=1) > site)
    return np.where((labels == NO_CLASS) & ~outside, class_table.OTHER, labels).astype(np.uint8)


@njit(cache=True, parallel=True)
def surface_labels(
    points: np.ndarray,
    triangles: np.ndarray,
    ints: np.ndarray,
    half: float,
    site: float,
    rasters: np.ndarray,
    rects: np.ndarray,
) -> np.ndarray:
    """(N,) uint8 label of surface points: the object's, on the ground road or grass; 0 outside the site (half
    side `site`, m).
    """
    out = np.zeros(len(points), np.uint8)
    for n in prange(len(points)):
        t = triangles[n]
        if t < 0:
            continue
        x, y = points[n, 0], points[n, 1]
        if max(abs(x), abs(y)) > site:
            out[n] = NO_CLASS
        elif ints[t, 0] == GROUND and ground_kind(x, y, half, rasters, rects)[0] != LAWN:
            out[n] = ROAD
        else:
            out[n] = ints[t, 1]
    return out
