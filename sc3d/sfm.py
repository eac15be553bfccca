"""Structure from motion: photos to cameras with pycolmap, metric and upright where GPS is known."""

from __future__ import annotations

import logging
import sqlite3
import tempfile
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from tqdm import tqdm

from sc3d.errors import InputError, Sc3dError
from sc3d.georeferencing.alignment import Similarity, main_plane
from sc3d.georeferencing.control_points import ControlPoints, align_to_control_points, transform
from sc3d.georeferencing.focal import anchor_focal, tells_focal
from sc3d.georeferencing.georeference import Georeference, from_origin
from sc3d.georeferencing.gps import Flight, place, read_flight, residuals
from sc3d.io.atomic import require_room, telling_of_full_disk, temporary_name
from sc3d.io.colmap import registered_images, write_model
from sc3d.io.readable_photos import readable_photos
from sc3d.settings.reconstruction import Reconstruct

logger = logging.getLogger(__name__)

# in the database: of a keypoint with its descriptor, of the matches of two photos
FEATURE_BYTES, PAIR_BYTES = 160, 20_000
# a model is moved onto its GPS if that makes the root mean square distance smaller by this factor
LOOSE = 1.1


@dataclass(frozen=True)
class Reconstructed:
    """What `reconstruct` found besides the model: figures for the summary, and where the model lies on Earth,
    if that is known.
    """

    summary: dict[str, object]
    georeference: Georeference | None


def reconstruct(
    images: Path,
    names: list[str],
    sparse: Path,
    settings: Reconstruct,
    control_points: ControlPoints | None = None,
) -> Reconstructed:
    """Photos to a COLMAP model in `sparse`: in local ENU, metric and upright, where GPS or control points
    allow it.

    images: folder; names: photos relative to it; sparse: folder to write the binary model to
    """
    pycolmap.set_random_seed(settings.seed)
    pycolmap.logging.minloglevel = 2
    if settings.camera_model not in pycolmap.CameraModelId.__members__ or settings.camera_model == "INVALID":
        raise InputError(
            f"unknown camera model {settings.camera_model!r}: one of {', '.join(list(pycolmap.CameraModelId.__members__)[1:])}"
        )
    flight = read_flight(images, names) if settings.gps else None
    if settings.matching == "spatial" and flight is None:
        raise InputError("--matching spatial needs GPS in the photos' EXIF: use exhaustive or sequential")
    sparse.parent.mkdir(parents=True, exist_ok=True)
    require_room(sparse, _database_size(len(names), settings))  # COLMAP's threads would end the process
    with tempfile.TemporaryDirectory(prefix=temporary_name("work"), dir=sparse.parent) as folder:
        work = Path(folder)
        database = work / "database.db"
        with telling_of_full_disk(database):
            readable, masks = readable_photos(images, names, work)
            _extract(database, images, names, settings, readable, masks)
            _write_priors(database, flight)
            _match(database, len(names), settings)
            model = _map(database, readable, work, settings, len(names), flight is not None)
        free = settings.focal == "refine" or (settings.focal == "auto" and tells_focal(model))
        focal = {} if free else anchor_focal(model, images, flight)
        georeference = _georeference(model, flight, control_points, settings)
        write_model(sparse, model)
    return Reconstructed(
        _summary(model, names, georeference) | focal | _heights(model, flight, georeference), georeference
    )


def _extract(
    database: Path, images: Path, names: list[str], settings: Reconstruct, readable: Path, masks: Path | None
) -> None:
    """Cameras from the photos in `images`, features from those in `readable` where `masks` are not 0."""
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = settings.max_size
    options.sift.max_num_features = settings.max_features
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = settings.camera_model
    pycolmap.Database.open(database).close()
    # else ids follow the threads that are done first
    pycolmap.import_images(database, images, pycolmap.CameraMode.AUTO, names, reader)
    reader.mask_path = masks or ""
    with _progress(database, "keypoints", len(names), "features", "photo"):
        pycolmap.extract_features(
            database, readable, names, pycolmap.CameraMode.AUTO, reader, options, pycolmap.Device.cpu
        )


def _database_size(num_photos: int, settings: Reconstruct) -> int:
    """Bytes that the database may take: keypoints with descriptors, matches, and the journal of what is being
    written.
    """
    partners = {"exhaustive": num_photos / 2, "sequential": 10, "spatial": 50}[settings.matching]
    return int(
        num_photos * (2 * FEATURE_BYTES * settings.max_features + PAIR_BYTES * min(partners, num_photos))
    )


def _write_priors(database: Path, flight: Flight | None) -> None:
    """Replace the positions that pycolmap read from EXIF by ENU positions with their covariance; photos
    without get none.
    """
    none = np.full(3, np.nan)
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image for image in opened.read_all_images()}
        priors = {prior.corr_data_id.id: prior for prior in opened.read_all_pose_priors()}
        for image_id, image in sorted(images.items()):
            tag = flight.tags.get(image.name) if flight else None
            position = flight.positions.get(image.name) if flight else None
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


def _match(database: Path, num_photos: int, settings: Reconstruct) -> None:
    match = {
        "exhaustive": pycolmap.match_exhaustive,
        "sequential": pycolmap.match_sequential,
        "spatial": pycolmap.match_spatial,
    }
    num_pairs = num_photos * (num_photos - 1) // 2 if settings.matching == "exhaustive" else None
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = settings.seed  # for each pair, whichever thread it falls to
    with _progress(database, "two_view_geometries", num_pairs, "matching", "pair"):
        match[settings.matching](database, verification_options=verification, device=pycolmap.Device.cpu)


