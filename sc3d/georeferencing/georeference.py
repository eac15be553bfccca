"""Where a scene lies on Earth: `georeference.json`, and world coordinates to a projected CRS and back, point
by point.

The world of a georeferenced scene is one of two things:
- local ENU: meters east, north and up of `origin` on the plane that touches the WGS 84 ellipsoid there. This
    is not a map projection: a UTM grid
  turns against it (convergence) and stretches it (scale, curvature), so every point goes through geocentric
  coordinates;
- the CRS itself minus `offset`, as COLMAP models of other tools in large coordinates are.
`local_from_world` is a similarity in front of either, for scenes whose world is neither. Heights pass through
unchanged (ellipsoidal as the GPS gives them; drones often give others, hence `altitude_offset`).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sc3d.errors import InputError
from sc3d.io.crs import split_crs
from sc3d.io.json_files import read_json, write_json

if TYPE_CHECKING:
    import pyproj

    from sc3d.scene.scene import Scene

logger = logging.getLogger(__name__)

LARGEST = (90.0, 180.0, 1e6)  # latitude, longitude, degrees; height, m
LARGEST_STRETCH = 1.0  # per cent; a neighboring UTM zone stretches lengths by 0.3
POINTS_AT_ONCE = 1_000_000  # points per call of PROJ
IDENTITY = tuple(tuple(float(row == column) for column in range(4)) for row in range(4))


@dataclass(frozen=True)
class Georeference:
    """How the world of a scene lies in a projected CRS.

    epsg: code of a projected CRS; its axes are used in the order easting, northing
    offset: (3,) easting, northing, height near the scene, in units of the CRS: subtract it before float32
        work. Without `origin`: world = CRS - offset
    origin: latitude, longitude (degrees) and ellipsoidal height (m) of the local ENU frame, WGS 84; None =
        the world is the CRS minus `offset`
    local_from_world: (4, 4) similarity from the world to ENU (or to the CRS minus offset)
    altitude_offset: added to all heights on the way to the CRS, m
    figures: residuals of the alignment, for reports
    """

    epsg: int
    offset: tuple[float, float, float]
    origin: tuple[float, float, float] | None = None
    local_from_world: tuple[tuple[float, ...], ...] = IDENTITY
    altitude_offset: float = 0.0
    figures: dict = field(default_factory=dict)

    @cached_property
    def crs(self) -> pyproj.CRS:
        return projected_crs(self.epsg)

    @cached_property
    def unit(self) -> float:
        """Meters per unit of the CRS; heights have the same unit as eastings."""
        return float(self.crs.axis_info[0].unit_conversion_factor)

    @property
    def meters(self) -> float:
        """Meters per unit of the world."""
        matrix = np.asarray(self.local_from_world, np.float64)
        scale = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
        return scale * (self.unit if self.origin is None else 1.0)

    @property
    def is_moved(self) -> bool:
        """Whether a similarity lies between the world and ENU (or the CRS)."""
        return self.local_from_world != IDENTITY

    def to_crs(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) world to (N, 3) float64 easting, northing, height in the CRS."""
        matrix = np.asarray(self.local_from_world, np.float64)
        local = np.asarray(points, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        if self.origin is None:
            return local + self.offset + [0.0, 0.0, self.altitude_offset / self.unit]
        return np.concatenate([self._project(part, self.origin) for part in _chunks(local)])

    def from_crs(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) easting, northing, height in the CRS to (N, 3) float64 world; the inverse of `to_crs`."""
        points = np.asarray(points, np.float64)
        if self.origin is None:
            local = points - self.offset - [0.0, 0.0, self.altitude_offset / self.unit]
        else:
            local = np.concatenate([self._unproject(part, self.origin) for part in _chunks(points)])
        matrix = np.asarray(self.local_from_world, np.float64)
        return np.linalg.solve(matrix[:3, :3], (local - matrix[:3, 3]).T).T

    def _project(self, enu: np.ndarray, origin: tuple[float, float, float]) -> np.ndarray:
        latitude, longitude, height = enu_to_geodetic(enu, origin).T
        easting, northing = self._crs_from_geodetic.transform(longitude, latitude)
        return _require_finite(
            np.stack([easting, northing, (height + self.altitude_offset) / self.unit], axis=1), self.epsg
        )

    def _unproject(self, points: np.ndarray, origin: tuple[float, float, float]) -> np.ndarray:
        longitude, latitude = self._crs_from_geodetic.transform(
            points[:, 0], points[:, 1], direction="INVERSE"
        )
        geodetic = np.stack([latitude, longitude, points[:, 2] * self.unit - self.altitude_offset], axis=1)
        return geodetic_to_enu(_require_finite(geodetic, self.epsg), origin)

    @cached_property
    def _crs_from_geodetic(self) -> pyproj.Transformer:
        return _transformer("EPSG:4326", self.crs)


def from_origin(
    origin: tuple[float, float, float],
    epsg: int | None = None,
    altitude_offset: float = 0.0,
    figures: dict | None = None,
    quiet: bool = False,
) -> Georeference:
    """Georeference of a world in local ENU at `origin` (latitude, longitude, height); `epsg` None = the UTM
    zone there (WGS 84). Warns, unless `quiet`, of a CRS that is made for elsewhere or stretches lengths;
    InputError if it is both.
    """
    origin = triple(origin)
    zone = epsg or utm_epsg(origin[0], origin[1])
    here = Georeference(zone, (0.0, 0.0, 0.0), origin, altitude_offset=altitude_offset).to_crs(
        np.zeros((1, 3))
    )[0]
    offset = triple(np.round(here))
    check_area(projected_crs(zone), origin, quiet)
    return Georeference(zone, offset, origin, altitude_offset=altitude_offset, figures=figures or {})


def check_area(crs: pyproj.CRS, origin: tuple[float, float, float], quiet: bool = False) -> None:
    """A warning, unless `quiet`, where a CRS is made for elsewhere or stretches lengths at a place (latitude,
    longitude, height); InputError where it is both.
    """
    area, percent = crs.area_of_use, 100 * _stretch(crs, origin)
    here = f"the scene at latitude {origin[0]:.4f}, longitude {origin[1]:.4f}"
    name = f"EPSG:{crs.to_epsg()}"
    inside = area is None or (
        area.south <= origin[0] <= area.north
        # an area across 180 degrees has its west in the east
        and (area.west <= origin[1] or area.west > area.east)
        and (origin[1] <= area.east or (area.west > area.east and origin[1] >= area.west))
    )
    if area is not None and not inside and percent > LARGEST_STRETCH:
        raise InputError(
            f"{name} is made for {area.name}: {here} lies far outside, where it stretches lengths by {percent:.0f} %; choose the CRS of the place with --epsg"
        )
    if quiet:
        return
    if area is not None and not inside:
        logger.warning("%s is made for %s: %s lies outside", name, area.name, here)
    if inside and percent > LARGEST_STRETCH:
        logger.warning(
            "%s stretches lengths by %.0f %% at %s: areas and slopes measured in it are wrong",
            name,
            percent,
            here,
        )


def _stretch(crs: pyproj.CRS, origin: tuple[float, float, float]) -> float:
    """How much longer or shorter a meter becomes at a place, as a fraction; infinite where a CRS ends."""
    import pyproj

    with np.errstate(all="ignore"):
        try:
            factors = pyproj.Proj(crs).get_factors(origin[1], origin[0])
        except pyproj.exceptions.ProjError:
            return float("inf")
    scales = np.array([factors.tissot_semimajor, factors.tissot_semiminor])
    return float(np.abs(scales - 1).max()) if np.isfinite(scales).all() else float("inf")


def triple(values: Iterable[float]) -> tuple[float, float, float]:
    """Three numbers as Python floats; ValueError for another count."""
    first, second, third = values
    return float(first), float(second), float(third)


def with_epsg(georeference: Georeference, epsg: int | None) -> Georeference:
    """The same place in another projected CRS, None = as it is. InputError if the world is not local ENU."""
    if epsg in (None, georeference.epsg):
        return georeference
    if georeference.origin is None:
        raise InputError(
            f"the scene's own coordinates are EPSG:{georeference.epsg}: they cannot become EPSG:{epsg} here, "
            "but `sc3d export --epsg` converts them"
        )
    other = from_origin(georeference.origin, epsg)
    return replace(georeference, epsg=other.epsg, offset=other.offset)


def georeference_path(scene: Scene) -> Path:
    return scene.path / "georeference.json"


def read_georeference(scene: Scene) -> Georeference | None:
    """The scene's georeference; None if it has none. InputError if the file is broken.

    `epsg` and `offset` are enough: {"epsg": 32615, "offset": [576000, 5188000, 0]} says world = CRS - offset.
    """
    path = georeference_path(scene)
    if not path.exists():
        return None
    content = read_json(path)
    try:
        if not isinstance(content, dict):
            raise ValueError("it holds no object")
        known: dict[str, Any] = {
            name: content[name] for name in Georeference.__dataclass_fields__ if name in content
        }
        for name in ("offset", "origin"):
            if known.get(name) is not None:
                known[name] = _numbers(known[name], (3,))
        if "local_from_world" in known:
            known["local_from_world"] = tuple(
                tuple(row) for row in np.reshape(_numbers(known["local_from_world"], (4, 4)), (4, 4)).tolist()
            )
        georeference = Georeference(
            **known
            | {"epsg": int(known["epsg"]), "altitude_offset": float(known.get("altitude_offset", 0.0))}
        )
        if not np.linalg.det(np.asarray(georeference.local_from_world)[:3, :3]) > 0:
            raise ValueError("local_from_world is not a similarity")
        if georeference.origin is not None and (np.abs(georeference.origin) > LARGEST).any():
            raise ValueError("origin is not latitude, longitude and height")
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise InputError(
            f'{path} cannot be used ({error!r}): {{"epsg": 32615, "offset": [e, n, h]}} is the least it holds'
        ) from None
    projected_crs(georeference.epsg)
    return georeference


def write_georeference(scene: Scene, georeference: Georeference) -> None:
    """Write `georeference.json`; fields that say nothing are left out."""
    content = asdict(georeference)
    if not georeference.is_moved:
        del content["local_from_world"]
    write_json(georeference_path(scene), content)


def projected_crs(epsg: int) -> pyproj.CRS:
    """The projected CRS of an EPSG code; InputError for any other."""
    import pyproj

    try:
        crs = pyproj.CRS.from_epsg(epsg)
    except pyproj.exceptions.CRSError:
        raise InputError(
            f"EPSG:{epsg} is unknown: give the code of a projected CRS, such as 32615 for WGS 84 / UTM zone 15N"
        ) from None
    if crs.is_compound or len(crs.axis_info) > 2:
        horizontal = split_crs(crs)[0]
        raise InputError(
            f"EPSG:{epsg} ({crs.name}) is a CRS of heights too, which are not converted here: give its horizontal part,"
            f" {horizontal.name}" + (f", EPSG:{horizontal.to_epsg()}" if horizontal.to_epsg() else "")
        )
    if not crs.is_projected:
        raise InputError(
            f"EPSG:{epsg} ({crs.name}) is not a projected CRS: choose one with eastings and northings, such as a UTM zone"
        )
    return crs


def utm_epsg(latitude: float, longitude: float) -> int:
    """EPSG code of the UTM zone (WGS 84) of a position in degrees."""
    from pyproj.aoi import AreaOfInterest
    from pyproj.database import query_utm_crs_info

    found = query_utm_crs_info("WGS 84", AreaOfInterest(longitude, latitude, longitude, latitude))
    if not found:
        raise InputError(
            f"no UTM zone at latitude {latitude}, longitude {longitude}: choose a projected CRS with --epsg"
        )
    return int(found[0].code)


def enu_to_geodetic(enu: np.ndarray, origin: tuple[float, float, float]) -> np.ndarray:
    """(N, 3) meters east, north, up of `origin` to (N, 3) latitude, longitude (degrees), ellipsoidal height
    (m), WGS 84.
    """
    longitude, latitude, height = _topocentric(origin).transform(*np.asarray(enu, np.float64).T)
    return np.stack([latitude, longitude, height], axis=1)


def geodetic_to_enu(geodetic: np.ndarray, origin: tuple[float, float, float]) -> np.ndarray:
    """The inverse of `enu_to_geodetic`."""
    latitude, longitude, height = np.asarray(geodetic, np.float64).T
    return np.stack(_topocentric(origin).transform(longitude, latitude, height, direction="INVERSE"), axis=1)


def crs_to_geodetic(points: np.ndarray, crs: pyproj.CRS) -> np.ndarray:
    """(N, 3) easting, northing, height of a projected CRS, or longitude, latitude, height of a geographic one,
    to latitude, longitude, height (m). Heights are in the unit that the CRS states for them, whatever they are
    above; without one in that of a projected CRS, else in meters.
    """
    points = np.asarray(points, np.float64)
    crs, unit = split_crs(crs)
    if unit is None:
        unit = crs.axis_info[0].unit_conversion_factor if crs.is_projected else 1.0
    longitude, latitude = _transformer("EPSG:4326", crs).transform(
        points[:, 0], points[:, 1], direction="INVERSE"
    )
    return np.stack([latitude, longitude, points[:, 2] * unit], axis=1)


def _topocentric(origin: tuple[float, float, float]) -> pyproj.Transformer:
    import pyproj

    latitude, longitude, height = triple(origin)
    return pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={latitude!r} +lon_0={longitude!r} +h_0={height!r} "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )


def _transformer(source: str, target: pyproj.CRS) -> pyproj.Transformer:
    import pyproj

    return pyproj.Transformer.from_crs(source, target, always_xy=True)


def _chunks(points: np.ndarray) -> list[np.ndarray]:
    return np.array_split(points, max(1, -(-len(points) // POINTS_AT_ONCE)))


def _numbers(values: object, shape: tuple[int, ...]) -> tuple[float, ...]:
    array = np.asarray(values, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{shape} finite numbers are expected, not {values}")
    return tuple(array.ravel().tolist())


def _require_finite(points: np.ndarray, epsg: int) -> np.ndarray:
    if not np.isfinite(points).all():
        raise InputError(
            f"the scene lies outside the area of EPSG:{epsg}: choose the CRS of the place with --epsg"
        )
    return points
