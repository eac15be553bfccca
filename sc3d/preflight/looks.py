"""A look at every photo, made small: features, and how sharp and bright it is where."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sc3d.io.images import has_alpha, read_opaque, read_small
from sc3d.io.progress import progress

LONGEST = (
    1600  # px, at which photos are judged: what is lost beyond that, `sc3d reconstruct` does not see either
)
GRID = 24  # cells of a photo along each side
BANDS = (0.7, 1.4, 2.8, 5.6)  # px: standard deviations whose differences are fine and coarse structure
LEAST_STRUCTURE = 1.0  # gray levels of coarse structure; below it, a cell has none that could be sharp
GAMMA = 2.2  # of stored values, about
WHITE, BLACK = 250, 5  # gray levels at which a photo shows nothing more


@dataclass(frozen=True)
class Effort:
    """How closely features are looked for: longest side of the photo, px, and number of features."""

    side: int
    features: int


QUICK, THOROUGH = Effort(800, 1000), Effort(1600, 2500)


@dataclass(frozen=True)
class Look:
    """One photo.

    size: width and height as stored, px
    points: (K, 2) float32 features, shares of width and height; descriptors: (K, 128) float32 unit RootSIFT
    sharpness: (GRID, GRID) log of fine by coarse structure, nan where there is none
    brightness: (GRID, GRID) log2 of the light, 0 = white; white, black: shares of the pixels that show
        nothing
    """

    size: tuple[int, int]
    points: np.ndarray
    descriptors: np.ndarray
    sharpness: np.ndarray
    brightness: np.ndarray
    white: float
    black: float


def look_at_photos(folder: Path, names: list[str]) -> list[Look]:
    """A look at each photo (names relative to `folder`), in their order."""
    return list(
        in_threads(lambda name: _look(folder / name, folder), progress(names, "looking at photos", "photo"))
    )


def in_threads(function, items: Iterable) -> Iterator:
    """`map` in as many threads as there are cores; the order stays."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield from pool.map(function, items)


def _look(photo: Path, folder: Path) -> Look:
    gray, size, opaque = _read(photo, folder)
    seen = gray if opaque is None else gray[opaque]
    cells = cv2.resize(gray.astype(np.float32), (GRID, GRID), interpolation=cv2.INTER_AREA)
    return Look(
        size,
        *_features(gray, opaque, QUICK),
        sharpness(gray),
        GAMMA * np.log2((cells + 1) / 256),
        float((seen >= WHITE).mean()) if seen.size else 0.0,
        float((seen <= BLACK).mean()) if seen.size else 1.0,
    )


def _read(photo: Path, folder: Path) -> tuple[np.ndarray, tuple[int, int], np.ndarray | None]:
    """(H, W) uint8 gray of a photo made small, its size as stored, and its opaque pixels, None = all."""
    image, size = read_small(photo, LONGEST, folder)
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    opaque = read_opaque(photo) if has_alpha(photo) else None
    if opaque is not None:
        opaque = cv2.resize(opaque.astype(np.uint8), gray.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    return gray, size, opaque


def features(photo: Path, folder: Path, effort: Effort) -> tuple[np.ndarray, np.ndarray]:
    """Points and descriptors of a photo, as in `Look`."""
    gray, _, opaque = _read(photo, folder)
    return _features(gray, opaque, effort)


def _features(gray: np.ndarray, opaque: np.ndarray | None, effort: Effort) -> tuple[np.ndarray, np.ndarray]:
    """RootSIFT (Arandjelovic and Zisserman 2012)."""
    scale = min(1.0, effort.side / max(gray.shape))
    size = tuple(max(1, round(side * scale)) for side in gray.shape[::-1])
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    mask = None if opaque is None else cv2.resize(opaque.astype(np.uint8), size)
    found, descriptors = cv2.SIFT_create(nfeatures=effort.features).detectAndCompute(small, mask)
    if descriptors is None or not len(found):
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    points = np.array([each.pt for each in found], np.float32) / np.array(size, np.float32)
    rooted = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    return points[: effort.features], rooted[: effort.features]


def sharpness(gray: np.ndarray) -> np.ndarray:
    """(GRID, GRID) log of the amplitude of fine by coarse structure in the cells of a (H, W) uint8 picture;
    nan where it has no structure. The ratio does not depend on contrast.
    """
    pixels = gray.astype(np.float32)
    levels = [cv2.GaussianBlur(pixels, (0, 0), sigma) for sigma in BANDS]
    fine, coarse = (
        cv2.resize((levels[row] - levels[row + 1]) ** 2, (GRID, GRID), interpolation=cv2.INTER_AREA)
        for row in (0, 2)
    )
    found = 0.5 * np.log(np.maximum(fine, 1e-4) / np.maximum(coarse, 1e-4))
    return np.where(coarse > LEAST_STRUCTURE**2, found, np.nan)
