"""Distances, areas and profiles between picked points, in meters where the scene has a place on Earth. Needs no
window.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sc3d.errors import InputError
from sc3d.georeferencing.georeference import Georeference

MOST_BINS = 500  # rows of a profile's table
LEAST_SPACINGS = 2.0  # length of a row of it, in point spacings
CRS_DECIMALS, LOCAL_DECIMALS = 3, 4


@dataclass(frozen=True)
class MeasureFrame:
    """What coordinates and lengths of a scene are told in.

    georeference: None = the scene's own coordinates, z up, whose scale nobody knows
    """

    georeference: Georeference | None = None

    @property
    def unit(self) -> str:
        """Of lengths."""
        return "units" if self.georeference is None else "m"

    @property
    def name(self) -> str:
        """Of the frame of coordinates."""
        return "scene, scale unknown" if self.georeference is None else f"EPSG:{self.georeference.epsg}"

    @property
    def axes(self) -> tuple[str, str, str]:
        return ("x", "y", "z") if self.georeference is None else ("easting", "northing", "height")

    def coordinates(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) world to (N, 3) float64 in the CRS, or as they are."""
        points = np.asarray(points, np.float64)
        return points if self.georeference is None else self.georeference.to_crs(points)

    def to_world(self, coordinates: np.ndarray) -> np.ndarray:
        """The inverse of `coordinates`."""
        coordinates = np.asarray(coordinates, np.float64)
        return coordinates if self.georeference is None else self.georeference.from_crs(coordinates)

    def lengths(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) world to (N, 3) float64 in which lengths are measured: east, north (on the ground, not on the
        stretched grid of the CRS, where the world is local ENU) and the height of the CRS, m; scene units
        without a georeference.
        """
        points, place = np.asarray(points, np.float64), self.georeference
        if place is None:
            return points
        heights = place.to_crs(points)[:, 2] * place.unit
        matrix = np.asarray(place.local_from_world, np.float64)
        local = (points @ matrix[:3, :3].T + matrix[:3, 3])[:, :2]
        return np.column_stack([local * (place.unit if place.origin is None else 1.0), heights])

    def tell(self, coordinates: np.ndarray) -> list[str]:
        """Three numbers as people read and copy them."""
        digits = LOCAL_DECIMALS if self.georeference is None else CRS_DECIMALS
        return [f"{value:.{digits}f}" for value in coordinates]


@dataclass(frozen=True)
class Line:
    """Lengths along a line of two points or more. height: of the last above the first; direct: between them"""

    length: float
    horizontal: float
    height: float
    direct: float

    @classmethod
    def through(cls, corners: np.ndarray) -> Line:
        """corners: (K, 3) as `MeasureFrame.lengths` has them."""
        steps = np.diff(corners, axis=0)
        return cls(
            float(np.linalg.norm(steps, axis=1).sum()),
            float(np.linalg.norm(steps[:, :2], axis=1).sum()),
            float(corners[-1, 2] - corners[0, 2]),
            float(np.linalg.norm(corners[-1] - corners[0])),
        )


@dataclass(frozen=True)
class Area:
    """horizontal: area of the outline on the plan; on_plane: on the plane that fits its corners best, which is
    tilted by `tilt` degrees and from which the farthest corner is `off`; perimeter
    """

    horizontal: float
    on_plane: float
    tilt: float
    off: float
    perimeter: float

    @classmethod
    def of(cls, corners: np.ndarray) -> Area:
        """corners: (K, 3) as `MeasureFrame.lengths` has them; InputError for fewer than three, or for an
        outline that crosses itself on the plane that fits best.
        """
        if len(corners) < 3:
            raise InputError("an area needs three corners")
        middle = corners.mean(axis=0)
        _, _, axes = np.linalg.svd(corners - middle)
        on_plane = (corners - middle) @ axes[:2].T
        if _crosses_itself(on_plane):
            raise InputError("the outline crosses itself: go around the area corner by corner")
        return cls(
            abs(_shoelace(corners[:, :2] - middle[:2])),
            abs(_shoelace(on_plane)),
            float(np.degrees(np.arccos(min(abs(axes[2, 2]), 1.0)))),
            float(np.abs((corners - middle) @ axes[2]).max()),
            float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).sum()),
        )


def _shoelace(corners: np.ndarray) -> float:
    x, y = corners.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _crosses_itself(corners: np.ndarray) -> bool:
    """Whether two sides that are no neighbors cross. corners: (K, 2)"""
    ends = np.roll(corners, -1, axis=0)
    for one in range(len(corners)):
        for other in range(one + 2, len(corners) - (one == 0)):
            a, b, c, d = corners[one], ends[one], corners[other], ends[other]
            if _side(a, b, c) * _side(a, b, d) < 0 and _side(c, d, a) * _side(c, d, b) < 0:
                return True
    return False


def _side(start: np.ndarray, end: np.ndarray, point: np.ndarray) -> float:
    """Positive to the left of a line, negative to the right."""
    (x, y), (px, py) = end - start, point - start
    return float(x * py - y * px)


@dataclass(frozen=True)
class Profile:
    """The points near a line, along it.

    rows: (N,) of the cloud; along, height: (N,) from the start of the line, and as measured; length: of the
        line on the plan; half_width: farthest points
    """

    rows: np.ndarray
    along: np.ndarray
    height: np.ndarray
    length: float
    half_width: float

    @classmethod
    def along_line(cls, points: np.ndarray, corners: np.ndarray, half_width: float) -> Profile:
        """points: (N, 3), corners: (K, 3) as `MeasureFrame.lengths` has them. On a line with bends a point
        counts for the nearest stretch. InputError if there is none.
        """
        if len(corners) < 2:
            raise InputError("a profile needs two points")
        if not half_width > 0:
            raise InputError("a profile needs a half width above 0")
        bends = _plan_of(corners)
        starts = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(bends, axis=0), axis=1))])
        if len(bends) < 2:
            raise InputError("the points of the line lie above one another: it has no length on the plan")
        low, high = bends.min(axis=0) - half_width, bends.max(axis=0) + half_width
        near = np.flatnonzero(((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1))
        along, away = _nearest_on_line(points[near, :2], bends, starts)
        inside = np.flatnonzero(away <= half_width)
        if not len(inside):
            raise InputError("no point of the cloud is so near to the line: take a larger half width")
        order = inside[np.argsort(along[inside], kind="stable")]
        return cls(near[order], along[order], points[near[order], 2], float(starts[-1]), half_width)

    def table(self, spacing: float) -> np.ndarray:
        """(R, 5) distance, lowest, median and highest height, and number of points of stretches of equal
        length: LEAST_SPACINGS x spacing, longer if there were more than MOST_BINS; those without points are
        left out.
        """
        step = self.step(spacing)
        bins = np.minimum(self.along / step, np.ceil(self.length / step) - 1).astype(np.int64)
        first = np.flatnonzero(np.concatenate([[True], bins[1:] != bins[:-1]]))
        parts = np.split(self.height, first[1:])
        return np.array(
            [
                ((number + 0.5) * step, part.min(), np.median(part), part.max(), len(part))
                for number, part in zip(bins[first], parts)
            ]
        )

    def step(self, spacing: float) -> float:
        """Length of the stretches of `table`."""
        return max(LEAST_SPACINGS * spacing, self.length / MOST_BINS)

    def csv(self, spacing: float, unit: str) -> str:
        """`table` as text."""
        head = f"distance_{unit},lowest_{unit},median_{unit},highest_{unit},points"
        rows = [
            f"{row[0]:.3f},{row[1]:.3f},{row[2]:.3f},{row[3]:.3f},{row[4]:.0f}" for row in self.table(spacing)
        ]
        return "\n".join([head, *rows]) + "\n"


def _plan_of(corners: np.ndarray) -> np.ndarray:
    """(K, 2) of a line on the plan, without stretches of no length."""
    plan = corners[:, :2]
    return plan[np.concatenate([[True], (np.diff(plan, axis=0) != 0).any(axis=1)])]


def _nearest_on_line(
    plan: np.ndarray, bends: np.ndarray, starts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where on a line points (N, 2) are, and how far from it; infinitely far before its start and behind its
    end.

    bends: (K, 2); starts: (K,) lengths up to them
    """
    along, away = np.zeros(len(plan)), np.full(len(plan), np.inf)
    for place, (start, end) in enumerate(zip(bends[:-1], bends[1:])):
        length = starts[place + 1] - starts[place]
        direction = (end - start) / length
        reached = (plan - start) @ direction
        on_line = np.clip(reached, 0, length)
        distance = np.linalg.norm(plan - start - on_line[:, None] * direction, axis=1)
        nearer = distance < away
        if place == 0:
            nearer &= reached >= 0
        if place == len(bends) - 2:
            nearer &= reached <= length
        along[nearer], away[nearer] = starts[place] + on_line[nearer], distance[nearer]
    return along, away
