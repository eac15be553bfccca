"""Photos + cameras + sparse points -> gaussians.ply, the training log and a contact sheet."""

from __future__ import annotations

import csv
import hashlib
import logging
from pathlib import Path

from sc3d.errors import InputError, left_out
from sc3d.geometry.blocks import split_blocks
from sc3d.io.atomic import atomic_path, claim, remove
from sc3d.io.photo_folder import find_photos
from sc3d.io.provenance import digest
from sc3d.io.readable_photos import tell_of_transparent
from sc3d.io.splats import origin_comment, write_splat_ply
from sc3d.scene.held_out import mean_scores, write_held_out
from sc3d.scene.scene import Scene, check_photos, require_views
from sc3d.settings.train import Train, TrainSettings
from sc3d.splatting.blocks import BlockJob, train_blocks
from sc3d.splatting.dataset import TrainingData, scene_data
from sc3d.splatting.device import device_type, pick_device
from sc3d.splatting.trainer import TrainResult, train
from sc3d.tiling.executor import open_executor
from sc3d.view.training_sheet import write_training_sheet

logger = logging.getLogger(__name__)

MIN_POINTS = 10  # sparse points to start from


def inputs(scene: Scene, settings: Train) -> list[Path]:
    return [scene.images, scene.sparse, *([scene.depth] if settings.fill and scene.depth.exists() else [])]


def outputs(scene: Scene, settings: Train) -> list[Path]:
    return [scene.gaussians]


def besides(scene: Scene, settings: Train) -> list[Path]:
    return [scene.path / "train.csv", scene.path / "train.jpg", scene.path / "held_out.csv"]


def run(scene: Scene, settings: Train) -> dict[str, object]:
    in_blocks = settings.blocks > 1
    if in_blocks and settings.cluster:  # whose workers may have the GPU that this machine lacks
        device = device_type(settings.device)
    else:
        device = pick_device(settings.device).type  # complain before the work begins
    training = settings.training.resolved(device)
    require_views(scene)
    check_photos(scene, [view.name for view in scene.model.views])
    _tell_of_left_out(scene)
    if len(scene.model.points) < MIN_POINTS:
        raise InputError(
            f"{scene.sparse} has {len(scene.model.points)} sparse points, too few to start from: run `sc3d reconstruct` with more overlap"
        )
    data, origin = scene_data(scene, training)
    _tell_of_held_out(data, training)
    unfinished = _unfinished(scene, settings, training)
    training = training.resolved(device, len(data.held_out(training).trained))
    if device == "cuda":
        logger.info(
            "training on a GPU: %d iterations, at most %d Gaussians, photos of %d px at most; defaults for a GPU were never measured",
            training.iterations,
            training.max_gaussians,
            max(max(view.width, view.height) for view in data.views),
        )
    if in_blocks:
        result, summary = _train_blocks(scene, settings, training, data, unfinished)
    else:
        checkpoint = unfinished if settings.checkpoint_every else None
        result, summary = train(data, training, checkpoint), {}
    write_splat_ply(scene.gaussians, result.gaussians.arrays(), [origin_comment(origin)])
    write_log(result.log, scene.path / "train.csv")
    write_held_out(scene.path / "held_out.csv", result.held_out)
    write_training_sheet(scene.path / "train.jpg", result, data, training)
    remove(unfinished)
    last = result.log[-1] if result.log else {}
    return {
        "photos": len(data.views),
        "size": f"{data.views[0].width}x{data.views[0].height}",
        "iterations": training.iterations,
        "max_gaussians": training.max_gaussians,
        "gaussians": len(result.gaussians),
        "psnr": round(last.get("psnr", float("nan")), 2),
        **{f"held_out_{name}": round(value, 3) for name, value in mean_scores(result.held_out).items()},
        **summary,
    }


def _tell_of_left_out(scene: Scene) -> None:
    known = {view.name for view in scene.model.views}
    names = [photo.relative_to(scene.images).as_posix() for photo in find_photos(scene.images)]
    unknown = [name for name in names if name not in known]
    if unknown:
        logger.info(left_out(unknown, len(names), "photos have no camera and are not used"))
    tell_of_transparent({name: scene.photo(name) for name in sorted(known)}, "teach nothing")


def _tell_of_held_out(data: TrainingData, settings: TrainSettings) -> None:
    """Say what training leaves out for a sector; InputError if hardly anything is left to start from."""
    split = data.held_out(settings)
    if not split.sector:
        return
    names = [data.views[index].name for index in split.sector]
    logger.info(left_out(names, len(data.views), "photos are held out as a sector"))
    used, total = len(data.subset(split.trained, settings.seen_by).points), len(data.points)
    if used < MIN_POINTS:
        raise InputError(
            f"{used} of {total} sparse points are seen by two photos that are not held out, too few to start from: lower --test-sector, or take a model whose points have tracks"
        )
    logger.info(
        "%d of %d sparse points are not used: fewer than 2 photos of the rest see them", total - used, total
    )
    if data.depth_maps is not None:
        logger.warning(
            "the depth maps in depth/ were made with the held-out photos too, so the sector's figures flatter: --no-fill trains without them"
        )


def write_log(rows: list[dict[str, float]], path: Path) -> None:
    """Write the rows of `TrainResult.log` as CSV; those of `train_blocks` have a first column more."""
    names = ["block"] if rows and "block" in rows[0] else []
    with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*names, "iteration", "loss", "psnr", "num_gaussians", "seconds"])
        writer.writeheader()
        writer.writerows(rows)


def _train_blocks(
    scene: Scene, settings: Train, training: TrainSettings, data: TrainingData, folder: Path
) -> tuple[TrainResult, dict[str, object]]:
    blocks = tuple(split_blocks(data.points, settings.blocks))
    here = not settings.workers and not settings.cluster
    job = BlockJob(scene.path.absolute(), training, blocks, folder.absolute(), progress=here)
    with open_executor(settings) as tasks:
        return train_blocks(job, data, tasks)


def _unfinished(scene: Scene, settings: Train, training: TrainSettings) -> Path:
    """Where this run's checkpoint lies, or the folder of its blocks; those of other settings, photos or
    cameras are removed. training: with the numbers of the device
    """
    blocks = settings.blocks if settings.blocks > 1 else 0
    state = repr((training, blocks, *map(digest, inputs(scene, settings))))
    mine = (
        scene.path
        / f"train.{hashlib.blake2b(state.encode(), digest_size=8).hexdigest()}.{'blocks' if blocks else 'checkpoint'}"
    )
    for other in [*scene.path.glob("train.*.checkpoint"), *scene.path.glob("train.*.blocks")]:
        if other != mine:
            remove(other)
    return claim(mine)
