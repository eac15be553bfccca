"""Labels of each tile from what all of them taught: rounds of mean field, or what `geometry` and `knn` carry
from the seeds, and what the labels mean.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from sc3d.propagation.appearance import (
    AppearanceStatistics,
    count_overruled,
    limited,
    overruled,
    plausible_seeds,
)
from sc3d.propagation.potts import appearance_marginals, decided, sure_examples, vote_marginals
from sc3d.propagation.propagate import spread, with_states
from sc3d.tiling.executor import Executor
from sc3d.tiling.learning import LearnedFromTiles
from sc3d.tiling.tile_graph import PropagateJob, TileGraph


def run_rounds(
    job: PropagateJob, executor: Executor, offered: np.ndarray, learned: LearnedFromTiles
) -> str | None:
    """As `potts.minimize_energy`; returns how the arrays of the last round are named, None = votes alone."""
    tiles, attempt = job.store.tiles, 0
    while learned.tells_apart:
        taught, last = learned, None
        for turn in range(max(job.settings.rounds, 1)):
            if not taught.tells_apart:
                break
            last = f"attempt{attempt}_round{turn}"
            parts = executor.run(f"round {turn + 1}", partial(_turn_task, job, offered, taught, last), tiles)
            taught = taught.relearned([statistics for statistics, _ in parts])
            counts = np.sum([counts for _, counts in parts], axis=0)
        if not (too_many := overruled(counts, learned.trust)).any():
            return last
        learned, attempt = replace(learned, trust=learned.trust.without(too_many)), attempt + 1
    return None


def _turn_task(
    job: PropagateJob,
    offered: np.ndarray,
    learned: LearnedFromTiles,
    name: str,
    tile: int,
) -> tuple[AppearanceStatistics, np.ndarray]:
    """A round of mean field, of this name; returns what its result teaches, and `count_overruled`."""
    part = TileGraph.load(job, tile)
    appearance, known = part.appearance(job), part.known
    if not job.results.has(tile, f"{name}_examples"):
        rating = learned.of(appearance).log_likelihood(known)
        if rating is None:
            raise ValueError("a round needs examples of two looks")
        found = appearance_marginals(part.graph, known, offered, rating, learned.trust, job.settings)
        examples = sure_examples(found[1], known)
        label, confidence = decided(part.graph, known, *found)
        arrays = {"label": label, "confidence": confidence, "examples": examples}
        job.results.write(tile, **{f"{name}_{key}": part.own(values) for key, values in arrays.items()})
    label, examples = (
        part.own_in_order(job.results.read(tile, f"{name}_{key}")) for key in ("label", "examples")
    )
    statistics = appearance.statistics(label, examples & part.core, known.num_classes)
    return statistics, count_overruled(known, label, part.core)


def limit_overruled(job: PropagateJob, executor: Executor, learned: LearnedFromTiles) -> LearnedFromTiles:
    """The same, with the classes of which too many seeds would go."""
    counts = executor.run("seeds", partial(_overruled_task, job, learned), job.store.tiles)
    return replace(learned, too_many=overruled(np.sum(counts, axis=0), learned.trust))


def _overruled_task(job: PropagateJob, learned: LearnedFromTiles, tile: int) -> np.ndarray:
    part = TileGraph.load(job, tile)
    return count_overruled(part.known, _start(job, part, learned), part.core)


def once_task(job: PropagateJob, offered: np.ndarray, learned: LearnedFromTiles | None, tile: int) -> None:
    """map without appearance, geometry or knn, within the margin."""
    part = TileGraph.load(job, tile)
    if job.settings.method == "map":
        found = vote_marginals(part.graph, part.known, offered, job.settings)
        label, confidence = decided(part.graph, part.known, *found)
    else:
        start = _start(job, part, learned)
        label, confidence = spread(part.graph, part.known.points, start, job.settings)
    job.results.write(tile, once_label=part.own(label), once_confidence=part.own(confidence))


def _start(job: PropagateJob, part: TileGraph, learned: LearnedFromTiles | None) -> np.ndarray:
    """The labels of the seeds; for geometry and knn without those that look like another class."""
    seeds = part.known.seed_labels
    if learned is None or job.settings.method == "map":
        return seeds
    rating = learned.of(part.appearance(job)).log_likelihood(part.known)
    kept = plausible_seeds(part.known, rating, learned.trust)
    return kept if learned.too_many is None else limited(part.known, kept, learned.too_many)


def state_task(
    job: PropagateJob,
    source: str,
    reached: dict[int, np.ndarray] | None,
    learned: LearnedFromTiles | None,
    tile: int,
) -> None:
    part = TileGraph.load(job, tile)
    label, confidence = (part.around(job, f"{source}_{name}") for name in ("label", "confidence"))
    if reached is not None:
        groups = part.halo.gather(lambda other: reached[other][job.results.read(other, "group", mapped=True)])
        label = np.where(groups[part.graph.order], label, 0)
    final = with_states(part.known.seeds, _start(job, part, learned), (label, confidence), job.settings)
    label = job.channels.to_ids(final.label)
    job.results.write(
        tile, label=part.own(label), confidence=part.own(final.confidence), state=part.own(final.state)
    )
