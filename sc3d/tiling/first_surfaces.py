"""First surfaces through a mesh that need not fit into memory: it is cut into parts, and the nearest hit over
all parts counts.

The minimum does not care about the order of the parts, so the ranges are those of the whole mesh.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import chain
from pathlib import Path
from typing import Protocol

import numba
import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, camera_rays, may_see, undistorted
from sc3d.geometry.raycast import Surface, surfels
from sc3d.io.atomic import atomic_path
from sc3d.io.chunked_clouds import RECORDS_AT_ONCE, CloudFile, positions
from sc3d.io.memory_limit import BASE
from sc3d.io.ply import Property, check_ply, num_triangles
from sc3d.scene.scene import Scene
from sc3d.tiling.executor import Executor
from sc3d.tiling.given_normals import NormalsOf
from sc3d.tiling.memory import TRIANGLE
from sc3d.tiling.store import CloudStatistics, TileGrid, TileStore

SLACK = 1e-5  # of the box around a part, and of a range: rays that only just reach it are cast


@dataclass(frozen=True)
class MeshParts:
    """Triangles by tile of the ground plane: folder/<part>.bin, (T, 9) float32 corners less `origin` (3,);
    boxes: {part: (2, 3) float64 their box, same frame}.
    """

    folder: Path
    origin: np.ndarray
    boxes: dict[int, np.ndarray]

    @classmethod
    def split(
        cls, triangles: Iterable[np.ndarray], grid: TileGrid, folder: Path, origin: np.ndarray
    ) -> MeshParts:
        """triangles: chunks (T, 3, 3) float64 world. Each triangle goes to the tile of its first corner.
        Parts that are there already are taken as they are.
        """
        index = folder / "boxes.npz"
        if not index.exists():
            for old in folder.iterdir():
                old.unlink()
            boxes: dict[int, np.ndarray] = {}
            for chunk in triangles:
                tiles, local = grid.tile_of(chunk[:, 0]), (chunk - origin).astype(np.float32)
                for tile in np.unique(tiles):
                    mine = local[tiles == tile]
                    box = np.stack([mine.min(axis=(0, 1)), mine.max(axis=(0, 1))]).astype(np.float64)
                    known = boxes.get(int(tile), box)
                    boxes[int(tile)] = np.stack([np.minimum(known[0], box[0]), np.maximum(known[1], box[1])])
                    with (folder / f"{tile}.bin").open("ab") as file:
                        file.write(np.ascontiguousarray(mine).data)
            with atomic_path(index) as temporary:
                np.savez(
                    temporary,
                    parts=np.array(sorted(boxes), np.int64),
                    boxes=np.array([boxes[part] for part in sorted(boxes)]).reshape(-1, 2, 3),
                )
        stored = np.load(index, allow_pickle=False)
        return cls(
            folder,
            np.asarray(origin, np.float64),
            dict(zip(stored["parts"].tolist(), stored["boxes"], strict=True)),
        )

    def surface(self, part: int) -> Surface:
        corners = np.fromfile(self.folder / f"{part}.bin", np.float32).reshape(-1, 3)
        return Surface(
            Surface.from_mesh(
                corners, np.arange(len(corners), dtype=np.uint32).reshape(-1, 3), np.zeros(3)
            ).scene,
            self.origin,
        )

    def first_ranges(self, views: list[View]) -> dict[str, np.ndarray]:
        """As of `SurfaceParts`; a part is loaded once for all of the views."""
        ranges = {view.name: np.full(view.height * view.width, np.inf, np.float32) for view in views}
        for part, (low, high) in self.boxes.items():
            seeing = [view for view in views if may_see(view, low + self.origin, high + self.origin)]
            if not seeing:
                continue
            surface = self.surface(part)
            for view in seeing:
                _cast(self, part, surface, view, camera_rays(view.camera), ranges[view.name])
        return ranges


def read_triangles(path: Path) -> Iterator[np.ndarray]:
    """Corners (T, 3, 3) float64, world, of the triangles of a binary PLY, in chunks; the vertices stay on
    disk.
    """
    header = check_ply(path)
    vertex, face = header.element("vertex"), header.element("face")
    corners = next((entry for entry in face.properties if entry.length), None) if face is not None else None
    if (
        not header.order
        or vertex is None
        or vertex.has_lists
        or face is None
        or corners is None
        or [element.name for element in header.elements] != ["vertex", "face"]
    ):
        raise InputError(
            f"{path} does not fit into --max-memory, and can be read in parts as binary PLY of vertices and triangles only: write it anew"
        )
    table = np.dtype([(entry.name, header.order + entry.dtype) for entry in vertex.properties])
    row = np.dtype([field for entry in face.properties for field in _fields(entry, corners, header.order)])
    start = header.size + table.itemsize * vertex.rows
    for first in range(0, face.rows, RECORDS_AT_ONCE):
        count = min(RECORDS_AT_ONCE, face.rows - first)
        faces = np.fromfile(path, row, count, offset=start + first * row.itemsize)
        if len(faces) < count or (faces["count"] != 3).any():
            raise InputError(
                f"{path} has faces that are not triangles: cut them into triangles, or allow more --max-memory"
            )
        used, inverse = np.unique(faces["corners"], return_inverse=True)
        # mapped anew each time, so that its pages can go
        vertices = positions(np.memmap(path, table, "r", header.size, (vertex.rows,))[used])
        yield vertices[inverse.reshape(-1, 3)]


def _fields(entry: Property, corners: Property, order: str) -> list[tuple]:
    if entry is corners:
        return [("count", order + entry.length), ("corners", order + entry.dtype, (3,))]
    if entry.length:
        raise InputError("the faces of the mesh have more than one list: write it anew with triangles only")
    return [(entry.name, order + entry.dtype)]


def _cast(
    parts: MeshParts, part: int, surface: Surface, view: View, directions: np.ndarray, nearest: np.ndarray
) -> None:
    """Lower `nearest` (H * W,) to the hits in one part."""
    low, high = parts.boxes[part]
    slack = SLACK * (1 + np.abs(view.center - parts.origin).max() + (high - low).max())
    reached = np.empty(len(nearest), np.bool_)
    _reach(
        directions,
        view.cam_from_world,
        view.center - parts.origin,
        low - slack,
        high + slack,
        nearest,
        reached,
    )
    pixels = np.flatnonzero(reached)
    if len(pixels):
        nearest[pixels] = np.minimum(nearest[pixels], surface.cast(view, directions[pixels])[0])


@numba.njit(parallel=True, cache=True, error_model="numpy")
def _reach(directions, cam_from_world, start, low, high, nearest, reached):
    """Which rays (K, 3), camera frame, enter the box before their nearest hit so far."""
    for k in numba.prange(len(directions)):
        enter, leave = 0.0, np.inf
        for axis in range(3):
            slope = np.float64(directions[k, 0]) * cam_from_world[0, axis]
            slope += (
                np.float64(directions[k, 1]) * cam_from_world[1, axis]
                + np.float64(directions[k, 2]) * cam_from_world[2, axis]
            )
            if abs(slope) < 1e-12:
                if start[axis] < low[axis] or start[axis] > high[axis]:
                    leave = -1.0
                continue
            first, second = (low[axis] - start[axis]) / slope, (high[axis] - start[axis]) / slope
            enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
        reached[k] = enter <= leave and enter <= nearest[k] * (1 + SLACK) and np.isfinite(directions[k, 2])


@dataclass(frozen=True)
class RangeMaps:
    """Ranges that are computed already, as a `RayTarget`: folder/<number of the view>.npy; numbers: {name of
    the view: number}.
    """

    folder: Path
    numbers: dict[str, int]

    def path(self, view: View) -> Path:
        return self.folder / f"{self.numbers[view.name]}.npy"

    def write(self, view: View, ranges: np.ndarray) -> None:
        with atomic_path(self.path(view)) as temporary, temporary.open("wb") as file:
            np.lib.format.write_array(file, ranges, allow_pickle=False)

    def cast(self, view: View, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `RayTarget.cast`, for all pixels of the view in order; the incidence is not known, NaN."""
        ranges = np.load(self.path(view), allow_pickle=False).ravel()
        if len(ranges) != len(directions):
            raise ValueError(f"{view.name}: ranges of {len(ranges)} pixels, asked for {len(directions)}")
        return ranges, np.full_like(ranges, np.nan)


