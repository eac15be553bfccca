"""What a camera sees of a site that is known from above: rays that pass below its top are blocked."""

from __future__ import annotations

import numpy as np

from sc3d.geometry.raster import Raster

CLEAR = 0.3  # a ray this far below the top of a cell is blocked, m
NEAR = 2  # cells from the start of a ray that do not block it, as points lie on what they are of


def in_sight(grid: Raster, tops: np.ndarray, points: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """(N,) bool: points that nothing on the way to the eye hides.

    tops: (H, W) z of the highest point of each cell, -inf = nothing; points: (N, 3) and eye: (3,), in the
        coordinates of the grid
    """
    ways = eye - points
    length = np.maximum(np.hypot(ways[:, 0], ways[:, 1]), 1e-9)
    step = ways * (grid.pixel / length)[:, None]
    highest = tops.max(initial=-np.inf)
    # up to the eye, or to where the ray is above everything
    rise = np.maximum(step[:, 2], 1e-12)
    above = np.where(step[:, 2] > 0, (highest - points[:, 2]) / rise, np.inf)
    last = np.minimum(length / grid.pixel, above)
    seen, number = np.ones(len(points), bool), NEAR
    while True:
        rows = np.flatnonzero(seen & (last > number))
        if not len(rows):
            return seen
        places = points[rows] + number * step[rows]
        inside = grid.holds(places)
        seen[rows] = ~inside | (tops.ravel()[grid.flat_cells(places)] < places[:, 2] + CLEAR)
        last[rows[~inside]] = 0.0  # the site has an edge, and nothing is known beyond
        number += 1
