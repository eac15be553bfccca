"""Color and texture of every pixel at several scales; nothing depends on position or orientation, so that
one photo teaches another.
"""

from __future__ import annotations

import cv2
import numpy as np

RADII = (1, 2, 4, 8, 16, 32)  # half widths of the windows, px of the photo at working size
TEXTURE_RADII = (2, 4, 8, 16, 32)
TENSOR_RADII = (4, 12)
EXTREME_RADII = (3, 9)
DARK = 6.0  # added to gray values before ratios, so that noise in the dark does not look like color


def pixel_features(image: np.ndarray) -> np.ndarray:
    """Features of every pixel.

    image: (H, W, 3) uint8 RGB
    returns: (H, W, F) float32: means, standard deviations, band energies, strength and coherence of edges,
        extremes
    """
    channels = _channels(image)
    lightness, green_over_red = channels[0], channels[3]
    planes = channels + [_mean(channel, radius) for channel in channels for radius in RADII]
    planes += [
        _deviation(channel, radius) for channel in (lightness, green_over_red) for radius in TEXTURE_RADII
    ]
    planes += _band_energies(lightness) + _edges(lightness) + _extremes(lightness)
    return np.stack(planes, axis=-1)


def _channels(image: np.ndarray) -> list[np.ndarray]:
    """Lab, and the logarithms of green over red and over blue, which shadow and exposure change little: (H,
    W) float32 each.
    """
    lab = cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2Lab)
    red, green, blue = cv2.split(np.log(image.astype(np.float32) + DARK))
    return [*cv2.split(lab), 50 * (green - red), 50 * (green - blue)]


def _mean(plane: np.ndarray, radius: int) -> np.ndarray:
    return cv2.blur(plane, (2 * radius + 1, 2 * radius + 1), borderType=cv2.BORDER_REFLECT)


def _deviation(plane: np.ndarray, radius: int) -> np.ndarray:
    """Local standard deviation, as a logarithm because contrasts multiply."""
    centered = plane - plane.mean()  # else squares of float32 cancel
    variance = _mean(centered * centered, radius) - _mean(centered, radius) ** 2
    return 5 * np.log(np.sqrt(np.maximum(variance, 0)) + 0.5)


def _band_energies(lightness: np.ndarray) -> list[np.ndarray]:
    """Mean size of the differences between neighboring scales: how coarse the texture is."""
    radii = RADII[:-1]
    levels = [lightness, *(_mean(lightness, radius) for radius in radii)]
    return [
        5 * np.log(_mean(np.abs(fine - coarse), 4 * radius) + 0.2)
        for fine, coarse, radius in zip(levels[:-1], levels[1:], radii, strict=True)
    ]


def _edges(lightness: np.ndarray) -> list[np.ndarray]:
    """Strength and coherence of the structure tensor: high coherence is one edge, low coherence is foliage."""
    smooth = cv2.GaussianBlur(lightness, (0, 0), 1.0)
    across, down = (
        cv2.Scharr(smooth, cv2.CV_32F, 1, 0, scale=1 / 16),
        cv2.Scharr(smooth, cv2.CV_32F, 0, 1, scale=1 / 16),
    )
    planes = []
    for radius in TENSOR_RADII:
        xx, yy, xy = (_mean(product, radius) for product in (across * across, down * down, across * down))
        trace, gap = np.maximum(xx + yy, 0), np.sqrt((xx - yy) ** 2 + 4 * xy**2)
        planes += [5 * np.log(np.sqrt(trace) + 0.2), 10 * gap / (trace + 0.5)]
    return planes


def _extremes(lightness: np.ndarray) -> list[np.ndarray]:
    """Darkest and lightest around: crowns have shadows between the leaves, lawns do not."""
    smooth, planes = cv2.GaussianBlur(lightness, (0, 0), 1.0), []
    for radius in EXTREME_RADII:
        window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
        planes += [_mean(cv2.erode(smooth, window), radius), _mean(cv2.dilate(smooth, window), radius)]
    return planes
