"""`sc3d benchmark fusion-speed`: label and propagate against their rivals, growth over points and views,
memory.
"""

from __future__ import annotations

import logging
import os
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, local_origin
from sc3d.geometry.raycast import Surface
from sc3d.io.clouds import read_cloud, read_mesh
from sc3d.io.provenance import peak_memory_mb, reset_peak_memory, versions
from sc3d.labelling.cloud import Cloud
from sc3d.labelling.fusion import Fusion, fuse
from sc3d.labelling.inputs import Masks
from sc3d.labelling.observation import Mask
from sc3d.propagation.labelled_points import LabelledPoints
from sc3d.propagation.propagate import propagate
from sc3d.scene.labelled_cloud import point_arrays, read_surface, spacing_of
from sc3d.scene.labels import Labels
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Label, Propagate
from tools.benchmark import fusion_rivals as rivals
from tools.benchmark.fusion_page import markdown
from tools.benchmark.publish import check_output, publish
from tools.benchmark.settings import BenchmarkFusionSpeed

logger = logging.getLogger(__name__)

FUSE, MAP, RAYS, Z_BUFFER, NEIGHBORS, SKLEARN = (
    "label",
    "propagate map",
    "rays only",
    "numpy z-buffer voter",
    "16 nearest neighbors",
    "scikit-learn KNN",
)


@dataclass(frozen=True)
class FusionWorkload:
    """A cloud and the views that label it; masks are those of the scene. read: mask by view, kept in memory
    so that no file is timed; levels: as of `LabelledPoints`
    """

    cloud: Cloud
    colors: np.ndarray
    views: list[View]
    masks: dict[str, Mask]
    surface: Surface
    num_channels: int
    levels: np.ndarray | None = None

    def read(self, view: View) -> Mask:
        return self.masks[view.name.split("#")[0]]

    @cached_property
    def voxel_size(self) -> float:
        """2 point spacings, world units."""
        return 2 * spacing_of(self.cloud.points)


def run_fusion_speed(command: BenchmarkFusionSpeed) -> None:
    """Measure, show the table, write it if wanted."""
    if min(command.points, default=0) < 1000 or min(command.views, default=0) < 2 or command.repeats < 1:
        raise InputError("the benchmark needs at least 1000 points, 2 views and 1 repeat")
    check_output(command.output)
    scene = Scene(command.scene)
    hint = "the benchmark needs cloud.ply, mesh.ply and masks; `sc3d benchmark tables` makes such scenes"
    scene.require(scene.cloud, scene.mesh, scene.masks, scene.classes, hint=hint)
    load, masks = os.getloadavg()[0], Masks.load(scene, scene.confidence)
    workload = _workload(scene, masks, command.points[0])
    _label_and_propagate(_cut(workload, 2000, 2))  # compiles
    compared = min(40, len(masks.views))
    record = {
        "benchmark": "fusion speed",
        "scene": scene.path.resolve().name,
        "versions": versions(),
        "load": load,
        "points": len(workload.cloud.points),
        "views": compared,
        "rays": sum(workload.masks[view.name][0].size for view in masks.views[:compared]),
        "triangles": len(read_mesh(scene.mesh).triangle.indices),
        "contenders": _compare(_cut(workload, None, compared), command.repeats),
        "growth_points": [_grown(_workload(scene, masks, count), compared) for count in command.points],
        "growth_views": [_grown(workload, count) for count in command.views],
    }
    publish(record, markdown(record), command.output)


