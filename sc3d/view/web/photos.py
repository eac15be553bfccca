"""Small pictures of a photo and of its mask, for a panel and for the camera's pyramid."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, resample
from sc3d.scene.class_table import ClassTable
from sc3d.scene.scene import Scene
from sc3d.view.viewpoints import fitted

_OPACITY = 0.6  # of a mask over its photo


@dataclass(frozen=True)
class PhotoPictures:
    """photo: (H, W, 3) uint8 RGB, None if the file is missing; mask: the class colors over it, None without
    a mask; note: what is missing, or "".
    """

    photo: np.ndarray | None
    mask: np.ndarray | None
    note: str = ""


def photo_pictures(scene: Scene, view: View, table: ClassTable | None, max_size: int) -> PhotoPictures:
    """The photo of a view as it was taken and the mask that was given for it, longest side `max_size` px."""
    photo, mask, missing = None, None, []
    size = _size(view, max_size)
    try:
        photo = cv2.resize(scene.read_photo(view.name), size, interpolation=cv2.INTER_AREA)
    except InputError:
        missing.append("photo")
    file = scene.mask_file(scene.masks, view.name)
    if table is not None and file is not None:
        labels = cv2.resize(scene.read_mask(file, view.name), size, interpolation=cv2.INTER_NEAREST)
        mask = overlay(photo, labels, table)
    else:
        missing.append("mask")
    return PhotoPictures(photo, mask, f"no {' and no '.join(missing)}" if missing else "")


def overlay(photo: np.ndarray | None, labels: np.ndarray, table: ClassTable) -> np.ndarray:
    """(H, W, 3) uint8 RGB: class colors over a photo of the same size, which stays as it is where there is
    no label; None: on white.

    photo: (H, W, 3) uint8; labels: (H, W) uint8
    """
    below = np.full((*labels.shape, 3), 255, np.uint8) if photo is None else photo
    mixed = np.round((1 - _OPACITY) * below + _OPACITY * table.palette[labels]).astype(np.uint8)
    return np.where(labels[..., None] > 0, mixed, below)


def thumbnail(photo: np.ndarray, view: View, max_size: int) -> np.ndarray:
    """(h, w, 3) uint8 RGB: a photo of any size as its undistorted (pinhole) view shows it, longest side at
    most `max_size` px.
    """
    return resample(photo, view, fitted(view, (max_size, max_size)))


def _size(view: View, max_size: int) -> tuple[int, int]:
    scale = min(1.0, max_size / max(view.width, view.height))
    return max(1, round(scale * view.width)), max(1, round(scale * view.height))
