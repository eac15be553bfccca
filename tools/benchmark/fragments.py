"""How many fragments a view has: the loops of `cpu.rasterization` once more, counting instead of compositing."""

from __future__ import annotations

import numba
import numpy as np

from sc3d.geometry.cameras import View
from sc3d.splatting.cpu.projection import RECORD, camera_array, gaussian_arrays, project_view
from sc3d.splatting.cpu.rasterization import (
    CHECK,
    LOG2_MIN_ALPHA,
    MIN_TRANSMITTANCE,
    PLANE,
    STRIDE,
    alpha_of,
    finished,
    log2_alpha,
    may_pass,
    measure_rows,
    open_tile,
)
from sc3d.splatting.cpu.simd import LANES, load, ramp, splat, store, total, where_at_least
from sc3d.splatting.cpu.tile_binning import TILE, sort_into_tiles, tile_frame
from sc3d.splatting.gaussians import Gaussians


def count_fragments(gaussians: Gaussians, view: View) -> tuple[float, float, float]:
    """What the rasterizer has to do for a view.

    returns: fragments per pixel that contribute (alpha >= 1/255, transmittance in front >= 1e-4); slots per
        pixel that are evaluated, which are whole runs of 8 pixels; share of the Gaussians that can touch the
        image
    """
    records, depths, radii = project_view(gaussian_arrays(gaussians), 0, camera_array(view))
    tiles = sort_into_tiles((view.width, view.height), records, depths)
    counts = np.zeros((len(tiles.order), 2), np.int64)
    _count(tiles, view.width, view.height, counts)
    fragments, slots = counts.sum(0) / (view.width * view.height)
    return float(fragments), float(slots), float((radii > 0).mean())


@numba.njit(cache=True, error_model="numpy", parallel=True)
def _count(tiles, width, height, counts):
    """counts: (tiles, 2) filled with contributing fragments and evaluated slots."""
    for tile in numba.prange(counts.shape[0]):
        frame = tile_frame(tile, width, height)
        pixels = np.empty(PLANE, np.float32)
        open_tile(pixels, frame[2], frame[3])
        counts[tile, 0], counts[tile, 1] = _count_tile(tiles, tile, frame, pixels)


@numba.njit(cache=True, error_model="numpy")
def _count_tile(tiles, tile, frame, pixels):
    records, lane, one = tiles.records, ramp(), splat(1.0)
    lines, ends = np.empty(3 * TILE, np.float32), np.empty(2 * TILE, np.int32)
    fragments, slots, first = 0, 0, tiles.starts[tile]
    for entry in range(first, tiles.starts[tile + 1]):
        if (entry - first) % CHECK == CHECK - 1 and finished(pixels):
            break
        base = np.int64(tiles.ranks[entry]) * RECORD
        first_row, last_row = measure_rows(records, base, frame, lines, ends)
        minus_decay, low = splat(-records[base + 3]), splat(LOG2_MIN_ALPHA)
        for row in range(first_row, last_row + 1):
            center, peak = lines[TILE + row], splat(lines[2 * TILE + row])
            for column in range(ends[row], ends[TILE + row], LANES):
                place = row * STRIDE + column
                transmittance = load(pixels, place)
                if may_pass(transmittance):
                    exponent = log2_alpha(minus_decay, lane + splat(np.float32(column) - center), peak)
                    alpha = alpha_of(exponent, transmittance)
                    store(pixels, place, transmittance - alpha * transmittance)
                    reached = where_at_least(transmittance, splat(MIN_TRANSMITTANCE), one)
                    fragments += np.int64(total(where_at_least(exponent, low, reached)))
                    slots += LANES
    return fragments, slots
