"""The GPS of a flight: what it can define, how a model lies to it, and the georeference that follows."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.georeferencing.alignment import (
    Similarity,
    fit_similarity_robust,
    flight_shape,
    main_plane,
    roll_upright,
)
from sc3d.georeferencing.georeference import (
    Georeference,
    crs_to_geodetic,
    enu_to_geodetic,
    from_origin,
    triple,
    utm_epsg,
)
from sc3d.georeferencing.geotags import Geotag, enu_positions, read_geotags
from sc3d.scene.scene import Scene

logger = logging.getLogger(__name__)

MIN_GPS = 3  # a similarity needs three positions
# standard deviations, and not less than OUTLIER_METERS: a position this far off takes no part in the fit
OUTLIER = 5.0
OUTLIER_METERS = 10.0
# relative, radians: a model within these of ENU is ENU, its rest is the noise of GPS
SAME_SCALE, SAME_ANGLE = 1e-3, 1e-3


@dataclass(frozen=True)
class Flight:
    """GPS of photos that can place a model.

    tags: by photo name, in the order of the names
    shape: "line" (the roll about it stays open) or "area"
    origin: latitude, longitude (degrees), altitude (m) of the local ENU frame; that of the first photo as a
        rule
    """

    tags: dict[str, Geotag]
    shape: str
    origin: tuple[float, float, float]

    @cached_property
    def positions(self) -> dict[str, np.ndarray]:
        """ENU position (3,) of each photo, m."""
        return dict(zip(self.tags, enu_positions(self.tags, self.origin)))


def read_flight(folder: Path, names: list[str]) -> Flight | None:
    """GPS of the photos (names relative to `folder`); None, with a warning, where it can place no model."""
    tags = read_geotags(folder, names)
    if len(tags) < MIN_GPS:
        logger.warning(
            "%s: the model gets no scale, no north and no position",
            f"only {len(tags)} of {len(names)} photos have GPS" if tags else "no photo has GPS",
        )
        return None
    sigma = np.median([tag.sigma for tag in tags.values()], axis=0)
    origin = next(iter(tags.values())).geodetic
    positions = enu_positions(tags, origin)
    shape = flight_shape(positions, float(sigma[:2].mean()))
    if shape == "point":
        logger.warning(
            "all GPS positions lie within %.1f m of one another, no more than they err: they give no scale, and none is used",
            float(np.linalg.norm(np.ptp(positions, axis=0))),
        )
        return None
    if shape == "line":
        logger.warning(
            "all photos with GPS lie on one line: GPS leaves the tilt about it open, the main plane of the points is taken for level. "
            "A second strip beside the first, or ground control points (--gcp), would fix it"
        )
    if len(tags) < len(names):
        logger.warning("%d of %d photos have GPS; the others follow", len(tags), len(names))
    return Flight(tags, shape, origin)


def place(flight: Flight, centers: dict[str, np.ndarray], points: np.ndarray) -> Similarity | None:
    """Similarity from a model's frame to the flight's ENU.

    centers: camera center (3,) by photo name, photos without GPS included; points: (P, 3) of the model, for
        the level of a flight along a line
    returns: None if fewer than three cameras have GPS or fit it
    """
    names = [name for name in flight.tags if name in centers]
    if len(names) < MIN_GPS:
        return None
    source, target = (
        np.array([centers[name] for name in names]),
        np.array([flight.positions[name] for name in names]),
    )
    sigma = np.median([flight.tags[name].sigma for name in names])
    fit, kept = fit_similarity_robust(source, target, max(OUTLIER * sigma, OUTLIER_METERS))
    if kept.sum() < MIN_GPS:
        return None
    if not kept.all():
        logger.warning(
            "GPS of %d photos is wrong and left out of the alignment: %s",
            (~kept).sum(),
            ", ".join(np.array(names)[~kept]),
        )
    return _rolled(fit, target[kept], points) if flight.shape == "line" else fit


def _rolled(fit: Similarity, positions: np.ndarray, points: np.ndarray) -> Similarity:
    """Turn about the flight line until the points' main plane is level, cameras above it."""
    axes, middle = main_plane(fit.apply(points))
    line = np.linalg.svd(positions - positions.mean(axis=0), full_matrices=False)[2][0]
    normal = axes[2] if axes[2] @ (positions.mean(axis=0) - middle) > 0 else -axes[2]
    turn, pivot = roll_upright(normal, line), positions.mean(axis=0)
    return Similarity(fit.scale, turn @ fit.rotation, turn @ (fit.translation - pivot) + pivot)


