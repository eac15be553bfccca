"""Ground control points: read from ODM's `gcp_list.txt`, triangulated in a model, and the model brought onto
them.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from sc3d.errors import InputError
from sc3d.georeferencing.alignment import Similarity, fit_similarity, fit_similarity_robust
from sc3d.georeferencing.georeference import crs_to_geodetic, geodetic_to_enu

if TYPE_CHECKING:
    import pyproj

logger = logging.getLogger(__name__)

# of the distance to the cameras; a point that misses the fit of the others by more was mistaken for another,
# or mistyped
MAX_ERROR = 0.02
PIXEL_CENTER = 0.5  # ODM and OpenSfM call the center of the first pixel (0, 0)
MIN_POINTS = 3


@dataclass(frozen=True)
class ControlPoints:
    """G surveyed points and where photos show them.

    names: of the points; geodetic: (G, 3) latitude, longitude (degrees), height (m)
    observations: per point, the (K, 2) px, COLMAP's convention, by photo name
    epsg: of the file's CRS if that is a projected one with a code, else None
    """

    names: list[str]
    geodetic: np.ndarray
    observations: list[dict[str, np.ndarray]]
    epsg: int | None

    @property
    def origin(self) -> tuple[float, float, float]:
        """Middle of the points, rounded: latitude, longitude, height of the local ENU frame."""
        latitude, longitude, height = self.geodetic.mean(axis=0)
        return round(float(latitude), 6), round(float(longitude), 6), round(float(height), 0)


def read_control_points(path: Path, photos: list[str]) -> ControlPoints:
    """Read a `gcp_list.txt`: a line with the CRS, then `x y z px py photo [name]` per observation.

    photos: known names; a photo is found by its name, or by the last part of it. InputError with the line for
        whatever cannot be understood.
    """
    try:
        lines = [
            (number, line.strip())
            for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), start=1)
        ]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the ground control points {path}: {error}") from None
    lines = [(number, line) for number, line in lines if line and not line.startswith("#")]
    if not lines:
        raise InputError(
            f"{path} is empty: the CRS is expected in its first line, then `x y z px py photo [name]`"
        )
    crs = parse_crs(lines[0][1], path)
    known = {Path(name).name: name for name in photos} | {name: name for name in photos}
    positions: dict[str, tuple[float, ...]] = {}
    observations: dict[str, dict[str, np.ndarray]] = {}
    unknown = set()
    for number, line in lines[1:]:
        position, pixel, photo, name = _parse(line, f"{path}, line {number}")
        if photo not in known:
            unknown.add(photo)
            continue
        if positions.setdefault(name, position) != position:
            raise InputError(f"{path}, line {number}: the point {name!r} has another position further up")
        observations.setdefault(name, {})[known[photo]] = np.array(pixel) + PIXEL_CENTER
    if unknown:
        logger.warning(
            "%s names %d photos that are not there: %s", path, len(unknown), ", ".join(sorted(unknown))
        )
    if len(positions) < MIN_POINTS:
        raise InputError(
            f"{path} has {len(positions)} points on known photos: at least {MIN_POINTS} are needed"
        )
    return ControlPoints(
        list(positions),
        crs_to_geodetic(np.array(list(positions.values())), crs),
        list(observations.values()),
        crs.to_epsg() if crs.is_projected else None,
    )


def parse_crs(header: str, path: Path) -> pyproj.CRS:
    """CRS of a header: `EPSG:32615`, `WGS84 UTM 15N`, `WGS84` (longitude, latitude) or a PROJ string."""
    import pyproj

    words = header.strip("'\"").split()
    try:
        if [word.upper() for word in words[:2]] == ["WGS84", "UTM"] and len(words) == 3:
            zone, south = int(words[2].rstrip("NSns")), words[2].upper().endswith("S")
            if not 1 <= zone <= 60:
                raise ValueError
            return pyproj.CRS.from_epsg((32700 if south else 32600) + zone)
        crs = (
            pyproj.CRS.from_epsg(4326)
            if [word.upper() for word in words] == ["WGS84"]
            else pyproj.CRS.from_user_input(" ".join(words))
        )
    except (pyproj.exceptions.CRSError, ValueError):
        raise InputError(
            f"{path} starts with {header!r}: a CRS is expected there, such as EPSG:32615, WGS84 UTM 15N or +proj=utm +zone=15"
        ) from None
    if not (crs.is_projected or crs.is_geographic):
        raise InputError(f"{path}: {crs.name} is neither a projected nor a geographic CRS")
    return crs


def _parse(line: str, where: str) -> tuple[tuple[float, ...], tuple[float, float], str, str]:
    """Position (x, y, z), pixel (x, y), photo and name of a line; a point without a name is called by its
    position.
    """
    words = line.split()
    try:
        numbers = [float(word) for word in words[:5]]
        if len(words) < 6 or not np.isfinite(numbers).all():
            raise ValueError
    except ValueError:
        raise InputError(
            f"{where}: `x y z px py photo [name]` with finite numbers is expected, not {line!r}"
        ) from None
    return tuple(numbers[:3]), (numbers[3], numbers[4]), words[5], " ".join(words[6:]) or " ".join(words[:3])


def triangulate(
    model: pycolmap.Reconstruction, observations: dict[str, np.ndarray]
) -> tuple[np.ndarray | None, np.ndarray]:
    """Point closest to the rays of its pixels.

    observations: (2,) px by photo name; photos that are not in the model do not count
    returns: (3,) model frame, None with fewer than two photos; (K,) reprojection errors, px
    """
    images = {model.image(image_id).name: model.image(image_id) for image_id in model.reg_image_ids()}
    seen = [(images[name], pixel) for name, pixel in observations.items() if name in images]
    if len(seen) < 2:
        return None, np.zeros(0)
    normal, moment = np.zeros((3, 3)), np.zeros(3)
    for image, pixel in seen:
        ray = np.asarray(image.camera.cam_ray_from_img(pixel[None])).ravel()
        direction = image.cam_from_world().rotation.matrix().T @ (ray / np.linalg.norm(ray))
        across = np.eye(3) - np.outer(direction, direction)
        normal, moment = normal + across, moment + across @ image.projection_center()
    point = np.linalg.solve(normal, moment)
    projected = [image.project_point(point) for image, _ in seen]
    return point, np.array(
        [
            np.inf if pixel is None else np.linalg.norm(pixel - given)
            for pixel, (_, given) in zip(projected, seen)
        ]
    )


def align_to_control_points(
    model: pycolmap.Reconstruction, points: ControlPoints, refine_focal: bool = True
) -> dict[str, object]:
    """Bring a model into ENU at `points.origin`: similarity, then bundle adjustment with the points held
    fixed. Changes the model.

    returns: figures: per point its residual east, north, up (m) and reprojection error (px); root mean
        squares; leave-one-out before the adjustment
    """
    target = geodetic_to_enu(points.geodetic, points.origin)
    source, used = _triangulate_all(model, points)
    if len(used) < MIN_POINTS:
        raise InputError(
            f"{len(used)} ground control points are seen by two or more registered photos: at least {MIN_POINTS} are needed"
        )
    fit, kept = fit_similarity_robust(
        source, target[used], MAX_ERROR * _distance(model, source, target[used])
    )
    if kept.sum() < MIN_POINTS:
        raise InputError(
            "the ground control points do not fit the model: check the CRS, the order x y (east, north) and the pixels"
        )
    if not kept.all():
        logger.warning(
            "ground control points left out, as they do not fit the others: %s",
            ", ".join(points.names[used[row]] for row in np.flatnonzero(~kept)),
        )
    spread = np.linalg.svd(target[used][kept] - target[used][kept].mean(axis=0), compute_uv=False) / np.sqrt(
        kept.sum()
    )
    if spread[1] < 0.02 * spread[0]:
        raise InputError(
            "the ground control points lie on one line: they leave the tilt about it open; add one beside it"
        )
    transform(model, fit)
    figures = {
        "points": len(used),
        "left_out": int((~kept).sum()),
        "leave_one_out_rms": _leave_one_out(source[kept], target[used][kept]),
    }
    _adjust(model, [points.observations[row] for row in used[kept]], target[used[kept]], refine_focal)
    return figures | _residuals(model, points, target, used[kept])


def transform(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Move a model."""
    model.transform(
        pycolmap.Sim3d(similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation)
    )


