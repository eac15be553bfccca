"""Color and relief of the classes as two more voters: what agreed points of each class look like, as joint
histograms.

The masks' errors are shared between views, so no voting removes them. Color and relief (height above the
ground around, roughness, slope) err otherwise. Each rater alone is poor; their product is good, because the
two hardly depend on one another once the class is known, and because neither can learn what only their
combination would tell apart: errors of the masks such as "flat, low and
dark: tree".
Counts are integers and bins are quantiles, so nothing depends on the order of points or the unit of length,
and parts of a cloud add up to the whole.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from sc3d.geometry.graph import Graph
from sc3d.propagation.labelled_points import MIN_EXAMPLES, LabelledPoints
from sc3d.propagation.quantile_sketch import QuantileSketch
from sc3d.propagation.terrain import relief_features
from sc3d.settings.labels import Propagate

COLOR_BINS, RELIEF_BINS = 24, 12  # per feature; 24^3 and 12^4 cells
COLOR_BLUR, RELIEF_BLUR = 1.0, 0.7  # standard deviation, bins
PRIOR_WEIGHT = 2.0  # points of the overall mixture added to each cell
UNKNOWN = np.log(0.05)  # their probability of a class they do not know
MIN_SKILL = 0.5  # share of the errors of "always the commonest class" that they must avoid on points held out
FOLD_BLOCKS = 8  # blocks along the longest side of the cloud; every other one is held out, as on a chessboard

IMPLAUSIBLE = np.log(0.5)  # a seed whose class the model gives less is a conflict

logger = logging.getLogger(__name__)

# per group of features, (cells, C) int64 examples of each class; statistics of parts add up
AppearanceStatistics = tuple[np.ndarray, ...]


@dataclass(frozen=True)
class Histogram:
    """The histogram cell of each point: cell (N,) int32, of prod(shape) cells; blur: standard deviation in
    bins.
    """

    cell: np.ndarray
    shape: tuple[int, ...]
    blur: float

    @classmethod
    def from_features(cls, features: np.ndarray, edges: list[np.ndarray], blur: float) -> Histogram:
        """features: (N, F); edges: per feature the inner borders of its bins."""
        cell = np.zeros(len(features), np.int32)
        for values, borders in zip(features.T, edges, strict=True):
            cell *= len(borders) + 1
            cell += np.searchsorted(borders, values, side="right").astype(np.int32)
        return cls(cell, tuple(len(borders) + 1 for borders in edges), blur)

    def count(self, label: np.ndarray, examples: np.ndarray, num_classes: int) -> np.ndarray:
        """(cells, C) int64 examples of each class; label: (N,) in 1..C at the examples (N,) bool."""
        counts = np.bincount(
            self.cell[examples].astype(np.int64) * num_classes + (label[examples] - 1),
            minlength=int(np.prod(self.shape)) * num_classes,
        )
        return counts.reshape(-1, num_classes)

    def table(self, counts: np.ndarray) -> np.ndarray:
        """(cells, C) log of the class shares in each cell, from the counts (cells, C)."""
        blurred = [
            gaussian_filter(
                part.reshape(self.shape).astype(np.float64), self.blur, mode="nearest", truncate=2.0
            )
            for part in counts.T
        ]
        smoothed = np.stack(blurred).reshape(len(blurred), -1).T + PRIOR_WEIGHT * np.maximum(
            counts.sum(axis=0) / max(counts.sum(), 1), 1e-9
        )
        return np.log(smoothed / smoothed.sum(axis=1, keepdims=True))


def edges_of(counts: list[QuantileSketch], bins: int) -> list[np.ndarray]:
    """Inner borders of `bins` bins per feature, its quantiles over all points, so that unit and scale do not
    matter.
    """
    return [part.quantiles(np.arange(1, bins) / bins) for part in counts]


@dataclass(frozen=True)
class AppearanceModel:
    """Groups of features that are taken as independent of one another given the class."""

    groups: tuple[Histogram, ...]

    @classmethod
    def from_features(cls, relief: np.ndarray, colors: np.ndarray | None) -> AppearanceModel:
        """Of a whole cloud. relief: (N, 4) of `relief_features`; colors: (N, 3) uint8 or None."""
        return cls.from_sketches(relief, colors, feature_counts(relief, colors))

    @classmethod
    def from_sketches(
        cls, relief: np.ndarray, colors: np.ndarray | None, counts: list[QuantileSketch]
    ) -> AppearanceModel:
        """The same for a part of a cloud; counts: `feature_counts` of the whole."""
        known = relief.shape[1]
        groups = (Histogram.from_features(relief, edges_of(counts[:known], RELIEF_BINS), RELIEF_BLUR),)
        return cls(
            groups
            if colors is None
            else (Histogram.from_features(colors, edges_of(counts[known:], COLOR_BINS), COLOR_BLUR), *groups)
        )

    def statistics(self, label: np.ndarray, examples: np.ndarray, num_classes: int) -> AppearanceStatistics:
        """What the examples (N,) bool of label (N,) uint8 teach."""
        return tuple(group.count(label, examples, num_classes) for group in self.groups)

    def offers(self, num_classes: int) -> np.ndarray:
        """(C,) bool classes that points may get without a single seed of them."""
        return np.zeros(num_classes, bool)

    def log_likelihood(self, statistics: AppearanceStatistics, label: np.ndarray) -> np.ndarray | None:
        """(N, C) float32 log-probability of the classes as color and relief see them; None where there is
        too little to learn from.

        label: (N,) uint8. Points of a class without enough examples get zeros: the model does not contradict
            what it does not know.
        """
        counts = statistics[0].sum(axis=0)
        known = counts >= MIN_EXAMPLES
        if known.sum() < 2:
            return None
        shares = np.log(np.maximum(counts, 1) / counts[known].sum())
        result = np.zeros((len(label), len(counts)), np.float32)
        for group, examples in zip(self.groups, statistics, strict=True):
            table = group.table(examples * known)
            # one by one: as a whole it would be copied, with millions of points
            for column in range(len(counts)):
                result[:, column] += table[:, column].astype(np.float32)[group.cell]
        result -= ((len(self.groups) - 1) * shares).astype(np.float32)
        result[:, ~known] = -np.inf
        result -= np.logaddexp.reduce(result, axis=1, keepdims=True)
        result[:, ~known] = UNKNOWN
        result[np.append(False, ~known)[label]] = 0
        return np.maximum(result, np.float32(np.log(1e-4)), out=result)

    def errors(self, statistics: AppearanceStatistics, label: np.ndarray, asked: np.ndarray) -> int | None:
        """How many of the points asked (N,) bool, whose label is taken for true, the statistics get wrong; None
        if it is too short.
        """
        rating = self.log_likelihood(statistics, label)
        return None if rating is None else int((rating[asked].argmax(axis=1) + 1 != label[asked]).sum())


def feature_counts(relief: np.ndarray, colors: np.ndarray | None) -> list[QuantileSketch]:
    """Counts of each feature: of relief (N, 4), then of colors (N, 3), if there are any."""
    return [
        QuantileSketch.from_values(column)
        for table in (relief, colors)
        if table is not None
        for column in table.T
    ]


def folds_of(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(N,) 0 or 1: half of the blocks of space each; low, high: (3,) corners of the whole cloud."""
    cells = ((points - low) / (float((high - low).max()) or 1.0) * FOLD_BLOCKS).astype(np.int32)
    return cells.sum(axis=1) % 2