def _workload(scene: Scene, masks: Masks, num_points: int) -> FusionWorkload:
    """Random points of the cloud (seed 0), all views with a mask. More points than the cloud has: copies,
    moved at random along the surface.
    """
    read, origin = read_cloud(scene.cloud), local_origin(masks.views)
    points, normals = point_arrays(read, np.array([view.center for view in masks.views]))
    surface, rng = read_surface(scene.surface, points, normals, origin), np.random.default_rng(0)
    colors = read.point.colors.numpy() if "colors" in read.point else np.full(points.shape, 127, np.uint8)
    spacing, rows = (
        spacing_of(points),
        np.concatenate([rng.permutation(len(points)) for _ in range(-(-num_points // len(points)))])[
            :num_points
        ],
    )
    moves = rng.normal(0, spacing, (num_points, 3)) * (np.arange(num_points) >= len(points))[:, None]
    moves -= np.einsum("ni,ni->n", moves, normals[rows])[:, None] * normals[rows]
    pictures = {view.name: masks.read(view) for view in masks.views}
    return FusionWorkload(
        Cloud(points[rows] + moves, normals[rows]),
        colors[rows],
        masks.views,
        pictures,
        surface,
        scene.class_table().channels.count,
        masks.table.levels(masks.channels),
    )


def _cut(workload: FusionWorkload, num_points: int | None, num_views: int) -> FusionWorkload:
    """The first points and views; with more views than there are, they are repeated under other names."""
    views = [
        replace(view, name=f"{view.name}#{row // len(workload.views)}")
        if row >= len(workload.views)
        else view
        for row, view in ((row, workload.views[row % len(workload.views)]) for row in range(num_views))
    ]
    cloud = (
        workload.cloud
        if num_points is None
        else Cloud(workload.cloud.points[:num_points], workload.cloud.normals[:num_points])
    )
    return replace(workload, cloud=cloud, colors=workload.colors[:num_points], views=views)


def _label(workload: FusionWorkload) -> Fusion:
    settings = Label(voxel_size=workload.voxel_size)
    return fuse(
        workload.cloud, workload.views, workload.read, workload.surface, workload.num_channels, settings
    )


def _propagate(workload: FusionWorkload, fusion: Fusion) -> Labels:
    evidence = LabelledPoints(
        workload.cloud.points, fusion.labels, fusion.votes, workload.colors, levels=workload.levels
    )
    return propagate(evidence, workload.cloud.normals, Propagate(method="map"))


def _label_and_propagate(workload: FusionWorkload) -> Labels:
    return _propagate(workload, _label(workload))


def _compare(workload: FusionWorkload, repeats: int) -> dict[str, dict[str, float]]:
    """Median CPU and wall seconds of each contender; they take turns."""
    sized = [view.resized(*workload.read(view)[0].shape[::-1]) for view in workload.views]
    bundles, fusion = rivals.ray_bundles(workload.surface, sized), _label(workload)
    contenders: dict[str, Callable[[], object]] = {
        FUSE: lambda: _label(workload),
        RAYS: lambda: rivals.cast_only(workload.surface, bundles),
        Z_BUFFER: lambda: rivals.vote_with_z_buffer(
            workload.cloud, workload.views, workload.read, workload.num_channels
        ),
        MAP: lambda: _propagate(workload, fusion),
        NEIGHBORS: lambda: rivals.find_neighbors(workload.cloud.points),
        SKLEARN: lambda: rivals.classify_neighbors(workload.cloud.points, fusion.labels.label),
    }
    if rivals.classify_neighbors(workload.cloud.points[:1], np.uint8([1])) is None:
        del contenders[SKLEARN]
    seconds = defaultdict(list)
    for _ in range(repeats):
        for name, run in contenders.items():
            seconds[name].append(_timed(run)[:2])
            logger.info("%s: %.1f CPU s", name, seconds[name][-1][0])
    return {
        name: dict(zip(("cpu_seconds", "wall_seconds"), np.median(runs, axis=0).tolist(), strict=True))
        for name, runs in seconds.items()
    }


def _grown(workload: FusionWorkload, num_views: int) -> dict[str, float]:
    """Seconds and peak memory of label and of propagate at one size."""
    workload = _cut(workload, None, num_views)
    # the first cast builds the tree
    rivals.cast_only(workload.surface, rivals.ray_bundles(workload.surface, workload.views[:1]))
    _ = workload.voxel_size  # measured once
    cpu, wall, peak, fusion = _timed(lambda: _label(workload))
    record = {
        "points": len(workload.cloud.points),
        "views": num_views,
        "voxels": len(np.unique(fusion.rows // 2)),
        "label_cpu_seconds": cpu,
        "label_wall_seconds": wall,
        "label_peak_memory_mb": peak,
    }
    cpu, wall, peak, _ = _timed(lambda: _propagate(workload, fusion))
    logger.info(
        "%d points, %d views: label %.1f s, propagate %.1f CPU s",
        record["points"],
        num_views,
        record["label_cpu_seconds"],
        cpu,
    )
    return record | {
        "propagate_cpu_seconds": cpu,
        "propagate_wall_seconds": wall,
        "propagate_peak_memory_mb": peak,
    }


def _timed(run: Callable[[], object]) -> tuple[float, float, int, object]:
    """CPU seconds of all threads, wall seconds, peak memory of the process (MB), and what was returned."""
    reset_peak_memory()
    cpu, wall = time.process_time(), time.perf_counter()
    result = run()
    return time.process_time() - cpu, time.perf_counter() - wall, peak_memory_mb(), result
