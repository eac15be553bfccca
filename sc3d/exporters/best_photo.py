"""Which photo shows an object best: the one in which most of its pixels are to be seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sc3d.exporters.projected_cloud import MapProjection
from sc3d.geometry.cameras import View, in_image, project
from sc3d.geometry.raster import Raster
from sc3d.instances.sight import in_sight

SAMPLES = 48  # points of an object that are looked for


def best_photos(
    objects: Sequence[np.ndarray],
    points: tuple[np.ndarray, np.ndarray],
    site: tuple[Raster, np.ndarray],
    views: Sequence[View],
    projection: MapProjection,
) -> list[str]:
    """Name of the photo that shows each object best, "" where none shows it; of equal ones the first.

    objects: rows (K,) of the points of each; points: (N, 3) world, and (N, 3) m in the frame of the grid
    site: grid, and (H, W) z of the highest point of each cell, m
    """
    samples = [_spread(points[1], rows) for rows in objects]
    chosen = np.concatenate([np.zeros(0, np.int64), *samples])
    owners = np.repeat(np.arange(len(samples)), [len(rows) for rows in samples])
    counts = np.maximum(np.bincount(owners, minlength=len(samples)), 1)
    best, names = np.zeros(len(samples)), [""] * len(samples)
    for view in views if len(chosen) else ():
        pixels, depth = project(view, points[0][chosen])
        shown = np.flatnonzero(in_image(view, pixels))
        if not len(shown):
            continue
        eye = projection.to_crs(view.center[None])[0] * projection.unit
        shown = shown[in_sight(*site, points[1][chosen[shown]], eye)]
        sizes = (view.focal / depth[shown]) ** 2  # px of a sample, but for a factor
        found = np.bincount(owners[shown], sizes, minlength=len(samples)) / counts
        for number in np.flatnonzero(found > best * (1 + 1e-9)):
            best[number], names[number] = found[number], view.name
    return names


def _spread(points: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Some of the rows (K,), spread over the points (N, 3) whatever their order."""
    ordered = rows[np.lexsort(points[rows].T)]
    return ordered[np.linspace(0, len(ordered) - 1, min(SAMPLES, len(ordered))).astype(np.int64)]
