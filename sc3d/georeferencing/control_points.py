"""Ground control points: read from a `gcp_list.txt`, triangulated in a model, and the model brought onto them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from sc3d.errors import InputError, examples
from sc3d.georeferencing.alignment import Similarity
from sc3d.georeferencing.control_fit import (
    EXCHANGED,
    MIN_POINTS,
    Accuracy,
    ControlFit,
    Correspondences,
    fit_control_points,
    fits_exchanged,
)
from sc3d.georeferencing.focal import adjustment_options
from sc3d.georeferencing.gcp_list import is_title, parse_crs, parse_mark, read_lines
from sc3d.georeferencing.georeference import crs_to_geodetic, geodetic_to_enu
from sc3d.georeferencing.geotags import is_altitude
from sc3d.georeferencing.up_direction import find_up, model_poses, upside_down
from sc3d.io.colmap import registered_images
from sc3d.io.crs import split_crs
from sc3d.scene.photo_names import PhotoNames

if TYPE_CHECKING:
    import pyproj

logger = logging.getLogger(__name__)

PIXEL_CENTER = 0.5  # ODM and OpenSfM call the center of the first pixel (0, 0)
# of the distance to the cameras; points that miss the fit by less are as good as the cameras
MAX_ERROR = 0.02
# share of the points whose marks meet: below the first the axes are in doubt, from the second on they are right
MOST_MEET = (0.5, 0.8)
BAD_MARK = 0.02  # of the photo's longer side: marks that miss the others by more were set wrong
FAR_FROM_GPS = 20_000.0  # m: control points this far from the photos' GPS are in another CRS


@dataclass(frozen=True)
class ControlPoints:
    """G surveyed points and where photos show them.

    names: of the points; geodetic: (G, 3) latitude, longitude (degrees), height (m; beyond what is on Earth: none)
    observations: per point, the (K, 2) px, COLMAP's convention, by photo name
    epsg: of the file's CRS, horizontal part, if that is a projected one with a code, else None
    """

    names: list[str]
    geodetic: np.ndarray
    observations: list[dict[str, np.ndarray]]
    epsg: int | None

    @property
    def origin(self) -> tuple[float, float, float]:
        """Median of the points, rounded, which a wrong one does not move away: latitude, longitude, height of
        the local ENU frame.
        """
        latitude, longitude, _ = np.median(self.geodetic, axis=0)
        heights = self.geodetic[self.measured, 2]
        height = float(np.median(heights)) if len(heights) else 0.0
        return round(float(latitude), 6), round(float(longitude), 6), round(height, 0)

    @property
    def measured(self) -> np.ndarray:
        """(G,) bool: the height can be one."""
        return np.array([is_altitude(height) for height in self.geodetic[:, 2]], bool)

    @property
    def enu(self) -> np.ndarray:
        """(G, 3) m, at `origin`; those without a height lie at its height."""
        geodetic = self.geodetic.copy()
        geodetic[~self.measured, 2] = self.origin[2]
        return geodetic_to_enu(geodetic, self.origin)


def read_control_points(path: Path, photos: Sequence[str]) -> ControlPoints:
    """Read a `gcp_list.txt`: a line with the CRS, then `x y z px py photo [name]` per observation, apart by
    tabs, semicolons, commas or blanks.

    photos: known names; a photo is found by its name, or by what is left of it without folders, suffix or
        case where that is clear. InputError with the line for whatever cannot be understood.
    """
    lines = read_lines(path)
    crs = parse_crs(lines[0][1], path)
    known = PhotoNames(photos)
    positions: dict[str, tuple[float, ...]] = {}
    observations: dict[str, dict[str, np.ndarray]] = {}
    unknown, twice = [], []
    for number, line in lines[2 if len(lines) > 1 and is_title(lines[1][1]) else 1 :]:
        mark = parse_mark(line, f"{path}, line {number}", known)
        if not mark.known:
            unknown.append(mark.photo)
            continue
        if positions.setdefault(mark.name, mark.position) != mark.position:
            raise InputError(
                f"{path}, line {number}: the point {mark.name!r} has another position further up"
            )
        pixel = np.array(mark.pixel) + PIXEL_CENTER
        before = observations.setdefault(mark.name, {}).setdefault(mark.photo, pixel)
        if (before != pixel).any():
            twice.append(f"{mark.name} in {mark.photo}")
    _warn(path, list(dict.fromkeys(unknown)), twice)
    if len(positions) < MIN_POINTS:
        raise InputError(
            f"{path} has {len(positions)} points on known photos: at least {MIN_POINTS} are needed"
        )
    return ControlPoints(
        list(positions),
        _geodetic(np.array(list(positions.values())), crs, path),
        list(observations.values()),
        split_crs(crs)[0].to_epsg() if crs.is_projected else None,
    )


def _warn(path: Path, unknown: list[str], twice: list[str]) -> None:
    if unknown:
        logger.warning("%s names %d photos that are not there: %s", path, len(unknown), examples(unknown))
    if twice:
        logger.warning(
            "%s marks %d points twice in one photo, the first mark counts: %s",
            path,
            len(twice),
            examples(twice),
        )


def _geodetic(positions: np.ndarray, crs: pyproj.CRS, path: Path) -> np.ndarray:
    geodetic = crs_to_geodetic(positions, crs)
    exchanged = crs_to_geodetic(positions[:, [1, 0, 2]], crs)
    if crs.is_projected and _are_inside(exchanged, crs) and not _are_inside(geodetic, crs):
        logger.warning(
            "%s: x and y are exchanged, north before east: as written the points lie outside the area of %s, exchanged inside; they are read so",
            path,
            crs.name,
        )
        geodetic = exchanged
    outside = ~np.isfinite(geodetic).all(axis=1) | (np.abs(geodetic[:, :2]) > [90.0, 180.0]).any(axis=1)
    if outside.any():
        raise InputError(
            f"{path}: {outside.sum()} of {len(positions)} points, such as {positions[outside][0].tolist()}, lie outside the area of {crs.name}: "
            f"check the CRS and the order ({'east, north' if crs.is_projected else 'longitude, latitude'})"
        )
    return geodetic


def _are_inside(geodetic: np.ndarray, crs: pyproj.CRS) -> bool:
    """Whether half of some points or more, (G, 3) latitude, longitude, height, lie where a CRS is made for."""
    area = split_crs(crs)[0].area_of_use
    if area is None:
        return False
    latitude, longitude, _ = geodetic.T
    width = (area.east - area.west) % 360 or 360
    inside = (latitude >= area.south) & (latitude <= area.north) & ((longitude - area.west) % 360 <= width)
    return bool(2 * inside.sum() >= len(inside))


def check_accuracy(file: Path | None, accuracy: Accuracy | None) -> None:
    """InputError for an accuracy without control points, or one that is none."""
    if accuracy is not None and file is None:
        raise InputError("--gcp-accuracy needs --gcp")
    if accuracy is not None and not all(0 < value < np.inf for value in accuracy):
        raise InputError("--gcp-accuracy takes two standard deviations above 0, m: horizontal, vertical")


def check_control_points(
    points: ControlPoints, sizes: dict[str, tuple[int, int]], gps: tuple[float, float, float] | None
) -> None:
    """What can be seen before there are cameras: InputError for marks outside their photos, a warning for
    points far from the photos' GPS.

    sizes: (width, height) px by photo name; gps: latitude, longitude, height of the photos
    """
    outside = [
        f"{name} in {photo} at {pixel[0] - PIXEL_CENTER:.0f} {pixel[1] - PIXEL_CENTER:.0f} of {sizes[photo][0]} x {sizes[photo][1]}"
        for name, seen in zip(points.names, points.observations)
        for photo, pixel in seen.items()
        if photo in sizes and ((pixel < 0) | (pixel > sizes[photo])).any()
    ]
    if outside:
        fits = all(
            (pixel[::-1] >= 0).all() and (pixel[::-1] <= sizes[photo]).all()
            for seen in points.observations
            for photo, pixel in seen.items()
            if photo in sizes
        )
        raise InputError(
            f"{len(outside)} marks of ground control points lie outside their photos ({examples(outside)}): "
            + (
                "with x and y of the pixels exchanged all lie inside; the order is px py (column, row)"
                if fits
                else "they belong to photos of another size"
            )
        )
    if gps is not None:
        away = float(np.linalg.norm(geodetic_to_enu(np.array([points.origin]), gps)))
        if away > FAR_FROM_GPS:
            logger.warning(
                "the ground control points lie %.0f km from the GPS of the photos, one of them is wrong: check their CRS and the order x y (east, north)",
                away / 1000,
            )


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
    point = np.linalg.lstsq(normal, moment, rcond=None)[0]  # rays may be parallel
    projected = [image.project_point(point) for image, _ in seen]
    return point, np.array(
        [
            np.inf if pixel is None else np.linalg.norm(pixel - given)
            for pixel, (_, given) in zip(projected, seen)
        ]
    )


def drop_wrong_marks(model: pycolmap.Reconstruction, points: ControlPoints) -> ControlPoints:
    """The points without the marks that miss the place on which the others of the same point agree; one per
    point. Marks that do not meet and cannot tell which of them is wrong take their point with them. Says so.
    """
    limit = BAD_MARK * max(max(camera.width, camera.height) for camera in model.cameras.values())
    _check_axes(model, points, limit)
    registered = {model.image(image_id).name for image_id in model.reg_image_ids()}
    kept, marks, apart = [], [], []
    for name, observations in zip(points.names, points.observations):
        seen = {photo: pixel for photo, pixel in observations.items() if photo in registered}
        kept.append(seen)
        if len(seen) < 2 or triangulate(model, seen)[1].max() <= limit:
            continue
        fewer = {photo: {key: seen[key] for key in seen if key != photo} for photo in seen}
        errors = {photo: triangulate(model, rest)[1].max(initial=0.0) for photo, rest in fewer.items()}
        good = [photo for photo in seen if len(fewer[photo]) > 1 and errors[photo] <= limit]
        if len(good) == 1:
            kept[-1] = fewer[good[0]]
            marks.append(f"{name} in {good[0]}")
        else:
            kept[-1] = {}
            apart.append(name)
    if marks:
        logger.warning(
            "marks that do not meet the others of the same ground control point are left out, %d: %s",
            len(marks),
            examples(marks),
        )
    if apart:
        logger.warning(
            "ground control points whose marks do not meet in one place are left out, %d: %s",
            len(apart),
            examples(apart),
        )
    return replace(points, observations=kept)


def _check_axes(model: pycolmap.Reconstruction, points: ControlPoints, limit: float) -> None:
    """InputError if the marks of most points meet only with the axes of the pixels exchanged or turned over."""
    heights = {image.name: image.camera.height for image in registered_images(model)}

    def share(read: Callable[[str, np.ndarray], np.ndarray]) -> float:
        """Of the points, those whose marks meet within `limit`, px."""
        seen = [
            {photo: read(photo, pixel) for photo, pixel in observations.items() if photo in heights}
            for observations in points.observations
        ]
        errors = [triangulate(model, marks)[1].max() for marks in seen if len(marks) > 1]
        return float(np.mean(np.array(errors) <= limit)) if errors else 1.0

    if share(lambda _, pixel: pixel) >= MOST_MEET[0]:
        return
    for read, what in (
        (lambda _, pixel: pixel[[1, 0]], "x and y of the pixels exchanged: the order is px py (column, row)"),
        (
            lambda photo, pixel: np.array([pixel[0], heights[photo] - pixel[1]]),
            "y of the pixels counted from the top: it runs downwards",
        ),
    ):
        if share(read) >= MOST_MEET[1]:
            raise InputError(f"the marks of the ground control points do not meet, but would with {what}")


def align_to_control_points(
    model: pycolmap.Reconstruction,
    points: ControlPoints,
    refine_focal: bool = True,
    accuracy: Accuracy | None = None,
    images: Path | None = None,
) -> dict[str, object]:
    """Bring a model into ENU at `points.origin`: similarity, then, if the points are as good as the cameras,
    bundle adjustment with the points held fixed. Changes the model.

    accuracy: standard deviations of the points, m: horizontal, vertical; None = estimated
    images: folder of the photos, for their orientation
    returns: figures: per point its residual east, north, up (m), reprojection error (px) and leave-one-out
        error (m); root mean squares; the same of those left out
    errors: InputError, before anything is changed, if the points do not fit
    """
    points = drop_wrong_marks(model, points)
    found = match_control_points(model, points, accuracy, images)
    fit, rows = found.fit, found.rows
    transform(model, fit.similarity)
    if fit.exact:
        held = fit.kept & fit.points.measured
        observations = [points.observations[row] for row in rows[held]]
        _adjust(model, observations, fit.points.target[held], refine_focal)
    return found.figures(model, points)


@dataclass(frozen=True)
class Matched:
    """How control points fit a model.

    rows: (U,) of the points that two or more photos show
    """

    fit: ControlFit
    rows: np.ndarray

    def figures(self, model: pycolmap.Reconstruction, points: ControlPoints) -> dict[str, object]:
        """Residuals of a model that has been brought onto the points."""
        offsets = np.array([triangulate(model, points.observations[row])[0] for row in self.rows])
        offsets = offsets - self.fit.points.target
        kept, measured = self.fit.kept, self.fit.points.measured
        horizontal = float((offsets[kept, :2] ** 2).sum(axis=1).mean())
        counted = offsets[kept & measured, 2] if measured.any() else np.zeros(1)
        # heights that are no measurements say nothing
        vertical = 0.0 if self.fit.upright else (counted**2).sum() / kept.sum()
        apart = self.fit.leave_one_out
        listed = {
            points.names[row]: {
                "east_north_up_m": np.round(offset, 4).tolist(),
                "reprojection_px": _reprojection(model, points.observations[row]),
            }
            for row, offset in zip(self.rows, offsets)
        }
        if apart is not None:
            for row, error in zip(self.rows[kept], apart):
                listed[points.names[row]]["leave_one_out_m"] = round(float(error), 4)
        out = {points.names[row] for row in self.rows[~kept]}
        return {
            "points": len(self.rows),
            "left_out": len(out),
            "leave_one_out_rms": None if apart is None else round(float(np.sqrt((apart**2).mean())), 4),
            "accuracy_horizontal_vertical_m": np.round(self.fit.accuracy, 4).tolist(),
            "up_from_cameras": self.fit.upright,
            "heights_not_used": [points.names[row] for row in self.rows[~measured]],
            "height_unit": self.fit.unit or "as given",
            "rms": round(float(np.sqrt(horizontal + vertical)), 4),
            "rms_horizontal": round(float(np.sqrt(horizontal)), 4),
            "rms_vertical": round(float(np.sqrt((counted**2).mean())), 4),
            "residuals": {name: found for name, found in listed.items() if name not in out},
            "residuals_left_out": {name: found for name, found in listed.items() if name in out},
        }


def match_control_points(
    model: pycolmap.Reconstruction,
    points: ControlPoints,
    accuracy: Accuracy | None = None,
    images: Path | None = None,
) -> Matched:
    """Fit control points to a model, which stays as it is, and say in one line how well they do. InputError if
    they do not.
    """
    target = points.enu
    source, rows = _triangulate_all(model, points)
    if len(rows) < MIN_POINTS:
        raise InputError(
            f"{len(rows)} ground control points are seen by two or more registered photos: at least {MIN_POINTS} are needed"
        )
    poses, heights = model_poses(model, images), points.geodetic[rows, 2]
    up = find_up(poses, np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3))
    fit = fit_control_points(
        Correspondences(
            source,
            target[rows],
            up.up,
            MAX_ERROR * _distance(model, source, target[rows]),
            accuracy,
            np.where(points.measured[rows], heights, np.nan),
        ),
        [points.names[row] for row in rows],
    )
    if upside_down(poses, fit.similarity.rotation[2]):
        raise InputError(
            f"the ground control points would turn the cameras upside down: {EXCHANGED}"
            if fits_exchanged(fit.points)
            else "the ground control points would turn the cameras upside down: check the order x y (east, north)"
        )
    if fit.upright:
        up.tell()
    _tell(fit, [points.names[row] for row in rows], heights)
    return Matched(fit, rows)


def _tell(fit: ControlFit, names: list[str], heights: np.ndarray) -> None:
    """One line of what the user should know of a fit; nothing if all is as it should be. heights: (U,) m, as
    given
    """
    distances = np.linalg.norm(fit.points.offsets(fit.similarity, fit.upright), axis=1)
    words = []
    if not fit.exact:
        rms = np.sqrt((distances[fit.kept] ** 2).mean())
        words.append(
            f"they fit to {rms:.2f} m{' horizontally' if fit.upright else ''}, so the cameras keep their shape"
        )
        if fit.kept.sum() == MIN_POINTS:
            words.append("three points cannot check one another")
    if not fit.kept.all():
        left_out = [f"{names[row]} ({distances[row]:.2f} m)" for row in np.flatnonzero(~fit.kept)]
        words.append(f"left out, as they do not fit the others: {', '.join(left_out)}")
    words += _tell_heights(fit, names, heights)
    if words:
        logger.warning("ground control points: %s", "; ".join(words))


def _tell_heights(fit: ControlFit, names: list[str], heights: np.ndarray) -> list[str]:
    words, unused = [], np.flatnonzero(~fit.points.measured)
    if fit.unit:
        words.append(
            f"heights are {fit.slope:.2f} times what the cameras and the coordinates say: they are taken for {fit.unit}; write them in the unit of the CRS"
        )
    if len(unused):
        values = ", ".join(f"{value:g}" for value in dict.fromkeys(heights[unused]))
        words.append(
            f"heights of {len(unused)} of {len(names)} are {values}, which is no measurement: these points count horizontally only, "
            + examples([names[row] for row in unused])
        )
    if fit.upright:
        reason = "" if len(unused) else f"heights are all {heights[0]:g} or say nothing: "
        words.append(f"{reason}up comes from the cameras")
    return words


def transform(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Move a model."""
    model.transform(
        pycolmap.Sim3d(similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation)
    )


def _triangulate_all(model: pycolmap.Reconstruction, points: ControlPoints) -> tuple[np.ndarray, np.ndarray]:
    """(U, 3) positions in the model and (U,) rows of the points that at least two registered photos show."""
    found = [triangulate(model, seen)[0] for seen in points.observations]
    used = np.array([row for row, point in enumerate(found) if point is not None], int)
    missing = [points.names[row] for row, seen in enumerate(points.observations) if len(seen) == 1]
    if missing:
        logger.warning(
            "ground control points that fewer than two registered photos show are left out, %d: %s",
            len(missing),
            examples(missing),
        )
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
    pycolmap.create_default_bundle_adjuster(adjustment_options(refine_focal), config, model).solve()
    for point in added:
        model.delete_point3D(point)
    for seen in reversed(observations):
        for name in [name for name in seen if name in images]:
            images[name].points2D.pop()
    model.update_point_3d_errors()


def _reprojection(model: pycolmap.Reconstruction, observations: dict[str, np.ndarray]) -> float:
    """Root mean square, px."""
    return round(float(np.sqrt((triangulate(model, observations)[1] ** 2).mean())), 3)
