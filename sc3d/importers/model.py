"""A project as a COLMAP model: cameras shared where they are equal, points with the photos that see them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from sc3d.geometry.cameras import View, in_image, project
from sc3d.importers.project import Project
from sc3d.io.atomic import atomic_path

MAX_POINTS = 100_000  # sparse points that are made from a cloud
# along the longer side of a photo: where tracks are guessed, the nearest points of a cell are seen
CELLS = 64
NEAR = 0.03  # of the distance


def write_model(
    path: Path,
    views: list[View],
    points: np.ndarray,
    colors: np.ndarray,
    observations: list[tuple[np.ndarray, np.ndarray]],
) -> None:
    """Write a binary COLMAP model.

    points, colors: (P, 3) float64 and uint8; observations: per view rows (K,) of points and their pixels (K,
        2)
    """
    model, cameras = pycolmap.Reconstruction(), {}
    for view in views:
        key = (view.camera.model_name, view.width, view.height, *view.camera.params)
        if key not in cameras:
            cameras[key] = pycolmap.Camera(view.camera.todict())
            cameras[key].camera_id = len(cameras)
            cameras[key].has_prior_focal_length = True
            model.add_camera_with_trivial_rig(cameras[key])
        view_id = model.num_images() + 1
        _, pixels = observations[view_id - 1]
        keypoints = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
        image = pycolmap.Image(
            name=view.name, camera_id=cameras[key].camera_id, image_id=view_id, points2D=keypoints
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world[:3]))
    tracks = [pycolmap.Track() for _ in points]
    for number, (rows, _) in enumerate(observations, start=1):
        for position, row in enumerate(rows):
            tracks[row].add_element(number, position)
    for point, color, track in zip(points, colors, tracks):
        model.add_point3D(point, track, color)
    with atomic_path(path) as temporary:
        temporary.mkdir(parents=True)
        model.write_binary(str(temporary))


def write_copy(path: Path, project: Project) -> None:
    """Write the COLMAP model that a project was read from, with the names and the frame of the project; all
    else in it is kept.
    """
    model = project.model
    images = sorted(
        (model.image(image_id) for image_id in model.reg_image_ids()), key=lambda image: image.name
    )
    for image, view in zip(images, project.views, strict=True):
        image.name = view.name
    if project.offset.any():
        model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), -project.offset))
    with atomic_path(path) as temporary:
        temporary.mkdir(parents=True)
        model.write_binary(str(temporary))


def sample(points: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most MAX_POINTS of the points, a fixed random choice in their order."""
    if len(points) <= MAX_POINTS:
        return points, colors
    rows = np.sort(np.random.default_rng(0).choice(len(points), MAX_POINTS, replace=False))
    return points[rows], colors[rows]


def guess_observations(views: list[View], points: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """What the views see of points without tracks: those inside the photo that are nearest, or nearly so, in
    their cell of it.
    """
    return [_visible(view, points) for view in views]


def _visible(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    pixels, depth = project(view, points)
    rows = np.flatnonzero(in_image(view, pixels) & (depth > 0))
    cell = (pixels[rows] * (CELLS / max(view.width, view.height))).astype(int)
    cell = cell[:, 1] * CELLS + cell[:, 0]
    nearest = np.full(CELLS * CELLS, np.inf)
    np.minimum.at(nearest, cell, depth[rows])
    rows = rows[depth[rows] <= nearest[cell] * (1 + NEAR)]
    return rows, pixels[rows]
