"""Projects, clouds and meshes of other programs -> sparse/0, images, georeference.json, cloud.ply,
mesh.ply.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from sc3d.errors import InputError, examples
from sc3d.georeferencing.georeference import georeference_path, projected_crs, write_georeference
from sc3d.georeferencing.up_direction import tell_tilt
from sc3d.importers.clouds import CLOUDS, MESHES, UNREAD, is_mesh, read_geometry, to_open3d
from sc3d.importers.frames import frame_of_scene, near_origin, place_geometries
from sc3d.importers.model import write_project
from sc3d.importers.photos import locate_photos
from sc3d.importers.project import Project, project_files, read_project, warn_of_left_out
from sc3d.io.atomic import require_writable
from sc3d.io.clouds import write_geometry
from sc3d.io.colmap import is_model
from sc3d.io.photo_folder import find_photos, require_place
from sc3d.io.provenance import Input, PhotoFrames
from sc3d.runner import execute
from sc3d.scene.photo_names import photo_name
from sc3d.scene.scene import Scene
from sc3d.settings.reconstruction import Import, ImportCommand

NO_POINTS = np.zeros((0, 3))


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
        and path.suffix.lower() in CLOUDS | MESHES | UNREAD
        and not path.name.endswith("calibrated_camera_parameters.txt")
    )


def inputs(scene: Scene, settings: Import) -> list[Input]:
    if settings.project not in settings.cloud:
        photos = [PhotoFrames(settings.images)] if settings.images else []  # whose names and sizes count
        return [*settings.cloud, *project_files(settings.project, settings), *photos]
    # the frame of a geometry alone is that of the cameras; without any, the place is made of it
    return [*settings.cloud, *([scene.sparse, georeference_path(scene)] if is_model(scene.sparse) else [])]


def outputs(scene: Scene, settings: Import) -> list[Path]:
    geometry = [scene.mesh if is_mesh(path) else scene.cloud for path in settings.cloud]
    return ([] if settings.project in settings.cloud else [scene.sparse]) + list(dict.fromkeys(geometry))


def _without_camera(project: Project, photos: Path | None) -> dict[str, object]:
    """How many photos of the folder have no camera, and the first of them."""
    if photos is None:
        return {}
    used = {view.name for view in project.views}
    names = [name for photo in find_photos(photos) if (name := photo_name(photo, photos)) not in used]
    return {"photos_without_camera": f"{len(names)} ({examples(names)})"} if names else {}


def run(scene: Scene, settings: Import) -> dict[str, object]:
    geometries = {path: read_geometry(path) for path in settings.cloud}
    kinds = [geometry.triangles is None for geometry in geometries.values()]
    if kinds.count(True) > 1 or kinds.count(False) > 1:
        raise InputError("--cloud takes one cloud and one mesh: merge them first")
    if settings.epsg is not None:
        projected_crs(settings.epsg)
    project, photos, figures = None, None, {}
    if settings.project in settings.cloud:
        views, georeference = frame_of_scene(scene, next(iter(geometries.values())), settings.epsg)
    else:
        project, photos = locate_photos(
            near_origin(read_project(settings.project, settings), settings.epsg), settings.images
        )
        warn_of_left_out(project, settings.project)
        views, georeference = project.views, project.georeference
        if photos is not None:
            require_place(photos, scene.images)
    sparse_points = project.points if project is not None else scene.model.points if views else NO_POINTS
    placed = place_geometries(geometries, georeference, views, sparse_points, settings.epsg)
    if project is not None:
        figures = write_project(scene, project, photos, [geometry for geometry, _ in placed.values()])
        figures |= _without_camera(project, photos)
        georeference_path(scene).unlink(missing_ok=True)
    if georeference is not None and (project is not None or not georeference_path(scene).exists()):
        write_georeference(scene, georeference)
    elif project is not None:
        tell_tilt(scene)
    for geometry, _ in placed.values():
        if geometry.triangles is not None:
            scene.unconfirmed.unlink(missing_ok=True)  # it belongs to another mesh
        write_geometry(scene.cloud if geometry.triangles is None else scene.mesh, to_open3d(geometry))
    figures |= {"epsg": georeference.epsg if georeference else None}
    return figures | {
        f"{path.name}": f"{len(geometry.positions):,} points, read as {frame}"
        for path, (geometry, frame) in placed.items()
    }