def skill_score(wrong: list[int | None], counts: np.ndarray) -> float:
    """Share of the errors of the best constant answer that the model avoids on blocks held out; 0 where it
    cannot learn.

    wrong: errors of each fold, asked about points that it has not seen; counts: (C,) examples of each class
    """
    errors = [number for number in wrong if number is not None]
    if len(errors) < len(wrong):
        return 0.0
    return 1 - sum(errors) / max(int(counts.sum() - counts.max()), 1)


def sum_statistics(parts: list[AppearanceStatistics]) -> AppearanceStatistics:
    """The statistics of all parts."""
    return tuple(np.sum(group, axis=0) for group in zip(*parts, strict=True))


def is_skillful(wrong: list[int | None], statistics: AppearanceStatistics) -> bool:
    """Whether the model does well enough; wrong: its errors on each fold held out."""
    skill = skill_score(wrong, statistics[0].sum(axis=0))
    logger.info(
        "color and relief avoid %.0f%% of errors on held-out agreed points%s",
        100 * skill,
        "" if skill >= MIN_SKILL else ": not used",
    )
    return skill >= MIN_SKILL


def plausible(start: np.ndarray, rating: np.ndarray | None) -> np.ndarray:
    """The seeds (N,) without those that look like another class: conflicts that all views share.

    rating: (N, C) log-likelihood of the classes; None = nothing is known
    """
    if rating is None:
        return start
    given = rating[np.arange(len(start)), np.maximum(start, 1).astype(np.int64) - 1]
    return np.where((start > 0) & (given < IMPLAUSIBLE), 0, start).astype(np.uint8)


def uses_appearance(settings: Propagate) -> bool:
    return settings.appearance and (settings.method == "map" or settings.verify_seeds)


@dataclass(frozen=True)
class LearnedAppearance:
    """A model of a cloud, and what its examples teach."""

    model: AppearanceModel
    statistics: AppearanceStatistics

    def log_likelihood(self, label: np.ndarray) -> np.ndarray | None:
        """As `AppearanceModel.log_likelihood`."""
        return self.model.log_likelihood(self.statistics, label)


def learn_appearance(graph: Graph, known: LabelledPoints) -> LearnedAppearance | None:
    """Color and relief of the classes from the agreed points, if that does well on agreed points that it has not seen.

    known: in the order of the graph
    """
    model = AppearanceModel.from_features(relief_features(graph, known.points, known.up), known.colors)
    start, examples = known.seed_labels, known.agreed
    folds = folds_of(known.points, known.points.min(axis=0), known.points.max(axis=0))
    halves = [model.statistics(start, examples & (folds == fold), known.num_classes) for fold in (0, 1)]
    wrong = [model.errors(halves[1 - fold], start, examples & (folds == fold)) for fold in (0, 1)]
    statistics = sum_statistics(halves)
    return LearnedAppearance(model, statistics) if is_skillful(wrong, statistics) else None
