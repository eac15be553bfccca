"""Training: photos with known cameras and sparse points become Gaussians that lie on the surface."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sc3d.io.atomic import atomic_path
from sc3d.settings.train import TrainSettings
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.trainer import Trainer

__all__ = ["TrainResult", "TrainSettings", "TrainingData", "train", "write_log"]


@dataclass
class TrainResult:
    """gaussians: not part of an autograd graph; exposures: (V, 2) a, b per view, zero where held out; log:
    rows of
    iteration, loss, psnr, num_gaussians, seconds; metrics: psnr and ssim over the held-out views (empty
    without any)."""

    gaussians: Gaussians
    exposures: np.ndarray
    log: list[dict[str, float]]
    metrics: dict[str, float] = field(default_factory=dict)


def train(
    data: TrainingData,
    settings: TrainSettings = TrainSettings(),
    checkpoint: Path | None = None,
    progress: bool = True,
) -> TrainResult:
    """Optimize Gaussians until they look like the photos.

    checkpoint: where `settings.checkpoint_every` saves; if it exists and belongs to the same settings, the
        run continues from it exactly
    progress: False hides the bar (it is hidden anyway where stderr is no terminal)
    Raises InputError for too few views or points and for images that do not fit their views.
    """
    trainer = Trainer(data, settings)
    if checkpoint is not None and checkpoint.is_file():
        trainer.resume(checkpoint)
    with tqdm(
        total=settings.iterations,
        initial=trainer.iteration,
        disable=None if progress else True,
        unit="it",
        desc="train",
    ) as bar:
        while trainer.iteration < settings.iterations:
            row = trainer.step()
            bar.update()
            if row is not None:
                bar.set_postfix(
                    loss=f"{row['loss']:.4f}", psnr=f"{row['psnr']:.2f}", gaussians=row["num_gaussians"]
                )
            if (
                checkpoint is not None
                and settings.checkpoint_every
                and trainer.iteration % settings.checkpoint_every == 0
            ):
                trainer.save(checkpoint)
    return TrainResult(
        trainer.gaussians.detached().to("cpu"), trainer.exposures, trainer.log, trainer.evaluate()
    )


def write_log(rows: list[dict[str, float]], path: Path) -> None:
    """Write the log rows as CSV; those of `train_blocks` have a first column more."""
    with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(
            file,
            [
                *(["block"] if rows and "block" in rows[0] else []),
                "iteration",
                "loss",
                "psnr",
                "num_gaussians",
                "seconds",
            ],
        )
        writer.writeheader()
        writer.writerows(rows)
