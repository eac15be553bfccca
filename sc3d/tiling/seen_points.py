"""What photos see of a labelled cloud that does not fit into memory: the row of the cloud's point that each
pixel shows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, camera_rays, local_origin, may_see
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.geometry.raycast import FirstSurface, first_surface, surface_points
from sc3d.io.chunked_clouds import CloudFile, positions
from sc3d.io.memory_limit import BASE
from sc3d.scene.labelled_cloud import REACH, LabelledSurface, read_labelled
from sc3d.scene.labels import Labels
from sc3d.scene.scene import Scene
from sc3d.settings.common import Memory
from sc3d.tiling.executor import Executor, SerialExecutor
from sc3d.tiling.first_surfaces import (
    RangeJob,
    RangeMaps,
    SurfaceParts,
    compute_ranges,
    sized_view,
    split_mesh,
)
from sc3d.tiling.given_normals import TileNormals, has_usable_normals
from sc3d.tiling.label import sample_spacing
from sc3d.tiling.memory import fits, max_points, memory_of, num_points, surface_bytes
from sc3d.tiling.store import CloudStatistics, Results, TileStore
from sc3d.tiling.voxel_parts import split_voxels
from sc3d.tiling.work_folder import WorkFolder

BYTES = 260  # of a point while pixels look for the nearest one
LABEL_BYTES = 10  # of a point whose label is kept in memory
LEAST_ROOM = 200 << 20  # bytes for a tile, however little is left
SHARE = 0.7  # of what is left that is planned with: pages of the files that a tile is read from come on top
SIZES = dict[str, tuple[int, int]]  # (width, height) of what is looked at, by name of the photo
Wanted = Callable[[str], np.ndarray | None]
"""(H, W) bool pixels of a photo that are looked at, None = all; a function that can be sent to workers"""


@dataclass(frozen=True)
class SeenJob:
    """What the task of a tile needs to know. pinhole: as in `RangeJob`; reach: largest distance of a pixel's
    point, world units.
    """

    scene: Path
    sizes: SIZES
    pinhole: int
    wanted: Wanted
    extent_low: np.ndarray
    store: TileStore
    results: Results
    maps: RangeMaps
    reach: float


@dataclass(frozen=True)
class SeenPoints:
    """Stands for `labelled_cloud.LabelledSurface` for the photos, sizes and pixels that were asked for.

    label: (N,) uint8 ids
    """

    job: SeenJob
    label: np.ndarray

    @property
    def reach(self) -> float:
        return self.job.reach

    def see(
        self, view: View, size: tuple[int, int], wanted: np.ndarray | None = None
    ) -> tuple[np.ndarray, FirstSurface]:
        """As `LabelledSurface.see`."""
        rows, first = self.rows(view, size, wanted)
        return np.where(rows >= 0, self.label[rows], 0).astype(np.uint8), first

    def rows(
        self, view: View, size: tuple[int, int], wanted: np.ndarray | None = None
    ) -> tuple[np.ndarray, FirstSurface]:
        """(H, W) int64 row of the cloud at each wanted pixel, -1 = nothing near; the first surface."""
        rows, job = np.full(size[0] * size[1], -1, np.int64), self.job
        for tile in job.store.tiles:
            name = f"seen{job.maps.numbers[view.name]}"
            if job.results.has(tile, name):
                pixels, found = job.results.read(tile, name)
                rows[pixels] = found
        rows = rows.reshape(size[::-1])
        first = first_surface(job.maps, view if job.pinhole else view.resized(*size))
        return rows if wanted is None else np.where(wanted, rows, -1), first


def surface_fits(scene: Scene, path: Path, settings: Memory) -> bool:
    """Whether a labelled cloud and the surface fit into memory as a whole, and nobody asked for workers."""
    count = num_points(path) if path.exists() else None
    return count is None or fits(count * BYTES + surface_bytes(scene.surface), settings)


@dataclass(frozen=True)
class LabelledSight:
    """A labelled cloud as photos see it. surface: of all its points, or by tiles; parts: gives (N, 3) points,
    world, and (N,) uint8 labels of each part
    """

    surface: LabelledSurface | SeenPoints
    labels: Labels
    parts: Callable[[], Iterator[tuple[np.ndarray, np.ndarray]]]


@contextmanager
def labelled_sight(
    scene: Scene,
    settings: Memory,
    path: Path,
    sizes: SIZES,
    output: Path,
    pinhole: int = 0,
    held: int = 0,
) -> Iterator[LabelledSight]:
    """What photos see of a labelled cloud, in memory or, where cloud and surface do not fit, by tiles.

    sizes: of the photos that will be asked for; output: beside which parts wait; pinhole: as in `RangeJob`;
        held: bytes that the caller has in memory
    """
    if surface_fits(scene, path, settings):
        cloud, labels = read_labelled(path, "propagate")
        points = cloud.point.positions.numpy().astype(np.float64)
        surface = LabelledSurface.build(cloud, scene.model.views, scene.surface)
        yield LabelledSight(surface, labels, lambda: iter([(points, labels.label)]))
        return
    file = CloudFile.open(path)
    labels = read_labels(file)
    decisive = (scene.sparse, scene.classes, *scene.surface, path)
    folder = WorkFolder(output, f"{output.name} {pinhole} {sorted(sizes.items())}", decisive, settings)
    left = memory_of(settings) - file.num_points * LABEL_BYTES - held
    room = Memory(f"{max(int(SHARE * left), BASE + LEAST_ROOM) >> 20}M")
    seen = find_points(scene, room, file, labels, sizes, folder, SerialExecutor(), pinhole=pinhole)

    def parts() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for start, records in file.chunks():
            yield positions(records), labels.label[start : start + len(records)]

    yield LabelledSight(seen, labels, parts)
    folder.remove()


def everything(name: str) -> None:
    """All pixels, as `Wanted`."""


def find_points(
    scene: Scene,
    settings: Memory,
    cloud: CloudFile,
    labels: Labels,
    sizes: Mapping[str, tuple[int, int]],
    folder: WorkFolder,
    executor: Executor,
    wanted: Wanted = everything,
    pinhole: int = 0,
) -> SeenPoints:
    """Find the cloud's point at the pixels of some photos, tile by tile."""
    statistics = CloudStatistics.from_cloud(cloud)
    grid = statistics.grid(max_points(settings, BYTES), REACH * statistics.spacing)
    store = TileStore.build(cloud, grid, folder.subfolder("tiles"))
    spacing, _ = sample_spacing(store, statistics)
    parts, origin = folder.subfolder("surface"), local_origin(scene.model.views)
    surface: SurfaceParts
    if scene.mesh.exists():
        surface = split_mesh(scene.surface, parts, origin, memory_of(settings))
    else:
        low, centers = statistics.extent.low, np.array([view.center for view in scene.model.views])
        normals = TileNormals(store, centers, low, has_usable_normals(cloud))
        surface = split_voxels(store, normals, low, spacing, parts, executor, settings)
    maps = RangeMaps(folder.subfolder("ranges"), {name: number for number, name in enumerate(sizes)})
    compute_ranges(RangeJob(scene.path, surface, maps, dict(sizes), pinhole), executor)
    job = SeenJob(
        scene.path,
        dict(sizes),
        pinhole,
        wanted,
        statistics.extent.low,
        store,
        Results(folder.subfolder("results"), store),
        maps,
        REACH * spacing,
    )
    executor.run("looking", partial(find_points_in_tile, job), store.tiles)
    return SeenPoints(job, labels.label)


def find_points_in_tile(job: SeenJob, tile: int) -> None:
    """Pixels whose first surface lies in the tile, and the nearest point of each: (2, K) int64 pixel and row
    of the cloud, for every view.
    """
    halo = job.store.with_halo(tile, job.reach)
    points = positions(halo.gather(job.store.records))
    low, high, index = (
        points.min(axis=0) - job.reach,
        points.max(axis=0) + job.reach,
        NeighborIndex(points, job.extent_low),
    )
    for name, size in job.sizes.items():
        view = sized_view(job.scene, name, size, job.pinhole)
        if not may_see(view, low, high):
            continue
        wanted = job.wanted(name)
        ranges = job.maps.cast(view, camera_rays(view.camera))[0].reshape(view.height, view.width)
        rows, columns = np.nonzero(np.isfinite(ranges) if wanted is None else np.isfinite(ranges) & wanted)
        hits = surface_points(FirstSurface(ranges, ranges, ranges), view, rows, columns)
        mine = job.store.grid.tile_of(hits) == tile
        if mine.any():
            nearest, distance = index.nearest(hits[mine], 1)
            near = distance[:, 0] <= job.reach
            pixels = (rows * view.width + columns)[mine][near]
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
