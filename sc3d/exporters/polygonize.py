"""Regions of a grid to polygons: traced along the cells' edges, simplified, and made rectangular where that
fits (shapely, rasterio).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sc3d.exporters.packages import load
from sc3d.geometry.raster import Raster

if TYPE_CHECKING:
    import shapely
else:
    shapely = load("shapely")

features, transforms = load("rasterio.features"), load("rasterio.transform")

MIN_IOU = 0.9  # IoU that a rectangular outline must have with the traced one, or it is not used

Side = tuple[int, float, float]  # axis that is constant along it (0 = x), its value there, its length


def polygonize(regions: np.ndarray, grid: Raster) -> dict[int, shapely.Polygon]:
    """The outline of each region, in the coordinates of the grid; of regions in several pieces that touch at
    corners at most, the largest piece.

    regions: (H, W) int32, 0 = none
    """
    transform = transforms.from_origin(grid.left, grid.top, grid.pixel, grid.pixel)
    found: dict[int, shapely.Polygon] = {}
    for geometry, value in features.shapes(
        regions.astype(np.int32), mask=regions > 0, connectivity=4, transform=transform
    ):
        polygon = shapely.geometry.shape(geometry)
        if int(value) not in found or polygon.area > found[int(value)].area:
            found[int(value)] = polygon
    return dict(sorted(found.items()))


def simplified(polygon: shapely.Polygon, tolerance: float) -> shapely.Polygon:
    """Douglas-Peucker, from the corner farthest from the middle, as the first one always stays; the traced
    outline if nothing valid is left.
    """
    rings = []
    for ring in (polygon.exterior, *polygon.interiors):
        corners = np.asarray(ring.coords)[:-1]
        rings.append(np.roll(corners, -int(np.argmax(np.hypot(*(corners - corners.mean(axis=0)).T))), axis=0))
    result = shapely.simplify(shapely.Polygon(rings[0], rings[1:]), tolerance)
    return result if isinstance(result, shapely.Polygon) and result.is_valid and result.area > 0 else polygon


def orthogonalized(polygon: shapely.Polygon, tolerance: float) -> shapely.Polygon:
    """The outline with right angles only, along its main directions; the simplified one where that would
    change it too much.

    tolerance: sides shorter than twice this are steps of the cells or noise, m
    """
    rough, reach = simplified(polygon, tolerance), 2 * tolerance
    border = np.concatenate(
        [
            np.asarray(shapely.segmentize(ring, reach / 4).coords)[:-1]
            for ring in (polygon.exterior, *polygon.interiors)
        ]
    )
    turn = main_direction(rough)
    sides = _sides(rough.exterior, turn, reach)
    if not sides:
        return rough
    turn += _tilt(sides, border @ _rotation(turn).T, reach)
    rings = []
    for ring in (rough.exterior, *rough.interiors):
        sides = _sides(ring, turn, reach)
        rings.append(
            _corners(_fitted(sides, border @ _rotation(turn).T, reach)) @ _rotation(turn) if sides else None
        )
    if rings[0] is None:
        return rough
    result = shapely.Polygon(rings[0], [ring for ring in rings[1:] if ring is not None])
    if not result.is_valid or result.intersection(polygon).area < MIN_IOU * result.union(polygon).area:
        return rough
    return result


def main_direction(polygon: shapely.Polygon) -> float:
    """Direction of the sides, radians modulo a right angle: the mean of four times their angles, weighted by
    squared length.
    """
    steps = np.concatenate(
        [np.diff(np.asarray(ring.coords), axis=0) for ring in (polygon.exterior, *polygon.interiors)]
    )
    vectors = steps[:, 0] + 1j * steps[:, 1]
    length = np.abs(vectors)
    folded = (np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0) ** 4 * length**2).sum()
    return float(np.angle(folded) / 4)


def _rotation(turn: float) -> np.ndarray:
    """(2, 2) from the world into the frame of the sides."""
    return np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])


def _sides(ring: shapely.LinearRing, turn: float, shortest: float) -> list[Side]:
    """The sides of a ring in the frame turned by `turn`, the two axes in turns, none shorter than `shortest`
    unless only four are left; [] if fewer.
    """
    sides = _alternate(np.asarray(ring.coords)[:-1] @ _rotation(turn).T)
    while len(sides) > 4:
        corners = _corners(sides)
        length = np.abs(np.roll(corners, -1, axis=0) - corners).max(axis=1)
        if length.min() >= shortest:
            break
        sides = _without(sides, int(np.argmin(length)))
    return sides


def _alternate(corners: np.ndarray) -> list[Side]:
    """Sides of a ring (K, 2), neighbors of one axis joined; [] if it has fewer than four."""
    steps = np.roll(corners, -1, axis=0) - corners
    middles = corners + 0.5 * steps
    axes = (np.abs(steps[:, 0]) >= np.abs(steps[:, 1])).astype(int)  # along x: y is constant
    changes = np.flatnonzero(axes != np.roll(axes, 1))
    if len(changes) < 4:
        return []
    sides: list[Side] = []
    for row in np.roll(np.arange(len(axes)), -changes[0]):
        axis = int(axes[row])
        side = (axis, float(middles[row, axis]), float(np.abs(steps[row]).max()))
        if sides and sides[-1][0] == axis:
            side = _joined(sides.pop(), side)
        sides.append(side)
    return sides


def _joined(first: Side, second: Side) -> Side:
    total = first[2] + second[2]
    return first[0], (first[1] * first[2] + second[1] * second[2]) / total, total


def _without(sides: list[Side], row: int) -> list[Side]:
    """The side is dropped and its two neighbors, which lie along the same axis, become one."""
    rolled = sides[row:] + sides[:row]
    return [_joined(rolled[-1], rolled[1]), *rolled[2:-1]]


def _corners(sides: list[Side]) -> np.ndarray:
    """(K, 2) where each side meets the one before it."""
    corners = np.empty((len(sides), 2))
    for row, (axis, value, _) in enumerate(sides):
        corners[row, axis], corners[row, 1 - axis] = value, sides[row - 1][1]
    return corners


def _near(sides: list[Side], border: np.ndarray, reach: float) -> list[np.ndarray]:
    """For each side, the border points (K, 2) within `reach` of it that are not at its ends; both in the
    frame of the sides.
    """
    corners, found = _corners(sides), []
    for row, (axis, value, _) in enumerate(sides):
        low, high = sorted((corners[row, 1 - axis], corners[(row + 1) % len(sides), 1 - axis]))
        inset = min(0.25 * (high - low), reach)
        along = border[:, 1 - axis]
        found.append(
            border[
                (np.abs(border[:, axis] - value) <= reach) & (along >= low + inset) & (along <= high - inset)
            ]
        )
    return found


def _tilt(sides: list[Side], border: np.ndarray, reach: float) -> float:
    """Mean angle of the border (N, 2) against its sides, radians: least squares along all sides at once."""
    products = squares = 0.0
    for (axis, _, _), points in zip(sides, _near(sides, border, reach)):
        if len(points):
            along, across = (points - points.mean(axis=0))[:, [1 - axis, axis]].T
            # the same turn has opposite slopes along x and y
            products += (along @ across) * (1 if axis else -1)
            squares += along @ along
    return float(np.arctan2(products, squares)) if squares else 0.0


def _fitted(sides: list[Side], border: np.ndarray, reach: float) -> list[Side]:
    """Each side moved to the median of the border (N, 2) along it."""
    near = _near(sides, border, reach)
    return [
        (axis, float(np.median(points[:, axis])) if len(points) else value, length)
        for (axis, value, length), points in zip(sides, near)
    ]