def _map(
    database: Path, images: Path, work: Path, settings: Reconstruct, num_photos: int, has_gps: bool
) -> pycolmap.Reconstruction:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = settings.seed
    options.num_threads = 1  # with more, sums of larger scenes are rounded otherwise in each run
    options.use_prior_position = has_gps
    options.use_robust_loss_on_prior_position = has_gps
    options.min_model_size = min(10, num_photos)
    with tqdm(total=num_photos, desc="cameras", unit="photo", disable=None) as bar:
        models = pycolmap.incremental_mapping(
            database, images, work, options, next_image_callback=lambda: bar.update(1)
        )
    if not models:
        raise Sc3dError(
            "no two photos could be matched: they need at least 60 % overlap and texture; try a larger --max-size"
        )
    return max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))


@contextmanager
def _progress(database: Path, table: str, total: int | None, description: str, unit: str) -> Iterator[None]:
    """Show how many rows a pycolmap call has written; it reports no progress itself."""
    done = threading.Event()

    def poll() -> None:
        with tqdm(total=total, desc=description, unit=unit, disable=None) as bar:
            while not bar.disable and not done.wait(0.5):
                with (
                    suppress(sqlite3.Error),
                    closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True, timeout=0.1)) as connection,
                ):
                    bar.update(connection.execute(f"select count(*) from {table}").fetchone()[0] - bar.n)
            if total is not None:
                bar.update(total - bar.n)

    thread = threading.Thread(target=poll, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def _georeference(
    model: pycolmap.Reconstruction,
    flight: Flight | None,
    control_points: ControlPoints | None,
    settings: Reconstruct,
) -> Georeference | None:
    """Bring a model into local ENU, from control points or else from GPS, or make it level at least; returns
    what is then known of its place.
    """
    if control_points is not None:
        figures = align_to_control_points(model, control_points, refine_focal=tells_focal(model))
        return from_origin(
            control_points.origin,
            settings.epsg or control_points.epsg,
            settings.altitude_offset,
            {"control_points": figures},
        )
    fit = place(flight, _centers(model), _points(model)) if flight else None
    if flight is None or fit is None:
        if flight:
            logger.warning(
                "the registered photos do not fit their GPS: the model has no scale, no north and no position"
            )
        _level(model)
        return None
    moved = dict(zip(_centers(model), fit.apply(np.array(list(_centers(model).values())))))
    if (
        flight.shape == "line"
        or residuals(flight, _centers(model))["rms"] > LOOSE * residuals(flight, moved)["rms"]
    ):
        transform(model, fit)
    return from_origin(
        flight.origin, settings.epsg, settings.altitude_offset, {"gps": residuals(flight, _centers(model))}
    )


def _centers(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    """Camera center (3,) by photo name."""
    return {image.name: image.projection_center() for image in registered_images(model)}


def _points(model: pycolmap.Reconstruction) -> np.ndarray:
    return np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)


def _level(model: pycolmap.Reconstruction) -> None:
    """Without GPS: z up = normal of the main plane of the sparse points, towards the cameras; unit = unknown."""
    axes, middle = main_plane(_points(model))
    if axes[2] @ (np.mean(list(_centers(model).values()), axis=0) - middle) < 0:
        axes = axes * [[1], [-1], [-1]]
    transform(model, Similarity(1.0, axes, -axes @ middle))


def _summary(
    model: pycolmap.Reconstruction, names: list[str], georeference: Georeference | None
) -> dict[str, object]:
    registered = {model.image(image_id).name for image_id in model.reg_image_ids()}
    left_out = [name for name in names if name not in registered]
    if left_out:
        logger.warning(
            "%d of %d photos could not be registered: %s", len(left_out), len(names), ", ".join(left_out)
        )
    return {
        "photos": len(names),
        "registered": len(registered),
        "left_out": left_out,
        "points": model.num_points3D(),
        "reprojection_error_px": round(float(model.compute_mean_reprojection_error()), 3),
        "frame": "ENU" if georeference else "local",
        "origin_lat_lon_alt": list(georeference.origin) if georeference and georeference.origin else None,
        "epsg": georeference.epsg if georeference else None,
    } | _errors(georeference)


def _heights(
    model: pycolmap.Reconstruction, flight: Flight | None, georeference: Georeference | None
) -> dict[str, float]:
    """Flight height above the middle of the points, and above take-off where DJI's XMP states it, m; a
    warning where they are far apart.
    """
    if georeference is None:
        return {}
    heights = {
        "height_above_points_m": round(
            float(
                np.mean([center[2] for center in _centers(model).values()]) - np.median(_points(model)[:, 2])
            ),
            1,
        )
    }
    stated = (
        [tag.above_takeoff for tag in flight.tags.values() if tag.above_takeoff is not None] if flight else []
    )
    if stated:
        heights["height_above_takeoff_m"] = round(float(np.median(stated)), 1)
        if not 0.7 < heights["height_above_points_m"] / max(np.median(stated), 0.1) < 1.4:
            logger.warning(
                "the cameras lie %.0f m above the points, XMP says %.0f m above take-off: unless the ground is that uneven, the focal length is wrong "
                "(see --focal)",
                heights["height_above_points_m"],
                heights["height_above_takeoff_m"],
            )
    return heights


def _errors(georeference: Georeference | None) -> dict[str, object]:
    """Residuals for the summary: "rms_to_gps_m" or "rms_to_control_points_m"."""
    figures = georeference.figures if georeference else {}
    return {f"rms_to_{kind}_m": found["rms"] for kind, found in figures.items()}
