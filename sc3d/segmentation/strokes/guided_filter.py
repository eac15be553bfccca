"""Guided filter: probabilities are smoothed, but not across the edges of the photo.

Source: He, Sun and Tang, "Guided image filtering" (2013), color guide; the coefficients are found at a
reduced size and applied to the large photo, as in He and Sun, "Fast guided filter" (2015).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np


class LocalLines(NamedTuple):
    """One plane as a linear function of the color around each pixel: (H, W, 3) float32 slope per unit of
    gray value 0 to 1; (H, W) float32 offset.
    """

    slope: np.ndarray
    offset: np.ndarray

    def apply(self, guide: np.ndarray) -> np.ndarray:
        """(H, W) float32 for a guide of any size, (H, W, 3) float32 0 to 1."""
        size = guide.shape[1::-1]
        slope, offset = (cv2.resize(values, size, interpolation=cv2.INTER_LINEAR) for values in self)
        return np.einsum("hwc,hwc->hw", slope, guide) + offset


def fit_lines(guide: np.ndarray, planes: np.ndarray, radius: int, smoothing: float) -> Iterator[LocalLines]:
    """Fit each plane by the guide's color in windows around every pixel.

    guide: (H, W, 3) float32 0 to 1; planes: (H, W, C) float32
    radius: half width of the windows, px
    smoothing: variance of the guide, below which a window counts as flat; larger smooths more
    """
    means = [_mean(guide[..., channel], radius) for channel in range(3)]
    inverse = _inverse_covariance(guide, means, radius, smoothing)
    for index in range(planes.shape[2]):
        plane = np.ascontiguousarray(planes[..., index])
        plane_mean = _mean(plane, radius)
        covariance = [
            _mean(guide[..., channel] * plane, radius) - means[channel] * plane_mean for channel in range(3)
        ]
        slope = [
            sum(inverse[min(row, column), max(row, column)] * covariance[column] for column in range(3))
            for row in range(3)
        ]
        offset = plane_mean - sum(slope[channel] * means[channel] for channel in range(3))
        yield LocalLines(
            np.stack([_mean(values, radius) for values in slope], axis=-1), _mean(offset, radius)
        )


def _inverse_covariance(
    guide: np.ndarray, means: list[np.ndarray], radius: int, smoothing: float
) -> dict[tuple[int, int], np.ndarray]:
    """Upper half of the inverse of each pixel's 3x3 covariance matrix, by cofactors."""
    cov = {}
    for row in range(3):
        for column in range(row, 3):
            cov[row, column] = (
                _mean(guide[..., row] * guide[..., column], radius)
                - means[row] * means[column]
                + (smoothing if row == column else 0)
            )
    inverse = {
        (0, 0): cov[1, 1] * cov[2, 2] - cov[1, 2] ** 2,
        (0, 1): cov[0, 2] * cov[1, 2] - cov[0, 1] * cov[2, 2],
        (0, 2): cov[0, 1] * cov[1, 2] - cov[0, 2] * cov[1, 1],
        (1, 1): cov[0, 0] * cov[2, 2] - cov[0, 2] ** 2,
        (1, 2): cov[0, 1] * cov[0, 2] - cov[0, 0] * cov[1, 2],
        (2, 2): cov[0, 0] * cov[1, 1] - cov[0, 1] ** 2,
    }
    determinant = sum(cov[0, column] * inverse[0, column] for column in range(3))
    return {place: values / determinant for place, values in inverse.items()}


def _mean(plane: np.ndarray, radius: int) -> np.ndarray:
    return cv2.blur(plane, (2 * radius + 1, 2 * radius + 1), borderType=cv2.BORDER_REFLECT)
