"""Open Photogrammetry Format (Pix4D): a `.opf` file, which names the JSON files of its items and the glTF file
of the tracks.

Specification: https://github.com/Pix4D/opf-spec, 1.0. Cameras are in the processing CRS, right-handed: base
coordinates times `scale`, x and y swapped for left-handed ones, plus `shift`. `orientation_deg` are omega, phi,
kappa of R_x R_y R_z, world from camera with x right, y up, z backwards; (0, 0) is the corner of the first pixel.
glTF has y up.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
import pyproj

from sc3d.errors import InputError, examples
from sc3d.geometry.cameras import View
from sc3d.geometry.distortion import DistortionModel, Lenses
from sc3d.georeferencing.georeference import Georeference, triple
from sc3d.importers.gltf import GltfPoints, gltf_buffers, read_gltf_points
from sc3d.importers.project import Project, require_found, rigid
from sc3d.io.crs import SURE, split_crs
from sc3d.io.folders import resolved
from sc3d.io.json_files import read_json
from sc3d.settings.reconstruction import Import

logger = logging.getLogger(__name__)

EXPECTED = "a .opf file or the folder with it is expected (unpack .opfz first)"
FORMATS = {
    name: f"application/opf-{name}+json"
    for name in ("camera-list", "input-cameras", "calibrated-cameras", "scene-reference-frame")
}
GLTF = "model/gltf+json"
FLIP = np.array([1.0, -1.0, -1.0])  # y and z of the camera change sign
MATCHES = "OPF_mesh_primitive_matches"
SAME = 1e-6  # relative, of scales


def matches(path: Path) -> bool:
    return _file(path) is not None


def files(path: Path) -> list[Path]:
    file = require_found(_file(path), path, EXPECTED)
    try:
        found = _resources(file)
        tracks = found.get(GLTF, [])
        buffers = [buffer for track in tracks if track.is_file() for buffer in gltf_buffers(track)]
    except (AttributeError, TypeError, LookupError, ValueError) as error:
        raise InputError(f"{file} is damaged or of another layout: {error!r}") from None
    return [file, *(one for ones in found.values() for one in ones), *buffers]


def read(path: Path, settings: Import) -> Project:
    file = require_found(_file(path), path, EXPECTED)
    _warn_of_others(path, file)
    found = _resources(file)
    documents = {name: _first(found, FORMATS[name], file) for name in FORMATS}
    for name in ("camera-list", "input-cameras", "calibrated-cameras"):
        if documents[name] is None:
            raise InputError(f"{file} has no {name}: export it after the photos are calibrated")
    names = {entry["id"]: _photo_name(entry["uri"]) for entry in documents["camera-list"]["cameras"]}
    sizes = {sensor["id"]: sensor["image_size_px"] for sensor in documents["input-cameras"]["sensors"]}
    sensors = {sensor["id"]: sensor["internals"] for sensor in documents["calibrated-cameras"]["sensors"]}
    lenses, views, uids = Lenses(settings.tolerance), list[View](), list[int]()
    left_out: dict[str, list[str]] = {}
    for camera in documents["calibrated-cameras"]["cameras"]:
        name, internals = names[camera["id"]], sensors[camera["sensor_id"]]
        if internals["type"] != "perspective":
            reason = f"of a {internals['type']} lens, which no COLMAP model has"
            left_out.setdefault(reason, []).append(name)
            continue
        where = f"{file}, {name}"
        lens = lenses.camera(_distortion(internals, sizes[camera["sensor_id"]]), where)
        views.append(View(name, lens, _pose(camera, where)))
        uids.append(camera["id"])
    cameras = documents["calibrated-cameras"]["cameras"]
    if rolling := sum(any(camera.get("rolling_shutter") or []) for camera in cameras):
        logger.warning(
            "%s: %d photos have a rolling shutter: each is read as if exposed at once", file, rolling
        )
    seen = {camera["id"] for camera in cameras}
    if missing := [name for uid, name in names.items() if uid not in seen]:
        left_out["that are not calibrated"] = missing
    lenses.warn(file)
    tracks = _tracks(found.get(GLTF, []), uids, file)
    return Project(
        "opf",
        views,
        tracks.points,
        tracks.colors,
        tracks.observations,
        found[FORMATS["camera-list"]][0].parent,
        _georeference(documents["scene-reference-frame"], file),
        {"read": file.name},
        left_out=left_out,
    )


def _file(path: Path) -> Path | None:
    if path.is_file():
        return path if path.suffix.lower() == ".opf" else None
    return min(_projects(path), default=None)


def _projects(path: Path) -> list[Path]:
    return [file for file in path.glob("*") if file.suffix.lower() == ".opf" and file.is_file()]


def _warn_of_others(path: Path, file: Path) -> None:
    others = sorted(other.name for other in _projects(path) if other != file) if path.is_dir() else []
    if others:
        logger.warning("%s: only %s is read, left out: %s", path, file.name, examples(others))


def _resources(file: Path) -> dict[str, list[Path]]:
    """Files of the items that are read, by format, in their order; the point clouds of other items than the
    calibration are dense ones, which are not read.
    """
    content = read_json(file)
    if not isinstance(content, dict) or not isinstance(content.get("items"), list):
        raise InputError(f"{file} has no list of items: {EXPECTED}")
    found: dict[str, list[Path]] = {}
    for item in content["items"]:
        for resource in item["resources"]:
            kind = resource["format"]
            if kind in FORMATS.values() or kind == GLTF and item["type"] == "calibration":
                found.setdefault(kind, []).append(_inside(file, resource["uri"]))
    return found


def _inside(file: Path, uri: str) -> Path:
    """The file that a project means; InputError if it lies elsewhere."""
    parts = urlsplit(uri)
    target = file.parent / unquote(parts.path)
    if parts.scheme or parts.netloc or not resolved(target).is_relative_to(resolved(file.parent)):
        raise InputError(f"{file} names {uri!r}, which is not in its folder: export it with all its files")
    return target


def _photo_name(uri: str) -> str:
    """A photo as path; a page of a TIFF is named behind it."""
    parts = urlsplit(uri)
    return unquote(parts.path) if parts.scheme in ("", "file") else unquote(uri)


def _first(found: dict[str, list[Path]], kind: str, file: Path) -> Any:
    """The content of the first file of a format; None if there is none, a warning if there are others."""
    paths = found.get(kind, [])
    if len(paths) > 1:
        logger.warning(
            "%s: only %s is read, left out: %s",
            file,
            paths[0].name,
            examples([path.name for path in paths[1:]]),
        )
    return read_json(paths[0]) if paths else None


def _distortion(internals: dict[str, Any], size: list[int]) -> DistortionModel:
    focal, (x, y) = float(internals["focal_length_px"]), internals["principal_point_px"]
    first, second = internals["tangential_distortion"]
    return DistortionModel(
        int(size[0]),
        int(size[1]),
        (focal, focal),
        (float(x), float(y)),
        triple(internals["radial_distortion"]),
        (float(first), float(second)),
    )


def _pose(camera: dict[str, Any], where: str) -> np.ndarray:
    """(4, 4) cam_from_world."""
    omega, phi, kappa = np.radians(np.array(camera["orientation_deg"], np.float64))
    (so, sp, sk), (co, cp, ck) = np.sin([omega, phi, kappa]), np.cos([omega, phi, kappa])
    about_x = np.array([[1, 0, 0], [0, co, -so], [0, so, co]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[ck, -sk, 0], [sk, ck, 0], [0, 0, 1]])
    world_from_cam = about_x @ about_y @ about_z * FLIP
    return rigid(world_from_cam.T, np.array(triple(camera["position"])), where)


def _georeference(document: Any, file: Path) -> Georeference | None:
    if document is None:
        return None
    definition, transform = document["crs"]["definition"], document["base_to_canonical"]
    try:
        crs = pyproj.CRS.from_user_input(definition)
    except pyproj.exceptions.CRSError:
        logger.warning("%s: its CRS cannot be understood, the place stays unknown: %.80s", file, definition)
        return None
    crs, height_unit = split_crs(crs)
    epsg = crs.to_epsg(min_confidence=SURE) if crs.is_projected else None
    if epsg is None:
        logger.warning("%s: %s has no EPSG code of a projected CRS: the place stays unknown", file, crs.name)
        return None
    unit = float(crs.axis_info[0].unit_conversion_factor)
    scale, shift = (np.array(triple(transform[name])) for name in ("scale", "shift"))
    # heights in the unit of eastings, which they have from here on
    same = scale * [1.0, 1.0, unit / (unit if height_unit is None else height_unit)]
    if not (same > 0).all() or np.ptp(same) > SAME * same.max():
        raise InputError(
            f"{file}: base_to_canonical has scales that do not make eastings and heights alike ({scale.tolist()}): export the project with one unit"
        )
    matrix = np.eye(4)
    matrix[:3, :3] /= same[0]
    return Georeference(
        epsg, triple(-shift / same[0]), local_from_world=tuple(tuple(row) for row in matrix.tolist())
    )


@dataclass(frozen=True)
class Tracks:
    """points, colors: (P, 3) float64 world; (P, 3) uint8; observations: as in `Project`"""

    points: np.ndarray
    colors: np.ndarray
    observations: list[tuple[np.ndarray, np.ndarray]] | None = None


def _tracks(paths: list[Path], uids: list[int], file: Path) -> Tracks:
    """The tie points, and where the cameras (their ids) see them; none without the file."""
    parts = [part for path in paths if path.is_file() for part in read_gltf_points(path, MATCHES)]
    gone = [path.name for path in paths if not path.is_file()]
    if gone:
        logger.warning("%s: its tie points are missing: %s", file, examples(gone))
    if not parts:
        return Tracks(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    # y is up in glTF
    points = np.concatenate([part.positions for part in parts])[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    colors = np.concatenate([part.colors for part in parts])
    seen = list(_sightings(parts))
    if not seen:
        return Tracks(points, colors)
    of_camera, rows, pixels = (np.concatenate(columns) for columns in zip(*seen))
    return Tracks(points, colors, [(rows[found := of_camera == uid], pixels[found]) for uid in uids])


def _sightings(parts: list[GltfPoints]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Camera ids (K,), rows of all points (K,), pixels (K, 2) of each part that has them."""
    start = 0
    for part in parts:
        found, begin = part.extension, start
        start += len(part.positions)
        if not found or "imagePoints" not in found:
            continue
        # a point's matches: 5 bytes where they begin, 3 bytes how many they are
        ranges = np.ascontiguousarray(part.accessor(found["pointIndexRanges"]), "<u4").view(np.uint8)
        ranges = ranges.reshape(-1, 8).astype(np.int64)
        first = ranges[:, :5] @ (1 << 8 * np.arange(5))
        counts = ranges[:, 5:] @ (1 << 8 * np.arange(3))
        uids = np.array([int(uid) for uid in found["cameraUids"]], np.uint64)
        cameras = uids[part.accessor(found["cameraIds"]).ravel().astype(np.int64)]
        if len(ranges) != len(part.positions) or counts.sum() > len(cameras):
            raise ValueError("match ranges that do not fit the points")
        pixels = part.accessor(found["imagePoints"]["pixelCoordinates"]).astype(np.float64)
        rows = np.repeat(np.arange(len(counts)), counts)
        place = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts) + first[rows]
        yield cameras[place], rows + begin, pixels[place]
