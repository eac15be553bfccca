"""`held_out.csv`: how a training did on the photos that it left out, one row per photo."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from sc3d.io.atomic import atomic_path

SAME_DEPTH = 0.01  # relative difference up to which depths agree
SECTOR = "sector"


@dataclass(frozen=True)
class HeldOutPhoto:
    """The Gaussians against a photo that they were not trained on. None: nothing there to judge by.

    held_out: "every <N>" or SECTOR; psnr (dB) and ssim: of all its pixels, with the exposure that fits best
    seen: share of the pixels that show what at least two photos of the training see; seen_psnr, seen_ssim: of
        those alone, so that the rest, which the training cannot know, does not count
    seen_depth: of those whose depth is known by stereo or, without `depth/`, at the sparse points, the share
        that is rendered within SAME_DEPTH of it
    """

    photo: str
    held_out: str
    psnr: float | None
    ssim: float | None
    seen: float
    seen_psnr: float | None
    seen_ssim: float | None
    seen_depth: float | None


SCORES = [field.name for field in fields(HeldOutPhoto)][2:]


def mean_scores(photos: Sequence[HeldOutPhoto]) -> dict[str, float]:
    """Number of "photos" and means of their SCORES: of every Nth by these names, of the sector as
    "sector_photos", "sector_psnr", ... What is None in all photos is left out, and so are kinds without any.
    """
    means: dict[str, float] = {}
    for prefix, is_sector in (("", False), ("sector_", True)):
        chosen = [photo for photo in photos if (photo.held_out == SECTOR) == is_sector]
        means |= {f"{prefix}photos": len(chosen)} if chosen else {}
        for name in SCORES:
            values = [value for photo in chosen if (value := getattr(photo, name)) is not None]
            means |= {prefix + name: float(np.mean(values))} if values else {}
    return means


def write_held_out(path: Path, photos: Sequence[HeldOutPhoto]) -> None:
    """Write the rows as CSV, an empty cell for None; without photos the file of an earlier training goes."""
    if not photos:
        path.unlink(missing_ok=True)
        return
    with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["photo", "held_out", *SCORES])
        writer.writeheader()
        writer.writerows(asdict(photo) for photo in photos)
