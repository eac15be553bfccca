"""On which side of the surface normals lie: programs that estimate them leave it to chance. The cameras
tell: what a photo shows faces it.
"""

from __future__ import annotations

import logging
from enum import Enum
from pathlib import Path

import numpy as np

from sc3d.geometry.cameras import View, in_image, project
from sc3d.geometry.neighbors import orient_normals

logger = logging.getLogger(__name__)

SAMPLE = 20_000  # points that are looked at
VIEWS = 60  # photos that look at them
PER_CELL = 8  # points of a cell of the image, of which the nearest is surely seen
LEAST = 50  # points in a photo that has a say
# shares of what is seen that faces its camera: of right normals 0.93 and more, leaves and grass included
RIGHT, INVERTED = 0.8, 0.2


class Sides(Enum):
    """What to do with the normals of a cloud: made anew, as they are, all turned around, each turned to the
    nearest camera.
    """

    ESTIMATE = "estimate"
    KEEP = "keep"
    INVERT = "invert"
    ORIENT = "orient"


def facing_share(points: np.ndarray, normals: np.ndarray, views: list[View]) -> float | None:
    """Share of what photos see first of the points (N, 3) whose normals (N, 3) face the photo; None if they
    see too few. World.
    """
    facing = count = 0
    for view in views[:: max(1, -(-len(views) // VIEWS))]:
        pixels, depths = project(view, points)
        inside = np.flatnonzero(in_image(view, pixels) & (depths > 0))
        if len(inside) < LEAST:
            continue
        side = max(1.0, float(np.sqrt(view.width * view.height * PER_CELL / len(inside))))
        columns, rows = (pixels[inside] // side).astype(np.int64).T
        cells = rows * (int(view.width // side) + 2) + columns
        order = np.lexsort((depths[inside], cells))
        first = inside[order[np.diff(cells[order], prepend=-1) > 0]]
        facing += int((np.einsum("ij,ij->i", view.center - points[first], normals[first]) > 0).sum())
        count += len(first)
    return facing / count if count else None


def judge_sides(points: np.ndarray, normals: np.ndarray, views: list[View], path: Path) -> Sides:
    """What to do with the normals of a cloud, by some of its points (N, 3) and their normals (N, 3); a
    warning if they are not right as they are.
    """
    share = facing_share(points, normals, views)
    if share is None or share >= RIGHT:
        return Sides.KEEP
    sides = Sides.INVERT if share <= INVERTED else Sides.ORIENT
    logger.warning(
        "%s: %.0f %% of the normals that photos see point away from them: %s",
        path,
        100 * (1 - share),
        "all are turned around" if sides is Sides.INVERT else "each is turned to the nearest camera",
    )
    return sides


def with_sides(points: np.ndarray, normals: np.ndarray, views: list[View], sides: Sides) -> np.ndarray:
    """(N, 3) unit normals at points (N, 3), turned as `judge_sides` says."""
    if sides in (Sides.KEEP, Sides.ESTIMATE):
        return normals
    if sides is Sides.INVERT:
        return -normals
    return orient_normals(points, normals, np.array([view.center for view in views]))


def sample_step(num_points: int) -> int:
    """Every how many points one is looked at."""
    return max(1, num_points // SAMPLE)
