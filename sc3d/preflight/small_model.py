"""Rough cameras and points from the few features of the looks, to hold GPS against."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path

import numpy as np
import pycolmap

from sc3d.io.atomic import telling_of_full_disk, temporary_name
from sc3d.io.child_process import ChildProcess
from sc3d.preflight.pairs import Pair
from sc3d.scene.scene import SparseModel, read_sparse_model
from sc3d.settings.reconstruction import Mapping
from sc3d.sfm import MODEL, NoModelError, begin, map_database

logger = logging.getLogger(__name__)


def rough_model(folder: Path, names: list[str], pairs: list[Pair]) -> SparseModel | None:
    """Cameras and points of the photos that fit together, in a frame of their own; GPS is not used. None if
    no two fit.

    names: relative to `folder`, in the order of the rows of `pairs`
    """
    with tempfile.TemporaryDirectory(prefix=temporary_name("work")) as temporary:
        work = Path(temporary)
        database = work / "database.db"
        with telling_of_full_disk(database), ChildProcess("COLMAP") as colmap:
            colmap.call(_prepare, database, folder, names, pairs, logger.isEnabledFor(logging.DEBUG))
            try:
                map_database(database, folder, work, Mapping(), len(names), False, colmap.call)
            except NoModelError:
                return None
        return read_sparse_model(work / MODEL)


def _prepare(database: Path, folder: Path, names: list[str], pairs: list[Pair], verbose: bool) -> None:
    """A database of the photos and of the pairs that were found."""
    begin(0, verbose)
    pycolmap.Database.open(database).close()
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = Mapping.camera_model
    pycolmap.import_images(database, folder, pycolmap.CameraMode.AUTO, names, reader)
    _write_matches(database, names, pairs)


def _write_matches(database: Path, names: list[str], pairs: list[Pair]) -> None:
    keypoints, options = _keypoints(len(names), pairs), pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    with pycolmap.Database.open(database) as opened:
        images = {image.name: image for image in opened.read_all_images()}
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        pixels = []
        for name, points in zip(names, keypoints, strict=True):
            camera = cameras[images[name].camera_id]
            pixels.append(points.astype(np.float64) * (camera.width, camera.height))
            opened.write_keypoints(images[name].image_id, pixels[-1].astype(np.float32))
        for pair in pairs:
            rows = (pair.first, pair.second)
            matches = np.stack([_rows(keypoints[row], pair.of(row)[1]) for row in rows], axis=1).astype(
                np.uint32
            )
            first, second = (images[names[row]] for row in rows)
            geometry = pycolmap.estimate_two_view_geometry(
                cameras[first.camera_id],
                pixels[rows[0]],
                cameras[second.camera_id],
                pixels[rows[1]],
                matches,
                options,
            )
            opened.write_matches(first.image_id, second.image_id, matches)
            opened.write_two_view_geometry(first.image_id, second.image_id, geometry)


def _keypoints(number: int, pairs: list[Pair]) -> list[np.ndarray]:
    """(K, 2) points of each photo that are in a pair, shares of width and height, sorted."""
    found: list[list[np.ndarray]] = [[np.zeros((0, 2), np.float32)] for _ in range(number)]
    for pair in pairs:
        for row in (pair.first, pair.second):
            found[row].append(pair.of(row)[1])
    return [np.unique(np.concatenate(each), axis=0) for each in found]


def _rows(keypoints: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Rows of `keypoints` (K, 2), sorted, that `points` (M, 2) are."""
    order = {tuple(point): row for row, point in enumerate(keypoints.tolist())}
    return np.array([order[tuple(point)] for point in points.tolist()])
