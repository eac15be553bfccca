"""Where photos say they were taken: GPS in EXIF, and what drones write into XMP beside it."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sc3d.georeferencing.georeference import geodetic_to_enu, triple
from sc3d.io.images import open_image

# m, of GPS that states none: what positions of one flight are worth against one another
STANDARD_DEVIATION = (1.0, 1.0, 1.0)
# m; RTK states the antenna's, but shutter and antenna are neither at one time nor in one place
SMALLEST_DEVIATION = 0.05
LARGEST_DEVIATION = 100.0  # m; what is stated beyond that is a filler
ALTITUDES = (-500.0, 20_000.0)  # m; what lies beyond is a filler, such as -9999 or 4294967295
HEAD = 1 << 20  # bytes of a photo that are searched for XMP
LATITUDE_REF, LATITUDE, LONGITUDE_REF, LONGITUDE, ALTITUDE_REF, ALTITUDE, HORIZONTAL_ERROR = (
    1,
    2,
    3,
    4,
    5,
    6,
    31,
)
BELOW = (1, 3)  # of the altitude reference: below sea level; below the ellipsoid (EXIF 3.0)
GPS_BLOCK = 0x8825
RTK_FLOAT = 34  # DJI's RtkFlag: 16 = without a reference station, 34 = float, 50 = fixed
# names of the position in XMP: DJI (one with a typing error of its firmware) and Autel; Skydio, newer DJI
XMP_LATITUDE, XMP_LONGITUDE = (
    ("GpsLatitude", "Latitude"),
    ("GpsLongitude", "GpsLongtitude", "Longitude"),
)
DRONE = r"(?:drone(?:-\w+)?|Camera)"  # prefixes: DJI, Skydio, Parrot, Autel; Pix4D's of several makers
# steps that coarse positions are cut to, degrees and m; EXIF finer than the last of them is as good as XMP
COARSE_ANGLES = sorted(
    (
        unit * 10.0**-digits
        for unit, most in ((1.0, 5), (1 / 60, 3), (1 / 3600, 2))
        for digits in range(most + 1)
    ),
    reverse=True,
)
COARSE_HEIGHTS = [1.0, 0.1]
Position = tuple[float, float, float]  # latitude, longitude (degrees), altitude (m)
ON_STEP = (6e-10, 2e-4)  # degrees, m: how closely a cut value lies on its step


@dataclass(frozen=True)
class Geotag:
    """Position of a photo.

    geodetic: latitude, longitude (degrees), altitude (m; the drone decides above what)
    deviation: standard deviations east, north, up, m; None = not stated
    above_takeoff: height above the take-off point, m; None = not stated
    rtk: the position was corrected by a reference station (fixed or float solution)
    """

    geodetic: tuple[float, float, float]
    deviation: tuple[float, float, float] | None = None
    above_takeoff: float | None = None
    rtk: bool = False

    @property
    def sigma(self) -> np.ndarray:
        """(3,) standard deviations to compute with, m."""
        return np.maximum(
            STANDARD_DEVIATION if self.deviation is None else self.deviation, SMALLEST_DEVIATION
        )


def read_geotags(folder: Path, names: list[str]) -> tuple[dict[str, Geotag], dict[str, str]]:
    """Geotags of the photos (names relative to `folder`) by name, and why the others have none."""
    found = {name: _read(folder / name) for name in sorted(names)}
    tags = {name: tag for name, tag in found.items() if isinstance(tag, Geotag)}
    return tags, {name: why for name, why in found.items() if isinstance(why, str)}


def read_geotag(photo: Path) -> Geotag | None:
    """The geotag of a photo; None without a usable latitude, longitude and altitude. InputError if the file
    is not an image.
    """
    found = _read(photo)
    return found if isinstance(found, Geotag) else None


def _read(photo: Path) -> Geotag | str:
    """The geotag of a photo, or why it has none."""
    with open_image(photo) as image:
        exif = image.getexif().get_ifd(GPS_BLOCK)
    text = _xmp_text(photo)
    xmp = _drone_numbers(text)
    stated = (
        _angle(exif.get(LATITUDE), exif.get(LATITUDE_REF), "NS"),
        _angle(exif.get(LONGITUDE), exif.get(LONGITUDE_REF), "EW"),
        _signed(_number(exif.get(ALTITUDE)), exif.get(ALTITUDE_REF)),
    )
    drone = triple(
        next((xmp[name] for name in names if name in xmp), math.nan)
        for names in (XMP_LATITUDE, XMP_LONGITUDE, ("AbsoluteAltitude",))
    )
    adobe, above_takeoff = _adobe(text), xmp.get("RelativeAltitude", math.nan)
    geodetic = _finer(_measured(stated), _measured(drone))
    if not all(map(math.isfinite, geodetic)):
        geodetic = _filled(geodetic, _measured(adobe))
    if not math.isfinite(geodetic[2]) and any(map(math.isfinite, (stated[2], drone[2], adobe[2]))):
        return _unusable((*geodetic[:2], 0.0)) or "with an altitude that no photo has"
    return _unusable(geodetic) or Geotag(
        geodetic,
        _deviation(xmp, _number(exif.get(HORIZONTAL_ERROR))),
        above_takeoff if is_altitude(above_takeoff) else None,
        xmp.get("RtkFlag", 0) >= RTK_FLOAT,
    )


def is_altitude(altitude: float) -> bool:
    """Whether an altitude, m, can be one on Earth and is not a filler or nothing."""
    return ALTITUDES[0] <= altitude <= ALTITUDES[1]


def _measured(position: Position) -> Position:
    """A position without an altitude that is a filler."""
    latitude, longitude, altitude = position
    return latitude, longitude, altitude if is_altitude(altitude) else math.nan


def read_drone_xmp(photo: Path) -> dict[str, float]:
    """Numbers that a drone wrote into XMP by name, such as RelativeAltitude (m) and RtkStdLon (m); empty
    without any.
    """
    return _drone_numbers(_xmp_text(photo))


def enu_positions(tags: dict[str, Geotag], origin: tuple[float, float, float]) -> np.ndarray:
    """(N, 3) positions of the tags, in their order, m east, north, up of `origin` (latitude, longitude,
    height).
    """
    return geodetic_to_enu(np.array([tag.geodetic for tag in tags.values()]).reshape(-1, 3), origin)


def _unusable(geodetic: Position) -> str | None:
    latitude, longitude, altitude = geodetic
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        return "without a position"
    if abs(latitude) > 90 or abs(longitude) > 180:
        return "with a position that is not on Earth"
    if latitude == longitude == 0:
        return "at latitude 0, longitude 0"
    return None if math.isfinite(altitude) else "without an altitude"


def _filled(stated: Position, other: Position) -> Position:
    """Place and height of `stated`, either from `other` where it is not there."""
    latitude, longitude = (stated if all(map(math.isfinite, stated[:2])) else other)[:2]
    return latitude, longitude, stated[2] if math.isfinite(stated[2]) else other[2]


def _finer(exif: Position, drone: Position) -> Position:
    """The position in EXIF; that in XMP where EXIF holds none, or holds the same cut to a coarse step.

    Positions that differ by more than such a step stay EXIF's: programs that correct them write there.
    """
    latitude, longitude, height = _filled(exif, drone)
    step = coarse_step(np.array([exif[:2]]))
    if all(abs(fine - coarse) <= step for fine, coarse in zip(drone[:2], exif[:2])):
        latitude, longitude = drone[:2]
    step = _coarse(np.array(exif[2:]), COARSE_HEIGHTS, ON_STEP[1])
    return latitude, longitude, drone[2] if abs(drone[2] - height) <= step else height


def coarse_step(angles: np.ndarray) -> float:
    """Step, degrees, that latitudes and longitudes (N, 2) are all cut to, such as whole seconds; 0 = none."""
    return _coarse(angles, COARSE_ANGLES, ON_STEP[0])


def _coarse(values: np.ndarray, steps: list[float], tolerance: float) -> float:
    if not np.isfinite(values).all():
        return 0.0
    return next(
        (step for step in steps if (np.abs(values - np.round(values / step) * step) < tolerance).all()), 0.0
    )


def _xmp_text(photo: Path) -> str:
    with photo.open("rb") as file:
        head = file.read(HEAD)
    start = head.find(b"<x:xmpmeta")
    return head[start : head.find(b"</x:xmpmeta>", start)].decode("utf-8", "replace") if start >= 0 else ""


def _properties(text: str, prefix: str) -> dict[str, str]:
    """Values in XMP, written as attributes or as elements, by name without the prefix."""
    pairs = re.findall(rf"\b{prefix}:(\w+)\s*=\s*[\"']([^\"']*)[\"']", text)
    return dict(pairs + re.findall(rf"<{prefix}:(\w+)>([^<]*)</", text))


def _drone_numbers(text: str) -> dict[str, float]:
    numbers = {name: _number(value) for name, value in _properties(text, DRONE).items()}
    return {name: value for name, value in numbers.items() if math.isfinite(value)}


def _adobe(text: str) -> Position:
    """Position in the XMP of photo editors, such as 46,50.5614N; NaN for what is not there."""
    found = _properties(text, "exif")
    altitude = _signed(_number(found.get("GPSAltitude")), found.get("GPSAltitudeRef"))
    return (
        _written_angle(found.get("GPSLatitude", ""), "NS"),
        _written_angle(found.get("GPSLongitude", ""), "EW"),
        altitude,
    )


def _written_angle(text: str, signs: str) -> float:
    parts = text.strip().rstrip("NSEWnsew").split(",")
    return _angle([*parts, 0, 0][:3], text.strip()[-1:], signs)


def _deviation(xmp: dict[str, float], horizontal_error: float) -> tuple[float, float, float] | None:
    stated = triple(xmp.get(name, 0.0) for name in ("RtkStdLon", "RtkStdLat", "RtkStdHgt"))
    if all(0 < value < LARGEST_DEVIATION for value in stated):
        return stated
    horizontal = xmp.get("GPSXYAccuracy", horizontal_error)
    if 0 < horizontal < LARGEST_DEVIATION:  # EXIF says nothing of the height, which GPS knows half as well
        vertical = xmp.get("GPSZAccuracy", 0.0)
        return (horizontal, horizontal, vertical if 0 < vertical < LARGEST_DEVIATION else 2 * horizontal)
    return None


def _angle(parts: Any, reference: object, signs: str) -> float:
    """Degrees of (degrees, minutes, seconds), the last ones may be missing; NaN if there is none.

    signs: the letters of the reference for positive and for negative; without either of them the sign counts
    """
    try:
        numbers = [_number(part) for part in parts][:3]
    except TypeError:
        numbers = [_number(parts)]
    angle = sum(number / 60**power for power, number in enumerate(numbers)) if numbers else math.nan
    letter = (reference.decode("latin-1") if isinstance(reference, bytes) else str(reference)).strip("\0 ")
    return -abs(angle) if letter[:1].upper() == signs[1] else angle


def _signed(altitude: float, reference: object) -> float:
    """An altitude with the sign that its reference says, which may be text, a byte or a number."""
    value = reference[0] if isinstance(reference, bytes) and reference else _number(reference)
    return -abs(altitude) if value in BELOW else altitude


def _number(value: Any) -> float:
    """A number, also one written as a ratio; NaN if it is none."""
    try:
        top, _, bottom = str(value).partition("/") if isinstance(value, str) else (value, "", "")
        return float(top) / (float(bottom) if bottom else 1.0)
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan
