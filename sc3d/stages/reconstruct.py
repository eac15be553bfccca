"""Photos -> sparse/0, and georeference.json where GPS or ground control points say where the scene is."""

from __future__ import annotations

import logging
from pathlib import Path

from sc3d.errors import InputError
from sc3d.georeferencing.control_points import read_control_points
from sc3d.georeferencing.georeference import georeference_path, projected_crs, write_georeference
from sc3d.io.atomic import require_writable
from sc3d.io.images import check_photo, find_photos, left_out, link_photos, num_pages
from sc3d.runner import execute
from sc3d.scene.photo_names import photo_name
from sc3d.scene.scene import Scene
from sc3d.settings.reconstruction import Reconstruct, ReconstructCommand
from sc3d.sfm import reconstruct

logger = logging.getLogger(__name__)

MIN_SIDE = 16  # px of a photo; nothing can be matched in less


def main(command: ReconstructCommand) -> None:
    scene = Scene(command.scene)
    prepare(command.photos, scene)
    execute("reconstruct", scene, command.reconstruct, command.overwrite)


def prepare(photos: Path, scene: Scene) -> None:
    """Check all photos, then make SCENE/images a link to their folder."""
    files = find_photos(photos)
    for file in files:
        if min(check_photo(file)) < MIN_SIDE:
            raise InputError(f"the photo {file} is smaller than {MIN_SIDE} px: take it out of the folder")
    _tell(photos, files)
    if len(files) < 2:
        raise InputError(f"{photos} holds one photo: at least two that overlap are needed")
    require_writable(scene.path)
    link_photos(photos, scene.images)


def _tell(photos: Path, files: list[Path]) -> None:
    """Say what of the folder is not used."""
    others, several = left_out(photos), [file.name for file in files if num_pages(file) > 1]
    if others:
        logger.warning("%s: left out %s", photos, others)
    if several:
        logger.warning(
            "%d TIFF files have several pages, of which the first is used: %s",
            len(several),
            ", ".join(several[:3]),
        )


def inputs(scene: Scene, settings: Reconstruct) -> list[Path]:
    return [scene.images] + ([settings.gcp] if settings.gcp else [])


def outputs(scene: Scene, settings: Reconstruct) -> list[Path]:
    return [scene.sparse]  # without georeference.json: photos without GPS give none


def run(scene: Scene, settings: Reconstruct) -> dict[str, object]:
    names = [photo_name(photo, scene.images) for photo in find_photos(scene.images)]
    if settings.epsg is not None:
        projected_crs(settings.epsg)
    control_points = read_control_points(settings.gcp, names) if settings.gcp else None
    found = reconstruct(scene.images, names, scene.sparse, settings, control_points)
    georeference_path(scene).unlink(missing_ok=True)  # of an earlier model
    if found.georeference is not None:
        write_georeference(scene, found.georeference)
    return found.summary
