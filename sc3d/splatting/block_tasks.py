"""Where blocks are trained: one task each, here or on Dask workers. A block that is finished, or has a
checkpoint, is not begun again.

Beside the checkpoint of block 3, `3.checkpoint`, lie its Gaussians, `3.ply`, and, written last, `3.json` with
the rest: with that it is finished.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numba
import numpy as np
import torch

from sc3d.errors import InputError
from sc3d.io.json_files import read_json, write_json
from sc3d.io.provenance import peak_memory_mb
from sc3d.io.splats import read_splat_ply, write_splat_ply
from sc3d.scene.scene import Scene
from sc3d.settings.train import TrainSettings
from sc3d.splatting.blocks import MIN_POINTS, Block, merge, restrict, share_settings, views_of
from sc3d.splatting.dataset import TrainingData, scene_data
from sc3d.splatting.evaluation import held_out_scores
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.train import TrainResult, train
from sc3d.tiling.executor import Executor

GPU = {"GPU": 1}  # what a worker must offer to get a block, with --device cuda


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


def train_blocks(job: BlockJob, data: TrainingData, tasks: Executor) -> tuple[TrainResult, dict[str, object]]:
    """Train all blocks and put them together.

    returns: the result as `train` has it, with "block" in the rows of the log, the last of which is about
        "all"; exposures are means over the
        blocks; figures for the summary
    Raises InputError, before any work, for a block that fewer than two photos see.
    """
    _check(job, data)
    job.folder.mkdir(exist_ok=True)
    tasks.run(
        "blocks",
        partial(train_block, job),
        range(len(job.blocks)),
        GPU if job.settings.device == "cuda" else None,
    )
    parts = [
        Gaussians.from_arrays(read_splat_ply(_file(job, index, "ply"))[0]) for index in range(len(job.blocks))
    ]
    records = [read_json(_file(job, index, "json")) for index in range(len(job.blocks))]
    gaussians = merge(parts, list(job.blocks))
    exposures, counts = np.zeros((len(data.views), 2)), np.zeros((len(data.views), 1))
    for record in records:
        exposures[record["views"]] += record["exposures"]
        counts[record["views"]] += 1
    rows = [{"block": index, **row} for index, record in enumerate(records) for row in record["log"]]
    rows.append(_total(records, len(gaussians)))
    summary = {
        "blocks": len(parts),
        "block_photos": [len(record["views"]) for record in records],
        "block_gaussians": [len(part) for part in parts],
        "block_peak_memory_mb": [record["peak_memory_mb"] for record in records],
    }
    scores = held_out_scores(gaussians, data, job.settings)
    return TrainResult(
        gaussians, (exposures / np.maximum(counts, 1)).astype(np.float32), rows, scores
    ), summary


def train_block(job: BlockJob, index: int) -> None:
    """The task: train one block, unless it is finished."""
    if _file(job, index, "json").is_file():
        return
    data, _ = scene_data(Scene(job.scene), job.settings)
    block, views = job.blocks[index], _trained_views(job, data, job.blocks[index])
    settings = share_settings(job.settings, data, block, views)
    checkpoint = _file(job, index, "checkpoint") if settings.checkpoint_every else None
    with one_thread():
        result = train(restrict(data, block, views), settings, checkpoint, job.progress)
    write_splat_ply(_file(job, index, "ply"), result.gaussians.arrays())
    peak = peak_memory_mb()  # of the process, so a worker's earlier blocks count
    write_json(
        _file(job, index, "json"),
        {"views": views, "exposures": result.exposures.tolist(), "log": result.log, "peak_memory_mb": peak},
    )
    _file(job, index, "checkpoint").unlink(missing_ok=True)


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


def _trained_views(job: BlockJob, data: TrainingData, block: Block) -> list[int]:
    held_out = set(job.settings.held_out(len(data.views)))  # of the whole run: no block may see them
    return [view for view in views_of(data, block) if view not in held_out]


def _check(job: BlockJob, data: TrainingData) -> None:
    for index, block in enumerate(job.blocks):
        views = _trained_views(job, data, block)
        if len(views) < 2:
            raise InputError(
                f"block {index} of {len(job.blocks)} is seen by {len(views)} photos (with {MIN_POINTS} sparse points): lower --blocks"
            )


def _file(job: BlockJob, index: int, suffix: str) -> Path:
    return job.folder / f"{index}.{suffix}"


def _total(records: list[dict], num_gaussians: int) -> dict[str, object]:
    """The log's last row: means over the last rows of the blocks, sums of their steps and seconds."""
    last = [record["log"][-1] for record in records]
    means = {name: float(np.mean([row[name] for row in last])) for name in ("loss", "psnr")}
    sums = {name: sum(row[name] for row in last) for name in ("iteration", "seconds")}
    return {
        "block": "all",
        "iteration": sums["iteration"],
        **means,
        "num_gaussians": num_gaussians,
        "seconds": sums["seconds"],
    }
