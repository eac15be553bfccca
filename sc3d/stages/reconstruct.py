"""Photos -> sparse/0, and georeference.json where GPS or ground control points say where the scene is.

Two steps: `map_photos` takes hours and is kept; what is here brings its cameras to their place.
"""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_args

from sc3d.errors import InputError
from sc3d.georeferencing.control_points import (
    ControlPoints,
    check_accuracy,
    check_control_points,
    read_control_points,
)
from sc3d.georeferencing.georeference import (
    from_origin,
    georeference_path,
    projected_crs,
    write_georeference,
)
from sc3d.georeferencing.gps import read_flight
from sc3d.georeferencing.placement import make_level, place_model
from sc3d.io.atomic import require_writable
from sc3d.io.colmap import load_model, registered_images, write_model
from sc3d.io.images import check_photo, num_pages
from sc3d.io.json_files import read_json
from sc3d.io.photo_folder import find_photos, link_photos, unused_files
from sc3d.io.readable_photos import tell_of_transparent
from sc3d.runner import MAX_SIDECAR, execute, sidecar, up_to_date
from sc3d.scene.photo_names import photo_name
from sc3d.scene.scene import Scene
from sc3d.settings.reconstruction import Mapper, Mapping, Matching, Reconstruct, ReconstructCommand
from sc3d.sfm import MATCH_ALL, choose_mapper, choose_matching, num_pairs

logger = logging.getLogger(__name__)

MIN_SIDE = 16  # px of a photo; nothing can be matched in less


def main(command: ReconstructCommand) -> None:
    scene = Scene(command.scene)
    settings = prepare(command.photos, scene, command.reconstruct)
    reconstruct(scene, settings, command.overwrite)


def reconstruct(scene: Scene, settings: Reconstruct, overwrite: bool) -> None:
    """Both steps, of which the first is repeated only if its own settings or the photos have changed."""
    for name, step in steps(settings):
        execute(name, scene, step, overwrite)


def steps(settings: Reconstruct) -> list[tuple[str, Mapping]]:
    """Names and settings of both steps."""
    mapping = Mapping(**{field.name: getattr(settings, field.name) for field in fields(Mapping)})
    return [("map_photos", mapping), ("reconstruct", settings)]


def prepare(photos: Path, scene: Scene, settings: Reconstruct) -> Reconstruct:
    """Check all photos and control points, then make SCENE/images a link to the folder of photos. Returns the
    settings with what auto stands for (--matching, --mapper), so that finished work is known as such by what was done.
    """
    files = find_photos(photos)
    sizes = {photo_name(file, photos): check_photo(file) for file in files}
    small = [name for name, size in sizes.items() if min(size) < MIN_SIDE]
    if small:
        raise InputError(
            f"the photo {photos / small[0]} is smaller than {MIN_SIDE} px: take it out of the folder"
        )
    _tell(photos, files)
    if len(files) < 2:
        raise InputError(f"{photos} holds one photo: at least two that overlap are needed")
    clear = tell_of_transparent({name: photos / name for name in sizes}, "show nothing")
    if len(files) - len(clear) < 2:
        raise InputError(
            f"{len(clear)} of {len(files)} photos in {photos} are wholly transparent: at least two others are needed; "
            "save them without alpha if it is no mask"
        )
    _check_place(photos, sizes, settings)
    require_writable(scene.path)
    link_photos(photos, scene.images)
    return _finished(scene, settings) or replace(
        settings,
        matching=_matching(photos, list(sizes), settings),
        mapper=choose_mapper(settings.mapper, len(sizes)),
    )


def _finished(scene: Scene, settings: Reconstruct) -> Reconstruct | None:
    """The settings with the matching and the mapper that the scene's cameras were made by, whatever auto would take
    today; None if they would be made anew with these too, or nothing is left to auto.
    """
    with suppress(InputError):
        record: Any = read_json(sidecar(scene.mapped), MAX_SIDECAR)
        made = record.get("settings") if isinstance(record, dict) else None
        made = made if isinstance(made, dict) else {}
        # records from before there was a choice say nothing of the mapper
        matching: Any = made.get("matching") if settings.matching == "auto" else settings.matching
        mapper: Any = made.get("mapper", Mapping.mapper) if settings.mapper == "auto" else settings.mapper
        if matching not in get_args(Matching) or mapper not in get_args(Mapper):
            return None
        asked = replace(settings, matching=matching, mapper=mapper)
        if asked != settings and up_to_date("map_photos", scene, steps(asked)[0][1]):
            return asked
    return None


