"""Training by blocks: the ground plane is cut into boxes that share borders, each is trained on its own, and
their cores become one model. Memory is that of a block, and blocks can be trained at the same time.

A photo of a block also shows ground outside. Those pixels are left out of the loss, rather than explained by
coarse Gaussians that are dropped afterwards: such a context costs the memory and time that blocks are to
save, and what it gets wrong the block's own Gaussians would make up for. What a pixel shows is told by the
nearest sparse points that its photo sees, so a roof before the block counts as what it is: outside.

Each block is one task, here or on workers. Beside the checkpoint of block 3, `3.checkpoint`, lie its
Gaussians, `3.ply`, and, written last, `3.json` with the rest: with that it is finished and not begun again.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numba
import numpy as np
import torch

from sc3d.errors import InputError
from sc3d.geometry.blocks import Block, views_of
from sc3d.geometry.shown import enlarged, shown_cells
from sc3d.io.atomic import claim
from sc3d.io.json_files import read_json, write_json
from sc3d.io.provenance import peak_memory_mb
from sc3d.io.splats import read_splat_ply, write_splat_ply
from sc3d.scene.scene import Scene
from sc3d.settings.train import TrainSettings
from sc3d.splatting import losses
from sc3d.splatting.dataset import TrainingData, scene_data
from sc3d.splatting.device import device_type
from sc3d.splatting.evaluation import held_out_scores
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.trainer import TrainResult, train
from sc3d.tiling.executor import Executor

GPU = {"GPU": 1.0}  # what a worker must offer to get a block, with --device cuda


@dataclass(frozen=True)
class BlockJob:
    """What every block's task needs to know. settings: of the whole run; blocks: all of them; folder: for
    what the tasks write; progress: show a bar
    """

    scene: Path
    settings: TrainSettings
    blocks: tuple[Block, ...]
    folder: Path
    progress: bool = True

    def file(self, index: int, suffix: str) -> Path:
        """Of what a block's task writes."""
        return self.folder / f"{index}.{suffix}"

    def views(self, data: TrainingData, index: int) -> list[int]:
        """Those that a block is trained on."""
        trained = set(data.held_out(self.settings).trained)  # of the whole run: no block may see the rest
        return [view for view in views_of(self.blocks[index], data.points, data.sightings) if view in trained]


def train_blocks(job: BlockJob, data: TrainingData, tasks: Executor) -> tuple[TrainResult, dict[str, object]]:
    """Train all blocks and put them together.

    returns: the result as `train` has it, with "block" in the rows of the log, the last of which is about
        "all"; exposures are means over the blocks; figures for the summary
    Raises InputError, before any work, for a block that fewer than two photos see.
    """
    indices = range(len(job.blocks))
    for index in indices:
        if len(job.views(data, index)) < 2:
            raise InputError(
                f"block {index} of {len(indices)} is seen by fewer than 2 photos that are trained on: lower --blocks"
            )
    claim(job.folder).mkdir(exist_ok=True)
    tasks.run("blocks", partial(train_block, job), indices, GPU if job.settings.device == "cuda" else None)
    parts = [Gaussians.from_arrays(read_splat_ply(job.file(index, "ply"))[0]) for index in indices]
    records = [cast(dict[str, Any], read_json(job.file(index, "json"))) for index in indices]
    gaussians = merge(parts, list(job.blocks))
    size = losses.EXPOSURE_SIZES[job.settings.exposure]
    exposures, counts = np.zeros((len(data.views), size)), np.zeros((len(data.views), 1))
    for record in records:
        exposures[record["views"]] += record["exposures"]
        counts[record["views"]] += 1
    exposures = (exposures / np.maximum(counts, 1)).astype(np.float32)
    rows = [{"block": index, **row} for index, record in enumerate(records) for row in record["log"]]
    rows.append(_total(records, len(gaussians)))
    summary = {
        "blocks": len(parts),
        "block_photos": [len(record["views"]) for record in records],
        "block_gaussians": [len(part) for part in parts],
        "block_peak_memory_mb": [record["peak_memory_mb"] for record in records],
    }
    return TrainResult(gaussians, exposures, rows, held_out_scores(gaussians, data, job.settings)), summary


def train_block(job: BlockJob, index: int) -> None:
    """The task: train one block, unless it is finished."""
    if job.file(index, "json").is_file():
        return
    data, _ = scene_data(Scene(job.scene), job.settings)
    block, views = job.blocks[index], job.views(data, index)
    settings, checkpoint = share_settings(job.settings, data, block, views), job.file(index, "checkpoint")
    with one_thread():
        part = restrict(data, block, views, job.settings.seen_by)
        result = train(part, settings, checkpoint if settings.checkpoint_every else None, job.progress)
    write_splat_ply(job.file(index, "ply"), result.gaussians.arrays())
    record = {"views": views, "exposures": result.exposures.tolist(), "log": result.log}
    # the peak is that of the process, so a worker's earlier blocks count
    write_json(job.file(index, "json"), {**record, "peak_memory_mb": peak_memory_mb()})
    checkpoint.unlink(missing_ok=True)


@contextmanager
def one_thread() -> Iterator[None]:
    """Blocks are what runs side by side, and the last digits of a training depend on the number of its
    threads: with one, all workers agree.
    """
    before = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])


def restrict(data: TrainingData, block: Block, views: list[int], seen_by: int = 0) -> TrainingData:
    """What a block is trained on: its views, the sparse points in core and border (that at least `seen_by` of
    the views see), masks of the pixels that show those.
    """
    part = data.subset(views, seen_by)
    near = block.holds(part.points, border=True)
    shown = [
        shown_cells(view, part.points[rows], near[rows])
        for view, rows in zip(part.views, part.sightings, strict=True)
    ]

    def mask(row: int) -> np.ndarray:
        found, own = enlarged(shown[row], part.views[row]), part.mask(row)
        return found if own is None else found & own

    return replace(part.with_points(near), masks=mask)


def share_settings(
    settings: TrainSettings, data: TrainingData, block: Block, views: list[int]
) -> TrainSettings:
    """Settings of one block: its share of the steps, by views, and of the Gaussians, by sparse points with
    those in the border.

    So each photo is looked at as often as without blocks, and all cores together hold about `max_gaussians`.
    """
    num_views = len(data.held_out(settings).trained)
    settings = settings.resolved(device_type(settings.device), num_views)
    iterations = max(1, round(settings.iterations * len(views) / num_views))
    share = float(block.holds(data.points, border=True).mean())
    max_gaussians = max(1, round(settings.max_gaussians * share))
    own = replace(settings, iterations=iterations, max_gaussians=max_gaussians)
    return replace(own, test_every=0, test_sector=0.0)


def merge(parts: list[Gaussians], blocks: list[Block]) -> Gaussians:
    """The Gaussians of every part whose centers lie in the core of its block, in the order of the blocks."""
    cores = [
        part[torch.from_numpy(block.holds(part.means.numpy()))].parameters()
        for part, block in zip(parts, blocks, strict=True)
    ]
    return Gaussians(**{name: torch.cat([core[name] for core in cores]) for name in cores[0]})


def _total(records: list[dict], num_gaussians: int) -> dict[str, object]:
    """The log's last row: means over the last rows of the blocks, sums of their steps and seconds."""
    last = [record["log"][-1] for record in records]
    means = {name: float(np.mean([row[name] for row in last])) for name in ("loss", "psnr")}
    iterations, seconds = (sum(row[name] for row in last) for name in ("iteration", "seconds"))
    row = {"block": "all", "iteration": iterations, **means}
    return row | {"num_gaussians": num_gaussians, "seconds": seconds}
