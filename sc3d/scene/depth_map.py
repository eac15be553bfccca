"""What lies in `depth/` of a scene: depth, normals and how many views confirm them, for every photo."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sc3d.errors import InputError, left_out
from sc3d.io.arrays import read_arrays
from sc3d.io.atomic import atomic_path
from sc3d.io.limits import DamagedFileError

FEW = 0.05  # of a photo's pixels; with fewer confirmed ones it hardly counts


@dataclass(frozen=True)
class DepthMap:
    """Of an undistorted view (`cameras.undistorted(view, max(H, W))`).

    depth: (H, W) float32 z in world units, camera frame; 0 = none
    normals: (H, W, 3) int8, 127 times the unit normal, camera frame, towards the camera
    num_views: (H, W) uint8, how many other views confirm the depth; 0 where confirmed surface just goes on
    sky: (H, W) bool, no surface at all
    """

    depth: np.ndarray
    normals: np.ndarray
    num_views: np.ndarray
    sky: np.ndarray

    def confirmed(self, min_views: int) -> np.ndarray:
        """(H, W) float32 depth that at least `min_views` other views confirm, else 0."""
        return np.where(self.num_views >= min_views, self.depth, 0).astype(np.float32)

    @property
    def continued(self) -> np.ndarray:
        """(H, W) float32 depth that no other view confirms, else 0."""
        return np.where(self.num_views == 0, self.depth, 0).astype(np.float32)

    @classmethod
    def nothing(cls, shape: tuple[int, int]) -> DepthMap:
        """A map of a photo of which nothing is known."""
        flags = np.zeros(shape, np.uint8)
        return cls(np.zeros(shape, np.float32), np.zeros((*shape, 3), np.int8), flags, flags.astype(bool))

    def resized(self, shape: tuple[int, int]) -> DepthMap:
        """The map with (height, width) pixels, by the nearest ones: depths are never averaged."""
        height, width = self.depth.shape
        if (height, width) == shape:
            return self
        rows = (np.arange(shape[0]) + 0.5) * height // shape[0]
        columns = (np.arange(shape[1]) + 0.5) * width // shape[1]
        chosen = np.ix_(rows.astype(int), columns.astype(int))
        return DepthMap(*(values[chosen] for values in vars(self).values()))


def hardly_confirmed(names: Sequence[str], shares: Sequence[float]) -> str:
    """One line about photos with a share of confirmed pixels below FEW; empty if there are none."""
    found = [name for name, share in zip(names, shares, strict=True) if share < FEW]
    return left_out(found, len(names), f"photos have under {FEW:.0%} confirmed depth") if found else ""


def depth_file(folder: Path, photo: str) -> Path:
    """Where the depth of a photo lies; photo: its name below `images/`."""
    return folder / f"{photo}.npz"


def write_depth_map(path: Path, depth_map: DepthMap) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **vars(depth_map))


def depth_map_size(path: Path) -> int:
    """Longest side, px, which `cameras.undistorted` takes; errors as in `read_depth_map`."""
    return max(_read(path, "num_views")[0].shape)


def read_depth_map(path: Path) -> DepthMap:
    """InputError if the file is missing, damaged or not what `sc3d depth` writes."""
    found = DepthMap(*_read(path, "depth", "normals", "num_views", "sky"))
    shape = found.depth.shape
    shapes = found.normals.shape, found.num_views.shape, found.sky.shape
    if len(shape) != 2 or shapes != ((*shape, 3), shape, shape):
        raise InputError(f"{path} is no depth map of `sc3d depth`: run it with --overwrite")
    return found


def _read(path: Path, *names: str) -> list[np.ndarray]:
    if not os.path.lexists(path):
        raise InputError(f"{path} is missing: run `sc3d depth` first")
    try:
        return read_arrays(path, names)
    except DamagedFileError as error:
        raise InputError(f"{path} is damaged ({error}): run `sc3d depth --overwrite`") from None