class SurfaceParts(Protocol):
    """A surface on disk."""

    def first_ranges(self, views: list[View]) -> dict[str, np.ndarray]:
        """(H * W,) float32 range of each pixel of a group of views, by name; inf = nothing hit."""


def write_ranges(parts: SurfaceParts, views: list[View], maps: RangeMaps) -> None:
    """Ranges of a group of views, sized as they shall be. Memory: the maps of the group, and what of the
    surface is looked at once.
    """
    views = [view for view in views if not maps.path(view).exists()]
    ranges = parts.first_ranges(views) if views else {}
    for view in views:
        maps.write(view, ranges[view.name].reshape(view.height, view.width))


GROUP = 16  # views whose ranges are held at once
SURFEL_MARGIN = 8.0  # of a tile, in point spacings: room for the neighbors of its points


@dataclass(frozen=True)
class RangeJob:
    """What a task needs to know: where the scene and the parts of its surface are, and the size of each view
    (width, height). pinhole: longest side of views without distortion that are looked through instead, 0 = none
    """

    scene: Path
    parts: SurfaceParts
    maps: RangeMaps
    sizes: dict[str, tuple[int, int]]
    pinhole: int = 0


def compute_ranges(job: RangeJob, executor: Executor) -> RangeMaps:
    """Ranges of all views in `job.sizes`; those that are there already are kept."""
    names = [
        name for name in _by_place(job) if not (job.maps.folder / f"{job.maps.numbers[name]}.npy").exists()
    ]
    executor.run(
        "first surfaces",
        partial(_range_task, job),
        [names[start : start + GROUP] for start in range(0, len(names), GROUP)],
    )
    return job.maps


