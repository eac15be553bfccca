"""The flight: a lawn-mower grid of nadir photos and two oblique rings."""

from __future__ import annotations

import numpy as np

from sc3d.geometry.cameras import View, look_at, pinhole_view
from sc3d.settings.synthesize import Synthesize

FOCAL_35MM = 28  # mm on 36 x 24 mm film; whole, because EXIF stores it so


def focal_length(width: int, height: int) -> float:
    """Focal length in px, exactly what COLMAP derives from FOCAL_35MM in EXIF."""
    return FOCAL_35MM / 43.27 * float(np.hypot(width, height))


def fly(settings: Synthesize) -> list[View]:
    """True cameras, `settings.num_views` of them: names view_000.jpg ..., pinhole, world = site center, z up,
    meters.
    """
    rng = np.random.default_rng([settings.seed, 2])
    num_nadir = settings.num_views if settings.num_views < 8 else round(0.6 * settings.num_views)
    num_ring = settings.num_views - num_nadir
    num_low = num_ring // 2 if num_ring >= 10 else 0
    poses = _nadir_poses(num_nadir, settings, rng)
    poses += _ring_poses(num_ring - num_low, (0.40 * settings.side, 0.80 * settings.altitude, 0.0), 0.0, rng)
    poses += _ring_poses(
        num_low, (0.42 * settings.side, 0.58 * settings.altitude, 0.12 * settings.side), 0.5, rng
    )
    digits = max(3, len(str(settings.num_views - 1)))
    size = (settings.width, settings.height)
    focal = focal_length(*size)
    calibration = (focal, focal, size[0] / 2, size[1] / 2)
    return [pinhole_view(f"view_{i:0{digits}d}.jpg", size, calibration, pose) for i, pose in enumerate(poses)]


def _nadir_poses(num: int, settings: Synthesize, rng: np.random.Generator) -> list[np.ndarray]:
    """Lines flown to and fro, image top in flight direction, with the unsteadiness of a real drone."""
    num_lines = max(1, round(np.sqrt(num / 1.5)))
    reach = 0.25 * settings.side
    poses = []
    for line, members in enumerate(np.array_split(np.arange(num), num_lines)):
        x = np.linspace(-reach, reach, num_lines)[line] if num_lines > 1 else 0.0
        heading = 1.0 if line % 2 == 0 else -1.0
        stations = np.linspace(-reach, reach, len(members)) * heading if len(members) > 1 else [0.0]
        for y in stations:
            center = np.array([x, y, settings.altitude]) + rng.normal(0, [0.4, 0.4, 0.3])
            yaw, pitch, roll = rng.normal(0, np.radians([2.0, 1.5, 1.0]))
            top = np.array([np.sin(yaw), heading * np.cos(yaw), 0.0])
            side = np.array([top[1], -top[0], 0.0])
            target = center + [0, 0, -1.0] + np.tan(pitch) * top + np.tan(roll) * side
            poses.append(look_at(center, target, tuple(top)))
    return poses


def _ring_poses(
    num: int, ring: tuple[float, float, float], phase: float, rng: np.random.Generator
) -> list[np.ndarray]:
    """Photos from a circle (radius, height, distance of the target from the middle towards the camera; m),
    looking inwards and down.
    """
    radius, height, near = ring
    poses = []
    for i in range(num):
        angle = 2 * np.pi * (i + phase) / num + rng.normal(0, 0.02)
        direction = np.array([np.cos(angle), np.sin(angle), 0.0])
        center = radius * direction + [0, 0, height] + rng.normal(0, 0.4, 3)
        poses.append(look_at(center, near * direction + [0, 0, 1.0] + rng.normal(0, [1.5, 1.5, 0.3])))
    return poses
