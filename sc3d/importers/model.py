"""A project as a COLMAP model: cameras shared where they are equal, points with the photos that see them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from sc3d.geometry.cameras import View, in_image, project
from sc3d.importers.project import Project
from sc3d.io.colmap import registered_images, write_model

MAX_POINTS = 100_000  # sparse points that are made from a cloud
# along the longer side of a photo: where tracks are guessed, the nearest points of a cell are seen
CELLS = 64
NEAR = 0.03  # of the distance


def write_copy(path: Path, project: Project) -> None:
    """Write the COLMAP model that a project was read from, with the names and the frame of the project; all
    else in it is kept.
    """
    model = project.model
    for image, view in zip(registered_images(model), project.views, strict=True):
        image.name = view.name
    if project.offset.any():
        model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), -project.offset))
    write_model(path, model)


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
