"""georeference.json for a scene that has cameras: from the GPS of its photos, from options alone, or the
present one with another CRS.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from sc3d.errors import InputError
from sc3d.georeferencing.georeference import (
    Georeference,
    georeference_path,
    projected_crs,
    read_georeference,
    with_epsg,
    write_georeference,
)
from sc3d.georeferencing.gps import georeference_photos
from sc3d.scene.scene import Scene
from sc3d.settings.reconstruction import GeoreferenceOptions


def inputs(scene: Scene, settings: GeoreferenceOptions) -> list[Path]:
    return [scene.sparse]


def outputs(scene: Scene, settings: GeoreferenceOptions) -> list[Path]:
    return [georeference_path(scene)]


def run(scene: Scene, settings: GeoreferenceOptions) -> dict[str, object]:
    if settings.epsg is not None:
        projected_crs(settings.epsg)
    present = None if settings.from_gps else read_georeference(scene)
    if settings.offset is not None:
        if settings.epsg is None:
            raise InputError("--offset needs --epsg: world = CRS - offset")
        found = Georeference(settings.epsg, settings.offset)
    elif present is not None:
        found = with_epsg(present, settings.epsg)
    else:
        found = georeference_photos(scene, settings.epsg)
    found = replace(found, altitude_offset=settings.altitude_offset)
    write_georeference(scene, found)
    return {
        "epsg": found.epsg,
        "crs": found.crs.name,
        "world": "local ENU" if found.origin else f"CRS minus {list(found.offset)}",
        "moved": found.is_moved,
    } | ({"rms_to_gps_m": found.figures["gps"]["rms"]} if "gps" in found.figures else {})