def _triangulate_all(model: pycolmap.Reconstruction, points: ControlPoints) -> tuple[np.ndarray, np.ndarray]:
    """(U, 3) positions in the model and (U,) rows of the points that at least two registered photos show."""
    found = [triangulate(model, seen)[0] for seen in points.observations]
    used = np.array([row for row, point in enumerate(found) if point is not None], int)
    missing = [points.names[row] for row, point in enumerate(found) if point is None]
    if missing:
        logger.warning("ground control points in fewer than two registered photos: %s", ", ".join(missing))
    return np.array([found[row] for row in used]).reshape(-1, 3), used


def _distance(model: pycolmap.Reconstruction, source: np.ndarray, target: np.ndarray) -> float:
    """Median distance, m, of the points from the nearest camera; `source`, `target` (U, 3): points in the
    model and in m.
    """
    size = np.median(np.linalg.norm(target - np.median(target, axis=0), axis=1)) / np.median(
        np.linalg.norm(source - np.median(source, axis=0), axis=1)
    )
    centers = np.array([model.image(image_id).projection_center() for image_id in model.reg_image_ids()])
    return float(size * np.median([np.linalg.norm(centers - point, axis=1).min() for point in source]))


def _adjust(
    model: pycolmap.Reconstruction,
    observations: list[dict[str, np.ndarray]],
    positions: np.ndarray,
    refine_focal: bool,
) -> None:
    """Bundle adjustment in which the surveyed points are further tracks at fixed positions, one pixel as good
    as that of any other track.
    """
    images = {model.image(image_id).name: model.image(image_id) for image_id in model.reg_image_ids()}
    config = pycolmap.BundleAdjustmentConfig()
    for image in images.values():
        config.add_image(image.image_id)
    added = []
    for seen, position in zip(observations, positions):
        track = pycolmap.Track()
        for name in [name for name in seen if name in images]:
            track.add_element(images[name].image_id, images[name].num_points2D())
            images[name].points2D.append(pycolmap.Point2D(seen[name]))
        added.append(model.add_point3D(position, track))
        config.add_constant_point(added[-1])
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary, options.refine_focal_length = False, refine_focal
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    for point in added:
        model.delete_point3D(point)
    for seen in reversed(observations):
        for name in [name for name in seen if name in images]:
            images[name].points2D.pop()
    model.update_point_3d_errors()


