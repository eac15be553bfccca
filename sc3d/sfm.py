"""Structure from motion: photos to cameras with pycolmap, near their GPS where it is known."""

from __future__ import annotations

import logging
import sqlite3
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager, closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from sc3d.errors import InputError, Sc3dError, left_out
from sc3d.geometry.shortlist import neighbors_by_look, neighbors_in_order
from sc3d.georeferencing.gps import Flight, read_flight
from sc3d.io.atomic import atomic_path, require_room, telling_of_full_disk, temporary_name
from sc3d.io.child_process import ChildProcess, Run, run_here
from sc3d.io.colmap import registered_images, write_model
from sc3d.io.limits import FARTHEST
from sc3d.io.progress import Progress, polled
from sc3d.io.readable_photos import readable_photos, transparent_photos
from sc3d.settings.reconstruction import Mapper, Mapping, Matching

logger = logging.getLogger(__name__)

MODEL = "model"  # folder of the largest model in that of the work; in it the others, from "2" on
# in the database: of a keypoint with its descriptor, of the matches of two photos
FEATURE_BYTES, PAIR_BYTES = 160, 20_000
MATCH_ALL = 100  # photos up to which auto matches every pair
FEW = 100  # photos up to which auto maps one after the other
MIN_MODEL = 10  # photos of a model beside another one
IN_ORDER, ALIKE = 10, 30  # partners of each photo by name and by look
# photos that each is matched with
PARTNERS: dict[Matching, int] = {"sequential": 10, "spatial": 50, "vocabulary": IN_ORDER + ALIKE}
DESCRIPTORS = 1000  # of each photo, that its look is made of


class NoModelError(Sc3dError):
    """No two photos fit together."""


def map_photos(images: Path, names: list[str], output: Path, settings: Mapping) -> dict[str, object]:
    """Photos to a COLMAP model, not yet brought to its place, in the folder `output`; returns figures.

    images: folder; names: photos relative to it
    """
    if settings.camera_model not in pycolmap.CameraModelId.__members__ or settings.camera_model == "INVALID":
        raise InputError(
            f"unknown camera model {settings.camera_model!r}: one of {', '.join(list(pycolmap.CameraModelId.__members__)[1:])}"
        )
    flight = read_flight(images, names) if settings.gps else None
    settings = replace(
        settings,
        matching=choose_matching(settings.matching, names, flight),
        mapper=choose_mapper(settings.mapper, len(names)),
    )
    if settings.matching == "spatial":
        _check_spatial(names, flight)
    output.parent.mkdir(parents=True, exist_ok=True)
    require_room(output, _database_size(len(names), settings))
    with tempfile.TemporaryDirectory(prefix=temporary_name("work"), dir=output.parent) as folder:
        work = Path(folder)
        database = work / "database.db"
        with telling_of_full_disk(output), ChildProcess("COLMAP") as colmap:
            colmap.call(begin, settings.seed, logger.isEnabledFor(logging.DEBUG))
            readable, masks = readable_photos(images, names, work)
            _extract(database, images, names, settings, readable, masks, colmap.call)
            colmap.call(_write_priors, database, flight)
            _match(database, len(names), settings, colmap.call)
            parts = map_database(
                database, readable, work, settings, len(names), flight is not None, colmap.call
            )
            reasons = _reasons(database, names, parts)
            clear = transparent_photos({name: images / name for name in reasons})
            reasons |= dict.fromkeys(clear, "wholly transparent")
        with atomic_path(output) as temporary:
            (work / MODEL).rename(temporary)
    if reasons:
        unregistered = [f"{name} ({why})" for name, why in reasons.items()]
        logger.warning(left_out(unregistered, len(names), "photos could not be registered"))
    others = {str(output / str(number)): len(part) for number, part in enumerate(parts[1:], start=2)}
    if others:
        logger.warning(
            "the photos make %d models that do not hang together; this scene is the largest. Kept: %s. A scene of"
            " each: `sc3d import MODEL OTHER_SCENE --images PHOTOS`, and `sc3d georeference OTHER_SCENE` to its place",
            len(parts),
            ", ".join(f"{model} ({count} photos)" for model, count in others.items()),
        )
    return {
        "photos": len(names),
        "registered": len(parts[0]),
        **({"other_models": others} if others else {}),
        "left_out": reasons,
    }


def begin(seed: int, verbose: bool) -> None:
    """Before all else in the process that COLMAP works in."""
    pycolmap.set_random_seed(seed)
    pycolmap.logging.minloglevel = 0 if verbose else 2


def _extract(
    database: Path,
    images: Path,
    names: list[str],
    settings: Mapping,
    readable: Path,
    masks: Path | None,
    run: Run = run_here,
) -> None:
    """Cameras from the photos in `images`, features from those in `readable` where `masks` are not 0."""
    with _polled(database, "keypoints", len(names), "features", "photo"):
        run(_extract_features, database, images, names, settings, readable, masks)


