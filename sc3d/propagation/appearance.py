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

from sc3d.geometry.graph import Graph
from sc3d.propagation.histogram import Histogram
from sc3d.propagation.labelled_points import MIN_EXAMPLES, LabelledPoints
from sc3d.propagation.misplaced import Misplaced, count_sides
from sc3d.propagation.quantile_sketch import QuantileSketch
from sc3d.propagation.terrain import relief_features
from sc3d.propagation.trust import BINS, Trust, bins_of, measure_trust
from sc3d.propagation.vote_evidence import count_disagreement, one_view_evidence, softmax, vote_shares
from sc3d.settings.labels import Propagate

COLOR_BINS, RELIEF_BINS = 24, 12  # per feature; 24^3 and 12^4 cells
COLOR_BLUR, RELIEF_BLUR = 1.0, 0.7  # standard deviation, bins
UNKNOWN = np.log(0.05)  # their probability of a class they do not know
MIN_HALF = 100  # examples of a class in each half of space, so that they can be judged by one another
FOLD_BLOCKS = 8  # blocks along the longest side of the cloud; every other one is held out, as on a chessboard
IMPLAUSIBLE = 0.5  # a seed whose class is less likely is a conflict
MAX_OVERRULED = 0.9  # share of a class's seeds that many views agree on that looks may overrule

logger = logging.getLogger(__name__)

# per group of features, (cells, C) int64 examples of each class; statistics of parts add up
AppearanceStatistics = tuple[np.ndarray, ...]


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
        groups = [Histogram.from_features(relief, edges_of(counts[:known], RELIEF_BINS), RELIEF_BLUR)]
        if colors is not None:
            groups.insert(
                0, Histogram.from_features(colors, edges_of(counts[known:], COLOR_BINS), COLOR_BLUR)
            )
        return cls(tuple(groups))

    def statistics(self, label: np.ndarray, examples: np.ndarray, num_classes: int) -> AppearanceStatistics:
        """What the examples (N,) bool of label (N,) uint8 teach."""
        return tuple(group.count(label, examples, num_classes) for group in self.groups)

    def offers(self, num_classes: int) -> np.ndarray:
        """(C,) bool classes that points may get without a single seed of them."""
        return np.zeros(num_classes, bool)

    def tables(self, statistics: AppearanceStatistics, known: np.ndarray) -> list[np.ndarray]:
        """Per group, (cells, C) float32 log-likelihood of each class, up to a number per cell; known: (C,)
        bool classes to look at.
        """
        return [
            group.likelihood(examples * known)
            for group, examples in zip(self.groups, statistics, strict=True)
        ]

    def contrasts(self, statistics: AppearanceStatistics, label: np.ndarray, asked: np.ndarray) -> np.ndarray:
        """(C, C, BINS per group) int64 points asked (N,) bool of each class (first axis), by how much more
        they look like another (second axis) than like their own, as the statistics of other points tell.
        """
        known = statistics[0].sum(axis=0) >= MIN_HALF
        size, shape = len(known), (BINS,) * len(self.groups)
        rows = np.flatnonzero(asked & np.append(False, known)[label])
        own, tables = label[rows].astype(np.int64) - 1, self.tables(statistics, known)
        result = np.zeros((size, size, *shape), np.int64)
        for other in np.flatnonzero(known):
            place = own
            for group, table in zip(self.groups, tables, strict=True):
                cells = group.cell[rows]
                place = place * BINS + bins_of(table[cells, other] - table[cells, own])
            counts = np.bincount(place, minlength=size * int(np.prod(shape)))
            result[:, other] = counts.reshape(size, *shape)
        return result

    def log_likelihood(
        self, statistics: AppearanceStatistics, trust: Trust, shares: np.ndarray
    ) -> np.ndarray | None:
        """(N, C) float32 log-probability of the classes as color and relief see them; None where no two
        looks are known.

        shares: (N, C) of the votes of each point. The more of them name classes whose look is not known, the
            less the model says: it does not contradict what it does not know.
        """
        if not tells_apart(statistics, trust):
            return None
        counts, known = statistics[0].sum(axis=0), known_looks(statistics, trust)
        result, tables = np.zeros((len(shares), len(counts)), np.float32), self.tables(statistics, known)
        for look in np.unique(trust.look[known]):
            members = np.flatnonzero(known & (trust.look == look))
            number = counts[members].sum()
            # of classes that look alike none is likelier beforehand
            rating = np.full(len(shares), np.log(number / len(members) / counts[known].sum()), np.float32)
            for group, table in zip(self.groups, tables, strict=True):
                mixed = np.logaddexp.reduce(table[:, members] + np.log(counts[members] / number), axis=1)
                rating += mixed.astype(np.float32)[group.cell]
            result[:, members] = rating[:, None]
        result[:, ~known] = -np.inf
        result -= np.logaddexp.reduce(result, axis=1, keepdims=True)
        result[:, ~known] = UNKNOWN
        np.maximum(result, np.float32(np.log(1e-4)), out=result)
        result *= 1 - shares[:, ~known].sum(axis=1, keepdims=True)
        return result


def known_looks(statistics: AppearanceStatistics, trust: Trust) -> np.ndarray:
    """(C,) bool classes whose look can be judged and of which there are enough examples."""
    return trust.known & (statistics[0].sum(axis=0) >= MIN_EXAMPLES)


def tells_apart(statistics: AppearanceStatistics, trust: Trust) -> bool:
    """Whether there are examples of two looks."""
    return len(np.unique(trust.look[known_looks(statistics, trust)])) >= 2


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


