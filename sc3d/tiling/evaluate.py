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
from sc3d.io.ply import num_triangles
from sc3d.io.provenance import PhotoFrames
from sc3d.metrics import EvaluationSummary, judge, truth_masks
from sc3d.scene.labelled_cloud import REACH
from sc3d.scene.labels import Labels
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Evaluate
from sc3d.tiling.executor import Executor, open_executor
from sc3d.tiling.first_surfaces import (
    RangeJob,
    RangeMaps,
    compute_ranges,
    split_mesh,
    split_surfels,
    views_of,
)
from sc3d.tiling.label import sample_spacing
from sc3d.tiling.memory import TRIANGLE, fits, max_points, memory_of, num_points
from sc3d.tiling.store import CloudStatistics, Results, TileStore
from sc3d.tiling.work_folder import WorkFolder

BYTES = 260  # of a point while pixels look for the nearest one


@dataclass(frozen=True)
class EvaluateJob:
    """What the task of a tile needs to know. truth: file of the truth mask of each view; zero_margin: as in
    `Scene.read_truth`; reach: largest distance of a pixel's point, world units
    """

    scene: Path
    truth: dict[str, Path]
    zero_margin: float | None
    extent_low: np.ndarray
    store: TileStore
    results: Results
    maps: RangeMaps
    reach: float


@dataclass(frozen=True)
class TiledSurface:
    """Stands for `labelled_cloud.LabelledSurface` where only pixels with truth are asked for."""

    job: EvaluateJob

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


def evaluate_fits(scene: Scene, settings: Evaluate) -> bool:
    """Whether cloud and mesh fit into memory as a whole, and nobody asked for workers."""
    path = settings.labelled or scene.labelled
    count = num_points(path) if path.exists() else None
    return count is None or fits(count * BYTES + num_triangles(scene.surface) * TRIANGLE, settings)


def evaluate_scene(scene: Scene, settings: Evaluate) -> EvaluationSummary:
    """As `metrics.evaluate_scene`, tile by tile, here or on the workers that the settings ask for."""
    cloud, output = CloudFile.open(settings.labelled or scene.labelled), settings.output or scene.metrics
    labels, truth = read_labels(cloud), settings.truth or scene.truth
    decisive = (scene.sparse, scene.classes, *scene.surface, truth, cloud.path, PhotoFrames(scene.images))
    folder = WorkFolder(output, "evaluate", decisive, settings)
    with open_executor(settings) as executor:
        surface = find_points(scene, settings, cloud, folder, executor)
    summary = judge(scene, settings, surface, labels)
    folder.remove()
    return summary


def find_points(
    scene: Scene, settings: Evaluate, cloud: CloudFile, folder: WorkFolder, executor: Executor
) -> TiledSurface:
    """Find the cloud's point at all pixels that have truth, tile by tile."""
    truth = truth_masks(scene, settings)
    views = [view for view in scene.model.views if view.name in truth]
    statistics = CloudStatistics.from_cloud(cloud)
    grid = statistics.grid(max_points(settings, BYTES), REACH * statistics.spacing)
    store = TileStore.build(cloud, grid, folder.subfolder("tiles"))
    spacing, _ = sample_spacing(store, statistics)
    parts, origin = folder.subfolder("surface"), local_origin(scene.model.views)
    if scene.mesh.exists():
        mesh = split_mesh(scene.surface, parts, origin, memory_of(settings))
    else:
        mesh = split_surfels(store, spacing, parts, origin)
    maps = RangeMaps(folder.subfolder("ranges"), {view.name: number for number, view in enumerate(views)})
    sizes = {view.name: scene.mask_size(truth[view.name], view.name) for view in views}
    compute_ranges(RangeJob(scene.path, mesh, maps, sizes), executor)
    results, files = (
        Results(folder.subfolder("results"), store),
        {view.name: truth[view.name] for view in views},
    )
    job = EvaluateJob(
        scene.path,
        files,
        settings.zero_margin,
        statistics.extent.low,
        store,
        results,
        maps,
        REACH * spacing,
    )
    executor.run("looking", partial(find_points_in_tile, job), store.tiles)
    return TiledSurface(job)


def find_points_in_tile(job: EvaluateJob, tile: int) -> None:
    """Pixels whose first surface lies in the tile, and the nearest point of each: (2, K) int64 pixel and row
    of the cloud, for every view.
    """
    halo = job.store.with_halo(tile, job.reach)
    points = positions(halo.gather(job.store.records))
    low, high, index, views = (
        points.min(axis=0) - job.reach,
        points.max(axis=0) + job.reach,
        NeighborIndex(points, job.extent_low),
        views_of(job.scene),
    )
    for name, file in job.truth.items():
        if not may_see(views[name], low, high):
            continue
        truth = Scene(job.scene).read_truth(file, name, job.zero_margin)
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
                tile, **{f"seen{job.maps.numbers[name]}": np.stack([pixels, halo.rows[nearest[near, 0]]])}
            )


def read_labels(cloud: CloudFile) -> Labels:
    """The labels of a cloud file, 10 bytes per point, without the rest; InputError if it has none."""
    names = {"label": np.uint8, "confidence": np.float32, "state": np.uint8, "num_views": np.int32}
    missing = [name for name in names if name not in cloud.names]
    if missing:
        raise InputError(
            f"{cloud.path} has no attribute {missing[0]!r}: it was not written by `sc3d propagate`"
        )
    columns = {name: np.empty(cloud.num_points, kind) for name, kind in names.items()}
    for start, records in cloud.chunks():
        for name, column in columns.items():
            column[start : start + len(records)] = records[name]
    return Labels(**columns)
