"""Procedural textures: value noise and patterns in surface coordinates, a function of world position only.

Compiled by numba: one call per sample, no shared state, so results do not depend on the number of threads.
Colors are linear RGB.
Octaves finer than the sample's footprint fade out, which keeps distant surfaces from flickering between
views.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sc3d.synthetic.ground import HALF_PAVED, HALF_ROAD, PARKING, RASTER_STEP

LAWN, CARRIAGEWAY, PAVEMENT, DRIVE, LOT = range(5)  # kinds of ground


@njit(cache=True, inline="never")
def random01(i: float, j: float, seed: int) -> float:
    """A fixed random number in [0, 1) for a lattice cell."""
    h = (
        np.uint64(np.int64(i)) * np.uint64(0x9E3779B1)
        + np.uint64(np.int64(j)) * np.uint64(0x85EBCA77)
        + np.uint64(np.int64(seed)) * np.uint64(0xC2B2AE3D)
    ) & np.uint64(0xFFFFFFFF)
    h = ((h ^ (h >> np.uint64(15))) * np.uint64(0x2C1B3C6D)) & np.uint64(0xFFFFFFFF)
    h = ((h ^ (h >> np.uint64(12))) * np.uint64(0x297A2D39)) & np.uint64(0xFFFFFFFF)
    h ^= h >> np.uint64(15)
    return np.float64(np.int64(h)) / 4294967296.0


@njit(cache=True)
def smooth(low: float, high: float, x: float) -> float:
    """0 below `low`, 1 above `high`, smooth between."""
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@njit(cache=True)
def value_noise(x: float, y: float, seed: int) -> float:
    """Value noise on the unit lattice, -1..1."""
    i, j = np.floor(x), np.floor(y)
    fx, fy = x - i, y - j
    fx, fy = fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy)
    low = random01(i, j, seed) * (1.0 - fx) + random01(i + 1, j, seed) * fx
    high = random01(i, j + 1, seed) * (1.0 - fx) + random01(i + 1, j + 1, seed) * fx
    return 2.0 * (low * (1.0 - fy) + high * fy) - 1.0


@njit(cache=True)
def fractal_noise(x: float, y: float, seed: int, size: float, octaves: int, footprint: float) -> float:
    """Sum of octaves of value noise, about -1..1; `size` of the coarsest and `footprint` of the sample in m."""
    total, amplitude, norm = 0.0, 1.0, 0.0
    for octave in range(octaves):
        visible = smooth(0.6, 1.4, size / footprint)
        if visible > 0.0:
            total += amplitude * visible * value_noise(x / size, y / size, seed + octave)
        norm += amplitude
        x, y = 0.8 * x - 0.6 * y + 17.3, 0.6 * x + 0.8 * y - 9.1  # turned: the lattices must not line up
        size *= 0.5
        amplitude *= 0.75
    return 1.6 * total / norm


@njit(cache=True)
def stripe(x: float, period: float, width: float, footprint: float) -> float:
    """1 on a line of `width` every `period` m, softened to the sample's footprint."""
    distance = abs(x - period * np.floor(x / period + 0.5))
    return min(max(0.5 + (0.5 * width - distance) / footprint, 0.0), 1.0) * min(1.0, 2.0 * width / footprint)


