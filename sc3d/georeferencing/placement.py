"""A model brought to its place: by ground control points, else by GPS, else made level."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from sc3d.georeferencing.alignment import Similarity, main_plane
from sc3d.georeferencing.control_fit import Accuracy
from sc3d.georeferencing.control_points import (
    ControlPoints,
    align_to_control_points,
    drop_wrong_marks,
    match_control_points,
    transform,
)
from sc3d.georeferencing.focal import anchor_focal, tells_focal
from sc3d.georeferencing.georeference import Georeference, from_origin
from sc3d.georeferencing.gps import Flight, agree, place, residuals
from sc3d.georeferencing.up_direction import model_poses, settle_up, upside_down
from sc3d.io.colmap import registered_images
from sc3d.settings.reconstruction import Reconstruct

logger = logging.getLogger(__name__)

# a model is moved onto its GPS if that makes the root mean square distance smaller by this factor
LOOSE = 1.1


@dataclass(frozen=True)
class Placed:
    """figures: for the summary; georeference: where the model lies on Earth, if that is known"""

    figures: dict[str, object]
    georeference: Georeference | None


def place_model(
    model: pycolmap.Reconstruction,
    images: Path,
    flight: Flight | None,
    control_points: ControlPoints | None,
    settings: Reconstruct,
) -> Placed:
    """Bring a model into local ENU, metric and upright, where GPS or control points allow it. Changes the
    model.

    images: folder of the photos, whose EXIF may have to say the focal length
    errors: InputError for control points that do not fit
    """
    pycolmap.logging.minloglevel = 0 if logger.isEnabledFor(logging.DEBUG) else 2
    flight = agree(flight, _centers(model)) if flight else None
    free = settings.focal == "refine" or (settings.focal == "auto" and tells_focal(model))
    focal = {} if free else anchor_focal(model, images, flight)
    georeference = _georeference(model, images, flight, control_points, settings)
    level = make_level(model, images) if georeference is None else {}
    return Placed(
        _summary(model, georeference) | level | focal | _heights(model, flight, georeference), georeference
    )


def _georeference(
    model: pycolmap.Reconstruction,
    images: Path,
    flight: Flight | None,
    control_points: ControlPoints | None,
    settings: Reconstruct,
) -> Georeference | None:
    """Bring a model into local ENU, from control points or else from GPS; returns what is then known of its
    place, None where neither says.
    """
    if control_points is not None:
        figures = align_to_control_points(
            model,
            control_points,
            refine_focal=tells_focal(model),
            accuracy=settings.gcp_accuracy,
            images=images,
        )
        return from_origin(
            control_points.origin,
            settings.epsg or control_points.epsg,
            settings.altitude_offset,
            {"control_points": figures},
        )
    if flight is None:
        return None
    poses = model_poses(model, images)
    fit = place(flight, _centers(model), lambda: settle_up(poses, _points(model)).up)
    if fit is not None and upside_down(poses, fit.rotation[2]):
        logger.warning(
            "the GPS would turn the cameras upside down, as where latitude and longitude are exchanged: it is not used"
        )
        fit = None
    if fit is None:
        return None
    moved = dict(zip(_centers(model), fit.apply(np.array(list(_centers(model).values())))))
    if (
        flight.shape == "line"
        or residuals(flight, _centers(model))["rms"] > LOOSE * residuals(flight, moved)["rms"]
    ):
        transform(model, fit)
    return from_origin(
        flight.origin, settings.epsg, settings.altitude_offset, {"gps": residuals(flight, _centers(model))}
    )


def georeference_control_points(
    model: pycolmap.Reconstruction,
    points: ControlPoints,
    epsg: int | None,
    accuracy: Accuracy | None = None,
    images: Path | None = None,
) -> Georeference:
    """Georeference of a model by control points, with a similarity in front; `model` is moved, what lies in its
    frame elsewhere stays. InputError if they do not fit.

    epsg: None = the CRS of the points, or the UTM zone; images: folder of the photos, for their orientation
    """
    points = drop_wrong_marks(model, points)
    found = match_control_points(model, points, accuracy, images)
    transform(model, found.fit.similarity)
    figures = {"control_points": found.figures(model, points)}
    placed = from_origin(points.origin, epsg or points.epsg, figures=figures)
    matrix = tuple(tuple(row) for row in found.fit.similarity.matrix.tolist())
    return replace(placed, local_from_world=matrix)


def _centers(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    """Camera center (3,) by photo name."""
    return {image.name: image.projection_center() for image in registered_images(model)}


def _points(model: pycolmap.Reconstruction) -> np.ndarray:
    return np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)


def make_level(model: pycolmap.Reconstruction, images: Path) -> dict[str, object]:
    """Without GPS: z up as the cameras have it, x along the longer side of the points, unit unknown. Changes
    the model; returns figures on how sure that is.

    images: folder of the photos
    """
    points = _points(model)
    found = settle_up(model_poses(model, images), points)
    axes, middle = main_plane(points)
    along = axes[0] if abs(axes[0] @ found.up) < 0.9 else axes[1]
    x = along - (along @ found.up) * found.up
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(found.up, x), found.up])
    transform(model, Similarity(1.0, rotation, -rotation @ middle))
    return found.figures


def _summary(model: pycolmap.Reconstruction, georeference: Georeference | None) -> dict[str, object]:
    return {
        "points": model.num_points3D(),
        "reprojection_error_px": round(float(model.compute_mean_reprojection_error()), 3),
        "frame": "ENU" if georeference else "local",
        "origin_lat_lon_alt": list(georeference.origin) if georeference and georeference.origin else None,
        "epsg": georeference.epsg if georeference else None,
    } | _errors(georeference)


def _heights(
    model: pycolmap.Reconstruction, flight: Flight | None, georeference: Georeference | None
) -> dict[str, float]:
    """Flight height above the middle of the points, and above take-off where DJI's XMP states it, m; a
    warning where they are far apart.
    """
    if georeference is None:
        return {}
    heights = {
        "height_above_points_m": round(
            float(
                np.mean([center[2] for center in _centers(model).values()]) - np.median(_points(model)[:, 2])
            ),
            1,
        )
    }
    stated = (
        [tag.above_takeoff for tag in flight.tags.values() if tag.above_takeoff is not None] if flight else []
    )
    if stated:
        heights["height_above_takeoff_m"] = round(float(np.median(stated)), 1)
        if not 0.7 < heights["height_above_points_m"] / max(np.median(stated), 0.1) < 1.4:
            logger.warning(
                "the cameras lie %.0f m above the points, XMP says %.0f m above take-off: unless the ground is that uneven, the focal length is wrong "
                "(see --focal)",
                heights["height_above_points_m"],
                heights["height_above_takeoff_m"],
            )
    return heights


def _errors(georeference: Georeference | None) -> dict[str, object]:
    """Residuals for the summary: "rms_to_gps_m" or "rms_to_control_points_m"."""
    figures = georeference.figures if georeference else {}
    return {f"rms_to_{kind}_m": found["rms"] for kind, found in figures.items()}
