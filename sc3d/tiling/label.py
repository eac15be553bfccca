"""`label` for clouds that do not fit into memory: the votes of a voxel need its own points only, so every
tile votes for itself.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from sc3d.geometry.cameras import View, local_origin
from sc3d.geometry.neighbors import NeighborIndex, point_spacing
from sc3d.geometry.voxels import BLOCK, VOXELS, file_header, sort_by_voxel, unpack_blocks, voxel_origin
from sc3d.io.chunked_clouds import CloudFile, positions, rows_at_once
from sc3d.io.ply import num_triangles, write_records
from sc3d.io.provenance import Input, PhotoFrames
from sc3d.labelling.cloud import Cloud, CloudExtent
from sc3d.labelling.fusion import Fusion, fuse
from sc3d.labelling.inputs import (
    FOOTPRINT_SAMPLE,
    Masks,
    best_confidence,
    point_density,
    require_in_view,
    voxel_size_for,
)
from sc3d.labelling.label import LabelSummary, summarize
from sc3d.labelling.normal_sides import Sides, judge_sides, sample_step, with_sides
from sc3d.labelling.prior_cloud import PriorVotes
from sc3d.scene.channels import Channels
from sc3d.scene.labelled_cloud import (
    INSTANCE,
    SPACING_NEIGHBORS,
    SPACING_SAMPLE,
    VOTES,
)
from sc3d.scene.labels import STATE_NAMES, Labels
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Label
from sc3d.tiling.executor import Executor, open_executor
from sc3d.tiling.first_surfaces import (
    RangeJob,
    RangeMaps,
    SurfaceParts,
    compute_ranges,
    split_mesh,
    split_surfels,
)
from sc3d.tiling.given_normals import NORMALS, TileNormals, has_usable_normals
from sc3d.tiling.label_grid_file import write_field
from sc3d.tiling.memory import TRIANGLE, fits, max_points, memory_of, num_points
from sc3d.tiling.prior_votes import hear_prior
from sc3d.tiling.store import CloudStatistics, Results, TileStore
from sc3d.tiling.voxel_parts import split_voxels
from sc3d.tiling.work_folder import WorkFolder

logger = logging.getLogger(__name__)

LEAST_BYTES = 420  # of a point while its tile votes
BYTES, VOTE_BYTES = 180, 40  # the same without its votes, and of each channel of these
PRIOR_BYTES = 150  # of a point of --prior, beside which the cloud is in memory
VOXEL = 2.2  # of a label voxel, in point spacings, while neither is known exactly
SAMPLE_MARGIN = 20.0  # around a tile whose spacing is measured, point spacings
# margin of a tile: the rest of a block that its border cuts, and the block beyond, which verification looks
# at
BLOCKS = 2


@dataclass(frozen=True)
class LabelJob:
    """What the task of a tile needs to know. settings: with the voxel size; maps: None = no occlusion test;
    confidence: folder of confidence maps or None; sides: what to do with given normals
    """

    scene: Path
    settings: Label
    extent: CloudExtent
    store: TileStore
    results: Results
    maps: RangeMaps | None
    confidence: Path | None
    sides: Sides = Sides.KEEP

    @property
    def margin(self) -> float:
        return BLOCKS * BLOCK * self.settings.voxel_size


def label_fits(scene: Scene, settings: Label) -> bool:
    """Whether cloud and mesh fit into memory as a whole, and nobody asked for workers."""
    source = settings.cloud or scene.cloud
    count = num_points(source)
    if count is None or not source.exists():
        return True  # cannot be read in parts
    needed = count * bytes_per_point(scene) + num_triangles(scene.surface) * TRIANGLE
    classified = num_points(settings.prior) if settings.prior is not None else None
    return fits(needed + (classified or 0) * PRIOR_BYTES, settings)


def bytes_per_point(scene: Scene) -> int:
    """Of memory while a tile votes: most goes to the votes, of which each class has a channel."""
    if not scene.classes.exists():
        return LEAST_BYTES  # which `Masks.load` refuses
    return max(LEAST_BYTES, BYTES + VOTE_BYTES * scene.class_table().channels.count)


def label_scene(scene: Scene, settings: Label, prior_name: Path | None = None) -> LabelSummary:
    """As `labelling.label.label_scene`, tile by tile, here or on the workers that the settings ask for."""
    settings = settings.resolved
    cloud = CloudFile.open(settings.cloud or scene.cloud)
    confidence = best_confidence(scene) if settings.use_confidence else None
    masks, output = _masks(scene, confidence, settings), settings.output or scene.seeds
    decisive: list[Input] = [
        scene.sparse,
        scene.classes,
        scene.masks,
        *([confidence] if confidence else []),
        *scene.surface,
        cloud.path,
        PhotoFrames(scene.images),
        *([settings.prior] if settings.prior else []),
    ]
    folder = WorkFolder(output, "label", decisive, settings)
    statistics = CloudStatistics.from_cloud(cloud)
    box = statistics.extent.low, statistics.extent.high
    require_in_view(cloud.path, box, masks, scene.model.points)
    masks.tell_of_left_out(*box)
    margin = BLOCKS * BLOCK * (settings.voxel_size or VOXEL * statistics.spacing)
    grid = statistics.grid(max_points(settings, bytes_per_point(scene)), margin)
    store = TileStore.build(cloud, grid, folder.subfolder("tiles"))
    spacing, sample = sample_spacing(store, statistics)
    if not settings.voxel_size:
        settings = replace(settings, voxel_size=voxel_size_for(spacing, sample, masks))
    sides = _judge_sides(cloud, masks.views or scene.model.views)
    results = Results(folder.subfolder("results"), store)
    job = LabelJob(scene.path, settings, statistics.extent, store, results, None, confidence, sides)
    with open_executor(settings) as executor:
        executor.run("normals", partial(normals_of_tile, job), store.tiles)
        if settings.depth_filter and masks.views:
            job = replace(job, maps=_ranges(scene, masks, job, spacing, folder, executor))
        name = prior_name or settings.prior
        if name is not None:
            hear_prior(settings, name, box, results, folder.subfolder("prior"), executor, masks)
        executor.run("voting", partial(label_tile, job), store.tiles)
    header = file_header(settings.voxel_size, masks.channels.ids)
    write_field(job.results, store.tiles, header, scene.votes_of(settings.output))
    counts, num_none = _write(output, cloud, job, masks.channels)
    num_turned = sum(int(results.read(tile, "turned")[0]) for tile in store.tiles)
    folder.remove()
    return summarize(counts, num_none, settings.voxel_size, masks.views, cloud.path, box, num_turned)


def _ranges(
    scene: Scene, masks: Masks, job: LabelJob, spacing: float, parts: WorkFolder, executor: Executor
) -> RangeMaps:
    origin, folder = local_origin(masks.views), parts.subfolder("surface")
    normals = partial(job.results.around, name="normals")
    surface: SurfaceParts
    if scene.mesh.exists() and job.settings.surface == "auto":
        surface = split_mesh(scene.surface, folder, origin, memory_of(job.settings))
    elif job.settings.surface == "surfels":
        surface = split_surfels(job.store, normals, spacing, folder, origin)
    else:
        low = job.extent.low
        surface = split_voxels(job.store, normals, low, spacing, folder, executor, job.settings)
    maps = RangeMaps(
        parts.subfolder("ranges"), {view.name: number for number, view in enumerate(masks.views)}
    )
    return compute_ranges(
        RangeJob(scene.path, surface, maps, {view.name: masks.size(view) for view in masks.views}),
        executor,
    )


def _masks(scene: Scene, confidence: Path | None, settings: Label) -> Masks:
    return Masks.load(scene, confidence, settings.unlabelled, needed=settings.prior is None)


def _judge_sides(cloud: CloudFile, views: list[View]) -> Sides:
    """What to do with the cloud's own normals, by the points that `labelling.label` looks at."""
    if not has_usable_normals(cloud):
        return Sides.ESTIMATE
    step = sample_step(cloud.num_points)
    sample = np.concatenate([records[-start % step :: step] for start, records in cloud.chunks()])
    return judge_sides(positions(sample), _normals(sample), views, cloud.path)