@njit(cache=True)
def ground_kind(
    x: float, y: float, half: float, rasters: np.ndarray, rects: np.ndarray
) -> tuple[int, float, float, bool]:
    """What the ground is at a place: kind, offset and length along the road it belongs to (or place in its
    rectangle), clear of junctions.
    """
    n = rasters.shape[1]
    column = min(max((x + half) / RASTER_STEP, 0.0), n - 1.001)
    row = min(max((y + half) / RASTER_STEP, 0.0), n - 1.001)
    i, j = int(row), int(column)
    fy, fx = row - i, column - j
    best, second, offset, along = 1e9, 1e9, 0.0, 0.0
    for road in range(rasters.shape[0] // 2):
        o, s = rasters[2 * road], rasters[2 * road + 1]
        d = (o[i, j] * (1 - fx) + o[i, j + 1] * fx) * (1 - fy) + (
            o[i + 1, j] * (1 - fx) + o[i + 1, j + 1] * fx
        ) * fy
        if abs(d) < best:
            second = best
            best, offset = abs(d), d
            along = (s[i, j] * (1 - fx) + s[i, j + 1] * fx) * (1 - fy) + (
                s[i + 1, j] * (1 - fx) + s[i + 1, j + 1] * fx
            ) * fy
        else:
            second = min(second, abs(d))
    if best < HALF_ROAD:
        return CARRIAGEWAY, offset, along, second > HALF_PAVED + 3.0
    for k in range(rects.shape[0]):
        dx, dy = x - rects[k, 0], y - rects[k, 1]
        u, v = rects[k, 2] * dx + rects[k, 3] * dy, rects[k, 2] * dy - rects[k, 3] * dx
        if abs(u) < rects[k, 4] and abs(v) < rects[k, 5]:
            return (LOT if rects[k, 6] == PARKING else DRIVE), u, v, True
    if best < HALF_PAVED:
        return PAVEMENT, offset, along, True
    return LAWN, offset, along, True


@njit(cache=True)
def _lawn_color(x, y, fp):
    coarse, medium = fractal_noise(x, y, 11, 16.0, 3, fp), fractal_noise(x, y, 21, 2.5, 3, fp)
    fine = fractal_noise(x, y, 31, 0.5, 3, fp)
    dry = smooth(-0.25, 0.75, coarse + 0.5 * medium)
    bare = smooth(0.35, 0.6, fractal_noise(x, y, 41, 6.0, 4, fp)) * 0.8
    light = (1.0 + 0.5 * fine) * (1.0 + 0.3 * medium)
    r, g, b = 0.085 + 0.17 * dry, 0.155 + 0.09 * dry, 0.035 + 0.055 * dry
    return (r + bare * (0.27 - r)) * light, (g + bare * (0.20 - g)) * light, (b + bare * (0.13 - b)) * light


@njit(cache=True)
def _asphalt_color(x, y, fp):
    light = (
        0.13
        * (1.0 + 0.22 * fractal_noise(x, y, 51, 7.0, 3, fp))
        * (1.0 + 0.35 * fractal_noise(x, y, 61, 0.4, 3, fp))
    )
    px, py = x + 0.6 * value_noise(x / 2.0, y / 2.0, 71), y + 0.6 * value_noise(x / 2.0, y / 2.0, 72)
    cell = random01(np.floor(px / 2.7), np.floor(py / 1.9), 73)
    if cell < 0.10:
        light *= 0.62  # mended places
    elif cell > 0.94:
        light *= 1.3
    crack = abs(value_noise(x / 1.7, y / 1.7, 81) + 0.3 * value_noise(x / 0.5, y / 0.5, 82))
    light *= 1.0 - 0.5 * (1.0 - smooth(0.02, 0.05 + fp / 2.0, crack)) * min(1.0, 0.08 / fp)
    return light, light, 1.04 * light


@njit(cache=True)
def ground_color(
    x: float, y: float, fp: float, half: float, rasters: np.ndarray, rects: np.ndarray
) -> tuple[float, float, float]:
    """Lawn, road, pavement or parking at a place; `fp` is the sample's footprint, the rest belongs to
    `Ground`.
    """
    kind, offset, along, clear = ground_kind(x, y, half, rasters, rects)
    if kind == LAWN:
        return _lawn_color(x, y, fp)
    if kind == PAVEMENT or kind == DRIVE:
        slab = 1.25 if kind == PAVEMENT else 2.5
        light = 0.30 + 0.10 * random01(np.floor(along / slab), np.floor(offset / 1.5), 91)
        light *= 1.0 - 0.45 * max(stripe(along, slab, 0.06, fp), stripe(offset, 1.5, 0.06, fp))
        light *= (1.0 + 0.25 * fractal_noise(x, y, 92, 3.0, 3, fp)) * (
            1.0 + 0.25 * fractal_noise(x, y, 96, 0.4, 2, fp)
        )
        if kind == PAVEMENT and abs(offset) < HALF_ROAD + 0.2:
            light *= 1.35  # curb stone
        return light, 0.96 * light, 0.88 * light
    r, g, b = _asphalt_color(x, y, fp)
    if kind == LOT:
        paint = stripe(offset, 2.5, 0.12, fp) if abs(along) > 2.6 else 0.0
    else:
        wheel = np.exp(-(((abs(abs(offset) - 1.5) - 0.75) / 0.3) ** 2))
        r, g, b = r * (1.0 - 0.18 * wheel), g * (1.0 - 0.18 * wheel), b * (1.0 - 0.18 * wheel)
        dash = min(max((1.5 - abs(along - 9.0 * np.floor(along / 9.0) - 4.5)) / fp + 0.5, 0.0), 1.0)
        edge = min(max(0.5 + (0.06 - abs(abs(offset) - HALF_ROAD + 0.35)) / fp, 0.0), 1.0)
        middle = min(max(0.5 + (0.075 - abs(offset)) / fp, 0.0), 1.0)
        paint = max(edge, middle * dash) if clear else 0.0
    paint *= 0.75 + 0.25 * fractal_noise(x, y, 99, 0.5, 2, fp)
    return r + paint * (0.72 - r), g + paint * (0.72 - g), b + paint * (0.68 - b)


@njit(cache=True)
def wall_color(
    u: float, v: float, width: float, height: float, seed: int, tint: tuple[float, float, float], fp: float
) -> tuple[float, float, float]:
    """Plaster or brick with windows and doors; u along the wall and v above the ground, m, of a wall of width
    x height m.
    """
    light = (1.0 + 0.16 * fractal_noise(u, v, seed, 1.5, 4, fp)) * (1.0 - 0.25 * (1.0 - smooth(0.0, 1.2, v)))
    r, g, b = tint[0] * light, tint[1] * light, tint[2] * light
    if seed % 3 == 0:  # brick courses
        row = np.floor(v / 0.22)
        light = 1.0 + 0.35 * (random01(np.floor(u / 0.45 + 0.5 * (row % 2)), row, seed) - 0.5) * smooth(
            0.4, 1.2, 0.45 / fp
        )
        r, g, b = r * light, g * light, b * light
    columns = np.floor((width - 0.8) / 2.4)
    story, column = np.floor(v / 2.8), np.floor((u - 0.5 * (width - 2.4 * columns)) / 2.4)
    if column < 0 or column >= columns or story < 0 or 2.8 * story + 2.6 > height:
        return r, g, b
    du, dv = abs(u - 0.5 * (width - 2.4 * columns) - 2.4 * column - 1.2), v - 2.8 * story
    low = 0.0 if story == 0 and random01(column, 1, seed) < 0.2 else 0.95
    if random01(column, story, seed + 5) < 0.12 or du > 0.62 or dv < low - 0.1 or dv > 2.35:
        return r, g, b
    if du > 0.52 or dv < low or dv > 2.25 or du < 0.03:
        return 0.62, 0.62, 0.6
    shine = 0.02 + 0.16 * random01(column, story, seed + 9) * (0.4 + 0.6 * (dv - low) / 1.4)
    return 0.8 * shine, shine, 1.2 * shine


@njit(cache=True)
def tile_color(
    u: float, v: float, width: float, height: float, seed: int, tint: tuple[float, float, float], fp: float
) -> tuple[float, float, float]:
    """Roof tiles with moss, roof windows and solar panels; u along the eaves and v up the slope, m, of a face
    of width x height m.
    """
    row = np.floor(v / 0.36)
    tile = random01(np.floor(u / 0.42 + 0.5 * (row % 2)), row, seed)
    light = (1.0 + 0.55 * (tile - 0.5) * smooth(0.5, 1.5, 0.5 / fp)) * (1.0 - 0.4 * stripe(v, 0.36, 0.07, fp))
    light *= 1.0 + 0.22 * fractal_noise(u, v, seed + 1, 2.5, 4, fp)
    moss = 0.5 * smooth(0.2, 0.7, fractal_noise(u, v, seed + 7, 3.0, 4, fp))
    r, g, b = tint[0] * light, tint[1] * light, tint[2] * light
    r, g, b = r + moss * (0.13 * light - r), g + moss * (0.14 * light - g), b + moss * (0.08 * light - b)
    cu, cv = np.floor(u / 3.1), np.floor(v / 2.6)
    if random01(cu, cv, seed + 3) < 0.13 and 1.0 < u < width - 1.6 and v < height - 1.6:  # roof windows
        du, dv = abs(u / 3.1 - cu - 0.5) * 3.1, abs(v / 2.6 - cv - 0.5) * 2.6
        if du < 0.42 and dv < 0.6:
            return (0.05, 0.06, 0.075) if du < 0.34 and dv < 0.52 else (0.25, 0.25, 0.25)
    if random01(1, 2, seed + 4) < 0.3 and height > 3.0:  # solar panels
        du, dv = u - 0.25 * width, v - 0.18 * height
        if 0 < du < 1.0 * np.floor(0.5 * width) and 0 < dv < 1.65 * np.floor(0.6 * height / 1.65):
            line = max(stripe(du, 1.0, 0.05, fp), stripe(dv, 1.65, 0.05, fp))
            shade = 1.0 + 0.3 * fractal_noise(u, v, seed + 5, 0.8, 2, fp)
            return (0.015 + 0.3 * line) * shade, (0.022 + 0.3 * line) * shade, (0.05 + 0.3 * line) * shade
    return r, g, b


@njit(cache=True)
def flat_roof_color(
    u: float, v: float, seed: int, tint: tuple[float, float, float], fp: float
) -> tuple[float, float, float]:
    """Roofing felt with gravel, seams, puddles and mended places; u and v in the roof, m."""
    light = (1.0 + 0.35 * fractal_noise(u, v, seed, 0.35, 3, fp)) * (
        1.0 + 0.3 * fractal_noise(u, v, seed + 3, 3.5, 4, fp)
    )
    light *= 1.0 - 0.35 * max(stripe(v, 1.3, 0.07, fp), stripe(u, 7.0, 0.07, fp))
    light *= 1.0 - 0.45 * smooth(0.35, 0.6, fractal_noise(u, v, seed + 9, 5.0, 3, fp))  # puddles
    if random01(np.floor(u / 2.2), np.floor(v / 1.3), seed + 12) < 0.08:
        light *= 0.65
    return tint[0] * light, tint[1] * light, tint[2] * light
