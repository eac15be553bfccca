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

from sc3d.io.progress import duration
from sc3d.runner import files, up_to_date
from sc3d.scene.scene import Scene

logger = logging.getLogger(__name__)

Stage = tuple[str, Any]  # name and settings
Sizes = Sequence[tuple[int, int]]  # width and height of every photo, px
PARTNERS = {"sequential": 10, "spatial": 50}  # photos that each is matched with
ROUND = 5  # s

# seconds on two cores, of scenes of 18 and 24 photos: rough, and too little where time grows faster than the
# number of photos
EXPECTED: dict[str, Callable[[Any, Sizes], float | None]] = {
    "map_photos": lambda settings, sizes: (
        1.7 * megapixels(sizes, settings.max_size) + 0.05 * num_pairs(len(sizes), settings.matching)
    ),
    "reconstruct": lambda settings, sizes: 0.1 * len(sizes),
    "depth": lambda settings, sizes: 1.5 * settings.num_sources * megapixels(sizes, settings.max_size),
    "train": lambda settings, sizes: _training(settings.training, sizes),
    "extract": lambda settings, sizes: 8 * megapixels(sizes, settings.max_size),
    "segment": lambda settings, sizes: _segmenting(settings, sizes),
    "label": lambda settings, sizes: 0.4 * len(sizes) + 0.25 * megapixels(sizes),
    "propagate": lambda settings, sizes: 1.8 * megapixels(sizes, 800),
    "evaluate": lambda settings, sizes: 0.4 * len(sizes),
    "report": lambda settings, sizes: 20.0,
}


def megapixels(sizes: Sizes, longest: int | None = None) -> float:
    """Of all photos, or of what is left of them where their longest side is no more than `longest` px."""
    scales = [1.0 if longest is None else min(1.0, longest / max(size)) for size in sizes]
    return sum(width * height * scale**2 for (width, height), scale in zip(sizes, scales, strict=True)) / 1e6


def num_pairs(num_photos: int, matching: str) -> float:
    """Photo pairs that are matched."""
    partners = PARTNERS.get(matching, num_photos)
    return num_photos * min(partners, num_photos - 1) / (2 if partners == num_photos else 1)


def _training(settings: Any, sizes: Sizes) -> float | None:
    """None: on a GPU nothing was measured."""
    if settings.device == "cuda":
        return None
    longest = [max(size) for size in sizes]
    pixels = [
        width * height * (settings.size(side) / side) ** 2 / 1e6
        for (width, height), side in zip(sizes, longest, strict=True)
    ]
    return 0.42 * settings.for_photos(len(sizes)).iterations * sum(pixels) / len(pixels)


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


def plan(stages: Sequence[Stage], runs: Sequence[bool], sizes: Sizes) -> str:
    """A line per stage with the time that it may take; sizes: at least one."""
    seconds = [EXPECTED[name](settings, sizes) if run else 0.0 for (name, settings), run in zip(stages, runs)]
    known = [value for value in seconds if value is not None]
    rows = [
        f"  {name:12s} {_told(value) if run else 'up to date'}"
        for (name, _), run, value in zip(stages, runs, seconds, strict=True)
    ]
    more = " and what is not known" if len(known) < len(seconds) else ""
    width, height = max(sizes)
    return "\n".join(
        [
            f"plan: {sum(runs)} of {len(stages)} stages to run, on {len(sizes)} photos of {width}x{height}:",
            *rows,
            f"  in all       {_told(sum(known))}{more}; rough estimates for two cores, here are {os.cpu_count()}",
        ]
    )


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
