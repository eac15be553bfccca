"""First surfaces of a bare cloud that does not fit into memory: the patches of its voxels
(`geometry.voxel_patches`), made tile by tile, are far fewer than its points, and are held as a whole.

A patch depends on the voxels around its own only, and on no order: those of the tiles are those of the whole
cloud.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, camera_rays
from sc3d.geometry.voxel_patches import Patches, patch_origin, surface_patches
from sc3d.geometry.voxel_traversal import VoxelSurface
from sc3d.geometry.voxels import SIDES, voxel_positions
from sc3d.io.atomic import atomic_path
from sc3d.io.chunked_clouds import positions
from sc3d.io.memory_limit import BASE
from sc3d.scene.labelled_cloud import SURFACE_VOXEL
from sc3d.settings.common import Memory
from sc3d.tiling.executor import Executor
from sc3d.tiling.given_normals import NormalsOf
from sc3d.tiling.memory import memory_of
from sc3d.tiling.store import TileStore

PATCH = 220  # bytes of a voxel with a patch while rays are cast, with its share of the grid
BEYOND = 2  # a gap that a tile's points close lies at most so far outside of it, voxels
SEEN = 4  # voxels around, by which a patch is made: support, gaps, and how far planes go on
SHAPE = 12  # numbers of a patch
KEYS, SHAPES = "keys.npy", "shapes.npy"


@dataclass(frozen=True)
class PatchJob:
    """What the task of a tile needs to know. low: (3,) of the whole cloud; folder: for the patches of each
    tile
    """

    store: TileStore
    normals: NormalsOf
    low: np.ndarray
    voxel_size: float
    folder: Path

    def file(self, tile: int) -> Path:
        return self.folder / f"{tile}.npz"


@dataclass(frozen=True)
class VoxelParts:
    """Patches of a whole cloud on disk: folder/keys.npy, (V,) int64 rising, and shapes.npy, as in
    `Patches`.
    """

    folder: Path
    voxel_size: float
    origin: np.ndarray

    def first_ranges(self, views: list[View]) -> dict[str, np.ndarray]:
        """(H * W,) float32 range of each pixel, by name of the view."""
        keys, shapes = (np.load(self.folder / name, allow_pickle=False) for name in (KEYS, SHAPES))
        surface = VoxelSurface(Patches.from_shapes(keys, shapes, self.voxel_size, self.origin))
        return {view.name: surface.cast(view, camera_rays(view.camera))[0] for view in views}


def split_voxels(
    store: TileStore,
    normals: NormalsOf,
    low: np.ndarray,
    spacing: float,
    folder: Path,
    executor: Executor,
    resources: Memory,
) -> VoxelParts:
    """The patches of a cloud in tiles. low: (3,) of the cloud, world; spacing: of its points, world units

    Patches that are there already are taken as they are. InputError, with the number, if they do not fit into
    memory.
    """
    voxel_size = SURFACE_VOXEL * spacing
    parts = VoxelParts(folder, voxel_size, patch_origin(low, voxel_size))
    if not (folder / SHAPES).exists():
        job = PatchJob(store, normals, low, voxel_size, folder)
        executor.run("voxels", partial(_patch_task, job), store.tiles)
        _join(job, resources)
    _require_room(len(np.load(folder / KEYS, mmap_mode="r", allow_pickle=False)), resources)
    return parts


def _patch_task(job: PatchJob, tile: int) -> None:
    """The patches in a tile, and of what its points close beside it."""
    if job.file(tile).exists():
        return
    halo = job.store.with_halo(tile, (BEYOND + SEEN) * job.voxel_size)
    points = positions(halo.gather(job.store.records))
    patches = surface_patches(points, job.normals(halo), job.voxel_size, job.low)
    centers = (voxel_positions(patches.keys) + 0.5) * job.voxel_size + patches.grid.origin
    mine = job.store.grid.within(centers, tile, BEYOND * job.voxel_size)
    with atomic_path(job.file(tile)) as temporary, temporary.open("wb") as file:
        np.savez(file, keys=patches.keys[mine], shapes=patches.shapes[mine])


def _join(job: PatchJob, resources: Memory) -> None:
    """The patches of all tiles in one table; the shapes come last."""
    found = []
    for tile in job.store.tiles:
        with np.load(job.file(tile), allow_pickle=False) as part:
            found.append(part["keys"])
    keys = np.unique(np.concatenate(found))
    _require_room(len(keys), resources)
    shapes = np.empty((len(keys), SIDES, SHAPE), np.float32)
    for tile in job.store.tiles:
        with np.load(job.file(tile), allow_pickle=False) as part:
            shapes[np.searchsorted(keys, part["keys"])] = part["shapes"]
    for name, values in ((KEYS, keys), (SHAPES, shapes)):
        with atomic_path(job.folder / name) as temporary, temporary.open("wb") as file:
            np.lib.format.write_array(file, values, allow_pickle=False)
    for tile in job.store.tiles:
        job.file(tile).unlink()


def _require_room(count: int, resources: Memory) -> None:
    needed = count * PATCH + BASE
    if needed > memory_of(resources):
        raise InputError(
            f"the surface of {count / 1e6:.1f} million voxels needs about {needed >> 20} MiB, and --max-memory leaves"
            f" {memory_of(resources) >> 20}: allow more, or choose --surface surfels"
        )
