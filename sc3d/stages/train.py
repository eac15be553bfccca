"""Photos + cameras + sparse points -> gaussians.ply, the training log and a contact sheet."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import local_origin, resample, undistorted
from sc3d.io import digest, read_image
from sc3d.scene import Scene, check_photos
from sc3d.settings import Train
from sc3d.splatting.device import pick_device
from sc3d.splatting.train import TrainingData, train, write_log
from sc3d.view.sheet import write_training_sheet

CACHED_PIXELS = 500_000_000  # undistorted photos kept in memory: 1.5 GB


def inputs(scene: Scene, settings: Train) -> list[Path]:
    return [scene.images, scene.sparse]


def outputs(scene: Scene, settings: Train) -> list[Path]:
    return [scene.gaussians]


def run(scene: Scene, settings: Train) -> dict[str, object]:
    pick_device(settings.device)  # complain before the work begins
    model = scene.model
    check_photos(scene, [view.name for view in model.views])
    if len(model.points) < 10:
        raise InputError(f"{scene.sparse} has {len(model.points)} sparse points, too few to start from: run `sc3d reconstruct` with more overlap")
    origin = local_origin(model.views)
    views = [undistorted(view.shifted(origin), settings.size(max(view.width, view.height))) for view in model.views]

    @lru_cache(maxsize=max(2, CACHED_PIXELS // max(view.width * view.height for view in views)))
    def image(index: int) -> np.ndarray:
        return resample(read_image(scene.photo(model.views[index].name)), model.views[index].shifted(origin), views[index])

    checkpoint = _checkpoint(scene, settings)
    data = TrainingData(views, image, model.points - origin, model.colors, model.tracks)
    result = train(data, settings, checkpoint if settings.checkpoint_every else None)
    result.gaussians.save(scene.gaussians, [f"sc3d origin {origin[0]:.3f} {origin[1]:.3f} {origin[2]:.3f}"])
    write_log(result.log, scene.path / "train.csv")
    write_training_sheet(scene.path / "train.jpg", result, data, settings)
    checkpoint.unlink(missing_ok=True)
    last = result.log[-1] if result.log else {}
    held_out = {f"held_out_{name}": round(value, 3) for name, value in result.metrics.items()}
    return {"photos": len(views), "size": f"{views[0].width}x{views[0].height}", "gaussians": len(result.gaussians)} | {
        "psnr": round(last.get("psnr", float("nan")), 2)} | held_out


def _checkpoint(scene: Scene, settings: Train) -> Path:
    """Where this run's checkpoint lies; those of other settings, photos or cameras are removed."""
    state = hashlib.blake2b(repr((settings, digest(scene.images), digest(scene.sparse))).encode(), digest_size=8).hexdigest()
    mine = scene.path / f"train.{state}.checkpoint"
    for other in scene.path.glob("train.*.checkpoint"):
        if other != mine:
            other.unlink()
    return mine
