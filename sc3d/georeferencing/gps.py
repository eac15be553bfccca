"""The GPS of a flight: what it can define, how a model lies to it, and the georeference that follows."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from sc3d.errors import InputError, examples
from sc3d.georeferencing.alignment import (
    Similarity,
    fit_similarity,
    fit_similarity_robust,
    flight_shape,
    roll_upright,
)
from sc3d.georeferencing.georeference import (
    Georeference,
    crs_to_geodetic,
    enu_to_geodetic,
    from_origin,
    geodetic_to_enu,
    triple,
    utm_epsg,
)
from sc3d.georeferencing.geotags import (
    STANDARD_DEVIATION,
    Geotag,
    coarse_step,
    enu_positions,
    read_geotags,
)
from sc3d.georeferencing.up_direction import settle_up, upside_down, view_poses
from sc3d.scene.scene import Scene

logger = logging.getLogger(__name__)

MIN_GPS = 3  # a similarity needs three positions
# standard deviations, and not less than OUTLIER_METERS: a position this far off takes no part in the fit
OUTLIER = 5.0
OUTLIER_METERS = 10.0
# a position is astray behind a gap this many times as wide as the rest lies from its middle, and in m; the rest
# is this share at least
FAR, FAR_METERS, FAR_SHARE = 10.0, 1000.0, 0.6
EARTH_RADIUS, METERS_PER_DEGREE = 6_371_000.0, 111_200.0
# relative, radians: a model within these of ENU is ENU, its rest is the noise of GPS
SAME_SCALE, SAME_ANGLE = 1e-3, 1e-3


@dataclass(frozen=True)
class Flight:
    """GPS of photos that can place a model.

    tags: by photo name, in the order of the names
    shape: "line" (the roll about it stays open) or "area"
    origin: latitude, longitude (degrees), altitude (m) of the local ENU frame; that of the first photo that
        is not astray, as a rule
    astray: photos whose positions lie so far from all others that cameras can only say that they are wrong
    """

    tags: dict[str, Geotag]
    shape: str
    origin: tuple[float, float, float]
    astray: frozenset[str] = frozenset()

    @cached_property
    def positions(self) -> dict[str, np.ndarray]:
        """ENU position (3,) of each photo, m."""
        return dict(zip(self.tags, enu_positions(self.tags, self.origin)))

    def without(self, names: frozenset[str]) -> Flight:
        """The flight of the other photos, at the same origin if that is still the position of one."""
        tags = {name: tag for name, tag in self.tags.items() if name not in names}
        origin = self.origin
        if origin not in {tag.geodetic for tag in tags.values()}:
            origin = next(iter(tags.values())).geodetic
        return Flight(tags, _shape(tags, origin), origin)


def read_flight(folder: Path, names: list[str], quiet: bool = False) -> Flight | None:
    """GPS of the photos (names relative to `folder`); None where it can place no model. Says so in warnings
    unless `quiet`.
    """
    level = logging.DEBUG if quiet else logging.WARNING
    tags, reasons = read_geotags(folder, names)
    far = _astray(tags)
    reasons |= dict.fromkeys(far, "far from all others")
    usable = {name: tag for name, tag in _coarse(tags, level).items() if name not in far}
    if len(usable) < MIN_GPS:
        logger.log(
            level,
            "%s: the model gets no scale, no north and no position",
            f"{len(usable)} of {len(names)} photos have GPS, {MIN_GPS} are needed{_counted(reasons)}"
            if tags or len(set(reasons.values())) > 1
            else f"no photo has GPS{_counted(reasons)}",
        )
        return None
    origin = next(iter(usable.values())).geodetic
    shape = _shape(usable, origin)
    if shape == "point":
        extent = float(np.linalg.norm(np.ptp(enu_positions(usable, origin), axis=0)))
        logger.log(
            level,
            "all GPS positions lie within %.1f m of one another, no more than they err: they give no scale, and none is used",
            extent,
        )
        return None
    if shape == "line":
        logger.log(
            level,
            "all photos with GPS lie on one line: GPS leaves the tilt about it open, the main plane of the points is taken for level. "
            "A second strip beside the first, or ground control points (--gcp), would fix it",
        )
    if reasons:
        logger.log(
            level,
            "%d of %d photos have GPS; the others follow%s",
            len(usable),
            len(names),
            _counted(reasons),
        )
    return Flight(tags | usable, shape, origin, far)


def _counted(reasons: dict[str, str]) -> str:
    """ " (2 without an altitude: a.jpg, b.jpg)": photos by what is wrong with their GPS; "" for those that have
    none at all.
    """
    kinds: dict[str, list[str]] = {}
    for name, why in reasons.items():
        kinds.setdefault(why, []).append(name)
    kinds.pop("without a position", None)
    parts = [f"{len(found)} {why}: {examples(found)}" for why, found in kinds.items()]
    return f" ({'; '.join(parts)})" if parts else ""


def _astray(tags: dict[str, Geotag]) -> frozenset[str]:
    """Photos beyond a gap that is many times as wide as all the others lie apart, such as those with the
    last position of another day. A long line, or sites side by side, have no such gap.
    """
    if len(tags) < MIN_GPS:
        return frozenset()
    names, places = list(tags), _geocentric(np.array([tag.geodetic for tag in tags.values()]))
    distance = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    order = np.argsort(distance, kind="stable")
    ranked = distance[order]
    gaps = ranked[1:] > np.maximum(FAR_METERS, FAR * ranked[:-1])
    gaps[: int(np.ceil(FAR_SHARE * len(tags))) - 1] = False
    return frozenset(names[row] for row in order[int(np.argmax(gaps)) + 1 :]) if gaps.any() else frozenset()


def _geocentric(geodetic: np.ndarray) -> np.ndarray:
    """(N, 3) directions from the middle of the Earth, times its radius, m; heights do not count. A sphere is
    near enough to tell sites apart.
    """
    latitude, longitude = np.radians(geodetic[:, :2]).T
    flat = np.cos(latitude)
    return EARTH_RADIUS * np.stack(
        [flat * np.cos(longitude), flat * np.sin(longitude), np.sin(latitude)], axis=1
    )


def _coarse(tags: dict[str, Geotag], level: int) -> dict[str, Geotag]:
    """The tags; where all positions are cut to a coarse step, such as whole seconds, with the deviation that
    this makes.
    """
    angles = np.array([tag.geodetic[:2] for tag in tags.values()]).reshape(-1, 2)
    step = METERS_PER_DEGREE * coarse_step(angles) if len(tags) >= MIN_GPS else 0.0
    sigma = step / np.sqrt(12)
    if sigma <= max(STANDARD_DEVIATION):
        return tags
    logger.log(level, "all GPS positions are cut to steps of %.0f m: they place the model no better", step)
    return {
        name: replace(tag, deviation=tag.deviation or (sigma, sigma, STANDARD_DEVIATION[2]))
        for name, tag in tags.items()
    }


def _shape(tags: dict[str, Geotag], origin: tuple[float, float, float]) -> str:
    """`flight_shape` of some geotags."""
    sigma = np.median([tag.sigma for tag in tags.values()], axis=0)
    return flight_shape(enu_positions(tags, origin), float(sigma[:2].mean()))


def agree(flight: Flight, centers: dict[str, np.ndarray]) -> Flight | None:
    """The flight without the photos whose GPS does not fit the cameras, with the shape and the origin that
    are left; the same flight if all fit.

    centers: camera center (3,) by photo name, in any frame
    returns: None, with a warning, where GPS and cameras do not fit, or too little is left
    """
    names = [name for name in flight.tags if name in centers]
    if len(names) < MIN_GPS:
        logger.warning("only %d registered photos have GPS: it is not used", len(names))
        return None
    source, distance, kept = _fitted(flight, names, centers)
    exchanged = 0.0 if kept.all() else _share_exchanged(flight, names, source)
    if kept.sum() < max(MIN_GPS, len(names) / 2) or exchanged > kept.mean():
        logger.warning(
            "GPS of %d of %d registered photos does not fit the cameras, it is not used%s",
            len(names) - kept.sum(),
            len(names),
            ": with latitude and longitude exchanged it would fit" if exchanged > 0.5 else "",
        )
        return None
    if kept.all() and not flight.astray:
        return flight
    wrong = np.array(names)[~kept].tolist()
    if wrong:
        logger.warning(
            "GPS of %d of %d photos is wrong, by up to %s, and left out: %s",
            len(wrong),
            len(names),
            told_distance(float(distance[~kept].max())),
            examples(wrong),
        )
    agreed = flight.without(frozenset(wrong) | {name for name in flight.astray if name not in centers})
    if agreed.shape == "point":
        logger.warning("the GPS positions that fit the cameras lie too close together: they are not used")
        return None
    return agreed


def _fitted(
    flight: Flight, names: list[str], centers: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Camera centers (N, 3), how far each lies from its GPS when most fit, m, and (N,) bool: which fit."""
    source = np.array([centers[name] for name in names])
    target = np.array([flight.positions[name] for name in names])
    fit, kept = fit_similarity_robust(source, target, _tolerance(flight, names))
    return source, np.linalg.norm(fit.apply(source) - target, axis=1), kept


