"""What training starts from: pinhole views with their photos, and sparse points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import torch

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, in_image, local_origin, project, resample, undistorted
from sc3d.geometry.held_out import HeldOut, held_out_views, times_seen
from sc3d.scene.depth_map import DepthMap, depth_file, read_depth_map
from sc3d.scene.scene import Scene
from sc3d.scene.splats import read_scene_splats
from sc3d.settings.train import TrainSettings
from sc3d.splatting.device import device_type
from sc3d.splatting.gaussians import Gaussians

CACHED_PIXELS = 500_000_000  # undistorted photos kept in memory: 1.5 GB


@dataclass(frozen=True)
class TrainingData:
    """Photos and sparse points; positions in a local world frame that float32 can hold.

    views: V pinhole views at training size, V >= 2
    images: per view (H, W, 3) uint8 RGB, a sequence or a function of the view's index (then read anew each
        time)
    points, colors: (N, 3) sparse points; (N, 3) uint8 RGB
    tracks: per view the row indices of the sparse points it sees; None = unknown
    masks: per view (H, W) bool, False = ignored; sequence, function (may return None) or None
    depth_maps: per view its map by stereo, of any size; a function (may return None) or None
    """

    views: list[View]
    images: Sequence[np.ndarray] | Callable[[int], np.ndarray]
    points: np.ndarray
    colors: np.ndarray
    tracks: list[np.ndarray] | None = None
    masks: Sequence[np.ndarray] | Callable[[int], np.ndarray | None] | None = None
    depth_maps: Callable[[int], DepthMap | None] | None = None

    def image(self, index: int) -> np.ndarray:
        """(H, W, 3) uint8 photo of a view. Raises InputError if its size is not the view's."""
        image = self.images(index) if callable(self.images) else self.images[index]
        return self._checked(image, index, "image")

    def mask(self, index: int) -> np.ndarray | None:
        """(H, W) bool mask of a view, if there is one. Raises InputError if its size is not the view's."""
        mask = self._raw_mask(index)
        return None if mask is None else self._checked(mask, index, "mask").astype(bool)

    def depth_map(self, index: int) -> DepthMap | None:
        """The map of a view by stereo, of the view's size, if there is one."""
        found = None if self.depth_maps is None else self.depth_maps(index)
        view = self.views[index]
        return None if found is None else found.resized((view.height, view.width))

    def stereo(
        self, index: int, halved: bool = False, device: torch.device | str = "cpu"
    ) -> tuple[torch.Tensor, torch.Tensor] | None:
        """(H, W) depth that other views confirm, 0 = none, and (H, W) bool sky, at full or half size."""
        found = self.depth_map(index)
        if found is None:
            return None
        view = self.views[index]
        if halved:
            found = found.resized((max(1, view.height // 2), max(1, view.width // 2)))
        return torch.from_numpy(found.confirmed(1)).to(device), torch.from_numpy(found.sky).to(device)

    def photo(
        self, index: int, halved: bool = False, device: torch.device | str = "cpu"
    ) -> tuple[View, torch.Tensor, torch.Tensor | None]:
        """View, (H, W, 3) image in [0, 1] and (H, W) bool mask or None, at full or half size."""
        view, image, mask = self.views[index], self.image(index), self.mask(index)
        if halved:
            size = max(1, view.width // 2), max(1, view.height // 2)
            view, image = view.resized(*size), cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            if mask is not None:
                mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
        # plane by plane, as `render` stores images
        planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))).float() / 255
        target = planes.permute(1, 2, 0).to(device)
        return view, target, None if mask is None else torch.from_numpy(mask).to(device)

    def subset(self, indices: list[int], seen_by: int = 0) -> TrainingData:
        """Some of the views, renumbered from 0, and the points that at least so many of them see."""
        part = TrainingData(
            [self.views[index] for index in indices],
            lambda row: self.image(indices[row]),
            self.points,
            self.colors,
            None if self.tracks is None else [self.tracks[index] for index in indices],
            lambda row: self._raw_mask(indices[row]),
            None if self.depth_maps is None else lambda row: self.depth_map(indices[row]),
        )
        return part.with_points(times_seen(part.sightings, len(self.points)) >= seen_by) if seen_by else part

    def with_points(self, chosen: np.ndarray) -> TrainingData:
        """The same with the points of an (N,) bool alone."""
        position = np.cumsum(chosen) - 1
        tracks = [position[rows[chosen[rows]]] for rows in self.sightings]
        return replace(self, points=self.points[chosen], colors=self.colors[chosen], tracks=tracks)

    @property
    def sightings(self) -> list[np.ndarray]:
        """`seen` of every view."""
        return [self.seen(index) for index in range(len(self.views))]

    def held_out(self, settings: TrainSettings) -> HeldOut:
        """Which views are trained on, and which are not."""
        tracks = self.sightings if settings.test_sector else []
        return held_out_views(self.views, tracks, self.points, settings.test_every, settings.test_sector)

    def seen(self, index: int) -> np.ndarray:
        """(T,) rows of the sparse points that a view sees; all in its image, where tracks are unknown."""
        if self.tracks is not None:
            return self.tracks[index]
        pixels, depths = project(self.views[index], np.asarray(self.points, np.float64))
        return np.nonzero(in_image(self.views[index], pixels) & (depths > 0))[0]

    def _raw_mask(self, index: int) -> np.ndarray | None:
        if self.masks is None:
            return None
        return self.masks(index) if callable(self.masks) else self.masks[index]

    def _checked(self, array: np.ndarray, index: int, what: str) -> np.ndarray:
        view, (height, width) = self.views[index], array.shape[:2]
        if (height, width) != (view.height, view.width):
            raise InputError(
                f"{what} of {view.name} is {width}x{height}, its view {view.width}x{view.height}"
            )
        return array


def scene_data(scene: Scene, settings: TrainSettings) -> tuple[TrainingData, np.ndarray]:
    """A scene's photos, undistorted at training size when they are asked for, and sparse points; the (3,)
    world position of the local origin.
    """
    settings = settings.resolved(device_type(settings.device))
    model = scene.model
    origin = local_origin(model.views)
    local = [view.shifted(origin) for view in model.views]
    views = [undistorted(view, settings.size(max(view.width, view.height))) for view in local]

    cached = lru_cache(maxsize=max(2, CACHED_PIXELS // max(view.width * view.height for view in views)))

    @cached
    def image(index: int) -> np.ndarray:
        return resample(scene.read_photo(model.views[index].name), local[index], views[index])

    @cached
    def opaque(index: int) -> np.ndarray | None:
        return scene.opaque_pixels(local[index], views[index])

    @cached
    def depth(index: int) -> DepthMap | None:
        file = depth_file(scene.depth, model.views[index].name)
        return read_depth_map(file) if file.exists() else None

    depth_maps = depth if settings.fill and scene.depth.exists() else None
    data = TrainingData(views, image, model.points - origin, model.colors, model.tracks, opaque, depth_maps)
    return data, origin


def load_gaussians(scene: Scene) -> tuple[Gaussians, np.ndarray]:
    """The trained Gaussians of a scene and the (3,) world position of their local origin, see `read_scene_splats`."""
    arrays, origin = read_scene_splats(scene)
    return Gaussians.from_arrays(arrays), origin
