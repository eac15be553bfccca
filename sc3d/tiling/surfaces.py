"""The ranges of the views of a scene, by tasks over groups of views: what `label` and `evaluate` share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from sc3d.geometry.cameras import View
from sc3d.geometry.raycast import surfels
from sc3d.io.chunked_clouds import CloudFile, columns, positions
from sc3d.scene.scene import Scene
from sc3d.tiling.executor import Executor
from sc3d.tiling.memory import BASE, TRIANGLE
from sc3d.tiling.ranges import MeshParts, RangeMaps, read_triangles, write_ranges
from sc3d.tiling.store import CloudStatistics, TileStore

GROUP = 16  # views whose ranges are held at once
SURFEL_MARGIN = 8.0  # of a tile, in point spacings: room for the neighbors of its points


@dataclass(frozen=True)
class RangeJob:
    """What a task needs to know: where the scene and the parts of its surface are, and the size of each view
    (width, height).
    """

    scene: Path
    parts: MeshParts
    maps: RangeMaps
    sizes: dict[str, tuple[int, int]]


def compute_ranges(job: RangeJob, tasks: Executor) -> RangeMaps:
    """Ranges of all views in `job.sizes`; those that are there already are kept."""
    names = [
        name for name in _by_place(job) if not (job.maps.folder / f"{job.maps.numbers[name]}.npy").exists()
    ]
    tasks.run(
        "first surfaces",
        partial(_range_task, job),
        [names[start : start + GROUP] for start in range(0, len(names), GROUP)],
    )
    return job.maps


def _range_task(job: RangeJob, names: list[str]) -> None:
    views = views_of(job.scene)
    write_ranges(job.parts, [views[name].resized(*job.sizes[name]) for name in names], job.maps)


def _by_place(job: RangeJob) -> list[str]:
    """Names of the views such that neighbors in the list see the same parts of the surface."""
    views = views_of(job.scene)
    names = sorted(job.sizes)
    centers = np.array([views[name].center for name in names])
    cells = (
        (centers - centers.min(axis=0)) / max(float(np.ptp(centers, axis=0).max()), 1e-9) * 7.999
    ).astype(int)
    return [names[row] for row in np.lexsort((cells[:, 1], cells[:, 0]))]


@lru_cache(maxsize=1)
def views_of(scene: Path) -> dict[str, View]:
    """The views of a scene by name; a worker reads them once."""
    return {view.name: view for view in Scene(scene).model.views}


def split_mesh(path: Path, folder: Path, origin: np.ndarray, memory: int) -> MeshParts:
    """Parts of a mesh file small enough for `memory` bytes."""
    vertices = CloudFile.open(path)
    # about two triangles for each vertex
    grid = CloudStatistics.from_cloud(vertices).grid(max((memory - BASE) // TRIANGLE // 2, 1000))
    return MeshParts.split(read_triangles(path), grid, folder, origin)


def split_surfels(store: TileStore, spacing: float, folder: Path, origin: np.ndarray) -> MeshParts:
    """The surfels of a cloud without a mesh, tile by tile; the cloud must have normals."""
    return MeshParts.split(_surfel_triangles(store, spacing, origin), store.grid, folder, origin)


def _surfel_triangles(store: TileStore, spacing: float, origin: np.ndarray) -> Iterator[np.ndarray]:
    for tile in store.tiles:
        window = store.window(tile, SURFEL_MARGIN * spacing)
        records = window.gather(store.records)
        vertices, triangles = surfels(
            positions(records) - origin, columns(records, ("nx", "ny", "nz")), spacing, window.core
        )
        yield vertices[triangles] + origin
