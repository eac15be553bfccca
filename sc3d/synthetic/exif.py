"""EXIF that a drone or a camera would write: focal length, time and, if it has it, GPS."""

from __future__ import annotations

import numpy as np
import pycolmap
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from PIL.TiffImagePlugin import IFDRational

from sc3d.synthetic.flight import FOCAL_35MM

# latitude, longitude (degrees) and ellipsoid height (m) of the world's origin; x east, y north
REFERENCE = (-37.9042, 144.9886, 20.0)


def geodetic(centers: np.ndarray) -> np.ndarray:
    """Latitude, longitude (degrees) and ellipsoid height (m), (N, 3), of world positions (N, 3)."""
    return np.asarray(pycolmap.GPSTransform().enu_to_ellipsoid(np.asarray(centers, np.float64), *REFERENCE))


def photo_exif(number: int, position: np.ndarray | None) -> Image.Exif:
    """EXIF block of photo `number` taken at `position` (latitude, longitude in degrees, height in m); None =
    without GPS.
    """
    exif = Image.Exif()
    exif[Base.Make], exif[Base.Model], exif[Base.Orientation] = "sc3d", "synthetic", 1
    detail = exif.get_ifd(IFD.Exif)
    detail[Base.FocalLengthIn35mmFilm] = FOCAL_35MM
    detail[Base.FocalLength] = IFDRational(880, 100)
    detail[Base.DateTimeOriginal] = f"2025:06:21 11:{number * 3 // 60 % 60:02d}:{number * 3 % 60:02d}"
    if position is not None:
        _add_gps(exif, position)
    return exif


def _add_gps(exif: Image.Exif, position: np.ndarray) -> None:
    gps = exif.get_ifd(IFD.GPSInfo)
    gps[GPS.GPSVersionID] = b"\x02\x03\x00\x00"
    gps[GPS.GPSLatitudeRef], gps[GPS.GPSLatitude] = (
        "N" if position[0] >= 0 else "S",
        _sexagesimal(position[0]),
    )
    gps[GPS.GPSLongitudeRef], gps[GPS.GPSLongitude] = (
        "E" if position[1] >= 0 else "W",
        _sexagesimal(position[1]),
    )
    gps[GPS.GPSAltitudeRef], gps[GPS.GPSAltitude] = (
        b"\x00" if position[2] >= 0 else b"\x01",
        IFDRational(round(abs(position[2]) * 1000), 1000),
    )


def _sexagesimal(angle: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    """Degrees, minutes and seconds to a millionth of a second (0.03 mm)."""
    millionths = round(abs(angle) * 3600 * 1_000_000)
    minutes, rest = divmod(millionths, 60_000_000)
    return IFDRational(minutes // 60, 1), IFDRational(minutes % 60, 1), IFDRational(rest, 1_000_000)
