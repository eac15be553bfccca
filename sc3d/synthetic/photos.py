"""Photos of the world: ray cast, shade, expose."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from sc3d.geometry.cameras import View, pixel_centers, rays
from sc3d.synthetic.masks import without_other
from sc3d.synthetic.shading import display
from sc3d.synthetic.world import World

SAMPLES_PER_BAND = 2_000_000  # rows are rendered in bands: large photos must not need gigabytes


@dataclass(frozen=True)
class Photo:
    """color (H, W, 3) uint8; depth (H, W) float32 z of the pixel center's ray, m, 0 = nothing there; truth
    (H, W) uint8 of the same ray, as `World.truth`.
    """

    color: np.ndarray
    depth: np.ndarray
    truth: np.ndarray

    @property
    def label(self) -> np.ndarray:
        """(H, W) uint8 class, 0 = none."""
        return without_other(self.truth)


def photograph(world: World, view: View) -> Photo:
    """Render a view. Colors are means of 2 x 2 samples per pixel; depth and label belong to exactly the
    pixel's center.

    Exposure and sensor noise are fixed by the world's seed and the view's name.
    """
    rng = np.random.default_rng([world.seed, 3, zlib.crc32(view.name.encode())])
    exposure = 1.0 + 0.06 * np.clip(rng.normal(), -2, 2)
    band = max(1, SAMPLES_PER_BAND // (4 * view.width))
    parts = [
        _render_rows(world, view, row, min(row + band, view.height)) for row in range(0, view.height, band)
    ]
    light, depth, truth = (np.concatenate(part) for part in zip(*parts))
    noise = 1.2 * rng.standard_normal(light.shape, dtype=np.float32)
    return Photo(display(light, exposure, noise), depth, truth)


def _render_rows(
    world: World, view: View, first: int, last: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linear light (h, W, 3), depth and truth (h, W) of the rows [first, last)."""
    shape = (last - first, view.width)
    centers = pixel_centers(*shape[::-1]) + [0.0, first]
    directions, cosines = rays(view, centers)
    range_, triangles = world.cast(view.center, directions)
    hit = triangles >= 0
    depth = np.where(hit, range_ * cosines, 0.0).astype(np.float32)
    truth = world.truth(_points(view.center, directions, range_, hit), triangles)
    light = np.zeros((len(centers), 3), np.float32)
    for offset in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        directions, cosines = rays(view, centers + offset)
        range_, triangles = world.cast(view.center, directions)
        hit = triangles >= 0
        slope = np.abs((directions * world.floats[triangles, 9:12]).sum(1))
        footprints = (np.where(hit, range_, 1.0) * 0.5 / view.focal / np.sqrt(np.maximum(slope, 0.1))).astype(
            np.float32
        )
        seen = world.light(_points(view.center, directions, range_, hit), triangles, footprints)
        seen[~hit] = world.sky(directions[~hit])
        light += 0.25 * seen
    return light.reshape(*shape, 3), depth.reshape(shape), truth.reshape(shape)


def _points(center: np.ndarray, directions: np.ndarray, range_: np.ndarray, hit: np.ndarray) -> np.ndarray:
    return (center + directions * np.where(hit, range_, 0.0)[:, None]).astype(np.float32)