def _matching(photos: Path, names: list[str], settings: Reconstruct) -> Matching:
    """Which pairs to match, told where that is not all, or where all are many."""
    many = len(names) > MATCH_ALL
    flight = read_flight(photos, names, quiet=True) if many and settings.gps else None
    chosen = choose_matching(settings.matching, names, flight)
    pairs, fewer = (int(num_pairs(len(names), matching)) for matching in (chosen, "auto"))
    if many and settings.matching == "auto":
        why = "all have GPS" if chosen == "spatial" else "not all have GPS"
        logger.info(
            "%d photos: about %d pairs are matched (--matching %s, as %s)", len(names), pairs, chosen, why
        )
    if many and chosen == "exhaustive":
        logger.warning(
            "--matching exhaustive compares %d pairs of photos; auto would compare about %d", pairs, fewer
        )
    return chosen


def _tell(photos: Path, files: list[Path]) -> None:
    """Say what of the folder is not used."""
    others, several = unused_files(photos), [file.name for file in files if num_pages(file) > 1]
    if others:
        logger.warning("%s: left out %s", photos, others)
    if several:
        logger.warning(
            "%d TIFF files have several pages, of which the first is used: %s",
            len(several),
            ", ".join(several[:3]),
        )


def _check_place(photos: Path, sizes: dict[str, tuple[int, int]], settings: Reconstruct) -> None:
    """What would be refused after hours of work otherwise: control points and --epsg."""
    check_accuracy(settings.gcp, settings.gcp_accuracy)
    points = _control_points(settings, list(sizes))
    if settings.epsg is not None:
        projected_crs(settings.epsg)
    if points is None and settings.epsg is None:
        return
    flight = read_flight(photos, list(sizes), quiet=True) if settings.gps else None
    if points is not None:
        check_control_points(points, sizes, flight.origin if flight else None)
    origin = points.origin if points else flight.origin if flight else None
    if origin is not None:
        from_origin(origin, settings.epsg, quiet=True)


def _control_points(settings: Reconstruct, names: list[str]) -> ControlPoints | None:
    return read_control_points(settings.gcp, names) if settings.gcp else None


def inputs(scene: Scene, settings: Reconstruct) -> list[Path]:
    return [scene.images, scene.mapped] + ([settings.gcp] if settings.gcp else [])


def outputs(scene: Scene, settings: Reconstruct) -> list[Path]:
    return [scene.sparse]  # without georeference.json: photos without GPS give none


def run(scene: Scene, settings: Reconstruct) -> dict[str, object]:
    names = [photo_name(photo, scene.images) for photo in find_photos(scene.images)]
    control_points = _control_points(settings, names)
    flight = read_flight(scene.images, names, quiet=True) if settings.gps else None
    model = load_model(scene.mapped)
    try:
        placed = place_model(model, scene.images, flight, control_points, settings)
    except InputError as error:
        raise InputError(_keep(scene, error)) from None
    write_model(scene.sparse, model)
    georeference_path(scene).unlink(missing_ok=True)  # of an earlier model
    if placed.georeference is not None:
        write_georeference(scene, placed.georeference)
    registered = {image.name for image in registered_images(model)}
    return {
        "photos": len(names),
        "registered": len(registered),
        "left_out": [name for name in names if name not in registered],
    } | placed.figures


def _keep(scene: Scene, error: InputError) -> str:
    """The message of a refused alignment, whose cameras are kept without a place unless there are others."""
    if scene.sparse.exists():
        return f"{error}. The cameras that were there stay as they are"
    model = load_model(scene.mapped)
    make_level(model, scene.images)
    write_model(scene.sparse, model)
    return (
        f"{error}. The cameras are kept in {scene.sparse}, without scale and place: "
        "the same command with a better file goes on from them"
    )
