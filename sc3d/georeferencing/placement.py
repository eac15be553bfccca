"""A model brought to its place: by ground control points, else by GPS, else made level."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from sc3d.georeferencing.alignment import Similarity, main_plane, upside_down
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
from sc3d.io.colmap import cam_from_world, registered_images
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
    pycolmap.logging.minloglevel = 2
    flight = agree(flight, _centers(model)) if flight else None
    free = settings.focal == "refine" or (settings.focal == "auto" and tells_focal(model))
    focal = {} if free else anchor_focal(model, images, flight)
    georeference = _georeference(model, flight, control_points, settings)
    return Placed(_summary(model, georeference) | focal | _heights(model, flight, georeference), georeference)


def _georeference(
    model: pycolmap.Reconstruction,
    flight: Flight | None,
    control_points: ControlPoints | None,
    settings: Reconstruct,
) -> Georeference | None:
    """Bring a model into local ENU, from control points or else from GPS, or make it level at least; returns
    what is then known of its place.
    """
    if control_points is not None:
        figures = align_to_control_points(
            model, control_points, refine_focal=tells_focal(model), accuracy=settings.gcp_accuracy
        )
        return from_origin(
            control_points.origin,
            settings.epsg or control_points.epsg,
            settings.altitude_offset,
            {"control_points": figures},
        )
    fit = place(flight, _centers(model), _points(model)) if flight else None
    if fit is not None and upside_down(_rotations(model), fit):
        logger.warning(
            "the GPS would turn the cameras upside down, as where latitude and longitude are exchanged: it is not used"
        )
        fit = None
    if flight is None or fit is None:
        make_level(model)
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
) -> Georeference:
    """Georeference of a model by control points, with a similarity in front; `model` is moved, what lies in its
    frame elsewhere stays. InputError if they do not fit.

    epsg: None = the CRS of the points, or the UTM zone
    """
    points = drop_wrong_marks(model, points)
    found = match_control_points(model, points, accuracy)
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


def _rotations(model: pycolmap.Reconstruction) -> np.ndarray:
    """(N, 3, 3) cam_from_world of the registered photos."""
    return np.array([cam_from_world(image)[:3, :3] for image in registered_images(model)])


def make_level(model: pycolmap.Reconstruction) -> None:
    """Without GPS: z up = normal of the main plane of the sparse points, towards the cameras; unit = unknown."""
    axes, middle = main_plane(_points(model))
    if axes[2] @ (np.mean(list(_centers(model).values()), axis=0) - middle) < 0:
        axes = axes * [[1], [-1], [-1]]
    transform(model, Similarity(1.0, axes, -axes @ middle))


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
