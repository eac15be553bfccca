"""What lies in `depth/` of a scene: depth, normals and how many views confirm them, for every photo."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.arrays import read_arrays
from sc3d.io.atomic import atomic_path
from sc3d.io.limits import DamagedFileError


@dataclass(frozen=True)
class DepthMap:
    """Of an undistorted view (`cameras.undistorted(view, max(H, W))`).

    depth: (H, W) float32 z in world units, camera frame; 0 = none
    normals: (H, W, 3) int8, 127 times the unit normal, camera frame, towards the camera
    num_views: (H, W) uint8, how many other views confirm the depth
    """

    depth: np.ndarray
    normals: np.ndarray
    num_views: np.ndarray

    def confirmed(self, min_views: int) -> np.ndarray:
        """(H, W) float32 depth that at least `min_views` other views confirm, else 0."""
        return np.where(self.num_views >= min_views, self.depth, 0).astype(np.float32)


def depth_file(folder: Path, photo: str) -> Path:
    """Where the depth of a photo lies; photo: its name below `images/`."""
    return folder / f"{photo}.npz"


def write_depth_map(path: Path, depth_map: DepthMap) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, depth=depth_map.depth, normals=depth_map.normals, num_views=depth_map.num_views)


def depth_map_size(path: Path) -> int:
    """Longest side, px, which `cameras.undistorted` takes; errors as in `read_depth_map`."""
    return max(_read(path, "num_views")[0].shape)


def read_depth_map(path: Path) -> DepthMap:
    """InputError if the file is missing, damaged or not what `sc3d depth` writes."""
    found = DepthMap(*_read(path, "depth", "normals", "num_views"))
    shape = found.depth.shape
    if len(shape) != 2 or found.normals.shape != (*shape, 3) or found.num_views.shape != shape:
        raise InputError(f"{path} is no depth map of `sc3d depth`: run it with --overwrite")
    return found


def _read(path: Path, *names: str) -> list[np.ndarray]:
    if not os.path.lexists(path):
        raise InputError(f"{path} is missing: run `sc3d depth` first")
    try:
        return read_arrays(path, names)
    except DamagedFileError as error:
        raise InputError(f"{path} is damaged ({error}): run `sc3d depth --overwrite`") from None
