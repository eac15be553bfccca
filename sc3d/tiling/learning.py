"""What the tiles of a cloud teach together of the looks of its classes: sums, minima and sketches over all of
them, in passes, as `appearance.learn_appearance` has it of a cloud in one piece.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sc3d.propagation.appearance import (
    AppearanceModel,
    AppearanceStatistics,
    LearnedAppearance,
    feature_counts,
    folds_of,
    held_out,
    sum_statistics,
    tells_apart,
    trust_of,
)
from sc3d.propagation.labelled_points import views_to_agree
from sc3d.propagation.misplaced import Misplaced, count_sides
from sc3d.propagation.none_evidence import count_votes
from sc3d.propagation.quantile_sketch import QuantileSketch
from sc3d.propagation.saved_appearance import add_prior, has_examples
from sc3d.propagation.terrain import WINDOWS, GroundModel, NormalStatistics
from sc3d.propagation.trust import Trust
from sc3d.propagation.vote_evidence import count_disagreement
from sc3d.tiling.executor import Executor
from sc3d.tiling.tile_graph import PropagateJob, TileGraph, cells_of, relief_histogram


@dataclass(frozen=True)
class TileSummary:
    """First look at a tile. seeds: (C,) int64 of each class; agreement: as `LabelledPoints.agreement`; lean:
    of its surfaces; touched: as counts of `Corrections.apply`; found: as `none_evidence.count_votes`;
    disagreement: as `vote_evidence.count_disagreement`
    """

    seeds: np.ndarray
    agreement: np.ndarray
    lean: NormalStatistics
    touched: np.ndarray
    found: np.ndarray
    disagreement: np.ndarray


def graph_task(job: PropagateJob, tile: int) -> TileSummary:
    part = TileGraph.load(job, tile)
    core, start = part.core, part.known.seed_labels
    return TileSummary(
        np.bincount(start[core], minlength=job.channels.count)[1:],
        part.known.agreement(core),
        NormalStatistics.from_normals(part.graph.normals[core], part.graph.spacings[core]),
        job.results.read(tile, "touched"),
        count_votes(part.known.known_votes[core]) if job.channels.none else np.zeros((0, 2), np.int64),
        count_disagreement(part.known, core),
    )


def offered_classes(summaries: list[TileSummary]) -> np.ndarray:
    """(C,) bool classes that have seeds."""
    return np.sum([summary.seeds for summary in summaries], axis=0) > 0


@dataclass(frozen=True)
class LearnedFromTiles:
    """`LearnedAppearance` without its model, of which each tile has its own part; too_many: (C,) bool as of
    `appearance.limited`, None = not known yet; prior: in the statistics, of another site, None = of none
    """

    statistics: AppearanceStatistics
    trust: Trust
    too_many: np.ndarray | None = None
    prior: AppearanceStatistics | None = None

    @property
    def tells_apart(self) -> bool:
        """Whether there are examples of two looks."""
        return tells_apart(self.statistics, self.trust)

    @property
    def offers(self) -> np.ndarray:
        """As `AppearanceModel.offers`."""
        return has_examples(self.prior) if self.prior is not None else np.zeros(len(self.trust.look), bool)

    def relearned(self, parts: list[AppearanceStatistics]) -> LearnedFromTiles:
        """What other examples teach, of which the tiles give these parts."""
        own = sum_statistics(parts)
        return replace(self, statistics=own if self.prior is None else add_prior(self.prior, own))

    def of(self, model: AppearanceModel) -> LearnedAppearance:
        return LearnedAppearance(model, self.statistics, self.trust)


def learn_from_tiles(
    job: PropagateJob, executor: Executor, summaries: list[TileSummary]
) -> tuple[PropagateJob, np.ndarray, LearnedFromTiles | None]:
    """The job without misplaced votes, its classes with seeds (C,) bool, and what the agreed points of all
    tiles teach, if that tells classes apart on points held out.
    """
    tiles, counts = job.store.tiles, measure_relief(job, executor, terrain_of_tiles(job, summaries))
    halves, least = _examples(job, executor, summaries, counts)
    if job.levels is not None:
        job = replace(job, misplaced=_misplaced(job, executor, halves, least, job.levels))
    if job.misplaced is not None:
        summaries = executor.run("graph", partial(graph_task, job), tiles)
        halves, least = _examples(job, executor, summaries, counts)
    contrasts = sum(executor.run("held-out looks", partial(_held_out_task, job, halves, least), tiles))
    trust = trust_of(halves, contrasts, np.sum([summary.disagreement for summary in summaries], axis=0))
    learned = None if trust is None else LearnedFromTiles(sum_statistics(halves), trust)
    return job, offered_classes(summaries), learned


def terrain_of_tiles(
    job: PropagateJob, summaries: list[TileSummary], cell: float | None = None
) -> GroundModel:
    """As `terrain.terrain_of` the whole cloud."""
    lean = NormalStatistics.merge([summary.lean for summary in summaries])
    return GroundModel.from_statistics(lean, job.extent.low, job.extent.high, job.up, cell)


def measure_relief(job: PropagateJob, executor: Executor, terrain: GroundModel) -> list[QuantileSketch]:
    """`appearance.feature_counts` of the whole cloud; leaves an array `relief` of every tile."""
    tiles = job.store.tiles
    grounds = terrain.grounds(executor.run("ground", partial(_lowest_task, job, terrain), tiles))
    for window, ground in zip(WINDOWS, grounds, strict=True):
        np.save(job.shared / f"ground{window}.npy", ground)
    parts = executor.run("relief", partial(_relief_task, job, terrain), tiles)
    return [QuantileSketch.merge(list(feature)) for feature in zip(*parts, strict=True)]


def _examples(
    job: PropagateJob, executor: Executor, summaries: list[TileSummary], counts: list[QuantileSketch]
) -> tuple[list[AppearanceStatistics], int]:
    """Statistics of the agreed points of both folds, and how many views must agree."""
    least = views_to_agree(np.sum([summary.agreement for summary in summaries], axis=0))
    parts = executor.run("examples", partial(_statistics_task, job, counts, least), job.store.tiles)
    return [sum_statistics(list(fold)) for fold in zip(*parts, strict=True)], least


def _misplaced(
    job: PropagateJob, executor: Executor, halves: list[AppearanceStatistics], least: int, levels: np.ndarray
) -> Misplaced | None:
    relief = [half[-1] for half in halves]
    sides = executor.run("sides", partial(_sides_task, job, relief, least), job.store.tiles)
    return Misplaced.measure(relief_histogram(np.empty(0, np.int32)), relief, sum(sides), levels)


def _sides_task(job: PropagateJob, halves: list[np.ndarray], least: int, tile: int) -> np.ndarray:
    part = TileGraph.load(job, tile)
    examples, folds = part.known.agreed_by(least) & part.core, _folds(job, part)
    return count_sides(part.appearance(job).groups[-1], halves, part.known, examples, folds)


def _folds(job: PropagateJob, part: TileGraph) -> np.ndarray:
    return folds_of(part.known.points, job.extent.low, job.extent.high)


def _lowest_task(job: PropagateJob, terrain: GroundModel, tile: int) -> tuple[np.ndarray, np.ndarray]:
    part = TileGraph.load(job, tile)
    return terrain.lowest(part.known.points[part.core])


def _relief_task(job: PropagateJob, terrain: GroundModel, tile: int) -> list[QuantileSketch]:
    part = TileGraph.load(job, tile)
    grounds = [np.load(job.shared / f"ground{window}.npy", allow_pickle=False) for window in WINDOWS]
    relief = terrain.features(part.graph, part.known.points, grounds)
    job.results.write(tile, relief=part.own(relief))
    return feature_counts(
        relief[part.core], None if part.known.colors is None else part.known.colors[part.core]
    )


def _statistics_task(
    job: PropagateJob, counts: list[QuantileSketch], least: int, tile: int
) -> tuple[AppearanceStatistics, AppearanceStatistics]:
    part = TileGraph.load(job, tile)
    appearance = AppearanceModel.from_sketches(
        part.own_in_order(job.results.read(tile, "relief")), part.known.colors, counts
    )
    job.results.write(tile, cells=part.own(cells_of(appearance)))
    examples, folds = part.known.agreed_by(least) & part.core, _folds(job, part)
    even, odd = (
        appearance.statistics(part.known.seed_labels, examples & (folds == fold), part.known.num_classes)
        for fold in (0, 1)
    )
    return even, odd


def _held_out_task(
    job: PropagateJob, halves: list[AppearanceStatistics], least: int, tile: int
) -> np.ndarray:
    part = TileGraph.load(job, tile)
    examples, folds = part.known.agreed_by(least) & part.core, _folds(job, part)
    return held_out(part.appearance(job), halves, part.known.seed_labels, examples, folds)
