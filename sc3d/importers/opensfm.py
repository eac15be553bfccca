"""OpenSfM and OpenDroneMap: `reconstruction.json`, `tracks.csv` for the observations, `reference_lla` or
ODM's `coords.txt` for the place.

Focal lengths and principal points are in units of the longer side of the photo, the latter from its middle;
`rotation` is the axis-angle vector of cam from world. The world is local ENU at `reference_lla`. ODM keeps
that as `reconstruction.topocentric.json` and writes `reconstruction.json` anew in UTM minus the offset of
`odm_georeferencing/coords.txt`, with rotations that are then rounded to the nearest: the topocentric file is
read if it is there.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pycolmap

from sc3d.errors import InputError, examples
from sc3d.geometry.cameras import View
from sc3d.geometry.distortion import DistortionModel, Lenses, NoModelError
from sc3d.georeferencing.gcp_list import parse_crs
from sc3d.georeferencing.georeference import Georeference, from_origin, triple
from sc3d.importers.project import Project, require_found, rigid
from sc3d.io.json_files import read_json, read_text
from sc3d.settings.reconstruction import Import

logger = logging.getLogger(__name__)

EXPECTED = "a folder with reconstruction.json, or with opensfm/reconstruction.json (ODM), is expected"
FILE, TOPOCENTRIC = "reconstruction.json", "reconstruction.topocentric.json"
NO_GPS = 999999.0  # gps_dop of a photo without GPS
NEAR_ZERO = 1e-6  # degrees, a decimeter
# projection types: names of the radial coefficients, and whether p1, p2 and a principal point belong to them
PERSPECTIVE = {
    "perspective": ("k1", "k2"),
    "simple_radial": ("k1",),
    "radial": ("k1", "k2"),
    "brown": ("k1", "k2", "k3"),
}
FISHEYE = {
    "fisheye": ("k1", "k2"),
    "fisheye_opencv": ("k1", "k2", "k3", "k4"),
    "fisheye62": ("k1", "k2", "k3", "k4", "k5", "k6"),
    "fisheye624": ("k1", "k2", "k3", "k4", "k5", "k6"),
}


def matches(path: Path) -> bool:
    return _folder(path) is not None


def files(path: Path) -> list[Path]:
    folder = require_found(_folder(path), path, EXPECTED)
    return [
        folder / FILE,
        folder / TOPOCENTRIC,
        folder / "tracks.csv",
        folder.parent / "odm_georeferencing" / "coords.txt",
    ]


def read(path: Path, settings: Import) -> Project:
    folder = require_found(_folder(path), path, EXPECTED)
    file = next(
        file
        for file in (path if path.is_file() else folder / TOPOCENTRIC, folder / TOPOCENTRIC, folder / FILE)
        if file.is_file()
    )
    parts = read_json(file)
    if (
        not isinstance(parts, list)
        or not all(isinstance(part, dict) and "shots" in part and "cameras" in part for part in parts)
        or not parts
    ):
        raise InputError(f"{file} is no list of reconstructions")
    part = max(parts, key=lambda part: len(part["shots"]))
    _warn_of_others(parts, part, file)
    cameras, unknown = _cameras(part, file, settings.tolerance)
    left_out = {
        f"of the camera {camera!r}, whose {reason}": names
        for camera, reason in unknown.items()
        if (names := [name for name, shot in part["shots"].items() if shot.get("camera") == camera])
    }
    shots = {name: shot for name, shot in part["shots"].items() if shot.get("camera") not in unknown}
    views = [_view(name, shot, cameras, f"{file}, shot {name!r}") for name, shot in shots.items()]
    points, colors, rows = _points(part.get("points", {}), file)
    root = folder.parent if folder.name == "opensfm" else folder
    observations = _observations(folder / "tracks.csv", views, rows)
    program = "odm" if root != folder else "opensfm"
    return Project(
        program,
        views,
        points,
        colors,
        observations,
        root / "images",
        _georeference(part, file, root, views),
        {"read": file.name},
        left_out=left_out,
    )


def _warn_of_others(parts: list[dict], taken: dict, file: Path) -> None:
    """Say what is in the other reconstructions, which share no frame with the one that is taken."""
    others = [part for part in parts if part is not taken]
    lost = sorted({name for part in others for name in part["shots"]} - set(taken["shots"]))
    if others:
        logger.warning(
            "%s has %d separate reconstructions: the one with most photos (%d) is taken; left out are those of %s photos, of which %d are not in it%s",
            file,
            len(parts),
            len(taken["shots"]),
            ", ".join(str(len(part["shots"])) for part in others),
            len(lost),
            f" ({examples(lost)})" if lost else "",
        )


def _cameras(part: dict, file: Path, tolerance: float) -> tuple[dict[str, pycolmap.Camera], dict[str, str]]:
    """COLMAP cameras of those that shots use, by name; and why some are of no kind that COLMAP has, unless
    all are.
    """
    lenses = Lenses(tolerance)
    used = [name for name in dict.fromkeys(_camera_names(part)) if name in part["cameras"]]
    cameras: dict[str, pycolmap.Camera] = {}
    unknown: dict[str, str] = {}
    for name in used:
        where = f"{file}, camera {name!r}"
        try:
            cameras[name] = lenses.camera(_distortion_model(part["cameras"][name], where), where)
        except NoModelError as error:
            if len(used) == 1:
                raise
            unknown[name] = str(error).removeprefix(f"{where}: the ").split(":")[0]
    if used and not cameras:
        raise InputError(f"{file}: no camera has a COLMAP model: undistort the photos first")
    lenses.warn(file)
    return cameras, unknown


def _camera_names(part: dict) -> list[str]:
    return [str(shot.get("camera")) for shot in part["shots"].values()]


def _folder(path: Path) -> Path | None:
    """The OpenSfM folder of a path: itself, `opensfm` in it, or the parent of a reconstruction file."""
    if path.is_file():
        return path.parent if path.name.startswith("reconstruction") and path.suffix == ".json" else None
    return next(
        (
            folder
            for folder in (path / "opensfm", path)
            if (folder / FILE).is_file() or (folder / TOPOCENTRIC).is_file()
        ),
        None,
    )


def _distortion_model(camera: dict, where: str) -> DistortionModel:
    kind = camera.get("projection_type", "perspective")
    if kind not in PERSPECTIVE | FISHEYE:
        raise NoModelError(
            f"{where}: the projection type {kind!r} has no COLMAP model: undistort the photos first"
        )
    try:
        width, height = int(camera["width"]), int(camera["height"])
        size = max(width, height)
        focal = [float(camera.get(key, camera.get("focal", "nan"))) * size for key in ("focal_x", "focal_y")]
        if kind in ("perspective", "fisheye"):
            focal = [float(camera["focal"]) * size] * 2
        principal = (
            float(camera.get("c_x", 0)) * size + width / 2,
            float(camera.get("c_y", 0)) * size + height / 2,
        )
        radial = tuple(float(camera.get(name, 0)) for name in (PERSPECTIVE | FISHEYE)[kind])
        tangential = (
            (float(camera.get("p1", 0)), float(camera.get("p2", 0)))
            if kind in ("brown", "fisheye62", "fisheye624")
            else (0.0, 0.0)
        )
        prism = [float(camera.get(f"s{number}", 0)) for number in range(4)]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where} lacks a number: {error}") from None
    return DistortionModel(
        width,
        height,
        (focal[0], focal[1]),
        principal,
        radial,
        tangential,
        kind in FISHEYE,
        prism=(prism[0], prism[2]) if kind == "fisheye624" else (0.0, 0.0),
        left_out=_prism_cost(prism, float(np.hypot(width, height)) / 2, focal[0])
        if kind == "fisheye624"
        else (),
    )


def _prism_cost(prism: list[float], reach: float, focal: float) -> tuple[tuple[str, float], ...]:
    """What it costs to leave out a thin prism of the fourth order; reach: from the middle to a corner, px."""
    cost = float(np.hypot(prism[1], prism[3])) * (reach / focal) ** 4 * focal
    return (("a thin prism of the fourth order", cost),) if cost else ()


def _view(name: str, shot: dict, cameras: dict[str, pycolmap.Camera], where: str) -> View:
    try:
        rotation, translation = (
            np.array(shot["rotation"], np.float64),
            np.array(shot["translation"], np.float64),
        )
        camera = cameras[shot["camera"]]
        if (
            rotation.shape != (3,)
            or translation.shape != (3,)
            or not np.isfinite([rotation, translation]).all()
        ):
            raise ValueError("three finite numbers each are expected")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: rotation, translation or camera cannot be used ({error})") from None
    matrix = pycolmap.Rotation3d(rotation).matrix()
    return View(name, camera, rigid(matrix, -matrix.T @ translation, where))


def _points(points: dict, file: Path) -> tuple[np.ndarray, np.ndarray, dict[str, int]]:
    """(P, 3) positions, (P, 3) colors, and the row of each track."""
    try:
        positions = np.array([point["coordinates"] for point in points.values()], np.float64).reshape(-1, 3)
        colors = np.array(
            [point.get("color", (128, 128, 128)) for point in points.values()], np.float64
        ).reshape(-1, 3)
        if not len(positions) == len(colors) == len(points):
            raise ValueError("three numbers each are expected")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{file} has points that cannot be used ({error!r})") from None
    kept, colors, names = (
        np.flatnonzero(np.isfinite(positions).all(axis=1)),
        np.nan_to_num(colors),
        list(points),
    )
    return (
        positions[kept],
        np.clip(np.rint(colors[kept]), 0, 255).astype(np.uint8),
        {str(names[place]): row for row, place in enumerate(kept)},
    )


def _observations(
    file: Path, views: list[View], rows: dict[str, int]
) -> list[tuple[np.ndarray, np.ndarray]] | None:
    """Rows of the points that each view sees and their pixels, from tracks.csv (all versions have photo,
    track, feature, x, y in front).
    """
    if not file.is_file():
        return None
    seen: dict[str, tuple[list[int], list[tuple[float, float]]]] = {view.name: ([], []) for view in views}
    with file.open(encoding="utf-8-sig", errors="replace") as lines:
        for line in lines:
            words = line.rstrip("\n").split("\t")
            if len(words) >= 8 and words[1] in rows and words[0] in seen:
                seen[words[0]][0].append(rows[words[1]])
                seen[words[0]][1].append((float(words[3]), float(words[4])))
    middles = [(max(view.width, view.height), np.array([view.width, view.height]) / 2) for view in views]
    return [
        (np.array(seen[view.name][0], int), np.array(seen[view.name][1]).reshape(-1, 2) * size + middle)
        for view, (size, middle) in zip(views, middles)
    ]


def _georeference(part: dict, file: Path, root: Path, views: list[View]) -> Georeference | None:
    coords, reference = root / "odm_georeferencing" / "coords.txt", part.get("reference_lla")
    if coords.is_file() and file.name != TOPOCENTRIC and not _is_topocentric(part, views):
        return _utm(coords)
    if reference is None:
        return None
    if not _has_gps(part):
        logger.warning(
            "%s: its photos have no GPS: the place stays unknown, scale and units are arbitrary", file
        )
        return None
    try:
        return from_origin(triple(reference[key] for key in ("latitude", "longitude", "altitude")))
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{file}: reference_lla has no latitude, longitude and altitude") from None


def _has_gps(part: dict) -> bool:
    """Whether the reference is a place: OpenSfM writes 0 N 0 E where no photo has GPS, whose positions are
    then zero and their dilution of precision NO_GPS. A flight at 0 N 0 E with GPS is one in the Gulf of Guinea.
    """
    reference = part["reference_lla"]
    if any(abs(float(reference.get(key) or 0.0)) > NEAR_ZERO for key in ("latitude", "longitude")):
        return True
    return any(
        any(shot.get("gps_position") or []) and float(shot.get("gps_dop") or 0.0) < NO_GPS
        for shot in part["shots"].values()
    )


def _is_topocentric(part: dict, views: list[View]) -> bool:
    """Whether cameras lie at their `gps_position`, which OpenSfM keeps in ENU whatever frame the
    reconstruction is in.
    """
    offsets = [
        np.subtract(shot["gps_position"], view.center)
        for shot, view in zip(part["shots"].values(), views)
        if len(shot.get("gps_position") or []) == 3
    ]
    return bool(offsets) and float(np.linalg.norm(np.median(offsets, axis=0)[:2])) < 20.0


def _utm(coords: Path) -> Georeference:
    lines = read_text(coords).splitlines()
    try:
        crs, offset = parse_crs(lines[0], coords), [float(word) for word in lines[1].split()[:2]]
    except (IndexError, ValueError):
        raise InputError(
            f"{coords}: a CRS and an offset (easting northing) are expected in its first two lines"
        ) from None
    epsg = crs.to_epsg()
    if epsg is None:
        raise InputError(f"{coords}: the CRS {lines[0]!r} has no EPSG code")
    return Georeference(epsg, (offset[0], offset[1], 0.0))
