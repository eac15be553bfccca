"""georeference.json for a scene that has cameras: from the GPS of its photos, from options alone, or the
present one with another CRS.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from sc3d.errors import InputError
from sc3d.georeferencing.georeference import (
    Georeference,
    from_origin,
    georeference_path,
    projected_crs,
    read_georeference,
    write_georeference,
)
from sc3d.georeferencing.gps import find_georeference, read_flight
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
        found = _changed(present, settings)
    else:
        found = _from_photos(scene, settings)
    found = replace(found, altitude_offset=settings.altitude_offset)
    write_georeference(scene, found)
    return {
        "epsg": found.epsg,
        "crs": found.crs.name,
        "world": "local ENU" if found.origin else f"CRS minus {list(found.offset)}",
        "moved": found.is_moved,
    } | ({"rms_to_gps_m": found.figures["gps"]["rms"]} if "gps" in found.figures else {})


def _changed(present: Georeference, settings: GeoreferenceOptions) -> Georeference:
    """The present georeference with the CRS of the settings."""
    if settings.epsg in (None, present.epsg):
        return present
    if present.origin is None:
        raise InputError(
            f"the scene's own coordinates are EPSG:{present.epsg}: they cannot become EPSG:{settings.epsg} here, "
            "but `sc3d export --epsg` converts them"
        )
    other = from_origin(present.origin, settings.epsg)
    return replace(present, epsg=other.epsg, offset=other.offset)


def _from_photos(scene: Scene, settings: GeoreferenceOptions) -> Georeference:
    views = [view for view in scene.model.views if scene.photo(view.name).is_file()]
    if not views:
        raise InputError(
            f"none of the photos is in {scene.images}: link their folder there, or pass --epsg and --offset"
        )
    flight = read_flight(scene.images, [view.name for view in views])
    found = (
        find_georeference(
            flight, {view.name: view.center for view in views}, scene.model.points, settings.epsg
        )
        if flight
        else None
    )
    if found is None:
        raise InputError(
            f"the photos in {scene.images} have no GPS that fits the cameras: pass --epsg and --offset if the scene is in a CRS"
        )
    return found