def distances(
    flight: Flight, centers: dict[str, np.ndarray]
) -> tuple[dict[str, float], dict[str, float]] | None:
    """How far, m, each camera lies from its GPS, by photo name, and those of them that GPS does not explain;
    None where it fits too few cameras to say that of the others.

    centers: camera center (3,) by photo name, in any frame
    """
    names = [name for name in flight.tags if name in centers]
    if len(names) <= MIN_GPS:
        return None
    _, distance, kept = _fitted(flight, names, centers)
    if kept.sum() <= max(MIN_GPS, len(names) / 2):
        return None
    told = dict(zip(names, distance.tolist(), strict=True))
    return told, {name: told[name] for name, fits in zip(names, kept, strict=True) if not fits}


def told_distance(meters: float) -> str:
    """A distance as it is told."""
    return f"{meters:.0f} m" if meters < 10_000 else f"{meters / 1000:.0f} km"


def _tolerance(flight: Flight, names: list[str]) -> float:
    """Distance, m, beyond which a position does not fit its camera."""
    return float(max(OUTLIER * np.median([flight.tags[name].sigma for name in names]), OUTLIER_METERS))


def _share_exchanged(flight: Flight, names: list[str], source: np.ndarray) -> float:
    """Share of the photos whose latitude and longitude, exchanged, fit camera centers (N, 3)."""
    geodetic = np.array([flight.tags[name].geodetic for name in names])[:, [1, 0, 2]]
    if np.abs(geodetic[:, 0]).max() > 90:
        return 0.0
    target = geodetic_to_enu(geodetic, triple(geodetic[0]))
    return float(fit_similarity_robust(source, target, _tolerance(flight, names))[1].mean())


