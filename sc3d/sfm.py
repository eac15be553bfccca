"""Structure from motion: photos to cameras with pycolmap, metric and upright where GPS is known."""

from __future__ import annotations

import logging
import sqlite3
import tempfile
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import numpy as np
import pycolmap
from tqdm import tqdm

from sc3d.errors import InputError, Sc3dError
from sc3d.io import atomic_path
from sc3d.settings import Reconstruct

logger = logging.getLogger(__name__)

MIN_GPS = 3  # a similarity transform needs three positions


def reconstruct(images: Path, names: list[str], sparse: Path, settings: Reconstruct) -> dict[str, object]:
    """Photos to a COLMAP model in `sparse`.

    images: folder; names: photos relative to it; sparse: folder to write the binary model to
    returns: summary with the registered and left-out photos, reprojection error in px, and the frame of the result
    """
    pycolmap.set_random_seed(settings.seed)
    pycolmap.logging.minloglevel = 2
    if settings.camera_model not in pycolmap.CameraModelId.__members__ or settings.camera_model == "INVALID":
        raise InputError(f"unknown camera model {settings.camera_model!r}: one of {', '.join(list(pycolmap.CameraModelId.__members__)[1:])}")
    sparse.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".work-", dir=sparse.parent) as folder:
        work = Path(folder)
        database = work / "database.db"
        _extract(database, images, names, settings)
        origin = _gps_origin(database) if settings.gps else None
        _match(database, len(names), settings, origin is not None)
        reconstruction = _map(database, images, work, settings, len(names), origin is not None)
        if origin is None:
            _level(reconstruction)
        with atomic_path(sparse) as output:
            output.mkdir()
            reconstruction.write_binary(str(output))
    return _summary(reconstruction, names, origin)


def _extract(database: Path, images: Path, names: list[str], settings: Reconstruct) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = settings.max_size
    options.sift.max_num_features = settings.max_features
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = settings.camera_model
    with _progress(database, "keypoints", len(names), "features", "photo"):
        pycolmap.extract_features(database, images, names, pycolmap.CameraMode.AUTO, reader, options, pycolmap.Device.cpu)


def _match(database: Path, num_photos: int, settings: Reconstruct, has_gps: bool) -> None:
    if settings.matching == "spatial" and not has_gps:
        raise InputError("--matching spatial needs GPS in the photos' EXIF: use exhaustive or sequential")
    match = {"exhaustive": pycolmap.match_exhaustive, "sequential": pycolmap.match_sequential, "spatial": pycolmap.match_spatial}
    num_pairs = num_photos * (num_photos - 1) // 2 if settings.matching == "exhaustive" else None
    with _progress(database, "two_view_geometries", num_pairs, "matching", "pair"):
        match[settings.matching](database, device=pycolmap.Device.cpu)


def _map(database: Path, images: Path, work: Path, settings: Reconstruct, num_photos: int, has_gps: bool) -> pycolmap.Reconstruction:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = settings.seed
    options.use_prior_position = has_gps
    options.use_robust_loss_on_prior_position = has_gps
    options.min_model_size = min(10, num_photos)
    with tqdm(total=num_photos, desc="cameras", unit="photo", disable=None) as bar:
        models = pycolmap.incremental_mapping(database, images, work, options, next_image_callback=lambda: bar.update(1))
    if not models:
        raise Sc3dError("no two photos could be matched: they need at least 60 % overlap and texture; try a larger --max-size")
    return max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))


@contextmanager
def _progress(database: Path, table: str, total: int | None, description: str, unit: str) -> Iterator[None]:
    """Show how many rows a pycolmap call has written; it reports no progress itself."""
    done = threading.Event()

    def poll() -> None:
        with tqdm(total=total, desc=description, unit=unit, disable=None) as bar:
            while not bar.disable and not done.wait(0.5):
                with suppress(sqlite3.Error), closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True, timeout=0.1)) as connection:
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


def _gps_origin(database: Path) -> list[float] | None:
    """Latitude, longitude (degrees) and altitude (m) of the first photo with GPS, the origin of pycolmap's ENU frame; None without GPS."""
    with pycolmap.Database.open(database) as opened:
        priors = sorted(opened.read_all_pose_priors(), key=lambda prior: prior.corr_data_id.id)
    positions = [prior.position for prior in priors if prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.WGS84]
    positions = [position for position in positions if np.isfinite(position).all()]
    return [float(value) for value in positions[0]] if len(positions) >= MIN_GPS else None


def _level(reconstruction: pycolmap.Reconstruction) -> None:
    """Without GPS: z up = normal of the main plane of the sparse points, towards the cameras; unit = unknown."""
    points = np.array([point.xyz for point in reconstruction.points3D.values()])
    centres = np.array([reconstruction.image(image_id).projection_center() for image_id in reconstruction.reg_image_ids()])
    middle = np.median(points, axis=0)
    near = points[np.linalg.norm(points - middle, axis=1) <= np.quantile(np.linalg.norm(points - middle, axis=1), 0.9)]
    axes = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2]
    if axes[2] @ (centres.mean(axis=0) - middle) < 0:
        axes = axes * [[1], [1], [-1]]
    axes[1] = np.cross(axes[2], axes[0])
    reconstruction.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(axes), -axes @ middle))


def _summary(reconstruction: pycolmap.Reconstruction, names: list[str], origin: list[float] | None) -> dict[str, object]:
    registered = {reconstruction.image(image_id).name for image_id in reconstruction.reg_image_ids()}
    left_out = [name for name in names if name not in registered]
    if left_out:
        logger.warning("%d of %d photos could not be registered: %s", len(left_out), len(names), ", ".join(left_out))
    return {
        "photos": len(names),
        "registered": len(registered),
        "left_out": left_out,
        "points": reconstruction.num_points3D(),
        "reprojection_error_px": round(float(reconstruction.compute_mean_reprojection_error()), 3),
        "frame": "local" if origin is None else "ENU",
        "origin_lat_lon_alt": origin,
    }
