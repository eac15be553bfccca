"""The sheet of a training: some of its photos, and what the Gaussians show in their place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from sc3d.geometry.held_out import HeldOut
from sc3d.io.images import write_image
from sc3d.scene.held_out import mean_scores
from sc3d.settings.train import TrainSettings
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.evaluation import Comparison, compare
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.trainer import TrainResult
from sc3d.view.contact_sheet import contact_sheet

NUM_ROWS = 6
"""Photos of a sheet."""
_TRAINED_ROWS = 2  # of them at least, where photos were held out


def write_training_sheet(
    path: Path, result: TrainResult, data: TrainingData, settings: TrainSettings
) -> None:
    """Write the contact sheet of a training, a picture of 1600 px width; its title says how long and how
    well. settings: `resolved`
    """
    title = f"{settings.iterations:,} iterations, {len(result.gaussians):,} Gaussians"
    if result.log:
        title += f", PSNR {result.log[-1]['psnr']:.2f} dB over the last steps"
    scores = mean_scores(result.held_out)
    for prefix, name in (("", "held-out photos"), ("sector_", "held-out sector")):
        if f"{prefix}psnr" in scores:
            psnr, ssim = scores[f"{prefix}psnr"], scores[f"{prefix}ssim"]
            title += f"; {name}: PSNR {psnr:.2f} dB, SSIM {ssim:.3f}"
    write_image(path, contact_sheet(training_rows(result.gaussians, data, settings, result.exposures), title))


def training_rows(
    gaussians: Gaussians, data: TrainingData, settings: TrainSettings, exposures: np.ndarray
) -> list[Comparison]:
    """Up to six photos spread over the flight with what training made of them, held-out ones first.

    exposures: per view as found by training, see `TrainResult`; held-out photos get what fits them best
    """
    rows = []
    for index, held_out in chosen_views(data.held_out(settings)):
        exposure = (0.0, 0.0) if settings.exposure == "none" else None if held_out else exposures[index]
        found = compare(gaussians, data.views[index], data.image(index), data.mask(index), exposure)
        rows.append(replace(found, held_out=held_out))
    return rows


def chosen_views(split: HeldOut) -> list[tuple[int, bool]]:
    """Index and whether it was held out, of the photos of a contact sheet: evenly spread, held-out ones
    first.
    """
    first = _spread(split.all, NUM_ROWS - min(_TRAINED_ROWS, len(split.trained)))
    rest = _spread(split.trained, NUM_ROWS - len(first))
    return [*((index, True) for index in first), *((index, False) for index in rest)]


def _spread(items: list[int], count: int) -> list[int]:
    """At most `count` items, evenly spread, the first and the last among them."""
    count = min(count, len(items))
    if not count:
        return []
    return [items[position] for position in np.linspace(0, len(items) - 1, count).round().astype(int)]
