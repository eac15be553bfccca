"""Which photos training leaves out to be judged by: every Nth, which asks for views between others, and a
sector, a contiguous part of the capture, which asks for views beyond them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from sc3d.errors import InputError
from sc3d.geometry.cameras import View

ENOUGH = 2  # photos that must see a point, or its place is not known
MOST_SEEDS = 16  # outermost cameras around which a sector is tried
_ROWS = 1000  # of the matrix of distances at a time


@dataclass(frozen=True)
class HeldOut:
    """Indices of views, ascending. every_nth: of those outside the sector; trained: those in neither."""

    every_nth: list[int]
    sector: list[int]
    trained: list[int]

    @property
    def all(self) -> list[int]:
        """Every view that is not trained on, ascending."""
        return sorted(self.every_nth + self.sector)


def held_out_views(
    views: list[View], tracks: list[np.ndarray], points: np.ndarray, every: int, share: float
) -> HeldOut:
    """Split the views. every: N of every Nth, by order, 0 = none; share: of the views that the sector takes,
    0 = none; the others as in `sector_views`. Raises InputError if fewer than two are left.
    """
    sector = sector_views(views, tracks, points, share) if share else []
    rest = [index for index in range(len(views)) if index not in set(sector)]
    every_nth = rest[every - 1 :: every] if every else []
    trained = [index for index in rest if index not in set(every_nth)]
    if len(trained) < ENOUGH:
        raise InputError(
            f"{len(trained)} photos to train on, and {len(views) - len(trained)} held out: at least {ENOUGH} are needed"
        )
    return HeldOut(every_nth, sector, trained)


def sector_views(views: list[View], tracks: list[np.ndarray], points: np.ndarray, share: float) -> list[int]:
    """A contiguous part of a capture: the cameras nearest to an outermost one, in place and viewing direction
    together. It depends on the cameras and points, not on names or order.

    views: any frame; tracks: per view the rows of the sparse points that it sees; points: (N, 3) of these
    share: of the views, above 0 and below 1; at least one is taken
    returns: indices, ascending. Outermost is a camera that is farthest from some other. Of several, the one
        is taken of whose sector the others see most: of the sightings in it, those whose point ENOUGH others
        see.
    """
    places = _places(views, points)
    order = np.lexsort(places.T)  # ties must not depend on the order of the views
    places, count = places[order], max(1, round(share * len(views)))
    seeds = _outermost(places)
    spread = np.unique(np.linspace(0, len(seeds) - 1, min(len(seeds), MOST_SEEDS)).round().astype(int))
    nearest = np.argsort(_distances(places[seeds[spread]], places), axis=1, kind="stable")[:, :count]
    sectors = [order[near] for near in nearest]
    kept = _shares_kept([np.unique(track) for track in tracks], len(points), sectors)
    return sorted(sectors[int(np.argmax(kept))].tolist())


def times_seen(tracks: list[np.ndarray], num_points: int) -> np.ndarray:
    """(num_points,) int64 in how many of the views each sparse point is seen. tracks: per view its rows"""
    rows = np.concatenate([np.zeros(0, np.int64), *(np.unique(track) for track in tracks)])
    return np.bincount(rows.astype(np.int64), minlength=num_points)


def _places(views: list[View], points: np.ndarray) -> np.ndarray:
    """(V, 6) where each camera stands and looks: its center, in units in which the capture is about as wide
    as directions are far apart, and its unit direction.
    """
    centers = np.stack([view.center for view in views])
    middle = np.median(centers, axis=0)
    scale = np.median(np.linalg.norm(centers - middle, axis=1))
    if len(points):  # of photos taken from one spot the directions decide, not its few centimeters
        scale = max(scale, 0.5 * np.median(np.linalg.norm(points - middle, axis=1)))
    directions = np.stack([view.cam_from_world[2, :3] for view in views])
    return np.hstack([(centers - middle) / max(float(scale), 1e-12), directions])


def _outermost(places: np.ndarray) -> np.ndarray:
    """Rows, ascending, of those that are the farthest from some row."""
    parts = range(0, len(places), _ROWS)
    farthest = [_distances(places[row : row + _ROWS], places).argmax(axis=1) for row in parts]
    return np.unique(np.concatenate(farthest))


def _distances(some: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Without their last digits, so that what is equally far is so."""
    return cdist(some, places).round(9)


def _shares_kept(tracks: list[np.ndarray], num_points: int, sectors: list[np.ndarray]) -> list[float]:
    """Per sector the share of its sightings whose point ENOUGH other views see."""
    total, kept = times_seen(tracks, num_points), []
    for sector in sectors:
        inside = times_seen([tracks[index] for index in sector], num_points)
        kept.append(float(inside[total - inside >= ENOUGH].sum() / max(inside.sum(), 1)))
    return kept
