"""Colour and relief as two more raters (METHOD section 6): what agreed points of each class look like, as joint histograms.

The masks' errors are shared between views, so no voting removes them. Colour and relief (height above the ground around, roughness, slope) err
otherwise. Each rater alone is poor; their product is good, because the two hardly depend on one another once the class is known, and because
neither can learn what only their combination would tell apart: errors of the masks such as "flat, low and dark: tree".
Counts are integers and bins are quantiles, so nothing depends on the order of points or the unit of length.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, minimum_filter

from sc3d.geometry.graph import Graph

logger = logging.getLogger(__name__)

COLOR_BINS, RELIEF_BINS = 24, 12  # per feature; 24^3 and 12^4 cells
COLOR_BLUR, RELIEF_BLUR = 1.0, 0.7  # standard deviation, bins
PRIOR_WEIGHT = 2.0  # points of the overall mixture added to each cell
MIN_EXAMPLES = 500  # agreed points of a class; with fewer the raters do not know it
UNKNOWN = np.log(0.05)  # their probability of a class they do not know
MIN_SKILL = 0.5  # share of the errors of "always the commonest class" that they must avoid on points held out
BLOCKS = 16  # stretches of the canonical order, every other one held out: blocks in space
CELL = 4.0  # cell of the ground raster, point spacings
WINDOWS = (9, 33)  # the ground is the lowest point within windows of this many cells
MAX_CELLS = 4096  # per side of the raster


def relief_features(graph: Graph, points: np.ndarray) -> np.ndarray:
    """(N, 4) float32 per point in canonical order: roughness, cosine of the slope, height above the lowest point within each window (spacings).

    points: (N, 3) world, canonical order. Up is the main direction of the normals, so no gravity has to be known.
    """
    spread = np.einsum("ni,nj->ij", graph.normals, graph.normals, dtype=np.float64)
    axes = np.linalg.eigh(spread)[1][:, ::-1]
    up = axes[:, 0]
    leaning = graph.normals.sum(axis=0, dtype=np.float64) @ up
    up = up * np.sign(leaning if abs(leaning) > 1e-9 * len(points) else up[np.abs(up).argmax()])
    local = points - points.min(axis=0)
    height, flat = np.einsum("ni,i->n", local, up), np.einsum("ni,ij->nj", local, axes[:, 1:])
    del local
    flat -= flat.min(axis=0)
    flat /= max(CELL * graph.spacing, float(flat.max()) / MAX_CELLS, 1e-12)  # in cells from here on
    lowest = _raster(flat, height)
    flat -= 0.5
    features = np.empty((len(points), 2 + len(WINDOWS)), np.float32)
    features[:, 0], features[:, 1] = graph.roughness, np.einsum("ni,i->n", graph.normals, up.astype(np.float32))
    for column, window in enumerate(WINDOWS, 2):
        ground = minimum_filter(lowest, window)
        ground = np.where(np.isfinite(ground), ground, height.min())
        below = map_coordinates(ground, flat.T, order=1, mode="nearest")  # bilinear: no steps on slopes
        features[:, column] = (height - below) / max(graph.spacing, 1e-12)
    return features


def _raster(flat: np.ndarray, height: np.ndarray) -> np.ndarray:
    cells = flat.astype(np.int32)
    shape = cells.max(axis=0).astype(np.int64) + 1
    lowest = np.full(int(shape.prod()), np.inf)
    np.minimum.at(lowest, cells[:, 0] * shape[1] + cells[:, 1], height)
    return lowest.reshape(shape)


@dataclass(frozen=True)
class Cells:
    """The histogram cell of each point: cell (N,) int32, of prod(shape) cells; blur: standard deviation in bins."""

    cell: np.ndarray
    shape: tuple[int, ...]
    blur: float

    @classmethod
    def of(cls, features: np.ndarray, bins: int, blur: float) -> Cells:
        """features: (N, F); bins are quantiles of all points, so that unit and scale do not matter."""
        shape = (bins,) * features.shape[1]
        cell = np.zeros(len(features), np.int32)
        for values in features.T:
            cell *= bins
            cell += np.searchsorted(np.quantile(values, np.arange(1, bins) / bins), values, side="right").astype(np.int32)
        return cls(cell, shape, blur)

    def rate(self, label: np.ndarray, examples: np.ndarray, num_classes: int) -> np.ndarray:
        """(cells, C) log of the class shares in each cell, learned from the rows `examples` of label (N,) in 1..C."""
        counts = np.bincount(self.cell[examples] * num_classes + (label[examples] - 1), minlength=int(np.prod(self.shape)) * num_classes)
        counts = counts.reshape(-1, num_classes).T.reshape(num_classes, *self.shape).astype(np.float64)
        counts = np.stack([gaussian_filter(part, self.blur, mode="nearest", truncate=2.0) for part in counts]).reshape(num_classes, -1).T
        shares = np.bincount(label[examples], minlength=num_classes + 1)[1:] / len(examples)
        smoothed = counts + PRIOR_WEIGHT * np.maximum(shares, 1e-9)
        return np.log(smoothed / smoothed.sum(axis=1, keepdims=True))


@dataclass(frozen=True)
class Raters:
    """Groups of features that are taken as independent of one another given the class."""

    groups: tuple[Cells, ...]

    @classmethod
    def of(cls, relief: np.ndarray, colors: np.ndarray | None) -> Raters:
        """relief: (N, 4) of `relief_features`; colors: (N, 3) uint8 or None."""
        groups = (Cells.of(relief, RELIEF_BINS, RELIEF_BLUR),)
        return cls(groups if colors is None else (Cells.of(colors, COLOR_BINS, COLOR_BLUR), *groups))

    def learn(self, label: np.ndarray, examples: np.ndarray, num_classes: int) -> np.ndarray | None:
        """(N, C) float32 log-probability of the classes as colour and relief see them; None where there is too little to learn from.

        label: (N,) uint8; examples: (N,) bool points to learn from
        Points of a class without enough examples get zeros: the raters do not contradict what they do not know.
        """
        counts = np.bincount(label[examples], minlength=num_classes + 1)[1:]
        known = counts >= MIN_EXAMPLES
        if known.sum() < 2:
            return None
        rows = np.flatnonzero(examples & np.append(False, known)[label])
        shares = np.log(np.maximum(counts, 1) / counts[known].sum())
        tables = [group.rate(label, rows, num_classes) for group in self.groups]
        result = np.zeros((len(label), num_classes), np.float32)
        for group, table in zip(self.groups, tables, strict=True):
            for column in range(num_classes):  # one by one: as a whole it would be copied, with millions of points
                result[:, column] += table[:, column].astype(np.float32)[group.cell]
        result -= ((len(self.groups) - 1) * shares).astype(np.float32)
        result[:, ~known] = -np.inf
        result -= np.logaddexp.reduce(result, axis=1, keepdims=True)
        result[:, ~known] = UNKNOWN
        result[np.append(False, ~known)[label]] = 0
        return np.maximum(result, np.float32(np.log(1e-4)), out=result)

    def skill(self, label: np.ndarray, examples: np.ndarray, num_classes: int) -> float:
        """Share of the errors of the best constant answer that the raters avoid on blocks held out; 0 where they cannot learn. Canonical order."""
        fold = (np.arange(len(label)) * BLOCKS // len(label)) % 2
        wrong = 0
        for held_out in (0, 1):
            rating = self.learn(label, examples & (fold != held_out), num_classes)
            if rating is None:
                return 0.0
            asked = examples & (fold == held_out)
            wrong += int((rating[asked].argmax(axis=1) + 1 != label[asked]).sum())
        counts = np.bincount(label[examples], minlength=num_classes + 1)
        return 1 - wrong / max(int(counts.sum() - counts.max()), 1)