def _normals(records: np.ndarray) -> np.ndarray:
    """(N, 3)"""
    return np.stack([records[name] for name in NORMALS], axis=1)


def sample_spacing(store: TileStore, statistics: CloudStatistics) -> tuple[float, np.ndarray]:
    """Sampling distance as `labelled_cloud.spacing_of` has it, and the points (S, 3) by which
    `default_voxel_size` measures mask pixels.
    """
    rows, distances, footprint_rows, footprints = [], [], [], []
    num_points = sum(store.counts.values())
    for tile in store.tiles:
        halo = store.with_halo(tile, SAMPLE_MARGIN * statistics.spacing)
        points = positions(halo.gather(store.records))
        mine = halo.core & (halo.rows % max(1, num_points // SPACING_SAMPLE) == 0)
        rows.append(halo.rows[mine])
        distances.append(
            NeighborIndex(points, statistics.extent.low).nearest(points[mine], SPACING_NEIGHBORS + 1)[1]
        )
        mine = halo.core & (halo.rows % max(1, num_points // FOOTPRINT_SAMPLE) == 0)
        footprint_rows.append(halo.rows[mine])
        footprints.append(points[mine])
    ordered = [
        np.concatenate(values)[np.argsort(np.concatenate(keys))]
        for keys, values in ((rows, distances), (footprint_rows, footprints))
    ]
    return point_spacing(ordered[0]) or 1.0, ordered[1]


def normals_of_tile(job: LabelJob, tile: int) -> None:
    """Leaves the normals of a tile, turned to the right side, and how many were turned."""
    if job.results.has(tile, "turned"):
        return
    scene, halo = Scene(job.scene), job.store.with_halo(tile, job.margin)
    views = _masks(scene, job.confidence, job.settings).views or scene.model.views
    centers = np.array([view.center for view in views])
    given = TileNormals(job.store, centers, job.extent.low, job.sides is not Sides.ESTIMATE)(halo)
    points = positions(halo.gather(job.store.records))
    normals = with_sides(points, given, views, job.sides)[halo.core]
    turned = (normals != given[halo.core]).any(axis=1).sum()
    job.results.write(tile, normals=normals)
    job.results.write(tile, turned=np.array([turned]))


def label_tile(job: LabelJob, tile: int) -> None:
    """Fuse the masks on one tile and write its labels, votes and part of the voxel field; a finished tile is
    left alone.
    """
    if job.results.has(tile, "field"):
        return
    scene, store = Scene(job.scene), job.store
    halo = store.with_halo(tile, job.margin)
    points, masks = positions(halo.gather(store.records)), _masks(scene, job.confidence, job.settings)
    normals = job.results.around(halo, "normals")
    origin = voxel_origin(job.extent.low, job.settings.voxel_size)
    density = None
    if job.settings.mechanisms.density:
        density = point_density(scene, points, job.settings.voxel_size, origin)
    prior = None
    if job.settings.prior is not None:
        prior = PriorVotes(job.results.around(halo, "prior"), job.settings.prior_weight)
    fusion = fuse(
        Cloud(points, normals, density, job.extent),
        masks.views,
        masks.read,
        job.maps,
        masks.channels.count,
        job.settings,
        masks.channels.none,
        prior,
    )
    core = halo.core
    labels = fusion.labels
    job.results.write(
        tile,
        label=masks.channels.to_ids(labels.label)[core],
        confidence=labels.confidence[core],
        state=labels.state[core],
        num_views=labels.num_views[core].astype(np.int32),
        votes=fusion.votes[core],
    )
    keys, votes = _blocks(fusion, points, core)
    job.results.write(tile, keys=keys, field=votes)


def _blocks(fusion: Fusion, points: np.ndarray, core: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (B, 3) int32 and counts of the field's blocks whose first point, by row, lies in the tile:
    each block belongs to one tile.
    """
    grid = fusion.grid
    voxels = sort_by_voxel(points, grid.voxel_size, grid.origin)
    blocks, first_voxel = np.unique(voxels.keys // VOXELS, return_index=True)
    mine = unpack_blocks(blocks[core[np.minimum.reduceat(voxels.order, voxels.starts[first_voxel])]])
    return mine, grid.grid.attribute(grid.ATTRIBUTE).numpy()[grid.slots(mine)]


def _write(path: Path, cloud: CloudFile, job: LabelJob, channels: Channels) -> tuple[np.ndarray, int]:
    """The cloud with the labels of its tiles; returns the number of points in each state, and of no class."""
    added = [
        ("label", "u1"),
        ("confidence", "f4"),
        ("state", "u1"),
        ("num_views", "i4"),
        *((f"{VOTES}{name}", "f4") for name in channels.names),
    ]
    names = {name for name, _ in added} | {"nx", "ny", "nz", INSTANCE}
    kept = [
        (name, cloud.dtype[name].str[1:])
        for name in cloud.names
        if name not in names and not name.startswith(VOTES)
    ]
    dtype = np.dtype([*kept, ("nx", "f4"), ("ny", "f4"), ("nz", "f4"), *added])
    counts, num_none = np.zeros(len(STATE_NAMES), np.int64), np.zeros(1, np.int64)

    def chunks():
        names, at_once = (
            ["label", "confidence", "state", "num_views", "votes", "normals"],
            rows_at_once(dtype),
        )
        fused = job.results.in_order(names, at_once)
        for (_, records), values in zip(cloud.chunks(at_once), fused, strict=True):
            result = np.empty(len(records), dtype)
            for name, _ in kept:
                result[name] = records[name]
            for column, name in enumerate(("nx", "ny", "nz")):
                result[name] = values["normals"][:, column]
            for channel, name in enumerate(channels.names):
                result[f"{VOTES}{name}"] = values["votes"][:, channel]
            for name in ("label", "confidence", "state", "num_views"):
                result[name] = values[name]
            counts[:] += np.bincount(values["state"], minlength=len(STATE_NAMES))
            num_none[:] += Labels(*(values[name] for name in names[:4])).of_no_class.sum()
            yield result

    write_records(path, chunks(), dtype, cloud.num_points, ["sc3d"])
    return counts, int(num_none[0])
