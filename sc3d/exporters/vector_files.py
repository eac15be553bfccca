"""Counted objects as map features: GeoJSON in WGS 84, or in the scene's own meters, and GeoPackage in the CRS
where pyogrio is installed.
"""

from __future__ import annotations

import importlib.util
import json
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sc3d.exporters.packages import load
from sc3d.exporters.projected_cloud import MapProjection
from sc3d.io.atomic import atomic_path

shapely = load("shapely")

DEGREES, METERS = 9, 3  # decimals of coordinates: 0.1 mm and 1 mm


@dataclass(frozen=True)
class Feature:
    """A building or a tree.

    polygon: shapely polygon in the CRS; number: from 1, per layer; name, label: its class; area: m2 of the
        outline
    height: of its top above the ground, m; ground: z of the ground under it, m; confidence: mean of its
        points, 0 to 1; num_points: of its class
    """

    polygon: object
    number: int
    name: str
    label: int
    area: float
    height: float
    ground: float
    confidence: float
    num_points: int

    def properties(self) -> dict[str, object]:
        """What the map shows, by name."""
        return {
            "id": self.number,
            "class": self.name,
            "label": self.label,
            "area_m2": round(self.area, 2),
            "height_m": round(self.height, 2),
            "ground_m": round(self.ground, 2),
            "confidence": round(self.confidence, 3),
            "points": self.num_points,
        }


def has_geopackage() -> bool:
    """True if the package that writes GeoPackages is installed."""
    return importlib.util.find_spec("pyogrio") is not None


def write_geojson(path: Path, objects: list[Feature], projection: MapProjection) -> None:
    """RFC 7946: longitude and latitude, WGS 84, outer rings counter-clockwise; without a CRS the scene's
    meters, which a member of the file says.
    """
    collection: dict[str, object] = {"type": "FeatureCollection", "name": path.stem}
    if projection.crs is None:
        collection["coordinates"] = "meters in the scene's own frame, not on Earth"
    collection["features"] = [
        {
            "type": "Feature",
            "id": item.number,
            "properties": item.properties(),
            "geometry": {"type": "Polygon", "coordinates": _rings(item, projection)},
        }
        for item in objects
    ]
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(collection, ensure_ascii=False) + "\n", encoding="utf-8")


def write_geopackage(path: Path, layers: dict[str, list[Feature]], projection: MapProjection) -> None:
    """One layer per kind of object, in the CRS."""
    raw = load("pyogrio.raw")
    logging.getLogger("pyogrio").setLevel(logging.WARNING)  # it reports every layer
    types = {"id": np.int32, "class": object, "label": np.int32, "points": np.int32}
    with atomic_path(path) as temporary:
        for name, objects in layers.items():
            rows = [item.properties() for item in objects]
            fields = list(Feature(None, 0, "", 0, 0.0, 0.0, 0.0, 0.0, 0).properties())
            columns = [
                np.array([row[field] for row in rows], types.get(field, np.float64)) for field in fields
            ]
            geometry = np.array([shapely.to_wkb(item.polygon) for item in objects], object)
            raw.write(
                str(temporary),
                geometry,
                columns,
                fields,
                layer=name,
                driver="GPKG",
                geometry_type="Polygon",
                crs=projection.crs.to_wkt(),
                append=temporary.exists(),
            )


def _rings(item: Feature, projection: MapProjection) -> list[list[list[float]]]:
    polygon = shapely.geometry.polygon.orient(item.polygon)
    decimals, forward = METERS, None
    if projection.crs is not None:
        import pyproj

        decimals, forward = (
            DEGREES,
            pyproj.Transformer.from_crs(projection.crs, "EPSG:4326", always_xy=True).transform,
        )
    rings = [np.asarray(ring.coords)[:, :2] for ring in (polygon.exterior, *polygon.interiors)]
    return [
        np.round(ring if forward is None else np.stack(forward(*ring.T), axis=1), decimals).tolist()
        for ring in rings
    ]
