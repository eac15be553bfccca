"""`propagate` for clouds that do not fit into memory, tile by tile, in passes.

Mean field looks a few edges far in each round, so a tile with a margin as wide gives what the whole cloud
would. What is learned of the classes, the ground below and which points hang together concern the whole: each
pass ends with sums, minima or links over all tiles.
`geometry` and `knn` see no farther than the margin, too; there a point farther from any seed may come out
otherwise than in one piece.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from sc3d.errors import InputError
from sc3d.georeferencing.up_direction import scene_up
from sc3d.instances.scene_objects import SceneObjects
from sc3d.io.chunked_clouds import CloudFile, positions
from sc3d.io.ply import read_header, write_records
from sc3d.io.provenance import Input, PhotoFrames
from sc3d.propagation.appearance import (
    AppearanceModel,
    AppearanceStatistics,
    LearnedAppearance,
    count_overruled,
    feature_counts,
    folds_of,
    held_out,
    limited,
    overruled,
    plausible_seeds,
    sum_statistics,
    tells_apart,
    trust_of,
    uses_appearance,
)
from sc3d.propagation.labelled_points import views_to_agree
from sc3d.propagation.misplaced import Misplaced, count_sides
from sc3d.propagation.none_evidence import NoneRates, count_votes
from sc3d.propagation.potts import STEPS, appearance_marginals, decided, sure_examples, vote_marginals
from sc3d.propagation.propagate import (
    PropagateSummary,
    fill_from_nearest,
    levels_of,
    no_seeds,
    spread,
    with_states,
)
from sc3d.propagation.quantile_sketch import QuantileSketch
from sc3d.propagation.terrain import WINDOWS, GroundModel, NormalStatistics
from sc3d.propagation.trust import Trust
from sc3d.propagation.vote_evidence import count_disagreement
from sc3d.scene.corrections import Corrections
from sc3d.scene.labelled_cloud import INSTANCE, UNCONFIRMED, VOTES, vote_channels
from sc3d.scene.labels import CORRECTED, PROPAGATED
from sc3d.scene.object_image import ReadObjects
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Propagate
from sc3d.tiling.executor import Executor, open_executor
from sc3d.tiling.label import sample_spacing
from sc3d.tiling.memory import fits, max_points, num_points
from sc3d.tiling.store import CloudStatistics, Results, TileStore
from sc3d.tiling.tile_graph import PropagateJob, TileGraph, cells_of, relief_histogram
from sc3d.tiling.work_folder import WorkFolder

logger = logging.getLogger(__name__)

LEAST_BYTES = 700
BYTES, VOTE_BYTES = 460, 40  # of a point while its tile is worked on, and more for each channel of its votes
EDGE = 2.6  # an edge is hardly longer, point spacings
HOPS = STEPS + 3  # how far a round of mean field looks, and what the edges at that distance depend on


def propagate_fits(scene: Scene, settings: Propagate) -> bool:
    """Whether the cloud fits into memory as a whole, and nobody asked for workers."""
    path = settings.seeds or scene.seeds
    count = num_points(path)
    if count is None:
        return True
    vertex = read_header(path).element("vertex") if path.suffix.lower() == ".ply" else None
    channels = vote_channels(entry.name for entry in vertex.properties) if vertex else None
    return fits(count * bytes_per_point(channels.count if channels else 1), settings)


def bytes_per_point(num_channels: int) -> int:
    """Of memory while a tile is worked on."""
    return max(LEAST_BYTES, BYTES + VOTE_BYTES * num_channels)


def propagate_scene(
    scene: Scene, settings: Propagate, read_objects: ReadObjects | None = None
) -> PropagateSummary:
    """As `propagation.propagate.propagate_scene`, tile by tile, here or on the workers that the settings ask for."""
    cloud, output = CloudFile.open(settings.seeds or scene.seeds), settings.output or scene.labelled
    channels = vote_channels(cloud.names)
    for name in ("nx", "label", "confidence", "state", "num_views", *([] if channels else [f"{VOTES}0"])):
        if name not in cloud.names:
            raise InputError(f"{cloud.path} has no attribute {name!r}: it was not written by `sc3d label`")
    if channels is None:
        raise InputError(f"{cloud.path} has votes of no class: it was not written by `sc3d label`")
    corrections = Corrections.of_scene(scene)
    decisive: list[Input] = [
        cloud.path,
        scene.sparse,
        scene.classes,
        PhotoFrames(scene.images),
        *corrections.files,
    ]
    folder, statistics = (
        WorkFolder(output, "propagate", decisive, settings),
        CloudStatistics.from_cloud(cloud),
    )
    room = max_points(settings, bytes_per_point(channels.count))
    grid = statistics.grid(room, HOPS * EDGE * statistics.spacing)
    store = TileStore.build(cloud, grid, folder.subfolder("tiles"))
    margin = HOPS * EDGE * sample_spacing(store, statistics)[0]
    results, shared = Results(folder.subfolder("results"), store), folder.subfolder("shared")
    up = scene_up(scene)
    levels = levels_of(scene, channels)
    job = PropagateJob(
        settings, statistics.extent, store, results, margin, channels, shared, up, corrections, levels=levels
    )
    with open_executor(settings) as executor:
        _solve(job, executor, cloud.path)
    objects = SceneObjects.tell_apart(scene, partial(_parts, cloud, job), read_objects)
    summary = _write(output, cloud, job, objects)
    folder.remove()
    return summary


def _solve(job: PropagateJob, executor: Executor, path: Path) -> None:
    """All passes; leaves arrays `label`, `confidence` and `state` of every tile."""
    tiles = job.store.tiles
    summaries = executor.run("graph", partial(_graph_task, job), tiles)
    job.corrections.warn_of_missing(np.sum([summary.touched for summary in summaries], axis=0), path)
    offered = _offered(summaries)
    if not offered[: len(job.channels.ids) - 1].any():
        raise no_seeds(path, job.corrections)
    if job.channels.none:
        job = replace(job, rates=NoneRates.from_counts(sum(summary.found for summary in summaries)))
    learned, source = None, None
    if uses_appearance(job.settings):
        job, offered, learned = _learn(job, executor, summaries)
    if job.settings.method == "map" and learned is not None:
        source = _rounds(job, executor, offered, learned)
    elif learned is not None:
        learned = _limit(job, executor, learned)
    if source is None:
        source = "once"
        executor.run("labels", partial(_once_task, job, offered, learned), tiles)
    reached = _reached(job, executor) if job.settings.method == "map" else None
    executor.run("states", partial(_state_task, job, source, reached, learned), tiles)


def _rounds(
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
            taught = replace(taught, statistics=sum_statistics([statistics for statistics, _ in parts]))
            counts = np.sum([counts for _, counts in parts], axis=0)
        if not (too_many := overruled(counts, learned.trust)).any():
            return last
        learned, attempt = replace(learned, trust=learned.trust.without(too_many)), attempt + 1
    return None


def _limit(job: PropagateJob, executor: Executor, learned: LearnedFromTiles) -> LearnedFromTiles:
    """The same, with the classes of which too many seeds would go."""
    counts = executor.run("seeds", partial(_overruled_task, job, learned), job.store.tiles)
    return replace(learned, too_many=overruled(np.sum(counts, axis=0), learned.trust))


def _overruled_task(job: PropagateJob, learned: LearnedFromTiles, tile: int) -> np.ndarray:
    part = TileGraph.load(job, tile)
    return count_overruled(part.known, _start(job, part, learned), part.core)


@dataclass(frozen=True)
class TileSummary:
    """First look at a tile. seeds: (C,) int64 of each class; agreement: as `LabelledPoints.agreement`; lean: of its
    surfaces; touched: as counts of `Corrections.apply`; found: as `none_evidence.count_votes`; disagreement: as
    `vote_evidence.count_disagreement`
    """

    seeds: np.ndarray
    agreement: np.ndarray
    lean: NormalStatistics
    touched: np.ndarray
    found: np.ndarray
    disagreement: np.ndarray


def _graph_task(job: PropagateJob, tile: int) -> TileSummary:
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


def _offered(summaries: list[TileSummary]) -> np.ndarray:
    """(C,) bool classes that have seeds."""
    return np.sum([summary.seeds for summary in summaries], axis=0) > 0


def _learn(
    job: PropagateJob, executor: Executor, summaries: list[TileSummary]
) -> tuple[PropagateJob, np.ndarray, LearnedFromTiles | None]:
    """The job without misplaced votes, its classes with seeds (C,) bool, and what the agreed points of all tiles
    teach, if that tells classes apart on points held out.
    """
    tiles = job.store.tiles
    lean = NormalStatistics.merge([summary.lean for summary in summaries])
    terrain = GroundModel.from_statistics(lean, job.extent.low, job.extent.high, job.up)
    for window, ground in zip(
        WINDOWS,
        terrain.grounds(executor.run("ground", partial(_lowest_task, job, terrain), tiles)),
        strict=True,
    ):
        np.save(job.shared / f"ground{window}.npy", ground)
    counts = [
        QuantileSketch.merge(list(parts))
        for parts in zip(*executor.run("relief", partial(_relief_task, job, terrain), tiles), strict=True)
    ]
    halves, least = _examples(job, executor, summaries, counts)
    if job.levels is not None:
        job = replace(job, misplaced=_misplaced(job, executor, halves, least, job.levels))
    if job.misplaced is not None:
        summaries = executor.run("graph", partial(_graph_task, job), tiles)
        halves, least = _examples(job, executor, summaries, counts)
    contrasts = sum(executor.run("held-out looks", partial(_held_out_task, job, halves, least), tiles))
    trust = trust_of(halves, contrasts, np.sum([summary.disagreement for summary in summaries], axis=0))
    learned = None if trust is None else LearnedFromTiles(sum_statistics(halves), trust)
    return job, _offered(summaries), learned


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


@dataclass(frozen=True)
class LearnedFromTiles:
    """`LearnedAppearance` without its model, of which each tile has its own part; too_many: (C,) bool as of
    `appearance.limited`, None = not known yet
    """

    statistics: AppearanceStatistics
    trust: Trust
    too_many: np.ndarray | None = None

    @property
    def tells_apart(self) -> bool:
        """Whether there are examples of two looks."""
        return tells_apart(self.statistics, self.trust)

    def of(self, model: AppearanceModel) -> LearnedAppearance:
        return LearnedAppearance(model, self.statistics, self.trust)


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


def _once_task(job: PropagateJob, offered: np.ndarray, learned: LearnedFromTiles | None, tile: int) -> None:
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


def _reached(job: PropagateJob, executor: Executor) -> dict[int, np.ndarray]:
    """Per tile, (K,) bool: the connected groups of its points from which some path, through whatever tiles,
    leads to a seed.
    """
    tiles = job.store.tiles
    sizes = np.cumsum([0, *executor.run("connections", partial(_component_task, job), tiles)])
    first = dict(zip(tiles, sizes[:-1].tolist(), strict=True))
    found = executor.run("links", partial(_link_task, job, first), tiles)
    links = np.concatenate([pairs for pairs, _ in found])
    graph = coo_matrix((np.ones(len(links), np.int8), links.T), shape=(sizes[-1], sizes[-1]))
    group, seeded = connected_components(graph, directed=False)[1], np.zeros(sizes[-1], bool)
    seeded[np.concatenate([with_seed for _, with_seed in found])] = True
    reached = np.bincount(group, seeded)[group] > 0
    return {
        tile: reached[first[tile] : first[tile] + size]
        for tile, size in zip(tiles, np.diff(sizes), strict=True)
    }


def _component_task(job: PropagateJob, tile: int) -> int:
    """Number the connected groups of a part's points over the edges of the tile's own points; returns how
    many there are.
    """
    part = TileGraph.load(job, tile)
    graph, count = part.graph, len(part.core)
    rows = np.repeat(part.core, np.diff(graph.starts))
    starts = np.append(0, np.cumsum(np.where(part.core, np.diff(graph.starts), 0)))
    edges = csr_matrix(
        (np.ones(int(rows.sum()), np.int8), graph.neighbors[rows], starts), shape=(count, count)
    )
    number, group = connected_components(edges, directed=False)
    job.results.write(tile, group=part.own(group.astype(np.int32)), all_groups=group.astype(np.int32))
    return number


def _link_task(job: PropagateJob, first: dict[int, int], tile: int) -> tuple[np.ndarray, np.ndarray]:
    """(L, 2) pairs of groups, numbered over all tiles, that share a point, and (S,) groups of the tile that
    hold a seed.
    """
    part = TileGraph.load(job, tile)
    mine = job.results.read(tile, "all_groups").astype(np.int64) + first[tile]
    others = part.halo.gather(
        lambda other: job.results.read(other, "group", mapped=True).astype(np.int64) + first[other]
    )[part.graph.order]
    pairs = np.unique(np.stack([mine[~part.core], others[~part.core]], axis=1), axis=0)
    return pairs, np.unique(mine[part.core & (part.known.seed_labels > 0)])


def _state_task(
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
    if job.settings.fill:
        label, confidence = fill_from_nearest(part.known.points, label, confidence)
    final = with_states(part.known.seeds, _start(job, part, learned), (label, confidence), job.settings)
    label = job.channels.to_ids(final.label)
    job.results.write(
        tile, label=part.own(label), confidence=part.own(final.confidence), state=part.own(final.state)
    )


def _parts(cloud: CloudFile, job: PropagateJob) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """As `instances.scene_objects.Parts`, in the order of the cloud."""
    found = job.results.in_order(["label"], cloud.rows_at_once)
    for (_, records), values in zip(cloud.chunks(), found, strict=True):
        doubted = records[UNCONFIRMED] if UNCONFIRMED in cloud.names else np.zeros(len(records), np.uint8)
        yield positions(records), values["label"], doubted == 0


def _write(path: Path, cloud: CloudFile, job: PropagateJob, objects: SceneObjects | None) -> PropagateSummary:
    taken = {INSTANCE, *(name for name in cloud.names if name.startswith(VOTES))}
    kept = [(name, cloud.dtype[name].str[1:]) for name in cloud.names if name not in taken]
    written = kept + ([(INSTANCE, "u4")] if objects is not None else [])
    counts, confidence = np.zeros(4, np.int64), [0.0]

    def chunks():
        found = job.results.in_order(["label", "confidence", "state"], cloud.rows_at_once)
        for (_, records), values in zip(cloud.chunks(), found, strict=True):
            result = np.empty(len(records), np.dtype(written))
            for name, _ in kept:
                result[name] = values[name] if name in values else records[name]
            if objects is not None:
                result[INSTANCE] = objects.find(positions(records), values["label"])
            labelled = values["label"] > 0
            states = (labelled & (values["state"] == PROPAGATED)).sum(), (values["state"] == CORRECTED).sum()
            counts[:] += len(records), labelled.sum(), *states
            confidence[0] += float(values["confidence"][labelled].sum(dtype=np.float64))
            yield result

    write_records(path, chunks(), np.dtype(written), cloud.num_points, ["sc3d"])
    num_points, labelled, propagated, corrected = counts.tolist()
    numbers = {} if objects is None else objects.figures()
    return PropagateSummary(num_points, labelled, propagated, confidence[0], corrected, objects=numbers)
