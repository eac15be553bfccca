"""Counted objects as map features: GeoJSON in WGS 84, or in the scene's own meters, and GeoPackage in the CRS
where pyogrio is installed.
"""

from __future__ import annotations

import importlib.util
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from sc3d.exporters.packages import load
from sc3d.exporters.projected_cloud import MapProjection
from sc3d.io.atomic import atomic_path

if TYPE_CHECKING:
    import shapely
else:
    shapely = load("shapely")

DEGREES, METERS = 9, 3  # decimals of coordinates: 0.1 mm and 1 mm
# fmt: off
FIELDS: dict[str, type] = {  # what the map shows of a feature
    "id": np.int32, "class": object, "label": np.int32, "area_m2": np.float64, "height_m": np.float64,
    "ground_m": np.float64, "confidence": np.float64, "points": np.int32, "volume_m3": np.float64,
    "instance": np.int64, "best_photo": object,
}
# fmt: on


@dataclass(frozen=True)
class Feature:
    """A building, a tree or another object.

    polygon: shapely polygon in the CRS; number: from 1, per layer; name, label: its class; area: m2 of the
        outline
    height: of its top above the ground, m; ground: z of the ground under it, m; confidence: mean of its
        points, 0 to 1; num_points: of its class; volume: between its top, as seen from above, and the
        ground, m3
    instance: its number in the cloud, 0 = it has none; photo: name of the one that shows it best, "" = none
    does
    """

    polygon: shapely.Polygon
    number: int
    name: str
    label: int
    area: float
    height: float
    ground: float
    confidence: float
    num_points: int
    volume: float
    instance: int = 0
    photo: str = ""

    def properties(self) -> dict[str, object]:
        """What the map shows, by name of the field."""
        lengths = round(self.area, 2), round(self.height, 2), round(self.ground, 2)
        values = self.number, self.name, self.label, *lengths, round(self.confidence, 3), self.num_points
        return dict(zip(FIELDS, (*values, round(self.volume, 1), self.instance, self.photo), strict=True))


def has_geopackage() -> bool:
    """True if the package that writes GeoPackages is installed."""
    return importlib.util.find_spec("pyogrio") is not None


class MapFeature(Protocol):
    """What a GeoJSON file can hold: a polygon in the CRS with a number, and what the map shows of it."""

    @property
    def polygon(self) -> shapely.Polygon: ...

    @property
    def number(self) -> int: ...

    def properties(self) -> dict[str, object]: ...


def write_geojson(path: Path, features: Sequence[MapFeature], projection: MapProjection) -> None:
    """RFC 7946: longitude and latitude, WGS 84, outer rings counter-clockwise; without a CRS the scene's
    meters, which a member of the file says.
    """
    collection: dict[str, object] = {"type": "FeatureCollection", "name": path.stem}
    if projection.crs is None:
        collection["coordinates"] = "meters in the scene's own frame, not on Earth"
    collection["features"] = [
        {
            "type": "Feature",
            "id": feature.number,
            "properties": feature.properties(),
            "geometry": {"type": "Polygon", "coordinates": _rings(feature, projection)},
        }
        for feature in features
    ]
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(collection, ensure_ascii=False) + "\n", encoding="utf-8")


def write_geopackage(path: Path, layers: dict[str, list[Feature]], projection: MapProjection) -> None:
    """One layer per kind of object, in the CRS."""
    raw = load("pyogrio.raw")
    logging.getLogger("pyogrio").setLevel(logging.WARNING)  # it reports every layer
    crs = projection.crs.to_wkt() if projection.crs else None
    with atomic_path(path) as temporary:
        for name, features in layers.items():
            rows = [feature.properties() for feature in features]
            columns: list[np.ndarray] = [
                np.array([row[field] for row in rows], dtype) for field, dtype in FIELDS.items()
            ]
            geometry = np.array([shapely.to_wkb(feature.polygon) for feature in features], object)
            options = {"driver": "GPKG", "geometry_type": "Polygon", "crs": crs, "append": temporary.exists()}
            raw.write(str(temporary), geometry, columns, list(FIELDS), layer=name, **options)


def _rings(feature: MapFeature, projection: MapProjection) -> list[list[list[float]]]:
    polygon = shapely.geometry.polygon.orient(feature.polygon)
    rings = [np.asarray(ring.coords)[:, :2] for ring in (polygon.exterior, *polygon.interiors)]
    if projection.crs is None:
        return [np.round(ring, METERS).tolist() for ring in rings]
    import pyproj

    forward = pyproj.Transformer.from_crs(projection.crs, "EPSG:4326", always_xy=True).transform
    return [np.round(np.stack(forward(*ring.T), axis=1), DEGREES).tolist() for ring in rings]
