"""The GPU path against the CPU's: the same image and gradients, training to the end, time and memory of a step,
labels lifted, blocks. With `device` cpu everything runs without a GPU and compares the CPU with itself, which tests
this file only.
"""

from __future__ import annotations

import logging
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, look_at, pinhole_view
from sc3d.io.json_files import read_json, write_text
from sc3d.io.provenance import peak_memory_mb, reset_peak_memory
from sc3d.runner import MAX_SIDECAR
from sc3d.scene.scene import Scene
from sc3d.settings.synthesize import Synthesize
from sc3d.settings.train import TrainSettings
from sc3d.splatting import strategy
from sc3d.splatting.device import pick_device
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.lifting import lift
from sc3d.splatting.losses import image_loss
from sc3d.splatting.rendering import render
from sc3d.synthetic.generate import synthesize
from tools.benchmark.settings import BenchmarkGpu

logger = logging.getLogger(__name__)

SMALL = (960, 640)  # px, of what both devices render
COMPARED = 20_000  # Gaussians that both devices render
LARGEST_IMAGE, LARGEST_GRADIENT = 5e-3, 1e-2  # differences that pass: of a color, and of gradients, relative
LOST = 0.5  # dB that a training on the GPU may be below that on the CPU
AGREEING = 0.99  # share of the labelled Gaussians that must get the same class
WARM_UP = 3  # steps before any is timed
CHANNELS = 5
HEADS = ("what", "measured", "limit", "passes")


@dataclass(frozen=True)
class Row:
    """A line of the table. limit: "" = a measurement without one; passes: None likewise"""

    what: str
    measured: str
    limit: str = ""
    passes: bool | None = None

    def __str__(self) -> str:
        verdict = {None: "", True: "yes", False: "NO"}[self.passes]
        return f"| {self.what} | {self.measured} | {self.limit} | {verdict} |"


def run_gpu(command: BenchmarkGpu) -> None:
    """Measure, print the table and write it to WORKDIR/gpu.md; InputError at the end if something fails."""
    device = pick_device(command.device)
    command.workdir.mkdir(parents=True, exist_ok=True)
    rows = []
    for row in all_rows(command, device):
        logger.info("%s", row)
        rows.append(row)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "the CPU against itself"
    lines = [f"On {name}, torch {torch.__version__}.", "", f"| {' | '.join(HEADS)} |", "|---|---|---|---|"]
    write_text(command.workdir / "gpu.md", "\n".join([*lines, *map(str, rows)]) + "\n")
    failed = [row.what for row in rows if row.passes is False]
    if failed:
        raise InputError(f"{len(failed)} of {len(rows)} lines do not pass: {', '.join(failed)}")


def all_rows(command: BenchmarkGpu, device: torch.device) -> Iterator[Row]:
    yield from likeness(device)
    yield lifting(device)
    for count in command.gaussians:
        yield step(device, count, command.size, command.steps)
    yield from trainings(command)


def scene_of(count: int, size: tuple[int, int], seed: int = 0) -> tuple[Gaussians, View]:
    """Flat Gaussians over rolling ground, and a view of most of it; opacities at which both renderers keep the same
    fragments.
    """
    random, half = np.random.default_rng(seed), 20.0
    x, y = random.uniform(-half, half, (2, count))
    points = np.stack([x, y, 1.5 * np.sin(0.3 * x) * np.cos(0.22 * y)], 1)
    scale = 1.5 * half / np.sqrt(count)
    log_scales = np.log(scale * random.uniform(0.5, 1.5, (count, 3)) * [0.1, 1, 1])
    parts = (points, log_scales, random.normal(size=(count, 4)), random.uniform(-2, 2, count))
    colors = random.normal(0, 0.5, (count, 3)), random.normal(0, 0.1, (count, 8, 3))
    gaussians = Gaussians(*(torch.from_numpy(part).float() for part in (*parts, *colors)))
    focal = 0.9 * size[0]
    pose = look_at(np.array([2.0, -9.0, 34.0]), np.zeros(3))
    return gaussians, pinhole_view("view", size, (focal, focal, size[0] / 2 + 3, size[1] / 2 - 2), pose)


def rendered(
    gaussians: Gaussians, view: View, device: torch.device
) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """What a device renders, and the gradients of one sum of all of it; on the CPU."""
    leaves = {
        name: values.detach().to(device, copy=True).requires_grad_()
        for name, values in gaussians.parameters().items()
    }
    found = render(Gaussians(**leaves), view)
    images = {
        "color": found.color,
        "alpha": found.alpha,
        "normal": found.normal,
        "plane": found.plane_distance,
    }
    weights = torch.Generator().manual_seed(0)
    total = sum(
        (image * torch.rand(image.shape, generator=weights).to(device)).sum() for image in images.values()
    )
    assert isinstance(total, torch.Tensor)
    total.backward()
    gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    return tuple({name: each.detach().cpu() for name, each in one.items()} for one in (images, gradients))  # type: ignore[return-value]


