"""Which cells of a height raster stand on the ground: the simple morphological filter of Pingel et al.
(2013), which allows for the slope around.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from sc3d.geometry.raster import interpolate

RADII = (1.0, 2.0, 4.0, 8.0, 15.0)  # of what may stand on the ground, from small to large, m
SLOPE, BUMP = 0.05, 0.2  # of the ground itself: m per m, beside the slope around; m
SMOOTH = 2.0  # the slope is that of the ground without what is narrower, m
COARSE = 2  # samples of the slope along a radius


def low_objects(
    heights: np.ndarray, pixel: float, radii: tuple[float, ...] = RADII, share: int = 100
) -> np.ndarray:
    """(H, W) bool: cells that stand on the ground, as cars, hedges, crowns and roofs do.

    heights: (H, W) m, the lowest of each cell, NaN = none; pixel: side of the cells, m; radii: of what may
        stand there, rising, m
    share: per cent of the slopes around that are no steeper than what is allowed for: 100 = the steepest, for
        heights that are next to all of the ground; less bears walls and stray points among them
    """
    left = heights.copy()
    for radius in radii:
        flat = opened(left, 2 * round(radius / pixel) + 1)
        allowed = SLOPE + _steepest(flat, radius, pixel, share)
        left[left > flat + BUMP + radius * allowed] = np.nan
    return np.isfinite(heights) & np.isnan(left)


def opened(heights: np.ndarray, size: int) -> np.ndarray:
    """(H, W) the opening by a square of `size` cells; NaN counts nowhere, and stays where all around is
    NaN.
    """
    low = ndimage.grey_erosion(np.where(np.isfinite(heights), heights, np.inf), (size, size), mode="nearest")
    high = ndimage.grey_dilation(np.where(np.isfinite(low), low, -np.inf), (size, size), mode="nearest")
    return np.where(np.isfinite(high), high, np.nan)


def _steepest(flat: np.ndarray, radius: float, pixel: float, share: int) -> np.ndarray:
    """(H, W) percentile `share` of the slope of an opened surface (H, W), m per m, within reach of the flat
    tops that an opening by `radius`, m, leaves.
    """
    if min(flat.shape) < 2:
        return np.zeros(flat.shape)
    filled = interpolate(flat, np.isfinite(flat))
    smooth = ndimage.gaussian_filter(filled, min(radius / 2, SMOOTH) / pixel, mode="nearest")
    slope = np.hypot(*np.gradient(smooth, pixel))
    if share == 100:
        return ndimage.maximum_filter(slope, 4 * round(radius / pixel) + 1, mode="nearest")
    step = max(1, int(radius / pixel / COARSE))  # a percentile of wide windows takes long
    size = 2 * round(2 * radius / pixel / step) + 1
    around = ndimage.percentile_filter(slope[::step, ::step], share, size, mode="nearest")
    return around.repeat(step, axis=0).repeat(step, axis=1)[: flat.shape[0], : flat.shape[1]]