def _extract_features(
    database: Path, images: Path, names: list[str], settings: Mapping, readable: Path, masks: Path | None
) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = settings.max_size
    options.sift.max_num_features = settings.max_features
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = settings.camera_model
    pycolmap.Database.open(database).close()
    # else ids follow the threads that are done first
    pycolmap.import_images(database, images, pycolmap.CameraMode.AUTO, names, reader)
    reader.mask_path = masks or ""
    pycolmap.extract_features(
        database, readable, names, pycolmap.CameraMode.AUTO, reader, options, pycolmap.Device.cpu
    )


def _database_size(num_photos: int, settings: Mapping) -> int:
    """Bytes that the database may take: keypoints with descriptors, matches, and the journal of what is being
    written.
    """
    pairs = num_pairs(num_photos, settings.matching)
    return int(num_photos * 2 * FEATURE_BYTES * settings.max_features + PAIR_BYTES * pairs)


def _write_priors(database: Path, flight: Flight | None) -> None:
    """Replace the positions that pycolmap read from EXIF by ENU positions with their covariance; photos
    without get none.
    """
    none = np.full(3, np.nan)
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image for image in opened.read_all_images()}
        priors = {prior.corr_data_id.id: prior for prior in opened.read_all_pose_priors()}
        for image_id, image in sorted(images.items()):
            trusted = flight is not None and image.name not in flight.astray
            tag = flight.tags.get(image.name) if flight and trusted else None
            position = flight.positions.get(image.name) if flight and trusted else None
            prior = priors.get(image_id) or (pycolmap.PosePrior() if tag else None)
            if prior is None:
                continue
            prior.corr_data_id = image.data_id
            prior.position = none if position is None else position
            prior.position_covariance = np.diag(tag.sigma**2 if tag else none)
            prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
            if image_id in priors:
                opened.update_pose_prior(prior)
            else:
                opened.write_pose_prior(prior)


def choose_matching(matching: Matching, names: list[str], flight: Flight | None) -> Matching:
    """What auto stands for with these photos; anything else as it is."""
    if matching != "auto":
        return matching
    if len(names) <= MATCH_ALL:
        return "exhaustive"
    return "vocabulary" if _without_place(names, flight) else "spatial"


def choose_mapper(mapper: Mapper, num_photos: int) -> Mapper:
    """What auto stands for with so many photos; anything else as it is."""
    if mapper != "auto":
        return mapper
    return "incremental" if num_photos <= FEW else "global"


def _without_place(names: list[str], flight: Flight | None) -> list[str]:
    """Photos without GPS that can be used; all without a flight."""
    return [name for name in names if not flight or name not in flight.tags or name in flight.astray]


def _check_spatial(names: list[str], flight: Flight | None) -> None:
    without = _without_place(names, flight)
    if flight is None:
        raise InputError(
            "--matching spatial needs GPS in the photos' EXIF: use auto, exhaustive, vocabulary or sequential"
        )
    if without:
        logger.warning(
            left_out(
                without,
                len(names),
                "photos have no GPS and are matched with no other (--matching vocabulary)",
            )
        )


def num_pairs(num_photos: int, matching: Matching) -> float:
    """Photo pairs that are matched, about; auto as for photos with GPS."""
    if matching == "auto":
        matching = "exhaustive" if num_photos <= MATCH_ALL else "spatial"
    partners = PARTNERS.get(matching, num_photos)
    return num_photos * min(partners, num_photos - 1) / (2 if partners == num_photos else 1)


def _match(database: Path, num_photos: int, settings: Mapping, run: Run = run_here) -> None:
    total = num_photos * (num_photos - 1) // 2 if settings.matching == "exhaustive" else None
    with _polled(database, "two_view_geometries", total, "matching", "pair"):
        run(_match_pairs, database, settings)


def _match_pairs(database: Path, settings: Mapping) -> None:
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = settings.seed  # for each pair, whichever thread it falls to
    given = {"verification_options": verification, "device": pycolmap.Device.cpu}
    if settings.matching == "vocabulary":
        _match_alike(database, given)
    elif settings.matching == "spatial":
        nearest = pycolmap.SpatialPairingOptions()
        nearest.max_num_neighbors, nearest.max_distance = PARTNERS["spatial"], FARTHEST
        pycolmap.match_spatial(database, pairing_options=nearest, **given)
    elif settings.matching == "sequential":
        pycolmap.match_sequential(database, **given)
    else:
        pycolmap.match_exhaustive(database, **given)


def _match_alike(database: Path, given: dict[str, Any]) -> None:
    """Match photos with those most alike, and with neighbors in name order."""
    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.name)
        pairs = neighbors_in_order(len(images), IN_ORDER) | neighbors_by_look(
            [_some_descriptors(opened, image.image_id) for image in images], ALIKE
        )
    listed = database.with_name("pairs.txt")
    # by id, as COLMAP splits its lists of names at blanks
    lines = [f"{images[first].image_id} {images[second].image_id}" for first, second in sorted(pairs)]
    listed.write_text("\n".join(lines) + "\n", encoding="utf-8")
    names = {image.image_id: image.name for image in images}
    _rename(database, {image_id: str(image_id) for image_id in names})
    try:
        options = pycolmap.ImportedPairingOptions()
        options.match_list_path = listed
        pycolmap.match_image_pairs(database, pairing_options=options, **given)
    finally:
        _rename(database, names)


