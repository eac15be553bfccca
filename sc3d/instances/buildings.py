"""Buildings on a grid: cells with roof points, closed, and split where roofs of different heights meet."""

from __future__ import annotations

from collections import Counter

import numpy as np
from scipy import ndimage

from sc3d.geometry.raster import Raster
from sc3d.instances.regions import cells_by_number, connected_cells, disk, neighbors, renumbered

CLOSING, OPENING = 0.6, 0.5  # gaps and strips narrower than about twice this vanish, m
SMOOTHING = 0.4  # standard deviation of the Gaussian that evens the border out, m
HOLE = 6.0  # courtyards smaller than this are gaps, m2
# of the points above the ground in a cell: fewer are a few wrong labels in a crown, not a roof under one
ROOF_SHARE = 0.3
STEP = 2.0  # roofs that differ by more along all their border are two buildings, m
# a part with this share of its border on one other building (a tower, a lift house) belongs to it
ENCLOSED = 0.5
# chimneys and machines end at steps of EDGE m; what is left of a roof has parts of at least this share of it
EDGE, PART = 0.35, 0.1
MAX_SLOPE = 1.5  # steeper is an edge, not a roof, in wide cells
TOP = 0.98  # quantile of the roof that is its height: the ridge without single high points


def roof_heights(tops: np.ndarray, share: np.ndarray, pixel: float) -> tuple[np.ndarray, np.ndarray]:
    """Cells that a roof covers, also under overhanging crowns, and its height there.

    tops: (H, W) z of the highest building point above the ground, m, -inf = none; share: (H, W) of the points
        above the ground that are of buildings; pixel: side of the cells, m
    returns: (H, W) bool; (H, W) float64 z, m, NaN elsewhere
    """
    known = np.isfinite(tops) & (share >= ROOF_SHARE)
    if not known.any():
        return known, np.full(tops.shape, np.nan)
    covered = close_roofs(known, pixel)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    heights = ndimage.median_filter(tops[tuple(nearest)], 3, mode="nearest")
    return covered, np.where(covered, heights, np.nan)


def close_roofs(covered: np.ndarray, pixel: float) -> np.ndarray:
    """Narrow gaps and small holes filled, strips and specks removed, the border moved to where half of the
    cells around are covered.
    """
    closing, opening = disk(CLOSING / pixel), disk(OPENING / pixel)
    margin = 2 * len(closing)
    covered = np.pad(covered, margin)
    closed = ndimage.binary_closing(covered, closing)
    holes, _ = ndimage.label(~closed)
    closed |= (np.bincount(holes.ravel())[holes] * pixel**2 < HOLE) & (holes > 0)
    # closing also fills the dents of a noisy border, which would move it outwards
    inner = ndimage.binary_erosion(closed, closing)
    smooth = ndimage.gaussian_filter((covered | inner).astype(np.float64), SMOOTHING / pixel) > 0.5
    return ndimage.binary_opening(smooth, opening)[margin:-margin, margin:-margin]


def split_buildings(covered: np.ndarray, heights: np.ndarray, grid: Raster, min_area: float) -> np.ndarray:
    """(H, W) int32 number of the building in each cell from 1, 0 = none: connected cells without a step
    between them.

    covered: (H, W) bool; heights: (H, W) m; min_area: smaller pieces go to the neighbor that they touch, or
        vanish, m2
    """
    blocks, _ = ndimage.label(covered)
    parts = connected_cells(covered.astype(np.int32), heights, STEP)
    large = covered & (np.bincount(parts.ravel())[parts] * grid.pixel**2 >= min_area)
    if not large.any():
        return np.zeros(grid.shape, np.int32)
    nearest = tuple(ndimage.distance_transform_edt(~large, return_distances=False, return_indices=True))
    parts = np.where(covered & (blocks == blocks[nearest]), parts[nearest], 0)
    return renumbered(join_enclosed(parts))


def join_enclosed(parts: np.ndarray) -> np.ndarray:
    """Parts with most of their border on one other part become part of it, the smallest first. parts: (H, W)
    int from 0 = none.
    """
    pairs = np.concatenate([np.stack([parts[a].ravel(), parts[b].ravel()], axis=1) for a, b in neighbors()])
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    found, counts = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0, return_counts=True)
    borders: dict[int, Counter] = {}
    for (part, other), count in zip(found.tolist(), counts.tolist()):
        borders.setdefault(part, Counter())[other] = count
    sizes, target = np.bincount(parts.ravel()), np.arange(parts.max() + 1)
    for part in sorted(set(borders) - {0}, key=lambda part: (sizes[part], part)):
        around = borders[part]
        other, shared = max(
            ((other, count) for other, count in around.items() if other),
            key=lambda item: item[1],
            default=(0, 0),
        )
        if other and shared >= ENCLOSED * around.total():
            target[target == part] = other
            del borders[part]
            borders[other].update({name: count for name, count in around.items() if name != other})
            for name in set(around) & set(borders):
                borders[name][other] += borders[name].pop(part)
            del borders[other][other]
    return target[parts]


def roof_tops(buildings: np.ndarray, heights: np.ndarray, pixel: float) -> np.ndarray:
    """(B,) float64 z of the ridge or parapet of each building, m: the top of its roof without chimneys and
    machines.

    buildings: (H, W) int32 numbers from 1; heights: (H, W) z, m; pixel: side of the cells, m
    """
    parts = connected_cells(buildings, heights, max(EDGE, MAX_SLOPE * pixel))
    large = np.bincount(parts.ravel())[parts] >= PART * np.bincount(buildings.ravel())[buildings]
    large |= ~_any_in(buildings, large)
    return np.array(
        [
            np.quantile(heights.ravel()[cells], TOP)
            for cells in cells_by_number(np.where(large, buildings, 0), int(buildings.max()))
        ]
    )


def _any_in(parts: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """(H, W) bool: cells of parts that hold a chosen cell."""
    return (np.bincount(parts.ravel(), chosen.ravel()) > 0)[parts]
