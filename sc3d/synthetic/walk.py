"""The walk: photos from eye height on the pavement of a street, and low oblique ones from above it."""

from __future__ import annotations

import numpy as np

from sc3d.geometry.cameras import View, look_at, pinhole_view
from sc3d.settings.synthesize import Synthesize
from sc3d.synthetic.flight import focal_length
from sc3d.synthetic.ground import Ground

EYE_HEIGHT = 1.6  # m
PAVEMENT = 4.1  # m from the middle of the street to the photographer
REACH = 0.22  # the walk ends this far from the middle, in sides of the site
# degrees to the right of straight across the street, and up; one after the other
GAZES = (
    (16.0, 9.0),
    (-18.0, 11.0),
    (6.0, -21.0),
    (-14.0, 6.0),
    (40.0, 5.0),
    (10.0, 12.0),
    (-40.0, 4.0),
    (-6.0, -12.0),
)


def walk(settings: Synthesize, ground: Ground) -> list[View]:
    """True cameras, `settings.num_views` of them: names view_000.jpg ..., pinhole, world = site center, z up,
    meters, the street along x. All stand in the south and see the row of houses in the north: three of four
    from the pavement, the last quarter from 5 to 8 m above the edge of the carriageway.
    """
    rng = np.random.default_rng([settings.seed, 2])
    num_low = settings.num_views // 4
    poses = _pavement_poses(settings.num_views - num_low, settings, ground, rng)
    poses += _low_poses(num_low, settings, ground, rng)
    digits = max(3, len(str(settings.num_views - 1)))
    size = (settings.width, settings.height)
    focal = focal_length(*size)
    calibration = (focal, focal, size[0] / 2, size[1] / 2)
    return [pinhole_view(f"view_{i:0{digits}d}.jpg", size, calibration, pose) for i, pose in enumerate(poses)]


def _pavement_poses(
    num: int, settings: Synthesize, ground: Ground, rng: np.random.Generator
) -> list[np.ndarray]:
    """Photos held by hand, from west to east."""
    poses = []
    for i, x in enumerate(_stations(num, settings)):
        aside, up = np.array(GAZES[i % len(GAZES)]) + rng.normal(0, 1.5, 2)
        place = np.array([x, -PAVEMENT]) + rng.normal(0, [0.25, 0.12])
        poses.append(_pose(ground, place, EYE_HEIGHT + rng.normal(0, 0.05), (90.0 - aside, up), rng))
    return poses


def _low_poses(num: int, settings: Synthesize, ground: Ground, rng: np.random.Generator) -> list[np.ndarray]:
    """Photos from a pole, turned to the east and to the west in turn."""
    poses = []
    for i, x in enumerate(_stations(num, settings)):
        aside = rng.uniform(22.0, 40.0) * (1.0 if i % 2 == 0 else -1.0)
        place = np.array([x, -2.0]) + rng.normal(0, 0.3, 2)
        poses.append(
            _pose(ground, place, rng.uniform(5.0, 8.0), (90.0 - aside, rng.uniform(-20.0, -8.0)), rng)
        )
    return poses


def _stations(num: int, settings: Synthesize) -> np.ndarray:
    """(num,) x of the photos."""
    return np.linspace(-1, 1, num) * REACH * settings.side if num > 1 else np.zeros(num)


def _pose(
    ground: Ground, place: np.ndarray, height: float, gaze: tuple[float, float], rng: np.random.Generator
) -> np.ndarray:
    """cam_from_world at `place` (2,), `height` m above the ground there; gaze: heading (counter-clockwise
    from x) and elevation, degrees; held level within a degree.
    """
    heading, elevation = np.radians(gaze)
    center = np.array([*place, ground.height(place[None])[0] + height])
    level = np.cos(elevation)
    forward = np.array([level * np.cos(heading), level * np.sin(heading), np.sin(elevation)])
    tilt = np.tan(rng.normal(0, np.radians(1.0)))
    top = (tilt * np.sin(heading), -tilt * np.cos(heading), 1.0)
    return look_at(center, center + forward, top)
