"""Numba kernels: how much of each class every Gaussian shows in a view.

The walk of `rasterization` with the same operations, hence the same fragments and weights; instead of
compositing colors it sums the weights w of a fragment over the pixels of each class. A tile keeps one plane
of mask weights per class that occurs in it, mostly one or two.
"""

from __future__ import annotations

import numba
import numpy as np

from sc3d.geometry.cameras import View
from sc3d.splatting.cpu.projection import RECORD, camera_array, gaussian_arrays, project_view
from sc3d.splatting.cpu.rasterization import (
    CHECK,
    PLANE,
    STRIDE,
    alpha_of,
    finished,
    log2_alpha,
    may_pass,
    measure_rows,
    open_tile,
)
from sc3d.splatting.cpu.simd import LANES, fma, load, ramp, splat, store, total
from sc3d.splatting.cpu.tile_binning import TILE, sort_into_tiles, tile_frame
from sc3d.splatting.gaussians import Gaussians

NONE = np.uint8(255)  # a pixel without label; so a view may have 255 classes
_ZERO = np.float32(0.0)


def add_evidence(
    gaussians: Gaussians,
    view: View,
    mask: np.ndarray,
    weights: np.ndarray,
    scale: float,
    evidence: np.ndarray,
) -> None:
    """Add a view's sum of w * mask weight * scale, rounded, to evidence (N, num_ids) int64.

    mask: (H, W) uint8 class ids, 0 = no label; weights: (H, W) float32
    """
    ids = np.flatnonzero(np.bincount(mask.ravel(), minlength=256)[1:]) + 1
    if not len(ids) or not len(gaussians):
        return
    records, depths, _ = project_view(gaussian_arrays(gaussians), 0, camera_array(view))
    tiles = sort_into_tiles((view.width, view.height), records, depths)
    columns = np.full(256, NONE)
    columns[ids] = np.arange(len(ids))
    contributions = np.zeros((len(tiles.ranks), len(ids)), np.float32)
    _lift(tiles, columns[mask], weights, contributions)
    _collect(tiles, contributions, ids, scale, evidence)


@numba.njit(cache=True, error_model="numpy")
def _lift_tile(tiles, tile, frame, classes, pixels, contributions):
    """Runs a tile front to back and writes sum(w * mask weight) of each instance and class into contributions
    (P, C).

    classes: (K,) columns of contributions; pixels: planes transmittance and mask weight of each of the K
        classes
    """
    records, lane = tiles.records, ramp()
    lines, ends = np.empty(3 * TILE, np.float32), np.empty(2 * TILE, np.int32)
    sums = np.empty(classes.shape[0] * LANES, np.float32)
    first = tiles.starts[tile]
    for entry in range(first, tiles.starts[tile + 1]):
        if (entry - first) % CHECK == CHECK - 1 and finished(pixels):
            return
        base = np.int64(tiles.ranks[entry]) * RECORD
        first_row, last_row = measure_rows(records, base, frame, lines, ends)
        minus_decay = splat(-records[base + 3])
        sums[:] = _ZERO
        for row in range(first_row, last_row + 1):
            center, peak = lines[TILE + row], splat(lines[2 * TILE + row])
            column, end = np.int64(ends[row]), np.int64(ends[TILE + row])
            while column < end:
                place = row * STRIDE + column
                u = lane + splat(np.float32(column) - center)
                column += LANES
                transmittance = load(pixels, place)
                if not may_pass(transmittance):
                    continue
                w = alpha_of(log2_alpha(minus_decay, u, peak), transmittance) * transmittance
                store(pixels, place, transmittance - w)
                for k in range(classes.shape[0]):
                    weight = load(pixels, place + (k + 1) * PLANE)
                    store(sums, k * LANES, fma(w, weight, load(sums, k * LANES)))
        for k in range(classes.shape[0]):
            contributions[np.int64(tiles.instances[entry]), classes[k]] = total(load(sums, k * LANES))


@numba.njit(cache=True, error_model="numpy")
def _classes_of(columns_image, top, left, rows, columns, slots):
    """Sorted columns that occur in a tile; slots (255,) filled with the place of each in that list."""
    slots[:] = -1
    count = 0
    for row in range(top, top + rows):
        for column in range(left, left + columns):
            if columns_image[row, column] != NONE:
                slots[columns_image[row, column]] = 0
    classes = np.empty(slots.shape[0], np.int64)
    for k in range(slots.shape[0]):
        if slots[k] == 0:
            classes[count], slots[k] = k, count
            count += 1
    return classes[:count]


@numba.njit(cache=True, error_model="numpy", parallel=True)
def _lift(tiles, columns_image, weights, contributions):
    """Sums of all tiles.

    columns_image: (H, W) uint8 column of contributions that the pixel's class has, NONE = no label; weights:
        (H, W) float32 of the mask
    contributions: (P, C) float32, zero on entry
    """
    height, width = columns_image.shape
    for item in numba.prange(tiles.order.shape[0]):
        tile = tiles.order[item]
        frame = tile_frame(tile, width, height)
        left, top, rows, columns = frame
        slots = np.empty(NONE, np.int64)
        classes = _classes_of(columns_image, top, left, rows, columns, slots)
        if tiles.starts[tile] < tiles.starts[tile + 1] and classes.shape[0] > 0:
            pixels = np.empty((1 + classes.shape[0]) * PLANE, np.float32)
            open_tile(pixels, rows, columns)
            for row in range(rows):
                for column in range(columns):
                    label = columns_image[top + row, left + column]
                    if label != NONE:
                        place = (1 + slots[label]) * PLANE + row * STRIDE + column
                        pixels[place] = weights[top + row, left + column]
            _lift_tile(tiles, tile, frame, classes, pixels, contributions)


@numba.njit(cache=True, error_model="numpy", parallel=True)
def _collect(tiles, contributions, ids, scale, evidence):
    """Adds the sums of each Gaussian's instances, times `scale` and rounded, to evidence (N, num_ids) int64.

    ids: (C,) column of evidence of each column of contributions. Whole numbers: the order of views does not
        matter.
    """
    visible, offsets = tiles.visible, tiles.offsets
    for rank in numba.prange(visible.shape[0]):
        for k in range(ids.shape[0]):
            value = 0.0
            for instance in range(offsets[rank], offsets[rank + 1]):
                value += contributions[instance, k]
            evidence[visible[rank], ids[k]] += np.int64(value * scale + 0.5)
