"""Projects, clouds and meshes of other programs -> sparse/0, images, georeference.json, cloud.ply, mesh.ply."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import View
from sc3d.georeferencing.georeference import (
    Georeference,
    georeference_path,
    projected_crs,
    read_georeference,
    write_georeference,
)
from sc3d.importers.clouds import CLOUDS, MESHES, Geometry, is_mesh, read_geometry, to_open3d
from sc3d.importers.frames import near_origin, to_world, whole_offset
from sc3d.importers.model import guess_observations, sample, write_copy
from sc3d.importers.photos import locate_photos
from sc3d.importers.project import Project, project_files, read_project
from sc3d.io.atomic import require_writable
from sc3d.io.clouds import write_geometry
from sc3d.io.colmap import build_model, write_model
from sc3d.io.images import link_photos, require_place
from sc3d.runner import execute
from sc3d.scene.scene import Scene
from sc3d.settings.reconstruction import Import, ImportCommand


def main(command: ImportCommand) -> None:
    require_writable(command.scene)
    settings = replace(command.settings, project=command.project)
    if not command.project.exists():
        raise InputError(f"{command.project} does not exist")
    if is_geometry(command.project, settings):
        settings = replace(settings, cloud=(command.project, *settings.cloud))
    scene = Scene(command.scene)
    scene.path.mkdir(parents=True, exist_ok=True)
    execute("import_project", scene, settings, command.overwrite)


def is_geometry(path: Path, settings: Import) -> bool:
    """Whether the project is a cloud or mesh alone, for a scene that has cameras or gets them otherwise."""
    return settings.source == "cloud" or (
        settings.source == "auto"
        and path.is_file()
        and path.suffix.lower() in CLOUDS | MESHES
        and not path.name.endswith("calibrated_camera_parameters.txt")
    )


def inputs(scene: Scene, settings: Import) -> list[Path]:
    return list(settings.cloud) + (
        [] if settings.project in settings.cloud else project_files(settings.project, settings)
    )


def outputs(scene: Scene, settings: Import) -> list[Path]:
    geometry = [scene.mesh if is_mesh(path) else scene.cloud for path in settings.cloud]
    return ([] if settings.project in settings.cloud else [scene.sparse]) + list(dict.fromkeys(geometry))


def run(scene: Scene, settings: Import) -> dict[str, object]:
    geometries = {path: read_geometry(path) for path in settings.cloud}
    kinds = [geometry.triangles is None for geometry in geometries.values()]
    if kinds.count(True) > 1 or kinds.count(False) > 1:
        raise InputError("--cloud takes one cloud and one mesh: merge them first")
    if settings.epsg is not None:
        projected_crs(settings.epsg)
    if settings.project in settings.cloud:
        views, georeference, figures = *_present(scene, geometries, settings), {}
        placed = _place(geometries, georeference, views, settings)
    else:
        project, photos = locate_photos(
            near_origin(read_project(settings.project, settings), settings.epsg), settings.images
        )
        if photos is not None:
            require_place(photos, scene.images)
        placed = _place(geometries, project.georeference, project.views, settings)
        georeference, figures = (
            project.georeference,
            _write_project(scene, project, photos, [geometry for geometry, _ in placed.values()]),
        )
        georeference_path(scene).unlink(missing_ok=True)
    if georeference is not None:
        write_georeference(scene, georeference)
    for geometry, _ in placed.values():
        write_geometry(scene.cloud if geometry.triangles is None else scene.mesh, to_open3d(geometry))
    figures |= {"epsg": georeference.epsg if georeference else None}
    return figures | {
        f"{path.name}": f"{len(geometry.positions):,} points, read as {frame}"
        for path, (geometry, frame) in placed.items()
    }


def _present(
    scene: Scene, geometries: dict[Path, Geometry], settings: Import
) -> tuple[list[View], Georeference | None]:
    """Cameras and place of a scene that is there; for one without cameras, a place near its first cloud if
    that states a CRS.
    """
    has_cameras = any((scene.sparse / f"cameras{suffix}").exists() for suffix in (".bin", ".txt"))
    views, georeference = scene.model.views if has_cameras else [], read_georeference(scene)
    first = next(iter(geometries.values()))
    epsg = first.epsg or settings.epsg
    if georeference is None and not views and epsg is not None:
        georeference = Georeference(epsg, tuple(whole_offset(first.positions).tolist()))
    return views, georeference


def _place(
    geometries: dict[Path, Geometry], georeference: Georeference | None, views: list[View], settings: Import
) -> dict[Path, tuple[Geometry, str]]:
    """The geometries in the scene's world, each with what its coordinates were taken for."""
    placed = {}
    for path, geometry in geometries.items():
        positions, frame = to_world(
            geometry.positions, geometry.epsg or settings.epsg, georeference, views, str(path)
        )
        placed[path] = replace(geometry, positions=positions), frame
    return placed


def _write_project(
    scene: Scene, project: Project, photos: Path | None, geometries: list[Geometry]
) -> dict[str, object]:
    """Write cameras and points, and link the photos; returns figures."""
    points, colors, observations, told = (
        project.points,
        project.colors,
        project.observations,
        "from the project",
    )
    if not len(points) and geometries:
        positions, told = geometries[0].positions, "drawn from the cloud, seen where they are nearest"
        points, colors = sample(
            positions,
            np.full((len(positions), 3), 128, np.uint8)
            if geometries[0].colors is None
            else geometries[0].colors,
        )
        observations = None
    if observations is None:
        points, colors = sample(points, colors)
        observations, told = (
            guess_observations(project.views, points),
            told.replace("from the project", "from the project, seen where they are nearest"),
        )
    if project.model is not None and len(project.points):
        write_copy(scene.sparse, project)
    else:
        write_model(scene.sparse, build_model(project.views, points, colors, observations))
    if photos is not None:
        link_photos(photos, scene.images)
    return {
        "program": project.program,
        "photos": len(project.views),
        "points": len(points),
        "points_are": told if len(points) else "none",
        "images": str(photos.resolve()) if photos else "not found: link them to SCENE/images",
    } | project.notes
