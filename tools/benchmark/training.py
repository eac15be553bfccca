"""Speed of training: one iteration stage by stage, the rasterizer against the arithmetic limit, whole steps
with and without surface terms.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from sc3d.io.provenance import peak_memory_mb, reset_peak_memory
from sc3d.settings.train import TrainSettings
from sc3d.splatting import strategy
from sc3d.splatting.cpu import (
    projection,
    projection_backward,
    rasterization,
    rasterization_backward,
    tile_binning,
)
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.losses import image_loss
from sc3d.splatting.rendering import render
from sc3d.splatting.trainer import Trainer
from tools.benchmark.fragments import count_fragments
from tools.benchmark.machine import Stopwatch, fma_gflops, num_threads, use_threads
from tools.benchmark.workload import Workload

# what the renderer calls for each stage; `loss`, `adam` and `total` are timed around the calls
FUNCTIONS = {
    "project": [(projection, "project_view")],
    "sort and bin": [(tile_binning, "sort_into_tiles")],
    "forward": [(rasterization, "rasterize"), (rasterization, "collect_contributions")],
    "backward": [(rasterization_backward, "rasterize_backward")],
    "project backward": [(projection_backward, "project_backward")],
}
STAGES = ("project", "sort and bin", "forward", "loss", "backward", "project backward", "adam")
FLOPS = 54 + 82  # per slot, forward and backward, with normals and plane distance
_STEPS = 1000  # length of the pretended runs that whole steps belong to
_LATE = 0.9  # where in such a run they are: no densification, full size


class Iteration:
    """One training iteration on the first view of a workload, 7 channels: render, L1 + 0.2 SSIM, backward,
    Adam with vanishing rates.
    """

    def __init__(self, workload: Workload) -> None:
        view, photo = workload.views[0], workload.photos[0]
        copies = {name: tensor.clone() for name, tensor in workload.gaussians.parameters().items()}
        self.optimizer = strategy.adam(Gaussians(**copies), dict.fromkeys(copies, 1e-7))
        self.view = view
        self.target = (
            torch.from_numpy(np.ascontiguousarray(photo.transpose(2, 0, 1))).float().div(255).permute(1, 2, 0)
        )
        self.slopes = [
            torch.full((3, view.height, view.width), 1e-6).permute(1, 2, 0),
            torch.full((view.height, view.width), 1e-6),
        ]

    def run(self) -> dict[str, np.ndarray]:
        """Seconds of each stage, of the `rest` (autograd, allocation) and the `total`: (3,) as in
        `Stopwatch`.
        """
        watch = Stopwatch()
        with watch.watching(FUNCTIONS), watch.stage("total"):
            rendering = render(strategy.current_gaussians(self.optimizer), self.view)
            with watch.stage("loss"):
                loss = image_loss(rendering.color, self.target)
            torch.autograd.backward([loss, rendering.normal, rendering.plane_distance], [None, *self.slopes])
            with watch.stage("adam"):
                self.optimizer.step()
                self.optimizer.zero_grad(set_to_none=True)
        seconds = {stage: watch.seconds[stage] for stage in STAGES}
        return seconds | {
            "rest": watch.seconds["total"] - sum(seconds.values()),
            "total": watch.seconds["total"],
        }


def measure_training(
    workload: Workload, repeats: int, rival: Callable[[], float | None] | None = None
) -> dict[str, object]:
    """Everything about one iteration; contenders take turns, medians of `repeats` are reported.

    rival: runs another program and returns its CPU seconds per iteration at one thread; None = it failed
    """
    threads, iteration = num_threads(), Iteration(workload)
    iteration.run()  # compiles
    single, many, ceilings, others = [], [], [], []
    reset_peak_memory()
    for _ in range(repeats):
        ceilings.append([fma_gflops(), fma_gflops(threads)])
        iteration.run()  # warm again after the loop above
        with use_threads(1):
            single.append(iteration.run())
        with use_threads(threads):
            many.append(iteration.run())
        if rival is not None:
            others += [seconds for seconds in [rival()] if seconds is not None]
    record = _describe(workload) | {"threads": threads, "peak_memory_mb": peak_memory_mb()}
    record |= {
        "cpu_seconds": _medians(single, 2),
        "wall_seconds_one_thread": _medians(single, 1),
        "wall_seconds": _medians(many, 1),
    }
    record["wall_speed_up"] = record["wall_seconds_one_thread"]["total"] / record["wall_seconds"]["total"]
    record["idle_speed_up"] = record["cpu_seconds"]["total"] / float(
        np.median([_idle_seconds(run, threads) for run in many])
    )
    record["ceiling_gflops"], record["ceiling_gflops_all_threads"] = np.median(ceilings, axis=0).tolist()
    spent = record["cpu_seconds"]["forward"] + record["cpu_seconds"]["backward"]
    pixels = workload.views[0].width * workload.views[0].height
    record["gflops"] = 1e-9 * FLOPS * record["slots_per_pixel"] * pixels / spent
    record["arithmetic_fraction"] = record["gflops"] / record["ceiling_gflops"]
    if others:
        record["opensplat_cpu_seconds"] = float(np.median(others))
        record["opensplat_ratio"] = record["opensplat_cpu_seconds"] / record["cpu_seconds"]["total"]
    return record


def measure_steps(workload: Workload, repeats: int) -> dict[str, float]:
    """CPU seconds at one thread of whole training steps on the first view, late in a run, without and with
    surface terms (second view as neighbor).
    """
    with use_threads(1):
        plain, surface = _trainer(workload, plain=True), _trainer(workload, plain=False)
        for trainer in (plain, surface):  # compiles, and renders the neighbor's depth
            _timed_step(trainer)
        reset_peak_memory()
        seconds = [[_timed_step(plain), _timed_step(surface)] for _ in range(repeats)]
    plain_seconds, surface_seconds = np.median(seconds, axis=0).tolist()
    return {
        "plain_step_cpu_seconds": plain_seconds,
        "surface_step_cpu_seconds": surface_seconds,
        "surface_step_ratio": surface_seconds / plain_seconds,
        "steps_peak_memory_mb": peak_memory_mb(),
    }


def _describe(workload: Workload) -> dict[str, object]:
    view = workload.views[0]
    fragments, slots, share = count_fragments(workload.gaussians, view)
    return {
        "name": workload.name,
        "gaussians": len(workload.gaussians),
        "width": view.width,
        "height": view.height,
        "visible_share": share,
        "fragments_per_pixel": fragments,
        "slots_per_pixel": slots,
    }


def _medians(runs: list[dict[str, np.ndarray]], clock: int) -> dict[str, float]:
    return {stage: float(np.median([run[stage][clock] for run in runs])) for stage in runs[0]}


def _idle_seconds(run: dict[str, np.ndarray], threads: int) -> float:
    """Wall seconds that an iteration would take if no thread had to wait for a core: per stage the busier of
    the calling thread and the others.
    """
    return sum(
        max(own, (process - own) / max(threads - 1, 1))
        for stage, (process, _, own) in run.items()
        if stage != "total"
    )


def _trainer(workload: Workload, plain: bool) -> Trainer:
    """A trainer late in its run, with the workload's Gaussians and vanishing rates."""
    points, size = workload.gaussians.means.numpy(), len(workload.gaussians)
    settings = TrainSettings(
        iterations=_STEPS, max_gaussians=size, max_size=10_000, sh_degree=0, plain=plain, fill=False
    )
    trainer = Trainer(
        TrainingData(list(workload.views), workload.photos, points, np.zeros(points.shape, np.uint8)),
        settings,
    )
    for name, tensor in workload.gaussians.parameters().items():
        trainer.gaussians.parameters()[name].data.copy_(tensor)
    for group in trainer.optimizer.param_groups:
        group["lr"] *= 1e-6
    trainer.iteration = round(_LATE * _STEPS)
    return trainer


def _timed_step(trainer: Trainer) -> float:
    trainer.queue = [1, 0]  # the first view is next, and is not the last of a pass
    watch = Stopwatch()
    with watch.stage("step"):
        trainer.step()
    return float(watch.seconds["step"][2])