def likeness(device: torch.device) -> Iterator[Row]:
    """Image and gradients of the same Gaussians on both devices."""
    gaussians, view = scene_of(COMPARED, SMALL)
    (images, gradients), (others, other_gradients) = (
        rendered(gaussians, view, on) for on in (torch.device("cpu"), device)
    )
    for name, image in images.items():
        scale = max(float(image.abs().max()), 1.0)
        # a few pixels end one fragment apart
        off = float(torch.quantile((image - others[name]).abs().reshape(-1)[::7], 0.999)) / scale
        yield Row(f"{name}, 99.9 % of the pixels", f"{off:.1e}", f"{LARGEST_IMAGE:g}", off <= LARGEST_IMAGE)
    for name, gradient in gradients.items():
        off = float((gradient - other_gradients[name]).norm() / gradient.norm().clamp_min(1e-12))
        yield Row(
            f"gradient of {name}, relative", f"{off:.1e}", f"{LARGEST_GRADIENT:g}", off <= LARGEST_GRADIENT
        )


def lifting(device: torch.device) -> Row:
    """Labels of the Gaussians from one view's mask of squares."""
    gaussians, view = scene_of(COMPARED, SMALL)
    rows, columns = np.mgrid[: view.height, : view.width] // 40
    mask = ((rows + 2 * columns) % CHANNELS).astype(np.uint8)
    found = [lift(gaussians.to(on), [view], lambda _: (mask, None), CHANNELS) for on in ("cpu", device)]
    seen = found[0].sum(axis=1) > 0.5
    same = float((found[0].argmax(1) == found[1].argmax(1))[seen].mean())
    return Row("lifted labels that agree", f"{same:.2%}", f"{AGREEING:.0%}", same >= AGREEING)


def step(device: torch.device, count: int, size: int, steps: int) -> Row:
    """Time and memory of rendering, loss, backward pass and Adam."""
    gaussians, view = scene_of(count, (size, size * 2 // 3))
    with torch.no_grad():
        target = render(gaussians.to(device), view).color.flip(0).contiguous()
    optimizer = strategy.adam(gaussians.to(device), dict.fromkeys(gaussians.parameters(), 1e-7))
    _reset_memory(device)
    for number in range(WARM_UP + steps):
        if number == WARM_UP:
            _wait(device)
            started = time.perf_counter()
        image_loss(render(strategy.current_gaussians(optimizer), view).color, target).backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    _wait(device)
    milliseconds = 1000 * (time.perf_counter() - started) / steps
    return Row(
        f"step, {count:,} Gaussians, {view.width}x{view.height} px",
        f"{milliseconds:.1f} ms, {_memory(device)} MB",
    )


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _reset_memory(device: torch.device) -> None:
    torch.cuda.reset_peak_memory_stats(device) if device.type == "cuda" else reset_peak_memory()


def _memory(device: torch.device) -> int:
    return torch.cuda.max_memory_allocated(device) >> 20 if device.type == "cuda" else peak_memory_mb()


def trainings(command: BenchmarkGpu) -> Iterator[Row]:
    """Trainings to the end, with scores of photos left out: of a synthetic site, and of scenes that are given; as a
    whole, and in blocks on one device.
    """
    site = command.workdir / "site"
    if not (site / "sparse").is_dir():
        synthesize(site, Synthesize(views=command.views, width=command.width, num_points=100_000))
    for scene in (site, *command.scenes):
        devices = dict.fromkeys(["cpu", command.device] if command.against_cpu else [command.device])
        scores = {device: trained(command, scene, device) for device in devices}
        for device, (psnr, text) in scores.items():
            lowest = scores["cpu"][0] - LOST if "cpu" in scores and device != "cpu" else np.nan
            known = bool(np.isfinite(lowest))
            limit = f"{lowest:.2f} dB" if known else ""
            yield Row(f"{scene.name} on {device}", text, limit, psnr >= lowest if known else None)
        yield Row(
            f"{scene.name} on {command.device}, 2 blocks", trained(command, scene, command.device, 2)[1]
        )
        if command.device.startswith("cuda"):
            text = trained(command, scene, command.device, defaults=True)[1]
            yield Row(f"{scene.name} on {command.device}, with its defaults", text)


def amounts(command: BenchmarkGpu, scene: Path) -> list[str]:
    """The CPU's numbers as options, so that all devices are asked for the same."""
    auto = TrainSettings(command.iterations).resolved("cpu", len(Scene(scene).model.views))
    values = {
        "iterations": auto.iterations,
        "max-gaussians": auto.max_gaussians,
        "max-size": auto.max_size,
    }
    return [word for name, value in values.items() for word in (f"--{name}", str(value))]


def trained(
    command: BenchmarkGpu, scene: Path, device: str, blocks: int = 0, defaults: bool = False
) -> tuple[float, str]:
    """PSNR of the photos left out, dB, and what is told of a training; a process of its own, as users start it.
    defaults: those of the device, not the CPU's
    """
    copy = command.workdir / f"{scene.name}_{device.replace(':', '')}_{'defaults' if defaults else blocks}"
    copy.mkdir(exist_ok=True)
    for name in ("images", "sparse", "depth", "masks", "classes.json"):
        if (scene / name).exists() and not (copy / name).exists():
            (copy / name).symlink_to((scene / name).resolve())
    options = ["--device", device, "--test-every", "8", "--overwrite", "--blocks", str(blocks)]
    options += [] if defaults else amounts(command, scene)
    code = "from sc3d.cli import main; main()"
    subprocess.run([sys.executable, "-c", code, "train", str(copy), *options], check=True)
    record = read_json(copy / "gaussians.ply.json", MAX_SIDECAR)
    summary, seconds = record["summary"], record["seconds"]
    psnr = float(summary.get("held_out_psnr", "nan"))
    return psnr, f"PSNR {psnr:.2f} dB left out, {seconds:.0f} s, {summary.get('gaussians', '?')} Gaussians"