def _range_task(job: RangeJob, names: list[str]) -> None:
    views = [sized_view(job.scene, name, job.sizes[name], job.pinhole) for name in names]
    write_ranges(job.parts, views, job.maps)


def sized_view(scene: Path, name: str, size: tuple[int, int], pinhole: int) -> View:
    """A view of a scene as it is looked through, see `RangeJob`."""
    view = views_of(scene)[name]
    return undistorted(view, pinhole) if pinhole else view.resized(*size)


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


def split_mesh(files: Sequence[Path], folder: Path, origin: np.ndarray, memory: int) -> MeshParts:
    """Parts of `Scene.surface` small enough for `memory` bytes."""
    given = [files[0], *(path for path in files[1:] if num_triangles([path]))]
    share = num_triangles(files[:1]) / max(num_triangles(files), 1)
    # about two triangles for each vertex
    room = int((memory - BASE) / TRIANGLE / 2 * share)
    grid = CloudStatistics.from_cloud(CloudFile.open(given[0])).grid(max(room, 1000))
    return MeshParts.split(chain.from_iterable(map(read_triangles, given)), grid, folder, origin)


def split_surfels(
    store: TileStore, normals: NormalsOf, spacing: float, folder: Path, origin: np.ndarray
) -> MeshParts:
    """The surfels of a cloud without a mesh, tile by tile."""
    return MeshParts.split(_surfel_triangles(store, normals, spacing, origin), store.grid, folder, origin)


def _surfel_triangles(
    store: TileStore, normals: NormalsOf, spacing: float, origin: np.ndarray
) -> Iterator[np.ndarray]:
    for tile in store.tiles:
        halo = store.with_halo(tile, SURFEL_MARGIN * spacing)
        points = positions(halo.gather(store.records))
        vertices, triangles = surfels(points - origin, normals(halo), spacing, halo.core)
        yield vertices[triangles] + origin