def residuals(flight: Flight, centers: dict[str, np.ndarray]) -> dict[str, float]:
    """How far camera centers (ENU) lie from their GPS: root mean squares in m, and the count; empty without
    any.
    """
    offsets = np.array(
        [centers[name] - flight.positions[name] for name in flight.tags if name in centers]
    ).reshape(-1, 3)
    if not len(offsets):
        return {}
    squares = (offsets**2).mean(axis=0)
    return {
        "photos": len(offsets),
        "rms": _meters(np.sqrt(squares.sum())),
        "rms_horizontal": _meters(np.sqrt(squares[:2].sum())),
        "rms_vertical": _meters(np.sqrt(squares[2])),
        "rtk_photos": sum(tag.rtk for tag in flight.tags.values()),
    }


def georeference_photos(scene: Scene, epsg: int | None) -> Georeference:
    """Georeference of a scene by the GPS of its photos; InputError if they are not there, or have none that
    fits the cameras. epsg: None = the UTM zone
    """
    views = [view for view in scene.model.views if scene.photo(view.name).is_file()]
    if not views:
        raise InputError(
            f"none of the photos is in {scene.images}: link their folder there, or pass --epsg and --offset"
        )
    flight = read_flight(scene.images, [view.name for view in views])
    centers = {view.name: view.center for view in views}
    found = find_georeference(flight, centers, scene.model.points, epsg) if flight else None
    if found is None:
        raise InputError(
            f"the photos in {scene.images} have no GPS that fits the cameras: pass --epsg and --offset if the scene is in a CRS"
        )
    return found


def find_georeference(
    flight: Flight, centers: dict[str, np.ndarray], points: np.ndarray, epsg: int | None
) -> Georeference | None:
    """Georeference of a model whose photos have GPS, whatever frame it is in; the model stays as it is.

    A model in local ENU (as `reconstruct` makes it) or in a CRS is recognized; any other gets a similarity in
    front. None if GPS and cameras do not fit.
    """
    crs = _in_crs(flight, centers, epsg)
    if crs is not None:
        return crs
    fit = place(flight, centers, points)
    if fit is None:
        return None
    if abs(fit.scale - 1) < SAME_SCALE and fit.angle < SAME_ANGLE:
        origin = triple(enu_to_geodetic(fit.apply(np.zeros((1, 3))), flight.origin)[0])
        return from_origin(origin, epsg, figures={"gps": residuals(replace(flight, origin=origin), centers)})
    found = from_origin(
        flight.origin,
        epsg,
        figures={"gps": residuals(flight, dict(zip(centers, fit.apply(np.array(list(centers.values()))))))},
    )
    return Georeference(
        found.epsg,
        found.offset,
        found.origin,
        tuple(tuple(row) for row in fit.matrix.tolist()),
        figures=found.figures,
    )


def _in_crs(flight: Flight, centers: dict[str, np.ndarray], epsg: int | None) -> Georeference | None:
    """The georeference of a model whose world is a CRS (`epsg`, or the UTM zone), within what GPS may err;
    None for any other.
    """
    georeference = Georeference(epsg or utm_epsg(*flight.origin[:2]), (0.0, 0.0, 0.0))
    names = [name for name in flight.tags if name in centers]
    found = crs_to_geodetic(np.array([centers[name] for name in names]), georeference.crs)
    stated = np.array([flight.tags[name].geodetic for name in names])
    meters = np.abs(found[:, :2] - stated[:, :2]) * [111_320.0, 111_320.0 * np.cos(np.radians(stated[0, 0]))]
    return georeference if np.isfinite(meters).all() and np.median(meters) < 2 * OUTLIER_METERS else None


def _meters(value: float) -> float:
    return round(float(value), 3)
