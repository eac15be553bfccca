"""Pixels of one pinhole view in another: the two matrices that all of stereo needs."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sc3d.geometry.cameras import View


@dataclass(frozen=True)
class GrayView:
    """A pinhole view and its gray photo: (H, W) float32, 0 to 1."""

    view: View
    gray: np.ndarray

    def at(self, longest: int) -> GrayView:
        """The same with a longest side of at most `longest` px."""
        view = smaller(self.view, longest)
        if view is self.view:
            return self
        return GrayView(view, cv2.resize(self.gray, (view.width, view.height), interpolation=cv2.INTER_AREA))


def smaller(view: View, longest: int) -> View:
    """The view with a longest side of at most `longest` px."""
    scale = longest / max(view.width, view.height)
    if scale >= 1:
        return view
    return view.resized(max(1, round(view.width * scale)), max(1, round(view.height * scale)))


def transfer(view: View, other: View) -> tuple[np.ndarray, np.ndarray]:
    """A (3, 3) and B (3,): a pixel (x, y) of `view` whose inverse depth is q lands at A (x, y, 1) + q B in
    `other`, projected; its depth there is the third component over q. Both pinhole.
    """
    rotation = other.cam_from_world[:3, :3] @ view.cam_from_world[:3, :3].T
    translation = other.cam_from_world[:3, 3] - rotation @ view.cam_from_world[:3, 3]
    return other.matrix @ rotation @ np.linalg.inv(view.matrix), other.matrix @ translation


def transfers(views: list[View], others: list[View]) -> tuple[np.ndarray, np.ndarray]:
    """(S, 3, 3) and (S, 3) float32 of `transfer` for S pairs."""
    pairs = [transfer(view, other) for view, other in zip(views, others, strict=True)]
    return np.array([pair[0] for pair in pairs], np.float32), np.array(
        [pair[1] for pair in pairs], np.float32
    )


def stacked(images: list[np.ndarray]) -> np.ndarray:
    """(S, h, w, ...) float32 of images of any sizes, filled up with 0."""
    height, width = max(len(image) for image in images), max(image.shape[1] for image in images)
    stack = np.zeros((len(images), height, width, *images[0].shape[2:]), np.float32)
    for row, image in enumerate(images):
        stack[row, : len(image), : image.shape[1]] = image
    return stack
