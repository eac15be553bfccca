"""How many fragments a view has: the loops of `kernels_raster` once more, counting instead of compositing."""

from __future__ import annotations

import numba
import numpy as np

from sc3d.geometry.cameras import View
from sc3d.splatting.cpu import rasterization as kernels_raster
from sc3d.splatting.cpu.projection import RECORD
from sc3d.splatting.cpu.rasterization import (
    CHECK,
    LOG2_MIN_ALPHA,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    PLANE,
    STRIDE,
    finished,
    measure_rows,
    open_tile,
)
from sc3d.splatting.cpu.simd import (
    LANES,
    any_at_least,
    exp2,
    fma,
    load,
    minimum,
    ramp,
    splat,
    store,
    total,
    where_at_least,
)
from sc3d.splatting.cpu.tile_binning import TILE
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.rendering import render
from tools.benchmark.machine import replaced


def count_fragments(gaussians: Gaussians, view: View) -> tuple[float, float, float]:
    """What the rasterizer has to do for a view.

    returns: fragments per pixel that contribute (alpha >= 1/255, transmittance in front >= 1e-4); slots per
        pixel that are evaluated,
        which are whole runs of 8 pixels; share of the Gaussians that can touch the image
    """
    caught = []
    rasterize = kernels_raster.rasterize

    def catching(*arguments):
        caught.append(arguments)
        return rasterize(*arguments)

    with replaced(kernels_raster, "rasterize", catching):
        radii = render(gaussians.detached(), view, 0, geometry=False).radii
    records, ranks, _, starts = caught[0][:4]
    counts = np.zeros((len(starts) - 1, 2), np.int64)
    _count(records, ranks, starts, view.width, view.height, counts)
    fragments, slots = counts.sum(0) / (view.width * view.height)
    return float(fragments), float(slots), float((radii > 0).float().mean())


@numba.njit(cache=True, error_model="numpy", parallel=True)
def _count(records, ranks, starts, width, height, counts):
    """counts: (tiles, 2) filled with contributing fragments and evaluated slots."""
    tiles_x = (width + TILE - 1) // TILE
    for tile in numba.prange(counts.shape[0]):
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        rows, columns = min(TILE, height - top), min(TILE, width - left)
        pixels = np.empty(PLANE, np.float32)
        open_tile(pixels, rows, columns)
        counts[tile, 0], counts[tile, 1] = _count_tile(
            records, ranks[starts[tile] : starts[tile + 1]], (left, top), (rows, columns), pixels
        )


@numba.njit(cache=True, error_model="numpy")
def _count_tile(records, ranks, origin, size, pixels):
    lane, low, high, limit, one = (
        ramp(),
        splat(LOG2_MIN_ALPHA),
        splat(MAX_ALPHA),
        splat(MIN_TRANSMITTANCE),
        splat(1.0),
    )
    lines, ends = np.empty(3 * TILE, np.float32), np.empty(2 * TILE, np.int32)
    fragments, slots = 0, 0
    for entry in range(ranks.shape[0]):
        if entry % CHECK == CHECK - 1 and finished(pixels):
            break
        base = np.int64(ranks[entry]) * RECORD
        first_row, last_row = measure_rows(
            records, base, np.float32(origin[0]), np.float32(origin[1]), size[0], size[1], lines, ends
        )
        minus_decay = splat(-records[base + 3])
        for row in range(first_row, last_row + 1):
            center, peak = lines[TILE + row], splat(lines[2 * TILE + row])
            for column in range(ends[row], ends[TILE + row], LANES):
                place = row * STRIDE + column
                transmittance = load(pixels, place)
                if any_at_least(transmittance, limit):
                    u = lane + splat(np.float32(column) - center)
                    exponent = fma(minus_decay * u, u, peak)
                    counted = where_at_least(exponent, low, where_at_least(transmittance, limit, one))
                    store(
                        pixels, place, transmittance - counted * minimum(exp2(exponent), high) * transmittance
                    )
                    fragments += np.int64(total(counted))
                    slots += LANES
    return fragments, slots
