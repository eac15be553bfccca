"""What photos see of a labelled cloud that does not fit into memory: the row of the cloud's point that each
judged pixel shows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, camera_rays, local_origin, may_see
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.geometry.raycast import FirstSurface, first_surface, surface_points
from sc3d.io.chunked_clouds import CloudFile, positions
from sc3d.io.images import image_size, read_index_image
from sc3d.scene.labelled_cloud import REACH
from sc3d.scene.labels import Labels
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Evaluate
from sc3d.tiling.executor import Executor
from sc3d.tiling.label import sample_spacing
from sc3d.tiling.memory import WorkFolder, max_points, memory_of
from sc3d.tiling.ranges import RangeMaps
from sc3d.tiling.store import CloudStatistics, Results, TileStore
from sc3d.tiling.surfaces import RangeJob, compute_ranges, split_mesh, split_surfels, views_of

BYTES = 260  # of a point while pixels look for the nearest one


@dataclass(frozen=True)
class EvaluateJob:
    """What the task of a tile needs to know. truth: file of the truth mask of each view; reach: largest
    distance of a pixel's point, world units
    """

    scene: Path
    truth: dict[str, Path]
    extent_low: np.ndarray
    store: TileStore
    results: Results
    maps: RangeMaps
    reach: float


@dataclass(frozen=True)
class TiledSurface:
    """Stands for `labelled.LabelledSurface` where only pixels with truth are asked for."""

    job: EvaluateJob
    parts: WorkFolder

    def rows(self, view: View, size: tuple[int, int], wanted: np.ndarray) -> tuple[np.ndarray, FirstSurface]:
        """(H, W) int64 row of the cloud at each wanted pixel, -1 = nothing near; the first surface. size:
        (width, height) of the truth mask.
        """
        rows, job = np.full(size[0] * size[1], -1, np.int64), self.job
        for tile in job.store.tiles:
            name = f"seen{job.maps.numbers[view.name]}"
            if job.results.has(tile, name):
                pixels, found = job.results.read(tile, name)
                rows[pixels] = found
        return np.where(wanted, rows.reshape(size[::-1]), -1), first_surface(job.maps, view.resized(*size))


def find_points_by_tiles(scene: Scene, settings: Evaluate, cloud: CloudFile, tasks: Executor) -> TiledSurface:
    """Find the cloud's point at all pixels that have truth, tile by tile."""
    truth = scene.mask_files(settings.truth or scene.truth, scene.class_table())
    views = [view for view in scene.model.views if view.name in truth]
    parts = WorkFolder(
        settings.output or scene.metrics,
        "evaluate",
        [scene.sparse, scene.mesh, settings.truth or scene.truth, cloud.path],
        settings,
    )
    survey = CloudStatistics.from_cloud(cloud)
    store = TileStore.build(
        cloud, survey.grid(max_points(settings, BYTES), REACH * survey.spacing), parts.subfolder("tiles")
    )
    spacing, _ = sample_spacing(store, survey)
    origin = local_origin(scene.model.views)
    mesh = (
        split_mesh(scene.mesh, parts.subfolder("surface"), origin, memory_of(settings))
        if scene.mesh.exists()
        else split_surfels(store, spacing, parts.subfolder("surface"), origin)
    )
    maps = RangeMaps(parts.subfolder("ranges"), {view.name: number for number, view in enumerate(views)})
    compute_ranges(
        RangeJob(scene.path, mesh, maps, {view.name: image_size(truth[view.name]) for view in views}), tasks
    )
    results = Results(parts.subfolder("results"), store)
    job = EvaluateJob(
        scene.path,
        {view.name: truth[view.name] for view in views},
        survey.extent.low,
        store,
        results,
        maps,
        REACH * spacing,
    )
    tasks.run("looking", partial(find_points_in_tile, job), store.tiles)
    return TiledSurface(job, parts)


def find_points_in_tile(job: EvaluateJob, tile: int) -> None:
    """Pixels whose first surface lies in the tile, and the nearest point of each: (2, K) int64 pixel and row
    of the cloud, for every view.
    """
    window = job.store.window(tile, job.reach)
    points = positions(window.gather(job.store.records))
    low, high, index, views = (
        points.min(axis=0) - job.reach,
        points.max(axis=0) + job.reach,
        NeighborIndex(points, job.extent_low),
        views_of(job.scene),
    )
    for name, file in job.truth.items():
        if not may_see(views[name], low, high):
            continue
        truth = read_index_image(file)
        view = views[name].resized(*truth.shape[::-1])
        ranges = job.maps.cast(view, camera_rays(view.camera))[0].reshape(truth.shape)
        rows, columns = np.nonzero(np.isfinite(ranges) & (truth > 0))
        hits = surface_points(FirstSurface(ranges, ranges, ranges), view, rows, columns)
        mine = job.store.grid.tile_of(hits) == tile
        if mine.any():
            nearest, distance = index.nearest(hits[mine], 1)
            near = distance[:, 0] <= job.reach
            pixels = (rows * truth.shape[1] + columns)[mine][near]
            job.results.write(
                tile, **{f"seen{job.maps.numbers[name]}": np.stack([pixels, window.rows[nearest[near, 0]]])}
            )


def read_labels(cloud: CloudFile) -> Labels:
    """The labels of a cloud file, 10 bytes per point, without the rest; InputError if it has none."""
    names = {"label": np.uint8, "confidence": np.float32, "state": np.uint8, "num_views": np.int32}
    missing = [name for name in names if name not in cloud.dtype.names]
    if missing:
        raise InputError(
            f"{cloud.path} has no attribute {missing[0]!r}: it was not written by `sc3d propagate`"
        )
    columns = {name: np.empty(cloud.num_points, kind) for name, kind in names.items()}
    for start, records in cloud.chunks():
        for name, column in columns.items():
            column[start : start + len(records)] = records[name]
    return Labels(**columns)
