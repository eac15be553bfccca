"""georeference.json for a scene that has cameras: from ground control points, the GPS of its photos or options
alone, or the present one with another CRS.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from sc3d.errors import InputError
from sc3d.georeferencing.control_points import check_accuracy, read_control_points
from sc3d.georeferencing.georeference import (
    Georeference,
    georeference_path,
    projected_crs,
    read_georeference,
    with_epsg,
    write_georeference,
)
from sc3d.georeferencing.gps import georeference_photos
from sc3d.georeferencing.placement import georeference_control_points
from sc3d.io.colmap import load_model, registered_images
from sc3d.scene.scene import Scene
from sc3d.settings.reconstruction import GeoreferenceOptions


def inputs(scene: Scene, settings: GeoreferenceOptions) -> list[Path]:
    if settings.gcp is not None:
        return [scene.sparse, settings.gcp]
    return [scene.sparse] if settings.offset is not None else [scene.sparse, scene.images]  # whose GPS counts


def outputs(scene: Scene, settings: GeoreferenceOptions) -> list[Path]:
    return [georeference_path(scene)]


def run(scene: Scene, settings: GeoreferenceOptions) -> dict[str, object]:
    if settings.epsg is not None:
        projected_crs(settings.epsg)
    check_accuracy(settings.gcp, settings.gcp_accuracy)
    if settings.gcp is not None and (settings.from_gps or settings.offset is not None):
        raise InputError("--gcp, --from-gps and --offset each say where the scene is: give one of them")
    present = None if settings.from_gps or settings.gcp else read_georeference(scene)
    if settings.gcp is not None:
        found = _from_control_points(scene, settings.gcp, settings)
    elif settings.offset is not None:
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
    } | {f"rms_to_{kind}_m": figures["rms"] for kind, figures in found.figures.items()}


def _from_control_points(scene: Scene, file: Path, settings: GeoreferenceOptions) -> Georeference:
    model = load_model(scene.sparse)
    points = read_control_points(file, [image.name for image in registered_images(model)])
    return georeference_control_points(model, points, settings.epsg, settings.gcp_accuracy, scene.images)
