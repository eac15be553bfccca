"""`propagate` for clouds that do not fit into memory, tile by tile, in passes.

Mean field looks a few edges far in each round, so a tile with a margin as wide gives what the whole cloud
would. What is learned of the classes, the ground below and which points hang together concern the whole: each
pass ends with sums, minima or links over all tiles.
`geometry` and `knn` see no farther than the margin, too; there a point farther from any seed may come out
otherwise than in one piece.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.georeferencing.georeference import georeference_path
from sc3d.georeferencing.up_direction import scene_up
from sc3d.instances.scene_objects import SceneObjects
from sc3d.io.chunked_clouds import CloudFile, positions
from sc3d.io.ply import read_header, write_records
from sc3d.io.provenance import Input, PhotoFrames
from sc3d.propagation.appearance import uses_appearance
from sc3d.propagation.none_evidence import NoneRates
from sc3d.propagation.potts import STEPS
from sc3d.propagation.propagate import (
    MAKE_CLOUD,
    PropagateSummary,
    levels_of,
    meters_per_unit,
    no_seeds,
    read_saved_appearance,
    start_of,
)
from sc3d.scene.channels import Channels
from sc3d.scene.corrections import Corrections
from sc3d.scene.labelled_cloud import INSTANCE, UNCONFIRMED, VOTES, vote_channels
from sc3d.scene.labels import CORRECTED, PROPAGATED
from sc3d.scene.object_image import ReadObjects
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Propagate
from sc3d.tiling.connections import reached_groups
from sc3d.tiling.executor import Executor, open_executor
from sc3d.tiling.filling import fill_tiles
from sc3d.tiling.given_normals import NORMALS
from sc3d.tiling.label import sample_spacing
from sc3d.tiling.learning import TileSummary, graph_task, learn_from_tiles, offered_classes
from sc3d.tiling.memory import fits, max_points, num_points
from sc3d.tiling.site_model import GivenModel, learn_for_others
from sc3d.tiling.spreading import limit_overruled, once_task, run_rounds, state_task
from sc3d.tiling.store import CloudStatistics, Results, TileStore
from sc3d.tiling.tile_graph import BareStart, PropagateJob
from sc3d.tiling.work_folder import WorkFolder

LEAST_BYTES = 700
BYTES, VOTE_BYTES = 460, 40  # of a point while its tile is worked on, and more for each channel of its votes
EDGE = 2.6  # an edge is hardly longer, point spacings
NORMAL_REACH = 8.0  # from which neighbors come that normals are estimated from, point spacings
HOPS = STEPS + 3  # how far a round of mean field looks, and what the edges at that distance depend on

# what is added to a cloud of which nothing was known
STARTED = [
    *((name, "f4") for name in NORMALS),
    ("label", "u1"),
    ("confidence", "f4"),
    ("state", "u1"),
    ("num_views", "i4"),
]


def propagate_fits(scene: Scene, settings: Propagate) -> bool:
    """Whether the cloud fits into memory as a whole, and nobody asked for workers."""
    path, bare = start_of(scene, settings)
    count = num_points(path)
    if count is None:
        return True
    vertex = read_header(path).element("vertex") if path.suffix.lower() == ".ply" and not bare else None
    channels = vote_channels(entry.name for entry in vertex.properties) if vertex else None
    if bare and scene.classes.exists():
        channels = scene.class_table().channels
    return fits(count * bytes_per_point(channels.count if channels else 1), settings)


def bytes_per_point(num_channels: int) -> int:
    """Of memory while a tile is worked on."""
    return max(LEAST_BYTES, BYTES + VOTE_BYTES * num_channels)


def propagate_scene(
    scene: Scene, settings: Propagate, read_objects: ReadObjects | None = None
) -> PropagateSummary:
    """As `propagation.propagate.propagate_scene`, tile by tile, here or on the workers that the settings ask for."""
    given, output = _given_model(scene, settings), settings.output or scene.labelled
    path, bare = start_of(scene, settings)
    if bare:
        scene.require(path, hint=MAKE_CLOUD)
    cloud = CloudFile.open(path)
    channels = scene.class_table().channels if bare else _channels_of(cloud)
    start = BareStart.of_cloud(cloud, scene) if bare else None
    corrections = Corrections.of_scene(scene)
    decisive: list[Input] = [
        cloud.path,
        scene.sparse,
        scene.classes,
        PhotoFrames(scene.images),
        *corrections.files,
        *([settings.model, georeference_path(scene)] if settings.model else []),
    ]
    folder, statistics = (
        WorkFolder(output, "propagate", decisive, settings),
        CloudStatistics.from_cloud(cloud),
    )
    room = max_points(settings, bytes_per_point(channels.count))
    reach = HOPS * EDGE + (NORMAL_REACH if start is not None and start.estimated else 0)
    grid = statistics.grid(room, reach * statistics.spacing)
    store = TileStore.build(cloud, grid, folder.subfolder("tiles"))
    margin = reach * sample_spacing(store, statistics)[0]
    results, shared = Results(folder.subfolder("results"), store), folder.subfolder("shared")
    up = scene_up(scene)
    levels = levels_of(scene, channels)
    job = PropagateJob(
        settings,
        statistics.extent,
        store,
        results,
        margin,
        channels,
        shared,
        up,
        corrections,
        levels=levels,
        start=start,
    )
    learned = None
    with open_executor(settings) as executor:
        summaries = _solve(job, executor, cloud.path, given)
        if settings.save_model is not None:
            kept = learn_for_others(job, executor, summaries, meters_per_unit(scene))
            learned = None if kept is None else kept.to_part()
    objects = SceneObjects.tell_apart(scene, partial(_parts, cloud, job), read_objects)
    summary = replace(_write(output, cloud, job, objects), learned=learned)
    folder.remove()
    return summary


def _given_model(scene: Scene, settings: Propagate) -> GivenModel | None:
    saved = read_saved_appearance(scene, settings)
    if saved is None or settings.model is None:
        return None
    return GivenModel(saved, settings.model, meters_per_unit(scene))


def _channels_of(cloud: CloudFile) -> Channels:
    """Of the votes of a cloud; InputError if `sc3d label` did not write it."""
    channels = vote_channels(cloud.names)
    for name in ("nx", "label", "confidence", "state", "num_views", *([] if channels else [f"{VOTES}0"])):
        if name not in cloud.names:
            raise InputError(f"{cloud.path} has no attribute {name!r}: it was not written by `sc3d label`")
    if channels is None:
        raise InputError(f"{cloud.path} has votes of no class: it was not written by `sc3d label`")
    return channels


def _solve(job: PropagateJob, executor: Executor, path: Path, given: GivenModel | None) -> list[TileSummary]:
    """All passes; leaves arrays `label`, `confidence` and `state` of every tile. Returns the first look at
    them.
    """
    tiles = job.store.tiles
    summaries = first = executor.run("graph", partial(graph_task, job), tiles)
    job.corrections.warn_of_missing(np.sum([summary.touched for summary in summaries], axis=0), path)
    offered = offered_classes(summaries)
    if given is None and not offered[: len(job.channels.ids) - 1].any():
        raise no_seeds(path, job.corrections)
    if job.channels.none:
        job = replace(job, rates=NoneRates.from_counts(sum(summary.found for summary in summaries)))
    learned, source = None, None
    if given is not None:
        learned = given.on_tiles(job, executor, summaries)
        offered = offered | learned.offers
    elif uses_appearance(job.settings):
        job, offered, learned = learn_from_tiles(job, executor, summaries)
    if job.settings.method == "map" and learned is not None:
        source = run_rounds(job, executor, offered, learned)
    elif learned is not None:
        learned = limit_overruled(job, executor, learned)
    if source is None:
        source = "once"
        executor.run("labels", partial(once_task, job, offered, learned), tiles)
    # a model labels what no seed reaches, too
    reached = reached_groups(job, executor) if job.settings.method == "map" and given is None else None
    if job.settings.fill:
        source, reached = fill_tiles(job, executor, source, reached), None
    executor.run("states", partial(state_task, job, source, reached, learned), tiles)
    return first


def _parts(cloud: CloudFile, job: PropagateJob) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """As `instances.scene_objects.Parts`, in the order of the cloud."""
    found = job.results.in_order(["label"], cloud.rows_at_once)
    for (_, records), values in zip(cloud.chunks(), found, strict=True):
        doubted = records[UNCONFIRMED] if UNCONFIRMED in cloud.names else np.zeros(len(records), np.uint8)
        yield positions(records), values["label"], doubted == 0


def _write(path: Path, cloud: CloudFile, job: PropagateJob, objects: SceneObjects | None) -> PropagateSummary:
    added = [] if job.start is None else STARTED
    taken = {INSTANCE, *dict(added), *(name for name in cloud.names if name.startswith(VOTES))}
    kept = [(name, cloud.dtype[name].str[1:]) for name in cloud.names if name not in taken]
    written = kept + added + ([(INSTANCE, "u4")] if objects is not None else [])
    counts, confidence = np.zeros(4, np.int64), [0.0]

    def chunks():
        names = ["label", "confidence", "state", *(["normals"] if job.start is not None else [])]
        found = job.results.in_order(names, cloud.rows_at_once)
        for (_, records), values in zip(cloud.chunks(), found, strict=True):
            if job.start is not None:
                normals = dict(zip(NORMALS, values.pop("normals").T, strict=True))
                values |= normals | {"num_views": np.zeros(len(records), np.int32)}
            result = np.empty(len(records), np.dtype(written))
            for name, _ in kept + added:
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
