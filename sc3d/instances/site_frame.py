"""Meters with z up, in which objects are told apart: from the world of a scene."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from sc3d.georeferencing.georeference import read_georeference
from sc3d.georeferencing.up_direction import scene_up
from sc3d.scene.scene import Scene

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SiteFrame:
    """site_from_world: (3, 3) similarity; measured: the scene's place says so, else 1 unit is taken as 1 m"""

    site_from_world: np.ndarray
    measured: bool

    @classmethod
    def of_scene(cls, scene: Scene) -> SiteFrame:
        """By the georeference; without one z turned up, as the cameras have it."""
        place = read_georeference(scene)
        if place is not None:
            matrix = np.asarray(place.local_from_world, np.float64)[:3, :3]
            return cls(matrix * (place.unit if place.origin is None else 1.0), True)
        up = scene_up(scene)
        return cls(np.eye(3) if up is None else turned_up(up), False)

    def place(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) m of points (N, 3) world."""
        return np.asarray(points, np.float64) @ self.site_from_world.T

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) world of points (N, 3) m."""
        return np.linalg.solve(self.site_from_world, np.asarray(points, np.float64).T).T

    def warn(self, scene: Scene) -> None:
        """One line, where nothing says how long a meter is."""
        if not self.measured:
            logger.warning(
                "%s has no georeference: its objects are told apart as if 1 unit were 1 m; if it is not, give it "
                "a place with `sc3d georeference`",
                scene.path,
            )


def turned_up(up: np.ndarray) -> np.ndarray:
    """(3, 3) the smallest rotation that turns `up` (3,), unit, to z (Rodrigues)."""
    x, y, z = up
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1 + z)
