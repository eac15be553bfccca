"""What another site taught, on a cloud in tiles, and what this one teaches others: `saved_appearance` of all
tiles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from sc3d.propagation.appearance import AppearanceModel, AppearanceStatistics, sum_statistics
from sc3d.propagation.labelled_points import views_to_agree
from sc3d.propagation.quantile_sketch import QuantileSketch
from sc3d.propagation.saved_appearance import (
    SavedAppearance,
    add_prior,
    has_examples,
    own_scale,
    sure_points,
)
from sc3d.propagation.trust import Trust
from sc3d.tiling.executor import Executor
from sc3d.tiling.learning import LearnedFromTiles, TileSummary, measure_relief, terrain_of_tiles
from sc3d.tiling.tile_graph import PropagateJob, TileGraph, cells_of


@dataclass(frozen=True)
class GivenModel:
    """A model for this scene. origin: its file; meters: per world unit of the scene, None = not known"""

    saved: SavedAppearance
    origin: Path
    meters: float | None

    def on_tiles(
        self, job: PropagateJob, executor: Executor, summaries: list[TileSummary]
    ) -> LearnedFromTiles:
        """As `SavedAppearance.on`."""
        self.saved.tell_of_colors(job.colored, self.origin)
        scale = self.saved.scale_on(terrain_of_tiles(job, summaries).spacing, self.meters)
        terrain = replace(terrain_of_tiles(job, summaries, scale.cell), spacing=scale.unit)
        measure_relief(job, executor, terrain)
        least = views_to_agree(np.sum([summary.agreement for summary in summaries], axis=0))
        own = sum_statistics(
            executor.run("examples", partial(_agreed_task, job, self.saved, least), job.store.tiles)
        )
        prior = self.saved.prior_beside(own, job.channels)
        statistics = add_prior(prior, own)
        disagreement = np.sum([summary.disagreement for summary in summaries], axis=0)
        trust = Trust.unmeasured(has_examples(statistics), disagreement)
        return LearnedFromTiles(statistics, trust, prior=prior)


def _agreed_task(job: PropagateJob, saved: SavedAppearance, least: int, tile: int) -> AppearanceStatistics:
    """What the agreed points of a tile teach; leaves its array `cells`."""
    part = TileGraph.load(job, tile)
    relief = part.own_in_order(job.results.read(tile, "relief"))
    appearance = AppearanceModel(saved.histograms(relief, part.known.colors))
    job.results.write(tile, cells=part.own(cells_of(appearance)))
    examples = part.known.agreed_by(least) & part.core
    return appearance.statistics(part.known.seed_labels, examples, part.known.num_classes)


def learn_for_others(
    job: PropagateJob, executor: Executor, summaries: list[TileSummary], meters: float | None
) -> SavedAppearance | None:
    """As `SavedAppearance.learn`, from the labels that the tiles have now. meters: as of `GivenModel`"""
    terrain = terrain_of_tiles(job, summaries)
    sketches = measure_relief(job, executor, replace(terrain, spacing=own_scale(terrain, meters).unit))
    parts = executor.run("sure points", partial(_sure_task, job, sketches), job.store.tiles)
    return SavedAppearance.from_statistics(sum_statistics(parts), sketches, terrain, job.channels, meters)


def _sure_task(job: PropagateJob, sketches: list[QuantileSketch], tile: int) -> AppearanceStatistics:
    part = TileGraph.load(job, tile)
    relief, label, confidence = (
        part.own_in_order(job.results.read(tile, name)) for name in ("relief", "label", "confidence")
    )
    label = job.channels.from_ids(label)
    examples = sure_points(label, confidence, job.channels) & part.core
    appearance = AppearanceModel.from_sketches(relief, part.known.colors, sketches)
    return appearance.statistics(label, examples, len(job.channels.ids) - 1)
