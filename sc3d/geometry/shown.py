"""What the pixels of a photo show, told by the nearest sparse points that the photo sees: without a surface,
and a roof before the ground counts as what it is.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from sc3d.geometry.cameras import View, in_image, project, rays
from sc3d.geometry.held_out import ENOUGH, times_seen

NEAREST = 5  # sparse points that say what a pixel shows
CELL = 4  # px, side of the cells of which that is asked


def shown_cells(view: View, points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """(H / CELL, W / CELL) uint8: 1 in cells that show chosen points, by majority of the nearest ones.

    points: (T, 3) sparse points that the view sees; chosen: (T,) bool
    """
    rows = _nearest(view, points)[1]
    return (2 * chosen[rows].sum(axis=2) > rows.shape[2]).astype(np.uint8)


def enlarged(cells: np.ndarray, view: View) -> np.ndarray:
    """(H, W) bool pixels of cells of a view."""
    return cv2.resize(cells, (view.width, view.height), interpolation=cv2.INTER_NEAREST).astype(bool)


class Witnesses:
    """Views, and what they can know of the surface in a view that is not among them."""

    def __init__(self, views: list[View], tracks: list[np.ndarray], points: np.ndarray) -> None:
        """tracks: per view the rows of the sparse points that it sees; points: (N, 3) all sparse points"""
        self.views, self.tracks, self.points = views, tracks, points
        self.known = times_seen(tracks, len(points)) >= ENOUGH

    def pixels(self, view: View, rows: np.ndarray) -> np.ndarray:
        """(H, W) bool: pixels of another view that show what at least ENOUGH of these views see: by the
        nearest sparse points, and what lies at the depth of the nearest is in ENOUGH of their images too, or
        the outside of the capture, which has no points, would count as its border does.

        rows: (T,) of the sparse points that the other view sees
        """
        points = self.points[rows]
        cells, (pixels, nearest) = shown_cells(view, points, self.known[rows]), _nearest(view, points)
        if not cells.any():
            return enlarged(cells, view)
        directions, along = rays(view, pixels)
        depths = project(view, points)[1][nearest[..., 0].ravel()]
        places = view.center + directions * (depths / along)[:, None]
        count = np.zeros(len(places), int)
        for other, track in zip(self.views, self.tracks, strict=True):
            if np.isin(track, rows).any():  # it looks there
                found, ahead = project(other, places)
                count += in_image(other, found) & (ahead > 0)
        return enlarged(cells * (count >= ENOUGH).reshape(cells.shape).astype(np.uint8), view)

    def depth(self, view: View, rows: np.ndarray) -> np.ndarray:
        """(H, W) float32 depth z of another view at the pixels of those of its sparse points that ENOUGH of
        these views see, the nearest one's; 0 elsewhere.
        """
        pixels, depths = project(view, self.points[rows[self.known[rows]]])
        usable = in_image(view, pixels) & (depths > 0)
        nearest = np.full((view.height, view.width), np.inf, np.float32)
        columns, lines = pixels[usable].astype(int).T
        np.minimum.at(nearest, (lines, columns), depths[usable].astype(np.float32))
        return np.where(np.isfinite(nearest), nearest, 0)


def _nearest(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(C, 2) middles of the cells, px; (rows, columns, <= NEAREST) rows of the points nearest to each in the
    image, nearest first.
    """
    shape = -(-view.height // CELL), -(-view.width // CELL)
    across = (np.arange(shape[1]) + 0.5) * view.width / shape[1]
    down = (np.arange(shape[0]) + 0.5) * view.height / shape[0]
    cells = np.stack([middle.ravel() for middle in np.meshgrid(across, down)], 1)
    pixels, depths = project(view, points)
    usable = np.flatnonzero(in_image(view, pixels) & (depths > 0))
    count = min(NEAREST, len(usable))
    if not count:
        return cells, np.zeros((*shape, 0), int)
    nearest = cKDTree(pixels[usable]).query(cells, k=count)[1]
    return cells, usable[nearest].reshape(*shape, count)
