"""Which photo sees a place best, and from where on the line of its look the place can be looked at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sc3d.annotate.questions import Evidence
from sc3d.geometry.cameras import View, in_image, project, rays
from sc3d.geometry.raycast import RayTarget

PROBES = 200  # points of a place that are looked for in photos
CANDIDATES = 8  # photos in which the place is largest, of which one is taken that sees most of it
# of the range, and two point spacings: how far behind the first surface a point is seen
RANGE_TOLERANCE = 0.01
LEAST_SEEN = 0.2  # share of a place that a photo must see
ALMOST = 0.98  # of the most that any of these photos sees: then the one that shows it largest is taken
CLEAR = 0.9  # of the way from a camera to what is behind it, that one can step back


@dataclass(frozen=True)
class Line:
    """A free line of sight, world. target: (3,) point of a place; towards: (3,) unit, from there through a
    photo's camera; reach: how far away on it nothing is in the way, inf = any
    """

    target: np.ndarray
    towards: np.ndarray
    reach: float


@dataclass(frozen=True)
class Shown:
    """Where a place is seen: the view, the rows of its points that are, and a line from about their
    middle.
    """

    view: View
    rows: np.ndarray
    line: Line


class BestPhoto:
    """Finds the photo of places of one cloud; the surface that hides them is made when it is first needed."""

    def __init__(self, known: Evidence, views: Sequence[View], surface: Callable[[], RayTarget]) -> None:
        self._known, self._views, self._make = known, views, surface
        self._made: RayTarget | None = None

    def find(self, rows: np.ndarray) -> Shown | None:
        """Where most of a place is seen, large; None if no photo sees enough of it. rows: (R,) of its
        points
        """
        points = self._known.points[rows[:: max(1, len(rows) // PROBES)]]
        sizes = []
        for view in self._views:
            pixels, depth = project(view, points)
            inside = in_image(view, pixels) & (depth > 0)
            near = float(np.median(depth[inside])) if inside.any() else np.inf
            sizes.append(float(inside.mean()) * (view.focal / near) ** 2)
        candidates = np.argsort(-np.array(sizes), kind="stable")[:CANDIDATES]
        seen = np.array([self._seen(self._views[index], points).mean() for index in candidates])
        if not len(seen) or seen.max() < LEAST_SEEN:
            return None
        found = self._views[candidates[np.argmax(seen >= ALMOST * seen.max())]]  # the largest of them
        rows = rows[self._seen(found, self._known.points[rows])]
        return Shown(found, rows, self._line(found, self._known.points[rows])) if len(rows) else None

    def _line(self, view: View, points: np.ndarray) -> Line:
        """From about the middle of what a photo sees to the photo and, up to what stands behind it, on."""
        target = points[np.argmin(((points - points.mean(axis=0)) ** 2).sum(axis=1))]
        towards = view.center - target
        distance = float(np.linalg.norm(towards))
        towards = towards / distance
        behind, _ = self._surface.cast(view, (view.cam_from_world[:3, :3] @ towards)[None].astype(np.float32))
        return Line(target, towards, distance + CLEAR * float(behind[0]))

    @property
    def _surface(self) -> RayTarget:
        if self._made is None:
            self._made = self._make()
        return self._made

    def _seen(self, view: View, points: np.ndarray) -> np.ndarray:
        """(N,) bool points that lie in the image and not behind the first surface."""
        pixels, _ = project(view, points)
        inside = in_image(view, pixels)
        directions, _ = rays(view, pixels[inside])
        reach, _ = self._surface.cast(view, (directions @ view.cam_from_world[:3, :3].T).astype(np.float32))
        distance = np.linalg.norm(points[inside] - view.center, axis=1)
        seen = np.zeros(len(points), bool)
        seen[inside] = distance <= reach + 2 * self._known.spacing + RANGE_TOLERANCE * distance
        return seen
