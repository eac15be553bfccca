"""Meters, up is z: as the scene's place says, else up by the cameras and a scale by what stands on the
ground.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from sc3d.georeferencing.georeference import read_georeference
from sc3d.georeferencing.up_direction import find_up, view_poses
from sc3d.scene.scene import Scene
from sc3d.segmentation.shape.points import STANDS, Thinned, find_relief

logger = logging.getLogger(__name__)

TALL, SHARE = 7.5, 90  # m: the taller houses and trees, give or take half; of what stands, percent are lower
FIRST = 1 / 150  # the first guess of a meter, as a share of the extent on the plan
# guesses at most; one that is between these, times the one before, stands: windows that far off still find the ground
STEPS, LEAST, MOST = 4, 0.5, 4.0
CUBES = 400  # along the extent: one point of each is enough


@dataclass(frozen=True)
class Frame:
    """axes: (3, 3) rows x, y, up in the world; scale: m per world unit; measured: the scene's place says so"""

    axes: np.ndarray
    scale: float
    measured: bool

    def place(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) m of points (N, 3) world, from their lowest corner."""
        return (points - points.min(axis=0)) @ (self.axes * self.scale).T


def find_frame(scene: Scene, points: np.ndarray) -> Frame:
    """The frame of a scene; points: (N, 3) world of its cloud, for the scale where nothing else says it."""
    place = read_georeference(scene)
    if place is not None:
        matrix = np.asarray(place.local_from_world, np.float64)[:3, :3]
        scale = float(np.cbrt(np.linalg.det(matrix)))
        return Frame(matrix / scale, scale * (1.0 if place.origin is not None else place.unit), True)
    found = find_up(view_poses(scene.model.views, scene.images), scene.model.points)
    found.tell()
    axes = upright(found.up)
    return Frame(axes, estimate_scale((points - points.min(axis=0)) @ axes.T), False)


def upright(up: np.ndarray) -> np.ndarray:
    """(3, 3) rotation whose last row is `up` (3,), unit."""
    rest = np.linalg.svd(up[None])[2][1:]
    axes = np.vstack([rest, up])
    return axes * np.array([[np.sign(np.linalg.det(axes))], [1.0], [1.0]])


def estimate_scale(points: np.ndarray) -> float:
    """Meters per unit of points (N, 3), up is z: such that SHARE per cent of what stands on the ground is
    lower than TALL.
    """
    low, high = np.percentile(points[:, :2], [2, 98], axis=0)
    extent = float((high - low).max()) or 1.0
    inside = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)
    some, meter = Thinned.from_points(points[inside], None, extent / CUBES).points, FIRST * extent
    for _ in range(STEPS):
        tall = standing_height(some / meter) * meter
        if not tall:
            break
        previous, meter = meter, tall / TALL
        if LEAST * previous <= meter <= MOST * previous:
            break
    return 1 / meter


def standing_height(points: np.ndarray) -> float:
    """Height of the taller of what stands on the ground, in the unit of the points (N, 3); 0 = nothing does."""
    relief = find_relief(points, np.ones(len(points), bool))
    top = np.full(relief.ground.size, -np.inf)
    np.maximum.at(top, relief.grid.flat_cells(points), relief.height)
    tall = top[top > STANDS]
    return float(np.percentile(tall, SHARE)) if len(tall) else 0.0