def _rename(database: Path, names: dict[int, str]) -> None:
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            image.name = names[image.image_id]
            opened.update_image(image)


def _some_descriptors(database: pycolmap.Database, image_id: int) -> np.ndarray:
    """(K, 128) float32 unit vectors, evenly from all features of a photo."""
    found = np.asarray(database.read_descriptors(image_id).data, np.float32)
    some = found[:: max(1, len(found) // DESCRIPTORS)]
    return some / np.maximum(np.linalg.norm(some, axis=1, keepdims=True), 1e-9)


def map_database(
    database: Path,
    images: Path,
    work: Path,
    settings: Mapping,
    num_photos: int,
    has_gps: bool,
    run: Run = run_here,
) -> list[list[str]]:
    """Models of what a COLMAP database holds: the photos of each, the largest first, which is written to `work /
    MODEL`, the next ones to folders "2", "3" ... in it; NoModelError if there is none.
    """
    with Progress(num_photos, "cameras", "photo") as bar:
        parts = run(_map, database, images, work, settings, num_photos, has_gps, step=bar.update)
    if not parts:
        raise NoModelError(
            "no two photos could be matched: they need at least 60 % overlap and texture; try a larger --max-size"
        )
    return parts


def _map(
    database: Path,
    images: Path,
    work: Path,
    settings: Mapping,
    num_photos: int,
    has_gps: bool,
    step: Callable[[], object],
) -> list[list[str]]:
    if settings.mapper == "global":
        models = pycolmap.global_mapping(database, images, work, _options_at_once(settings, num_photos))
    else:
        options = _options_in_turn(settings, num_photos, has_gps)
        models = pycolmap.incremental_mapping(database, images, work, options, next_image_callback=step)
    ordered = sorted(models.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    for number, model in enumerate(ordered, start=1):
        write_model(work / MODEL / (str(number) if number > 1 else ""), model)
    return [[image.name for image in registered_images(model)] for model in ordered]


def _options_at_once(settings: Mapping, num_photos: int) -> pycolmap.GlobalPipelineOptions:
    """Rotations of all photos, then all positions, then all together (GLOMAP: Pan et al., ECCV 2024)."""
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = settings.seed
    options.min_model_size = min(MIN_MODEL, num_photos)
    options.mapper.global_positioning.use_gpu = options.mapper.bundle_adjustment.ceres.use_gpu = False
    return options


def _options_in_turn(
    settings: Mapping, num_photos: int, has_gps: bool
) -> pycolmap.IncrementalPipelineOptions:
    """Photo after photo, near their GPS."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = settings.seed
    options.num_threads = 1  # with more, sums of larger scenes are rounded otherwise in each run
    options.use_prior_position = has_gps
    options.use_robust_loss_on_prior_position = has_gps
    options.min_model_size = min(MIN_MODEL, num_photos)
    return options


def _reasons(database: Path, names: list[str], parts: list[list[str]]) -> dict[str, str]:
    """Why photos have no pose, by name: how many matches (inliers of the two-view geometry) they share with
    photos that have one. parts: photos of each model, that of the scene first
    """
    registered = set(parts[0])
    elsewhere = {name: len(part) for part in parts[1:] for name in part}
    with pycolmap.Database.open(database) as opened:
        ids = {image.image_id: image.name for image in opened.read_all_images()}
        features = {name: opened.num_keypoints_for_image(image_id) for image_id, name in ids.items()}
        pairs, inliers = opened.read_two_view_geometry_num_inliers()
    matches: dict[str, list[tuple[int, str]]] = {}
    for pair, count in zip(pairs, inliers):
        first, second = (ids[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair))
        for name, other in ((first, second), (second, first)):
            if count:
                matches.setdefault(name, []).append((count, other))
    reasons = {}
    for name in sorted(set(names) - registered):
        found = matches.get(name, [])
        among = [match for match in found if match[1] not in registered]
        reasons[name] = f"{features.get(name, 0)} features; matches with the registered: " + _best_match(
            [match for match in found if match[1] in registered]
        )
        if among:
            reasons[name] += f"; with others that are left out: {_best_match(among)}"
        if name in elsewhere:
            reasons[name] += f"; one of {elsewhere[name]} photos that fit one another but not the rest"
    return reasons


def _best_match(matches: list[tuple[int, str]]) -> str:
    if not matches:
        return "none"
    count, other = max(matches)
    return f"{count} with {other}" + (f", fewer with {len(matches) - 1} more" if len(matches) > 1 else "")


def _polled(
    database: Path, table: str, total: int | None, description: str, unit: str
) -> AbstractContextManager[None]:
    """A context that shows how many rows a pycolmap call has written; it reports no progress itself."""

    def count() -> int | None:
        with (
            suppress(sqlite3.Error),
            closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True, timeout=0.1)) as connection,
        ):
            return connection.execute(f"select count(*) from {table}").fetchone()[0]
        return None

    return polled(Progress(total, description, unit), count)
