"""What `sc3d run` tells before it starts and at its end: which stages will run and for how long about, and
what there is to look at.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sc3d.io.caches import has_kernels
from sc3d.io.progress import duration
from sc3d.runner import files, up_to_date
from sc3d.scene.scene import Scene
from sc3d.sfm import num_pairs

logger = logging.getLogger(__name__)

Stage = tuple[str, Any]  # name and settings
Sizes = Sequence[tuple[int, int]]  # width and height of every photo, px
ROUND = 5  # s
SLOW = 3600  # s that a stage takes to be warned of
FASTER = {  # what makes stages faster, and coarser
    "map_photos": "less with --reconstruct.matching auto, a smaller --reconstruct.max-size or --reconstruct.max-features",
    "depth": "less with a smaller --depth.max-size or --depth.num-sources",
    "train": "none with --extract.from depth; less with fewer --train.iterations, a smaller --train.max-size, or a GPU",
    "extract": "less with a smaller --extract.max-size",
}

# seconds on two idle cores. Each rule lies between what the sidecars of two scenes recorded, 18 photos of
# 1600x900 and 24 of 640x427, and at most 1.5 times off either; compared with these alone. Too little where time
# grows faster than the number of photos.
EXPECTED: dict[str, Callable[[Any, Sizes], float | None]] = {
    "map_photos": lambda settings, sizes: _mapping(settings, sizes),
    "reconstruct": lambda settings, sizes: 0.03 * len(sizes),
    "depth": lambda settings, sizes: 1.5 * settings.num_sources * megapixels(sizes, settings.max_size),
    "train": lambda settings, sizes: _training(settings.training, sizes),
    "extract": lambda settings, sizes: 8.7 * megapixels(sizes, settings.max_size),
    "segment": lambda settings, sizes: _segmenting(settings, sizes),
    "label": lambda settings, sizes: 0.32 * len(sizes) + 0.16 * megapixels(sizes),
    "propagate": lambda settings, sizes: 1.5 * megapixels(sizes, 800),
    "evaluate": lambda settings, sizes: 0.4 * len(sizes),
    "report": lambda settings, sizes: 20.0,
}


def megapixels(sizes: Sizes, longest: int | None = None) -> float:
    """Of all photos, or of what is left of them where their longest side is no more than `longest` px."""
    scales = [1.0 if longest is None else min(1.0, longest / max(size)) for size in sizes]
    return sum(width * height * scale**2 for (width, height), scale in zip(sizes, scales, strict=True)) / 1e6


def _mapping(settings: Any, sizes: Sizes) -> float:
    """Features by pixels, matches by pairs (of smaller photos, which have fewer features, less each), cameras."""
    pixels, count = megapixels(sizes, settings.max_size), len(sizes)
    detail = min(1.0, pixels / count / 1.44)
    return 1.35 * pixels + 0.14 * detail * num_pairs(count, settings.matching) + 0.5 * count


def _training(settings: Any, sizes: Sizes) -> float | None:
    """None: on a GPU nothing was measured."""
    from sc3d.splatting.device import device_type

    device = device_type(settings.device)
    if device == "cuda":
        return None
    settings = settings.resolved(device, len(sizes))
    longest = [max(size) for size in sizes]
    pixels = [
        width * height * (settings.size(side) / side) ** 2 / 1e6
        for (width, height), side in zip(sizes, longest, strict=True)
    ]
    return 0.49 * settings.iterations * sum(pixels) / len(pixels)


def _segmenting(settings: Any, sizes: Sizes) -> float | None:
    """None: how long models and strokes take was not measured."""
    if settings.backend == "geometry":
        return 10 + 3.0 * megapixels(sizes, 1600)
    if settings.backend != "files":
        return None
    return (0.5 * len(sizes) if settings.refine else 0.0) + 0.1 * megapixels(sizes)


def pending(scene: Scene, stages: Sequence[Stage], overwrite: bool) -> list[bool]:
    """Which stages will run: those whose outputs are not up to date, and those that read what others write
    anew.
    """
    written: set[Path] = set()
    runs = []
    for name, settings in stages:
        read, outputs = files(name, scene, settings)
        runs.append(overwrite or bool(written & set(read)) or not up_to_date(name, scene, settings))
        if runs[-1]:
            written |= set(outputs)
    return runs


def expected_seconds(stages: Sequence[Stage], runs: Sequence[bool], sizes: Sizes) -> list[float | None]:
    """How long each stage may take: 0 for those that will not run, None where it is not known."""
    return [
        EXPECTED[name](settings, sizes) if run else 0.0
        for (name, settings), run in zip(stages, runs, strict=True)
    ]


def plan(stages: Sequence[Stage], runs: Sequence[bool], sizes: Sizes, finished: str = "up to date") -> str:
    """A line per stage with the time that it may take; sizes: at least one; finished: said of stages that will
    not run.
    """
    seconds = expected_seconds(stages, runs, sizes)
    known = [value for value in seconds if value is not None]
    rows = [
        f"  {name:12s} {_told(value) if run else finished}"
        for (name, _), run, value in zip(stages, runs, seconds, strict=True)
    ]
    more = " and what is not known" if len(known) < len(seconds) else ""
    first = "" if has_kernels() or not any(runs) else "; the first run also compiles, a minute or two"
    width, height = max(sizes)
    return "\n".join(
        [
            f"plan: {sum(runs)} of {len(stages)} stages to run, on {len(sizes)} photos of {width}x{height}:",
            *rows,
            f"  in all       {_told(sum(known))}{more}; rough estimates for two cores, here are {os.cpu_count()}{first}",
        ]
    )


def warn_of_slow(stages: Sequence[Stage], runs: Sequence[bool], sizes: Sizes) -> None:
    """Warn of the stages that may take hours, and say which option makes them faster."""
    seconds = expected_seconds(stages, runs, sizes)
    slow = [
        f"{name} {_told(value)}{f' ({FASTER[name]})' if name in FASTER else ''}"
        for (name, _), value in zip(stages, seconds, strict=True)
        if value is not None and value > SLOW
    ]
    if slow:
        logger.warning("slow on %d photos: %s", len(sizes), "; ".join(slow))


def _told(seconds: float | None) -> str:
    if seconds is None:
        return "not known how long"
    return f"about {duration(max(ROUND, ROUND * math.ceil(seconds / ROUND)))}"


def results(scene: Scene) -> str:
    """What is there to open."""
    found = {
        "report": scene.report,
        "labelled cloud": scene.labelled,
        "mesh": scene.mesh,
        "masks": scene.masks,
        "training": scene.path / "train.jpg",
        "figures": scene.metrics,
    }
    rows = [f"  {name:15s} {path}" for name, path in found.items() if path.exists()]
    return "\n".join([*rows, f"  in the browser  sc3d view {scene.path} --web"])
