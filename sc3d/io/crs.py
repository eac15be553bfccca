"""The CRS of files: its horizontal part, and the unit of the heights; in LAS by WKT or GeoTIFF keys.

Keys: http://geotiff.maptools.org/spec/geotiff6.html: 3072 is the projected CRS, 3076 its unit, 4096 the
vertical CRS, 4099 the unit of heights; 32767 = defined elsewhere.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from sc3d.errors import InputError

if TYPE_CHECKING:
    import laspy
    import pyproj
    from pyproj._crs import Axis

logger = logging.getLogger(__name__)

VERTICAL_CRS, VERTICAL_UNIT = 4096, 4099
USER_DEFINED = 32767
SURE = 70  # of 100, how like an EPSG entry a CRS must be to have its code


class FileCrs(NamedTuple):
    """epsg: code of the horizontal CRS, None = not stated; height_scale: what turns heights into its unit."""

    epsg: int | None = None
    height_scale: float = 1.0


def read_las_crs(header: laspy.LasHeader, path: Path) -> FileCrs:
    """The CRS of a LAS file; InputError for one in degrees; a warning for one that cannot be used."""
    import pyproj

    try:
        crs = header.parse_crs()
    except (pyproj.exceptions.CRSError, ValueError, IndexError, KeyError) as error:
        logger.warning("%s: its CRS cannot be understood and is not used: %s", path, str(error)[:120])
        return FileCrs()
    if crs is None:
        return FileCrs()
    return describe_crs(crs, path, _unit_of_keys(header))


def describe_crs(crs: pyproj.CRS, path: Path, height_unit: float | None = None) -> FileCrs:
    """What a CRS says. height_unit: meters, of a file that states it elsewhere."""
    crs, unit_of_heights = split_crs(crs)
    height_unit = unit_of_heights or height_unit
    if crs.is_geographic or crs.is_geocentric:
        kind = "in degrees" if crs.is_geographic else "geocentric"
        raise InputError(f"{path} is in {crs.name}, {kind}: convert it to a projected CRS first")
    epsg = crs.to_epsg(min_confidence=SURE)
    if epsg is None:
        logger.warning(
            "%s is in %r, which has no EPSG code: its CRS is not used, --epsg says which it is",
            path,
            crs.name,
        )
    unit = float(crs.axis_info[0].unit_conversion_factor) if crs.axis_info else 1.0
    scale = 1.0 if height_unit is None else height_unit / unit
    if abs(scale - 1) > 1e-9:
        logger.info("%s: heights are in another unit than eastings: multiplied by %.7g", path, scale)
        return FileCrs(epsg, scale)
    return FileCrs(epsg)


def split_crs(crs: pyproj.CRS) -> tuple[pyproj.CRS, float | None]:
    """The horizontal part of a CRS, be it compound, bound to another by TOWGS84, or with heights of its
    own; and meters per unit of its heights, negative if it counts depths, None = it does not say.
    """
    crs = _unbound(crs)
    if crs.is_compound:
        horizontal, vertical = (_unbound(part) for part in crs.sub_crs_list[:2])
        return horizontal, _meters_up(vertical.axis_info[0])
    if crs.is_geocentric or len(crs.axis_info) < 3:
        return crs, None
    return crs.to_2d(), _meters_up(crs.axis_info[2])


def _meters_up(axis: Axis) -> float:
    return float(axis.unit_conversion_factor) * (-1 if axis.direction == "down" else 1)


def _unbound(crs: pyproj.CRS) -> pyproj.CRS:
    return crs.source_crs if crs.is_bound and crs.source_crs is not None else crs


def _unit_of_keys(header: laspy.LasHeader) -> float | None:
    """Meters per unit of heights by the GeoTIFF keys; None if they do not say."""
    import pyproj

    keys = {
        key.id: key.value_offset
        for record in header.vlrs
        for key in getattr(record, "geo_keys", ())
        if key.tiff_tag_location == 0
    }
    units = {int(code): unit.conv_factor for code, unit in _length_units().items()}
    if keys.get(VERTICAL_UNIT) in units:
        return units[keys[VERTICAL_UNIT]]
    code = keys.get(VERTICAL_CRS)
    try:
        return (
            None
            if code in (None, 0, USER_DEFINED)
            else float(pyproj.CRS.from_epsg(code).axis_info[0].unit_conversion_factor)
        )
    except pyproj.exceptions.CRSError:
        return None


def _length_units() -> dict:
    from pyproj.database import get_units_map

    return {unit.code: unit for unit in get_units_map(auth_name="EPSG", category="linear").values()}
