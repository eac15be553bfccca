"""Mask errors as a segmenter makes them: shifted boundaries, filled gaps, missed and confused segments,
hopeful confidences.

All random numbers are drawn whatever the strength, so a stronger setting makes the same errors larger and
adds others.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from sc3d.scene import class_table
from sc3d.synthetic.mesh import BUILDING, GRASS, NO_CLASS, ROAD, TREE

NUM_LABELS = 5
MISSED, CONFUSED = 0.05, 0.12  # shares of segments at strength 1
BLEED = 3.5  # standard deviation of boundary shifts at strength 1, px of an 800 px wide image
CONFUSIONS = {
    BUILDING: ((ROAD, 0.8), (GRASS, 0.2)),
    TREE: ((GRASS, 0.75), (BUILDING, 0.25)),
    ROAD: ((GRASS, 0.55), (BUILDING, 0.45)),
    GRASS: ((ROAD, 0.5), (TREE, 0.5)),
}


def noisy_mask(label: np.ndarray, strength: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A segmenter-like mask of a true label map.

    label: (H, W) uint8 truth; strength: 0 = no errors, 1 = about 77 % of the labelled pixels right
    returns: (H, W) uint8 mask; (H, W) uint8 confidence, 255 = sure: lower near mask edges and, with overlap,
        for wrong segments
    """
    field = _displacement(label.shape, rng)
    segments, num_segments = _segments(label, rng)
    fate, choice = rng.random(num_segments), rng.random(num_segments)
    quality, hope = rng.normal(size=num_segments), rng.random(num_segments)
    grain = rng.normal(size=label.shape).astype(np.float32)
    if strength <= 0:
        return label.copy(), np.full(label.shape, 255, np.uint8)
    scale = label.shape[1] / 800
    whole = _fill_gaps(label, strength * scale)
    wrong = np.minimum(strength * (MISSED + CONFUSED), 0.95)
    missed = fate < wrong * MISSED / (MISSED + CONFUSED)
    confused = (fate < wrong) & ~missed
    shift = BLEED * strength * scale * field
    segments, whole = _warp(segments, shift), _warp(whole, shift)
    table = np.tile(np.arange(NUM_LABELS, dtype=np.uint8), (num_segments, 1))
    table[missed] = NO_CLASS
    for source, targets in CONFUSIONS.items():
        (first, share), (second, _) = targets
        table[confused, source] = np.where(choice[confused] < share, first, second)
    mask = table[segments, whole]
    mean = np.where(missed | confused, 0.62 + 0.16 * quality, 0.84 + 0.09 * quality)
    return mask, _confidence(mask, mean[segments], strength, scale, grain, hope[segments])


def without_other(truth: np.ndarray) -> np.ndarray:
    """uint8 class of each pixel of a truth mask, 0 = none: what `noisy_mask` starts from."""
    return np.where(truth == class_table.OTHER, NO_CLASS, truth).astype(np.uint8)


def _displacement(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """(H, W, 2) float32 smooth random field, unit variance, correlated over about 1/30 of the image width."""
    height, width = shape
    field = np.zeros((height, width, 2), np.float32)
    for cells, weight in ((9, 0.7), (30, 0.6), (90, 0.3)):
        coarse = rng.normal(size=(max(2, round(cells * height / width)) + 2, cells + 2, 2)).astype(np.float32)
        field += 1.45 * weight * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return field


def _segments(label: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, int]:
    """Segment ids (H, W) int32: whole buildings and, elsewhere, Voronoi cells on a jittered grid; and their
    number.
    """
    height, width = label.shape
    step = width / 11
    ticks = np.stack(
        np.meshgrid(np.arange(-0.5, width / step + 1), np.arange(-0.5, height / step + 1)), -1
    ).reshape(-1, 2)
    seeds = (ticks + rng.uniform(-0.5, 0.5, ticks.shape)) * step
    grid = np.stack(np.meshgrid(np.arange(0, width, 4), np.arange(0, height, 4)), -1).astype(np.float64)
    cells = cKDTree(seeds).query(grid.reshape(-1, 2))[1].reshape(grid.shape[:2]).astype(np.int32)
    cells = np.kron(cells, np.ones((4, 4), np.int32))[:height, :width]
    whole = _fill_gaps(label, width / 800)
    # each class of a cell errs by itself
    segments = cells * NUM_LABELS + np.where(whole == NO_CLASS, GRASS, whole)
    closed = cv2.morphologyEx(
        (whole == BUILDING).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)
    )
    num_buildings, building = cv2.connectedComponents(closed)
    most = len(seeds) * NUM_LABELS
    segments = np.where(building > 0, most + building, segments)
    return segments.astype(np.int32), most + num_buildings


def _fill_gaps(label: np.ndarray, scale: float) -> np.ndarray:
    """Close the gaps of crowns, drop specks and let small objects be swallowed by what surrounds them."""
    whole = label.copy()
    size = 2 * round(3 * scale) + 1
    ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    crowns = cv2.morphologyEx((label == TREE).astype(np.uint8), cv2.MORPH_CLOSE, ellipse)
    whole[(crowns > 0) & (label != BUILDING)] = TREE
    small = _small_objects(label, 3500 * scale**2)
    if small.any() and (whole != NO_CLASS).any():
        nearest, ids = cv2.distanceTransformWithLabels(
            (small | (whole == NO_CLASS)).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        seeds = np.zeros(ids.max() + 1, np.uint8)
        known = nearest == 0
        seeds[ids[known]] = whole[known]
        whole[small] = seeds[ids[small]]
    return cv2.medianBlur(whole, 2 * min(round(1.5 * scale), 3) + 1) if round(1.5 * scale) else whole


def _small_objects(label: np.ndarray, max_area: float) -> np.ndarray:
    """(H, W) bool: pixels of unlabelled components below `max_area` px, such as cars."""
    _, components, stats, _ = cv2.connectedComponentsWithStats((label == NO_CLASS).astype(np.uint8))
    small = stats[:, cv2.CC_STAT_AREA] < max_area
    small[0] = False
    return small[components]


def _warp(image: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Sample an integer image (H, W) at pixels moved by `field` (H, W, 2) px, nearest neighbor."""
    height, width = image.shape
    columns = np.clip(np.round(np.arange(width) + field[..., 0]), 0, width - 1).astype(np.int64)
    rows = np.clip(np.round(np.arange(height)[:, None] + field[..., 1]), 0, height - 1).astype(np.int64)
    return image[rows, columns]


def _confidence(
    mask: np.ndarray, mean: np.ndarray, strength: float, scale: float, grain: np.ndarray, hope: np.ndarray
) -> np.ndarray:
    """Confidence from the segment's quality and the distance to the mask's edges; a tenth of the segments is
    overrated.
    """
    edges = np.zeros(mask.shape, np.uint8)
    edges[:, 1:] |= mask[:, 1:] != mask[:, :-1]
    edges[1:] |= mask[1:] != mask[:-1]
    distance = cv2.distanceTransform(1 - edges, cv2.DIST_L2, 5)
    value = (
        np.where(hope < 0.1, np.maximum(mean, 0.85), mean)
        * (0.45 + 0.55 * (1 - np.exp(-distance / (5.0 * scale))))
        + 0.02 * grain
    )
    value = 1.0 - min(strength, 1.0) * (1.0 - np.clip(value, 0.05, 1.0))
    return np.where(mask == NO_CLASS, 0, np.round(255 * value)).astype(np.uint8)
