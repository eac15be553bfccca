"""Pix4Dmapper: `*_calibrated_camera_parameters.txt` in `1_initial/params`, with `*_offset.xyz` and
`*_wkt.prj` beside it.

The model is m = K [R | -R t] X with OpenCV's axes and distortion; the world is the project's CRS minus the
offset; (0, 0) is the corner of the first pixel.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj

from sc3d.errors import InputError, examples
from sc3d.geometry.cameras import View
from sc3d.geometry.distortion import DistortionModel, Lenses
from sc3d.georeferencing.georeference import Georeference, triple
from sc3d.importers.frames import LARGE, near_origin
from sc3d.importers.project import Project, require_found, rigid
from sc3d.io.crs import split_crs
from sc3d.io.json_files import read_text
from sc3d.settings.reconstruction import Import

logger = logging.getLogger(__name__)

EXPECTED = (
    "a project folder with 1_initial/params/*_calibrated_camera_parameters.txt, or that file, is expected"
)
SUFFIX = "calibrated_camera_parameters.txt"
LINES = 10  # per photo


def matches(path: Path) -> bool:
    return _file(path) is not None


def files(path: Path) -> list[Path]:
    file = require_found(_file(path), path, EXPECTED)
    return [file, *_place_files(file)]


def read(path: Path, settings: Import) -> Project:
    file = require_found(_file(path), path, EXPECTED)
    _warn_of_others(path, file)
    lines = [(number, line.strip()) for number, line in enumerate(read_text(file).splitlines(), start=1)]
    header = [line.lower() for _, line in lines[:8]]
    if any("fisheye" in line for line in header):
        raise InputError(f"{file}: Pix4D's fisheye polynomial has no COLMAP model: export undistorted photos")
    body = [(number, line) for number, line in lines if line][_header_length(lines, file) :]
    if len(body) % LINES:
        raise InputError(
            f"{file} is cut off or of another layout: {LINES} lines per photo are expected after the header, {len(body)} lines are there"
        )
    lenses, views = Lenses(settings.tolerance), []
    for start in range(0, len(body), LINES):
        name, distortion, rotation, center = _block(body[start : start + LINES], file)
        where = f"{file}, {name}"
        views.append(View(name, lenses.camera(distortion, where), rigid(rotation, center, where)))
    lenses.warn(file)
    georeference = _georeference(file)
    project = Project("pix4d", views, georeference=georeference, notes={"read": file.name})
    if georeference is None or _place_files(file)[1].is_file():
        return project
    if all(np.abs(view.center).max() < LARGE for view in views):
        logger.warning(
            "%s is missing, and the positions are not those of a CRS: the place stays unknown",
            _place_files(file)[1],
        )
    return near_origin(replace(project, georeference=None), georeference.epsg)


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path] if path.name.endswith(SUFFIX) else []
    folders = (path, path / "params", path / "1_initial" / "params")
    return [file for folder in folders for file in sorted(folder.glob(f"*{SUFFIX}"))]


def _file(path: Path) -> Path | None:
    """The largest file, if there are several: it has most photos."""
    return max(_files(path), key=lambda file: file.stat().st_size, default=None)


def _warn_of_others(path: Path, file: Path) -> None:
    others = [other.name for other in _files(path) if other != file]
    if others:
        logger.warning("%s: only %s is read, left out: %s", path, file.name, examples(others))


def _header_length(lines: list[tuple[int, str]], file: Path) -> int:
    """Lines in front of the first photo, empty ones not counted: up to the one that states the camera
    model.
    """
    filled = [line for _, line in lines if line]
    found = [row for row, line in enumerate(filled[:12]) if line.lower().startswith("camera model")]
    if not found:
        raise InputError(
            f"{file} does not start as Pix4D writes it, with fileName ... camera model m = K [R|-Rt] X"
        )
    return found[0] + 1


def _block(lines: list[tuple[int, str]], file: Path) -> tuple[str, DistortionModel, np.ndarray, np.ndarray]:
    """Name, distortion, rotation (3, 3) and center (3,) of a photo."""
    name, *size = lines[0][1].rsplit(maxsplit=2)
    try:
        width, height = (int(word) for word in size)
        rows = [np.array(line.split(), np.float64) for _, line in lines[1:]]
        matrix, radial, tangential, center, rotation = (
            np.stack(rows[:3]),
            rows[3],
            rows[4],
            rows[5],
            np.stack(rows[6:]),
        )
        if (matrix.shape, radial.shape, tangential.shape, center.shape, rotation.shape) != (
            (3, 3),
            (3,),
            (2,),
            (3,),
            (3, 3),
        ):
            raise ValueError
    except ValueError:
        raise InputError(
            f"{file}, line {lines[0][0]}: name, width and height, then K [3x3], distortion [3] and [2], position [3] and rotation [3x3] "
            "are expected"
        ) from None
    distortion = DistortionModel(
        width,
        height,
        (float(matrix[0, 0]), float(matrix[1, 1])),
        (float(matrix[0, 2]), float(matrix[1, 2])),
        tuple(radial.tolist()),
        tuple(tangential.tolist()),
        skew=float(matrix[0, 1]),
    )
    return name, distortion, rotation, center


def _place_files(file: Path) -> tuple[Path, Path]:
    """WKT of the CRS and offset that belong to a parameter file."""
    stem = file.name.removesuffix(SUFFIX)
    return file.with_name(f"{stem}wkt.prj"), file.with_name(f"{stem}offset.xyz")


def _georeference(file: Path) -> Georeference | None:
    projection, offset_file = _place_files(file)
    if not projection.is_file():
        return None
    try:
        crs = pyproj.CRS.from_wkt(read_text(projection).strip())
        offset = (
            np.array(read_text(offset_file).replace(",", " ").split(), np.float64)[:3]
            if offset_file.is_file()
            else np.zeros(3)
        )
    except (pyproj.exceptions.CRSError, ValueError):
        raise InputError(
            f"{projection} or {offset_file} cannot be understood: a WKT of a CRS and three numbers are expected"
        ) from None
    crs, height_unit = split_crs(crs)
    if crs.is_engineering:
        logger.warning("%s: the project has local coordinates: the place stays unknown", projection)
        return None
    epsg = crs.to_epsg()
    if not crs.is_projected or epsg is None or offset.shape != (3,):
        logger.warning(
            "%s: %s has no EPSG code of a projected CRS: the place stays unknown", projection, crs.name
        )
        return None
    if height_unit is not None and abs(height_unit / crs.axis_info[0].unit_conversion_factor - 1) > 1e-9:
        raise InputError(
            f"{projection} has heights in another unit than eastings: export the project with one unit"
        )
    return Georeference(epsg, triple(offset))
