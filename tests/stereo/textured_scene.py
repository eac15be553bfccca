"""Views of textured planes, rendered exactly: what stereo is tried on."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from sc3d.geometry.cameras import look_at, pinhole_view, rays
from sc3d.stereo.pinhole_pairs import GrayView

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
TEXELS = 12.0  # per world unit


def textured_view(
    center: np.ndarray,
    target: np.ndarray,
    planes: list[tuple[np.ndarray, float]],
    seed: int = 0,
    name: str = "a.png",
) -> tuple[GrayView, np.ndarray]:
    """A view of planes n . X = d, the nearest in front, and its true depth (H, W), 0 where none is hit."""
    calibration = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    view = pinhole_view(name, (WIDTH, HEIGHT), calibration, look_at(center, target, (0.0, -1.0, 0.0)))
    directions, ray_z = rays(view)
    nearest, gray = np.full(len(directions), np.inf), np.zeros(len(directions))
    for number, (normal, distance) in enumerate(planes):
        normal = normal / np.linalg.norm(normal)
        with np.errstate(divide="ignore"):
            along = (distance - view.center @ normal) / (directions @ normal)
        points = view.center + directions * along[:, None]
        hit = (along > 0) & (along < nearest) & np.isfinite(along)
        gray[hit] = texture(points[hit], normal, seed + number)
        nearest[hit] = along[hit]
    depth = np.where(np.isfinite(nearest), nearest * ray_z, 0)
    return GrayView(view, gray.reshape(HEIGHT, WIDTH).astype(np.float32)), depth.reshape(HEIGHT, WIDTH)


def texture(points: np.ndarray, normal: np.ndarray, seed: int) -> np.ndarray:
    """Gray values 0 to 1 of (N, 3) points on a plane."""
    noise = gaussian_filter(np.random.default_rng(seed).random((256, 256)), 1.2, mode="wrap")
    noise = (noise - noise.min()) / np.ptp(noise)
    axes = np.linalg.svd(normal[None])[2][1:]
    return map_coordinates(noise, (points @ axes.T).T * TEXELS, order=3, mode="grid-wrap").clip(0, 1)
