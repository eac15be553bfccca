"""A project as a COLMAP model: cameras shared where they are equal, points with the photos that see them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from sc3d.geometry.cameras import View, in_image, project
from sc3d.importers.clouds import Geometry
from sc3d.importers.project import Project
from sc3d.io.colmap import build_model, registered_images, write_model
from sc3d.io.folders import resolved
from sc3d.io.photo_folder import link_photos
from sc3d.scene.scene import Scene

MAX_POINTS = 100_000  # sparse points that are made from a cloud
# along the longer side of a photo: where tracks are guessed, the nearest points of a cell are seen
CELLS = 64
NEAR = 0.03  # of the distance


def write_project(
    scene: Scene, project: Project, photos: Path | None, geometries: list[Geometry]
) -> dict[str, object]:
    """Write cameras and points of a project, and link its photos.

    photos: their folder, None = not found; geometries: in the scene's world, of which the first gives the
        points where the project has none
    returns: figures for the summary
    """
    points, colors, observations = project.points, project.colors, project.observations
    told = "from the project"
    if not len(points) and geometries:
        told = "drawn from the cloud, seen where they are nearest"
        points, colors, observations = *_sparse_points(geometries[0]), None
    if observations is None:
        points, colors = sample(points, colors)
        observations = guess_observations(project.views, points)
        told = told.replace("from the project", "from the project, seen where they are nearest")
    if project.model is not None and len(project.points):
        write_copy(scene.sparse, project.model, project)
    else:
        write_model(scene.sparse, build_model(project.views, points, colors, observations))
    if photos is not None:
        link_photos(photos, scene.images)
    return {
        "program": project.program,
        "photos": len(project.views),
        "left_out": project.counts_left_out(),
        "points": len(points),
        "points_are": told if len(points) else "none",
        "images": str(resolved(photos)) if photos else "not found: link them to SCENE/images",
    } | project.notes


def _sparse_points(geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    """A sample of the points of a cloud or mesh and their colors, gray without."""
    gray = np.full((len(geometry.positions), 3), 128, np.uint8)
    return sample(geometry.positions, gray if geometry.colors is None else geometry.colors)


def write_copy(path: Path, model: pycolmap.Reconstruction, project: Project) -> None:
    """Write the COLMAP model that a project was read from, with the names and the frame of the project; all
    else in it is kept.
    """
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
