"""Cameras that hold a whole scene, and the photos' cameras as lines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sc3d.geometry.cameras import View, look_at, pinhole_view, rays, undistorted


def overview(points: np.ndarray, size: tuple[int, int], from_above: bool = False) -> View:
    """A view from the air that holds all points.

    points: (N, 3) world, up = +z
    size: (width, height) px
    from_above: straight down, north up; else from the south, 45 degrees down
    """
    points = np.asarray(points, np.float64)
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    backward = np.array([0.0, 0.0, 1.0]) if from_above else np.array([0.0, -1.0, 1.0]) / np.sqrt(2)
    focal = (3.0 if from_above else 1.4) * max(size)  # from above nearly parallel, so that walls do not show
    slopes = 0.95 * np.array(size) / (2 * focal)
    span = max(float(np.ptp(points, axis=0).max()), 1e-3)
    # center what is seen, then step back until it fits; converges because the view is narrow
    for _ in range(8):
        cam_from_world = look_at(target + span * backward, target)
        offsets = (points - target) @ cam_from_world[:3, :3].T
        distance = max(float((np.abs(offsets[:, :2]) / slopes - offsets[:, 2:]).max()), 0.2 * span)
        seen = offsets[:, :2] / (offsets[:, 2:] + distance)
        shift = (seen.min(axis=0) + seen.max(axis=0)) / 2 * distance
        center = target + distance * backward
        target = target + shift @ cam_from_world[:2, :3]
    calibration = (focal, focal, size[0] / 2, size[1] / 2)
    return pinhole_view(
        "above" if from_above else "oblique", size, calibration, look_at(center, center - backward)
    )


def fitted(view: View, size: tuple[int, int], even: bool = False) -> View:
    """The undistorted view of a photo, as large as fits into `size` (width, height) px but not enlarged;
    even: both sides divisible by 2.
    """
    pinhole = undistorted(view)
    scale, step = min(1.0, size[0] / pinhole.width, size[1] / pinhole.height), 2 if even else 1
    return pinhole.resized(
        *(max(step, step * int(scale * side / step + 1e-6)) for side in (pinhole.width, pinhole.height))
    )


def frusta(views: Sequence[View], depth: float) -> np.ndarray:
    """(8 M, 2, 3) float64 line ends, world, of camera pyramids whose base lies `depth` (world units) before
    the center.
    """
    lines = np.empty((len(views), 8, 2, 3))
    for edges, view in zip(lines, views, strict=True):
        pinhole = undistorted(view, 100)
        width, height = pinhole.width, pinhole.height
        directions, z = rays(pinhole, np.array([[0, 0], [width, 0], [width, height], [0, height]], float))
        corners = view.center + directions / z[:, None] * depth
        edges[:4, 0], edges[:4, 1] = view.center, corners
        edges[4:, 0], edges[4:, 1] = corners, np.roll(corners, -1, axis=0)
    return lines.reshape(-1, 2, 3)


def frustum_depth(views: Sequence[View], points: np.ndarray) -> float:
    """Length of drawn camera pyramids, world units, that suits the scene and the gaps between cameras."""
    extent = float(np.linalg.norm(np.ptp(without_outliers(points), axis=0)))
    if len(views) < 2:
        return 0.05 * extent
    centers = np.array([view.center for view in views])
    gaps = np.linalg.norm(centers[:, None] - centers[None], axis=2) + np.diag(np.full(len(views), np.inf))
    return float(np.clip(0.4 * np.median(gaps.min(axis=1)), 0.01 * extent, 0.08 * extent))


def without_outliers(points: np.ndarray) -> np.ndarray:
    """Points that a picture must hold: a few floaters far away would shrink the rest to a dot."""
    sample = points[:: max(1, len(points) // 100_000)]
    low, high = np.quantile(sample, [0.002, 0.998], axis=0)
    margin = 0.25 * (high - low) + 1e-6
    return sample[((sample >= low - margin) & (sample <= high + margin)).all(axis=1)]