def sum_statistics(parts: list[AppearanceStatistics]) -> AppearanceStatistics:
    """The statistics of all parts."""
    return tuple(np.sum(group, axis=0) for group in zip(*parts, strict=True))


def held_out(
    model: AppearanceModel,
    halves: list[AppearanceStatistics],
    label: np.ndarray,
    examples: np.ndarray,
    folds: np.ndarray,
) -> np.ndarray:
    """`AppearanceModel.contrasts` of the examples (N,) bool, each looked at by what the other fold (N,) teaches."""
    first, second = (model.contrasts(halves[1 - fold], label, examples & (folds == fold)) for fold in (0, 1))
    return first + second


def trust_of(
    halves: list[AppearanceStatistics], contrasts: np.ndarray, disagreement: np.ndarray
) -> Trust | None:
    """What was measured (see `measure_trust`); halves: statistics of the folds."""
    counts = np.stack([half[0].sum(axis=0) for half in halves])
    known = (counts.sum(axis=0) >= MIN_EXAMPLES) & (counts >= MIN_HALF).all(axis=0)
    trust = measure_trust(contrasts, known, disagreement) if known.sum() >= 2 else None
    if trust is None:
        logger.info("color and relief tell no two classes apart on agreed points held out: not used")
    else:
        logger.info("color and relief on agreed points held out: %s", trust.describe())
    return trust


def count_overruled(known: LabelledPoints, label: np.ndarray, core: np.ndarray | None = None) -> np.ndarray:
    """(2, C) int64 seeds of each class without a vote against them that nobody has corrected: all, and those
    that are not of that class by label (N,). core: (N,) bool points to count, None = all.
    """
    asked = known.agreed & ~known.corrected & (True if core is None else core)
    seeds, size = known.seed_labels, known.num_classes + 1
    return np.stack(
        [np.bincount(seeds[rows], minlength=size)[1:] for rows in (asked, asked & (label != seeds))]
    )


def overruled(counts: np.ndarray, trust: Trust) -> np.ndarray:
    """(C,) bool classes that must be left to the votes, and are not yet, by `count_overruled`; said in a line."""
    too_many = trust.known & (counts[1] > MAX_OVERRULED * counts[0])
    if too_many.any():
        logger.info(
            "color and relief contradict most of the seeds of %d classes that no view contradicts: left to the votes",
            too_many.sum(),
        )
    return too_many


def plausible_seeds(known: LabelledPoints, rating: np.ndarray | None, trust: Trust) -> np.ndarray:
    """(N,) uint8 seeds without those likelier of another class, by looks and votes: conflicts that all views share.
    What people have corrected stays.

    rating: (N, C) log-likelihood of the classes by their looks; None = nothing is known
    """
    seeds = known.seed_labels
    if rating is None:
        return seeds
    posterior = softmax(rating + one_view_evidence(known, trust.errors))
    own = posterior[np.arange(len(seeds)), np.maximum(seeds, 1).astype(np.int64) - 1]
    return np.where(known.corrected | (own >= IMPLAUSIBLE), seeds, 0).astype(np.uint8)


def limited(known: LabelledPoints, kept: np.ndarray, too_many: np.ndarray) -> np.ndarray:
    """The seeds kept (N,), and those without a vote against them of classes (C,) bool of which too many would go."""
    back = known.sure & np.append(False, too_many)[known.seed_labels]
    return np.where(back, known.seed_labels, kept)


def uses_appearance(settings: Propagate) -> bool:
    return settings.appearance and (settings.method == "map" or settings.verify_seeds)


@dataclass(frozen=True)
class LearnedAppearance:
    """A model of a cloud, what its examples teach, and how far that is believed."""

    model: AppearanceModel
    statistics: AppearanceStatistics
    trust: Trust

    def log_likelihood(self, known: LabelledPoints) -> np.ndarray | None:
        """As `AppearanceModel.log_likelihood`."""
        return self.model.log_likelihood(self.statistics, self.trust, vote_shares(known))


def learn_appearance(graph: Graph, known: LabelledPoints) -> tuple[LabelledPoints, LearnedAppearance | None]:
    """What is known without `Misplaced` votes, and color and relief of the classes from the agreed points, if that
    tells classes apart on agreed points that it has not seen.

    known: in the order of the graph
    """
    model = AppearanceModel.from_features(relief_features(graph, known.points, known.up), known.colors)
    folds = folds_of(known.points, known.points.min(axis=0), known.points.max(axis=0))
    if known.levels is not None and known.votes is not None:
        known = _placed(model.groups[-1], known, folds, known.levels)
    start, examples = known.seed_labels, known.agreed
    halves = [model.statistics(start, examples & (folds == fold), known.num_classes) for fold in (0, 1)]
    trust = trust_of(halves, held_out(model, halves, start, examples, folds), count_disagreement(known))
    return known, None if trust is None else LearnedAppearance(model, sum_statistics(halves), trust)


def _placed(
    relief: Histogram, known: LabelledPoints, folds: np.ndarray, levels: np.ndarray
) -> LabelledPoints:
    start, examples = known.seed_labels, known.agreed
    halves = [relief.count(start, examples & (folds == fold), known.num_classes) for fold in (0, 1)]
    sides = count_sides(relief, halves, known, examples, folds)
    misplaced = Misplaced.measure(relief, halves, sides, levels)
    return known if misplaced is None else misplaced.without(known, relief.cell)


def plausible(known: LabelledPoints, appearance: LearnedAppearance) -> np.ndarray:
    """(N,) uint8 seeds that look like their class, or of which too many would go."""
    kept = plausible_seeds(known, appearance.log_likelihood(known), appearance.trust)
    return limited(known, kept, overruled(count_overruled(known, kept), appearance.trust))