def _leave_one_out(source: np.ndarray, target: np.ndarray) -> float | None:
    """Root mean square distance, m, at which points are found by the fit of the others: what the model is
    worth between control points.
    """
    if len(source) <= MIN_POINTS:
        return None
    rest = [np.delete(np.arange(len(source)), row) for row in range(len(source))]
    errors = [
        fit_similarity(source[keep], target[keep]).apply(source[row : row + 1])[0] - target[row]
        for row, keep in enumerate(rest)
    ]
    return round(float(np.sqrt((np.array(errors) ** 2).sum(axis=1).mean())), 4)


def _residuals(
    model: pycolmap.Reconstruction, points: ControlPoints, target: np.ndarray, rows: np.ndarray
) -> dict[str, object]:
    listed, offsets = {}, []
    for row in rows:
        position, pixels = triangulate(model, points.observations[row])
        offsets.append(position - target[row])
        listed[points.names[row]] = {
            "east_north_up_m": np.round(offsets[-1], 4).tolist(),
            "reprojection_px": round(float(np.sqrt((pixels**2).mean())), 3),
        }
    squares = (np.array(offsets) ** 2).mean(axis=0)
    return {
        "rms": round(float(np.sqrt(squares.sum())), 4),
        "rms_horizontal": round(float(np.sqrt(squares[:2].sum())), 4),
        "rms_vertical": round(float(np.sqrt(squares[2])), 4),
        "residuals": listed,
    }
