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
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.georeferencing.up_direction import scene_up
from sc3d.instances.scene_objects import SceneObjects
from sc3d.io.chunked_clouds import CloudFile, positions
from sc3d.io.ply import read_header, write_records
from sc3d.io.provenance import Input, PhotoFrames
from sc3d.propagation.appearance import uses_appearance
from sc3d.propagation.none_evidence import NoneRates
from sc3d.propagation.potts import STEPS
from sc3d.propagation.propagate import PropagateSummary, levels_of, no_seeds
from sc3d.scene.corrections import Corrections
from sc3d.scene.labelled_cloud import INSTANCE, UNCONFIRMED, VOTES, vote_channels
from sc3d.scene.labels import CORRECTED, PROPAGATED
from sc3d.scene.object_image import ReadObjects
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Propagate
from sc3d.tiling.connections import reached_groups
from sc3d.tiling.executor import Executor, open_executor
from sc3d.tiling.label import sample_spacing
from sc3d.tiling.learning import graph_task, learn_from_tiles, offered_classes
from sc3d.tiling.memory import fits, max_points, num_points
from sc3d.tiling.spreading import limit_overruled, once_task, run_rounds, state_task
from sc3d.tiling.store import CloudStatistics, Results, TileStore
from sc3d.tiling.tile_graph import PropagateJob
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
    summaries = executor.run("graph", partial(graph_task, job), tiles)
    job.corrections.warn_of_missing(np.sum([summary.touched for summary in summaries], axis=0), path)
    offered = offered_classes(summaries)
    if not offered[: len(job.channels.ids) - 1].any():
        raise no_seeds(path, job.corrections)
    if job.channels.none:
        job = replace(job, rates=NoneRates.from_counts(sum(summary.found for summary in summaries)))
    learned, source = None, None
    if uses_appearance(job.settings):
        job, offered, learned = learn_from_tiles(job, executor, summaries)
    if job.settings.method == "map" and learned is not None:
        source = run_rounds(job, executor, offered, learned)
    elif learned is not None:
        learned = limit_overruled(job, executor, learned)
    if source is None:
        source = "once"
        executor.run("labels", partial(once_task, job, offered, learned), tiles)
    reached = reached_groups(job, executor) if job.settings.method == "map" else None
    executor.run("states", partial(state_task, job, source, reached, learned), tiles)


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
