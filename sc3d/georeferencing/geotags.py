"""Where photos say they were taken: GPS in EXIF, more of it in DJI's XMP."""

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
GPS_BLOCK = 0x8825


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


def read_geotags(folder: Path, names: list[str]) -> dict[str, Geotag]:
    """Geotags of the photos (names relative to `folder`) that have one, by name."""
    found = {name: read_geotag(folder / name) for name in sorted(names)}
    return {name: tag for name, tag in found.items() if tag is not None}


def read_geotag(photo: Path) -> Geotag | None:
    """The geotag of a photo; None without a usable latitude, longitude and altitude. InputError if the file
    is not an image.
    """
    with open_image(photo) as image:
        exif = image.getexif().get_ifd(GPS_BLOCK)
    xmp = read_dji_xmp(photo)
    latitude = _angle(exif.get(LATITUDE), exif.get(LATITUDE_REF), "S")
    longitude = _angle(exif.get(LONGITUDE), exif.get(LONGITUDE_REF), "W")
    altitude = _number(exif.get(ALTITUDE))
    altitude = (
        xmp.get("AbsoluteAltitude", math.nan)
        if math.isnan(altitude)
        else -altitude
        if exif.get(ALTITUDE_REF) in (1, b"\x01")
        else altitude
    )
    geodetic = (latitude, longitude, altitude)
    if (
        not all(math.isfinite(value) for value in geodetic)
        or abs(latitude) > 90
        or abs(longitude) > 180
        or latitude == longitude == 0
    ):
        return None
    return Geotag(
        geodetic,
        _deviation(xmp, _number(exif.get(HORIZONTAL_ERROR))),
        xmp.get("RelativeAltitude"),
        xmp.get("RtkFlag", 0) >= 16,
    )


def read_dji_xmp(photo: Path) -> dict[str, float]:
    """Numbers in DJI's XMP block by name, such as RelativeAltitude (m) and RtkStdLon (m); empty without one."""
    with photo.open("rb") as file:
        head = file.read(HEAD)
    start = head.find(b"<x:xmpmeta")
    text = head[start : head.find(b"</x:xmpmeta>", start)].decode("utf-8", "replace") if start >= 0 else ""
    pairs = re.findall(r"drone-dji:(\w+)\s*=\s*[\"']([^\"']*)[\"']", text) + re.findall(
        r"<drone-dji:(\w+)>([^<]*)</drone-dji:\w+>", text
    )
    numbers = {name: _number(value) for name, value in pairs}
    return {name: value for name, value in numbers.items() if math.isfinite(value)}


def enu_positions(tags: dict[str, Geotag], origin: tuple[float, float, float]) -> np.ndarray:
    """(N, 3) positions of the tags, in their order, m east, north, up of `origin` (latitude, longitude,
    height).
    """
    return geodetic_to_enu(np.array([tag.geodetic for tag in tags.values()]).reshape(-1, 3), origin)


def _deviation(xmp: dict[str, float], horizontal_error: float) -> tuple[float, float, float] | None:
    stated = triple(xmp.get(name, 0.0) for name in ("RtkStdLon", "RtkStdLat", "RtkStdHgt"))
    if all(value > 0 for value in stated):
        return stated
    if horizontal_error > 0:  # EXIF says nothing of the height, which GPS knows about half as well
        return (horizontal_error, horizontal_error, 2 * horizontal_error)
    return None


def _angle(parts: Any, reference: object, negative: str) -> float:
    """Degrees of (degrees, minutes, seconds); NaN if there is none."""
    try:
        degrees, minutes, seconds = (_number(part) for part in parts)
    except (TypeError, ValueError):
        return math.nan
    angle = degrees + minutes / 60 + seconds / 3600
    return -angle if str(reference).strip("\0 ").upper().startswith(negative) else angle


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan
