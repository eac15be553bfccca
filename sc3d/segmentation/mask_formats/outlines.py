"""Regions as other programs store them, polygons and run-length codes, turned into pixels.

One rule for all formats: x to the right, y down, px; the top-left pixel covers 0 to 1, and a pixel belongs to
a polygon if its center does. So polygons that share an edge neither overlap nor leave a gap, which programs
that also draw the boundary's pixels cannot say. Everything is checked when it is built, against the size of
the image and before memory is taken; OutlineError says what is wrong.

`rasterio.features.rasterize` has the same rule but for centers that lie on an edge, which it gives to the
other side (of random polygons with corners at whole or half pixels, 82 % and 62 % differ by some pixels, of
others none). Against what the formats' own libraries draw (tests/segmentation/mask_files) it differs in 216
px of LabelMe, 31 of COCO and 135 of CVAT, this module in 276, 29 and 135. It takes 0.17 ms for a car, 0.9 ms
for a building and 40 ms for 2000 corners in a 20-megapixel photo; this 0.07, 2.2 and 33 ms. So it is not
worth 100 MB that every user would have to install.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

CROSSINGS_AT_ONCE = 1 << 20  # of edges and rows
MAX_SAGITTA = 0.02  # px by which the polygon that stands for an ellipse may miss it

Values = Sequence | np.ndarray  # numbers, or texts of numbers, as a file holds them


class OutlineError(ValueError):
    """A region that cannot be drawn; the text completes "the region ..."."""


@dataclass(frozen=True)
class Polygons:
    """The union of closed polygons. rings: each (N, 2) float64 x, y, px; inside by the even-odd rule."""

    rings: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class RunLengths:
    """A run-length code of a box of pixels.

    counts: (N,) int64 lengths of runs, in turn outside and inside; they sum to width x height
    box: left, top, width, height, px
    by_column: runs go down the columns (COCO), otherwise along the rows (CVAT)
    """

    counts: np.ndarray
    box: tuple[int, int, int, int]
    by_column: bool


@dataclass(frozen=True)
class MaskCrop:
    """The pixels of a region: mask is (height, width) bool, its top-left pixel lies at column `left` and row
    `top`.
    """

    left: int
    top: int
    mask: np.ndarray

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the image that the crop covers."""
        return slice(self.top, self.top + self.mask.shape[0]), slice(
            self.left, self.left + self.mask.shape[1]
        )


def polygons(rings: Iterable[Values], size: tuple[int, int]) -> Polygons:
    """Build polygons from coordinates, each ring (N, 2) or x, y, x, y, ...; size: (width, height) px of the
    image.
    """
    checked = tuple(_ring(ring, size) for ring in rings)
    if not checked:
        raise OutlineError("has no polygon")
    corners = np.concatenate(checked)
    low, high = corners.min(axis=0), corners.max(axis=0)
    # What reaches a whole image beyond the edge was drawn on another image; a little beyond is how polygons
    # reach the edge.
    if (
        (high <= 0).any()
        or (low >= size).any()
        or (low < -np.array(size)).any()
        or (high > 2 * np.array(size)).any()
    ):
        raise OutlineError("lies outside of the image")
    return Polygons(checked)


def _ring(ring: Values, size: tuple[int, int]) -> np.ndarray:
    points = numbers(ring)
    if points.size % 2 or points.size < 6:
        raise OutlineError("is a polygon of fewer than three points")
    points = points.reshape(-1, 2)
    rows = np.clip(points[:, 1], 0, size[1])
    if np.abs(rows - np.roll(rows, 1)).sum() > size[0] * size[1] + 2 * size[1]:
        raise OutlineError("crosses more rows than the image has pixels")
    return points


def rectangle(corner: Values, opposite: Values, rotation: float, size: tuple[int, int]) -> Polygons:
    """A rectangle from two opposite corners, turned by `rotation` degrees (clockwise as seen) around its
    center.
    """
    (x0, y0), (x1, y1) = numbers(corner), numbers(opposite)
    points = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return polygons([_turn(points, ((x0 + x1) / 2, (y0 + y1) / 2), rotation)], size)


def ellipse(center: Values, radii: Values, rotation: float, size: tuple[int, int]) -> Polygons:
    """An ellipse with half axes `radii` px, turned by `rotation` degrees (clockwise as seen) around its
    center.
    """
    (x, y), half = numbers(center), numbers(radii)
    if not (half > 0).all() or (half > 3 * max(size)).any():
        raise OutlineError("is an ellipse whose radii do not fit the image")
    num_points = max(16, math.ceil(math.pi / math.acos(1 - min(MAX_SAGITTA / half.max(), 0.1))))
    angle = np.arange(num_points) * (2 * np.pi / num_points)
    points = np.stack([x + half[0] * np.cos(angle), y + half[1] * np.sin(angle)], axis=1)
    return polygons([_turn(points, (x, y), rotation)], size)


def _turn(points: np.ndarray, center: tuple[float, float], degrees: float) -> np.ndarray:
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return (points - center) @ np.array([[cos, sin], [-sin, cos]]) + center if degrees else points


def run_lengths(
    counts: Values, box: tuple[int, int, int, int], by_column: bool, size: tuple[int, int]
) -> RunLengths:
    """Build a run-length code; the sum of the counts is checked before anything of that size exists."""
    left, top, width, height = box
    if width < 1 or height < 1 or left < 0 or top < 0 or left + width > size[0] or top + height > size[1]:
        raise OutlineError("lies outside of the image")
    lengths = numbers(counts)
    if (
        (lengths < 0).any()
        or (lengths > width * height).any()
        or (lengths != np.floor(lengths)).any()
        or int(lengths.sum()) != width * height
    ):
        raise OutlineError("has a run-length code that does not add up to its width x height")
    return RunLengths(lengths.astype(np.int64), box, by_column)


def row_lengths(mask: np.ndarray) -> np.ndarray:
    """Counts along the rows of a (H, W) bool mask."""
    flat = mask.ravel()
    changes = np.flatnonzero(np.diff(flat, prepend=False))
    return np.diff(changes, prepend=0, append=flat.size)


def numbers(values: Values) -> np.ndarray:
    """(...) float64 of decoded numbers or texts of numbers; OutlineError unless all are finite."""
    try:
        array = np.array(values, np.float64)
    except (ValueError, TypeError, OverflowError):
        raise OutlineError("has coordinates that are not numbers") from None
    if not np.isfinite(array).all():
        raise OutlineError("has coordinates that are not finite numbers")
    return array


def rasterize(outline: Polygons | RunLengths, size: tuple[int, int]) -> MaskCrop:
    """The pixels of a region, in the smallest box that surely holds them; size: (width, height) px of the
    image.
    """
    if isinstance(outline, RunLengths):
        return _decode(outline)
    corners = np.concatenate(outline.rings)
    left, top = np.clip(np.floor(corners.min(axis=0)), 0, size).astype(int).tolist()
    right, bottom = np.clip(np.ceil(corners.max(axis=0)), 0, size).astype(int).tolist()
    mask = np.zeros((bottom - top, right - left), bool)
    for ring in outline.rings:
        mask |= _fill(ring - (left, top), *mask.shape)
    return MaskCrop(left, top, mask)


def _fill(ring: np.ndarray, height: int, width: int) -> np.ndarray:
    """(height, width) bool: pixels whose center lies inside. Every edge toggles, in each row it crosses, all
    pixels to the right of it.
    """
    toggles = np.zeros(height * (width + 1), np.uint8)
    ends = np.roll(ring, -1, axis=0)
    # From the upper to the lower end, so that an edge that two polygons share, once in each sense, is
    # computed alike.
    swap = (ring[:, 1] > ends[:, 1])[:, None]
    upper, lower = np.where(swap, ends, ring), np.where(swap, ring, ends)
    first, stop = (np.clip(np.ceil(end[:, 1] - 0.5), 0, height).astype(np.int64) for end in (upper, lower))
    total = np.cumsum(stop - first)
    for begin in range(0, int(total[-1]), CROSSINGS_AT_ONCE):
        crossing = np.arange(begin, min(begin + CROSSINGS_AT_ONCE, int(total[-1])))
        edge = np.searchsorted(total, crossing, side="right")
        row = stop[edge] - (total[edge] - crossing)
        (x0, y0), (x1, y1) = upper[edge].T, lower[edge].T
        column = np.ceil(x0 + (row + 0.5 - y0) * ((x1 - x0) / (y1 - y0)) - 0.5)
        np.bitwise_xor.at(
            toggles, row * (width + 1) + np.clip(column, 0, width).astype(np.int64), np.uint8(1)
        )
    return np.bitwise_xor.accumulate(toggles.reshape(height, width + 1), axis=1)[:, :-1].astype(bool)


def _decode(outline: RunLengths) -> MaskCrop:
    """Decode only the lines (columns or rows) between the first and the last pixel inside."""
    left, top, width, height = outline.box
    length = height if outline.by_column else width
    ends = np.cumsum(outline.counts)
    inside = np.flatnonzero(outline.counts[1::2])
    if not len(inside):
        return MaskCrop(left, top, np.zeros((0, 0), bool))
    first, last = ends[2 * inside[0]] // length, (ends[2 * inside[-1] + 1] - 1) // length
    bounds = np.clip(ends, first * length, (last + 1) * length)
    values = np.repeat(np.arange(len(bounds)) % 2 == 1, np.diff(bounds, prepend=first * length))
    lines = values.reshape(int(last - first + 1), length)
    return (
        MaskCrop(left + int(first), top, lines.T)
        if outline.by_column
        else MaskCrop(left, top + int(first), lines)
    )
