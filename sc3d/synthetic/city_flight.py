"""A flight over a whole city: a lawn-mower grid of nadir photos, and oblique ones of the same grid from four
sides.
"""

from __future__ import annotations

import numpy as np

from sc3d.geometry.cameras import View, look_at, pinhole_view
from sc3d.settings.synthesize import Synthesize, SynthesizeCity
from sc3d.synthetic.flight import focal_length

ALTITUDE = 120.0  # m
TILT = np.radians(40.0)  # of oblique photos, from straight down
MARGIN = 0.25 * ALTITUDE  # m between the outermost photos' middles and the edge of the city
NADIR = 0.6  # share of the photos


def fly_over(size: tuple[float, float], settings: SynthesizeCity) -> list[View]:
    """`settings.views` true cameras, named view_000.jpg ..., over a city of `size` (west to east, south to
    north; m) around the origin, z up.
    """
    rng = np.random.default_rng([settings.seed, 2])
    num_nadir = max(1, round(NADIR * settings.views))
    sides = [np.array(side, np.float64) for side in ((0, 1, 0), (1, 0, 0), (0, -1, 0), (-1, 0, 0))]
    poses = _poses(num_nadir, size, (sides[0], 0.0), rng)
    for side, members in zip(sides, np.array_split(np.arange(settings.views - num_nadir), 4), strict=True):
        poses += _poses(len(members), size, (side, TILT), rng)
    digits = max(3, len(str(settings.views - 1)))
    width, height = settings.width, Synthesize(width=settings.width).height
    focal = focal_length(width, height)
    return [
        pinhole_view(f"view_{i:0{digits}d}.jpg", (width, height), (focal, focal, width / 2, height / 2), pose)
        for i, pose in enumerate(poses)
    ]


def _poses(
    num: int, size: tuple[float, float], look: tuple[np.ndarray, float], rng: np.random.Generator
) -> list[np.ndarray]:
    """Photos whose middles lie on a grid; look: direction on the ground that their tops point to, and tilt in
    radians. Unsteady, as a real drone is.
    """
    direction, tilt = look
    targets = _grid(num, size)
    centers = (
        targets
        + [0.0, 0.0, ALTITUDE]
        - ALTITUDE * np.tan(tilt) * direction
        + rng.normal(0, [0.4, 0.4, 0.3], (num, 3))
    )
    targets = targets + rng.normal(0, [3.0, 3.0, 0.3], (num, 3))
    return [
        look_at(center, target, tuple(direction)) for center, target in zip(centers, targets, strict=True)
    ]


def _grid(num: int, size: tuple[float, float]) -> np.ndarray:
    """(num, 3) places on the ground along lines to and fro, northwards first; as photos are 3:2, lines lie
    1.5 times as far apart as places on them.
    """
    reach = np.maximum(np.array(size) / 2 - MARGIN, 1.0)
    num_lines = min(max(1, round(np.sqrt(num / 1.5 * reach[0] / reach[1]))), num)
    places = np.zeros((num, 3))
    for line, members in enumerate(np.array_split(np.arange(num), max(num_lines, 1))):
        places[members, 0] = (2 * line + 1 - num_lines) / max(num_lines - 1, 1) * reach[0]
        along = np.linspace(-reach[1], reach[1], len(members)) if len(members) > 1 else np.zeros(len(members))
        places[members, 1] = along if line % 2 == 0 else -along
    return places