def place(flight: Flight, centers: dict[str, np.ndarray], up: Callable[[], np.ndarray]) -> Similarity | None:
    """Similarity from a model's frame to the flight's ENU; of a flight that has been through `agree` all
    positions count.

    centers: camera center (3,) by photo name, photos without GPS included; up: finds (3,) up in the model's
        frame, which is asked for a flight along a line
    returns: None if fewer than three cameras have GPS
    """
    names = [name for name in flight.tags if name in centers]
    if len(names) < MIN_GPS:
        return None
    source, target = (
        np.array([centers[name] for name in names]),
        np.array([flight.positions[name] for name in names]),
    )
    fit = fit_similarity(source, target)
    return _rolled(fit, target, up()) if flight.shape == "line" else fit


def _rolled(fit: Similarity, positions: np.ndarray, up: np.ndarray) -> Similarity:
    """Turn about the flight line until `up` (3,) of the model is as far up as that takes it."""
    line = np.linalg.svd(positions - positions.mean(axis=0), full_matrices=False)[2][0]
    turn, pivot = roll_upright(fit.rotation @ up, line), positions.mean(axis=0)
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
    poses = view_poses(views, scene.images)
    found = (
        find_georeference(flight, centers, lambda: settle_up(poses, scene.model.points).up, epsg)
        if flight
        else None
    )
    turn = np.array(found.local_from_world)[:3, :3] if found else np.eye(3)
    if found is not None and upside_down(poses, turn[2]):
        raise InputError(
            f"the GPS of the photos in {scene.images} would turn the cameras upside down, as where latitude and longitude are exchanged or of the wrong sign: correct it, or pass --epsg and --offset"
        )
    if found is None:
        raise InputError(
            f"the photos in {scene.images} have no GPS that fits the cameras: pass --epsg and --offset if the scene is in a CRS"
        )
    return found


def find_georeference(
    flight: Flight, centers: dict[str, np.ndarray], up: Callable[[], np.ndarray], epsg: int | None
) -> Georeference | None:
    """Georeference of a model whose photos have GPS, whatever frame it is in; the model stays as it is.

    A model in local ENU (as `reconstruct` makes it) or in a CRS is recognized; any other gets a similarity in
    front. None if GPS and cameras do not fit. up: as in `place`
    """
    crs = _in_crs(flight, centers, epsg)
    if crs is not None:
        return crs
    agreed = agree(flight, centers)
    fit = place(agreed, centers, up) if agreed else None
    if agreed is None or fit is None:
        return None
    flight = agreed
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
