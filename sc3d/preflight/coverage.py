"""A map of how many photos show each place."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sc3d.georeferencing.alignment import fit_similarity_robust, main_plane
from sc3d.georeferencing.gps import MIN_GPS, OUTLIER_METERS, Flight
from sc3d.scene.scene import SparseModel

ACROSS = 32  # cells along the longer side
BORDER = 0.01  # share of the points beyond each side of the map: some lie far off
ENOUGH = 3  # photos that make a surface sure


@dataclass(frozen=True)
class Coverage:
    """photos: (rows, columns) int, how many show each cell, north or top first; cell: its side; metric: in m,
    not in units of the model.
    """

    photos: np.ndarray
    cell: float
    metric: bool

    @property
    def enough(self) -> float:
        """Share of the cells that photos show at all which ENOUGH show."""
        shown = self.photos > 0
        return float((self.photos >= ENOUGH).sum() / max(shown.sum(), 1))

    def text(self) -> str:
        """A character per cell, twice as high as wide as characters are: the number of photos, + from ten on."""
        rows = self.photos[: len(self.photos) // 2 * 2].reshape(-1, 2, self.photos.shape[1]).max(axis=1)
        return "\n".join(
            "".join("." if not count else str(count) if count < 10 else "+" for count in row) for row in rows
        )


def coverage_of(model: SparseModel, points: np.ndarray, metric: bool) -> Coverage | None:
    """What a photo shows from above is the convex hull of the points that it sees. points: (P, 3) those of
    the model, z up; None without any.
    """
    seen = np.unique(np.concatenate([*model.tracks, np.zeros(0, int)])).astype(int)
    if not len(seen):
        return None
    low, high = np.quantile(points[seen, :2], [BORDER, 1 - BORDER], axis=0)
    cell = float(max((high - low).max(), 1e-9)) / ACROSS
    columns, rows = np.maximum(np.ceil((high - low) / cell).astype(int), 1)
    photos = np.zeros((rows, columns), int)
    for track in model.tracks:
        place = np.floor((points[track, :2] - low) / cell).astype(np.int32)
        place = place[((place >= 0) & (place < (columns, rows))).all(axis=1)]
        if len(place):
            outline = cv2.convexHull(np.ascontiguousarray(place.reshape(-1, 1, 2)))
            photos += cv2.fillConvexPoly(np.zeros((rows, columns), np.uint8), outline, 1)[::-1]
    return Coverage(photos, cell, metric)


def leveled(model: SparseModel, flight: Flight | None) -> tuple[np.ndarray, bool]:
    """(P, 3) points of a model of any frame, z up, and whether they are in m, east and north: placed by GPS
    where that fits, else laid on their main plane.
    """
    views = [view for view in model.views if flight and view.name in flight.positions]
    if flight and len(views) > MIN_GPS:
        centers = np.array([view.center for view in views])
        places = np.array([flight.positions[view.name] for view in views])
        fit, kept = fit_similarity_robust(centers, places, OUTLIER_METERS)
        if kept.sum() > max(MIN_GPS, len(views) / 2):
            return fit.apply(model.points), True
    if len(model.points) < MIN_GPS:
        return model.points, False
    axes, middle = main_plane(model.points)
    return (model.points - middle) @ axes.T, False
