"""What is seen from eye height only: textures of facades, the grain of every surface, clouds.

Compiled by numba, like `sc3d.synthetic.texture`, whose rules it follows.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from sc3d.synthetic.mesh import ASHLAR, BARK, GLASS, GROUND, LEAF, MASONRY, PAINT, PANE, WOOD
from sc3d.synthetic.texture import CARRIAGEWAY, LAWN, fractal_noise, ground_kind, random01, smooth, stripe

CLOUD_SIZE = 1.6  # of the largest clouds, in units of their height above the ground


@njit(cache=True)
def facade_color(
    material: int,
    u: float,
    v: float,
    size: tuple[float, float],
    seed: int,
    tint: tuple[float, float, float],
    fp: float,
) -> tuple[float, float, float]:
    """Linear RGB of plaster, bricks, stone blocks, window panes or painted wood; u along the face and v up,
    m; `size` of the face, m.
    """
    if material == PANE:
        return _pane_color(u, v, size, seed, fp)
    if material == WOOD:
        light = (1.0 + 0.25 * fractal_noise(u / 0.25, v, seed, 0.4, 4, fp)) * (
            1.0 - 0.45 * stripe(v, 0.09, 0.015, fp)
        )
        return tint[0] * light, tint[1] * light, tint[2] * light
    light = 1.0 + 0.22 * fractal_noise(u, v, seed, 2.0, 5, fp)
    streak = smooth(0.15, 0.7, fractal_noise(u, v / 6.0, seed + 7, 0.7, 3, fp))
    light *= (1.0 - 0.3 * streak) * (1.0 - 0.3 * (1.0 - smooth(0.0, 0.9, v)))
    if material == MASONRY or material == ASHLAR:
        length, height, joint = (0.25, 0.083, 0.014) if material == MASONRY else (0.62, 0.31, 0.02)
        row = np.floor(v / height)
        along = u / length + 0.5 * (row % 2)
        block = random01(np.floor(along), row, seed) - 0.5
        light *= 1.0 + (0.7 if material == MASONRY else 0.4) * block * smooth(0.4, 1.2, height / fp)
        gap = max(stripe(along * length, length, joint, fp), stripe(v, height, joint, fp))
        pale = 0.32 if material == MASONRY else 0.16
        return (
            tint[0] * light + gap * (pale - tint[0] * light),
            tint[1] * light + gap * (pale - tint[1] * light),
            tint[2] * light + gap * (0.9 * pale - tint[2] * light),
        )
    flaked = smooth(0.45, 0.55, fractal_noise(u, v, seed + 13, 1.7, 5, fp)) * (v < 2.6)
    return (
        (tint[0] + flaked * (0.30 - tint[0])) * light,
        (tint[1] + flaked * (0.26 - tint[1])) * light,
        (tint[2] + flaked * (0.22 - tint[2])) * light,
    )


@njit(cache=True)
def _pane_color(u, v, size, seed, fp):
    """A dark room behind glass, with curtains, blinds, or the blurred picture of the other side."""
    dark = 0.02 + 0.03 * smooth(0.0, size[1], v) + 0.02 * fractal_noise(u, v, seed, 0.5, 3, fp)
    kind = random01(seed, 3, 7)
    edge = abs(u / size[0] - 0.5)
    if kind < 0.45 and edge > 0.22 + 0.05 * np.sin(9.0 * v + seed):  # curtains, drawn aside
        fold = 0.26 + 0.10 * np.sin(2.0 * np.pi * u / 0.11 + 1.3 * np.sin(2.0 * v)) * smooth(
            0.5, 1.5, 0.06 / fp
        )
        return fold, 0.95 * fold, 0.85 * fold
    if kind > 0.75 and v > size[1] * (0.25 + 0.5 * random01(seed, 5, 7)):  # a blind
        light = 0.38 * (1.0 - 0.4 * stripe(v, 0.06, 0.015, fp))
        return light, 0.96 * light, 0.86 * light
    return dark, 1.1 * dark, 1.35 * dark


@njit(cache=True)
def _lawn_grain(x, y, fp):
    """Blades, clover and small flowers: three factors of the light."""
    blades = 1.0 + 0.55 * fractal_noise(x, y, 211, 0.09, 4, fp) + 0.3 * fractal_noise(x, y, 213, 0.35, 3, fp)
    r, g, b = blades, blades, blades
    i, j = np.floor(x / 0.23), np.floor(y / 0.23)
    kind = random01(i, j, 221)
    if kind < 0.22:
        dx = x / 0.23 - i - 0.2 - 0.6 * random01(i, j, 222)
        dy = y / 0.23 - j - 0.2 - 0.6 * random01(i, j, 223)
        radius = (0.025 if kind < 0.08 else 0.055) * (0.6 + 0.8 * random01(i, j, 224))
        inside = smooth(-0.5, 0.5, (radius - 0.23 * np.hypot(dx, dy)) / fp) * min(1.0, radius / fp)
        if kind < 0.04:  # dandelions
            r, g, b = r + inside * (4.5 - r), g + inside * (2.2 - g), b + inside * (0.7 - b)
        elif kind < 0.08:  # daisies
            r, g, b = r + inside * (5.0 - r), g + inside * (3.6 - g), b + inside * (9.0 - b)
        else:  # weeds and fallen leaves
            tone = 0.45 if kind < 0.17 else 1.7
            r, g, b = r + inside * (tone - r), g + inside * (0.8 * tone - g), b + inside * (0.7 * tone - b)
    return r, g, b


@njit(cache=True)
def _paved_grain(x, y, kind, fp):
    """Aggregate, spots and fallen leaves: one factor of the light."""
    size = 0.035 if kind == CARRIAGEWAY else 0.05
    light = 1.0 + 0.35 * fractal_noise(x, y, 231, size, 3, fp) + 0.18 * fractal_noise(x, y, 233, 0.25, 3, fp)
    i, j = np.floor(x / 0.31), np.floor(y / 0.31)
    spot = random01(i, j, 241)
    if spot < 0.25:
        dx = x / 0.31 - i - 0.25 - 0.5 * random01(i, j, 242)
        dy = y / 0.31 - j - 0.25 - 0.5 * random01(i, j, 243)
        radius = 0.012 + 0.04 * random01(i, j, 244)
        inside = smooth(-0.5, 0.5, (radius - 0.31 * np.hypot(dx, 1.6 * dy)) / fp) * min(1.0, radius / fp)
        light += inside * ((0.45 if spot < 0.15 else 1.9) - light)
    return light


@njit(cache=True, parallel=True)
def add_grain(
    light: np.ndarray,
    points: np.ndarray,
    triangles: np.ndarray,
    footprints: np.ndarray,
    floats: np.ndarray,
    ints: np.ndarray,
    half: float,
    rasters: np.ndarray,
    rects: np.ndarray,
) -> None:
    """Multiply `light` (N, 3) float32 in place by details that are centimeters and millimeters large; the
    others are the arguments of `sc3d.synthetic.shading.shade`.
    """
    for n in prange(len(points)):
        t = triangles[n]
        if t < 0:
            continue
        material, fp = ints[t, 0], max(footprints[n], 1e-3)
        if material == GLASS or material == PAINT or material == PANE:
            continue
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        r = g = b = 1.0
        if material == GROUND:
            kind = ground_kind(x, y, half, rasters, rects)[0]
            if kind == LAWN:
                r, g, b = _lawn_grain(x, y, fp)
            else:
                r = g = b = _paved_grain(x, y, kind, fp)
        else:
            column = floats[t]
            dx, dy, dz = x - column[0], y - column[1], z - column[2]
            u = dx * column[3] + dy * column[4] + dz * column[5]
            v = dx * column[6] + dy * column[7] + dz * column[8]
            if material == LEAF:
                u, v = x + 0.6 * z, y - 0.8 * z
            strength = 0.5 if material == BARK else 0.28
            r = g = b = 1.0 + strength * fractal_noise(u, v, 251 + ints[t, 2], 0.12, 5, fp)
        light[n, 0] *= max(r, 0.05)
        light[n, 1] *= max(g, 0.05)
        light[n, 2] *= max(b, 0.05)


@njit(cache=True, parallel=True)
def cloudy_sky(directions: np.ndarray) -> np.ndarray:
    """(N, 3) float32 linear RGB of unit directions (N, 3) into a blue sky with faint clouds, pale at the
    horizon.
    """
    out = np.empty((len(directions), 3), np.float32)
    for n in prange(len(directions)):
        up = max(directions[n, 2], 0.0)
        height = up + 0.12  # of the clouds' layer, bent towards the horizon
        x, y = directions[n, 0] / height, directions[n, 1] / height
        noise = fractal_noise(x, y, 301, CLOUD_SIZE, 5, 0.02 / height)
        cloud = 0.75 * smooth(-0.05, 0.75, noise) * smooth(0.0, 0.15, up)
        clear = smooth(0.0, 0.7, up)
        out[n, 0] = (0.72 - 0.42 * clear) * (1.0 - cloud) + cloud
        out[n, 1] = (0.82 - 0.30 * clear) * (1.0 - cloud) + cloud
        out[n, 2] = (0.95 - 0.10 * clear) * (1.0 - cloud) + 1.02 * cloud
    return out
