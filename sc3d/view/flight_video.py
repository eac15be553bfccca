"""A video along the cameras of a flight."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from sc3d.errors import Sc3dError
from sc3d.geometry.cameras import View, pinhole_view
from sc3d.io.atomic import atomic_path
from sc3d.io.progress import progress
from sc3d.splatting.evaluation import picture
from sc3d.view.colors import Coloring
from sc3d.view.display_splats import DisplaySplats
from sc3d.view.viewpoints import fitted

FRAMES_PER_SECOND = 25
WHITE = (255, 255, 255)  # where there are no splats


def flight_path(
    views: Sequence[View], size: tuple[int, int], frames_per_view: int = 20, longest: int = 600
) -> list[View]:
    """Pinhole cameras of a smooth ride through the views in their order, at even speed.

    size: (width, height) px that the frames fit into; they have the first view's field of view and even sides
    frames_per_view, longest: about so many frames between two neighbors, and never more than so many in all
    """
    first = fitted(views[0], size, even=True)
    frame, calibration = (first.width, first.height), tuple(first.matrix[[0, 1, 0, 1], [0, 1, 2, 2]])
    centers = np.array([view.center for view in views])
    rotations = Rotation.from_matrix([view.cam_from_world[:3, :3] for view in views])
    if len(views) < 2:
        return [pinhole_view("flight", frame, calibration, first.cam_from_world)]
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    turns = (rotations[1:] * rotations[:-1].inv()).magnitude()
    times = np.concatenate([[0], np.cumsum(steps / max(np.median(steps), 1e-9) + turns + 1e-3)])
    moments = np.linspace(0, times[-1], int(np.clip(round(frames_per_view * times[-1]), 2, longest)))
    turned, moved = Slerp(times, rotations)(moments).as_matrix(), PchipInterpolator(times, centers)(moments)
    poses = np.tile(np.eye(4), (len(moments), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turned, -np.einsum("nij,nj->ni", turned, moved)
    return [pinhole_view("flight", frame, calibration, pose) for pose in poses]


def write_flight(
    path: Path, splats: DisplaySplats, by: Coloring, views: Sequence[View], size: tuple[int, int]
) -> None:
    """Write a video (MP4) of Gaussians along the cameras of a flight, on white.

    by: the photos' colors where the splats have no labels; views: world; size: (width, height) px that the
        frames fit into
    """
    gaussians = splats.gaussians if splats.label is None else splats.painted(by)
    ride = flight_path([view.shifted(splats.origin) for view in views], size)
    frames = (picture(gaussians, view, WHITE) for view in progress(ride, "flight", "frame"))
    write_video(path, frames, (ride[0].width, ride[0].height))


def write_video(path: Path, frames: Iterable[np.ndarray], size: tuple[int, int]) -> None:
    """Write (H, W, 3) uint8 RGB frames of one (width, height) as MP4, replaced only when complete."""
    with atomic_path(path) as temporary:
        writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter_fourcc(*"mp4v"), FRAMES_PER_SECOND, size)
        if not writer.isOpened():
            raise Sc3dError("this OpenCV cannot write MP4 videos: reinstall opencv-python-headless")
        try:
            for frame in frames:
                writer.write(np.ascontiguousarray(frame[..., ::-1]))
        finally:
            writer.release()
