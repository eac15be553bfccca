"""Masks that follow the edges of their photo: what a mask rendered through the surface shows is ragged where the surface
is, at the borders of crowns and roofs.

Each label is a picture of zeros and ones, to which the guided filter gives the photo's edges (He, Sun, Tang, Guided
Image Filtering, IEEE PAMI 35(6), 2013): around each pixel the label is taken for a linear function of the photo's color.
The largest wins. It is computed on a smaller picture (He, Sun, Fast Guided Filter, arXiv 1505.00996, 2015), whose
linear functions are then applied to the whole.
"""

from __future__ import annotations

import cv2
import numpy as np

RADIUS = 1 / 80  # of the windows, of the longest side
# added to the variances of the colors (0 to 1) of a window: a contrast of 3 % is an edge
EPSILON = 1e-3
WORKING_SIDE = 1000  # px, of the smaller picture

Pair = tuple[np.ndarray, np.ndarray]


def follow_edges(labels: np.ndarray, photo: np.ndarray) -> Pair:
    """The labels with the photo's edges, (H, W) of the same type, and (H, W) float32 how clear each of them is, 0 to 1.

    labels: (H, W) small integers; photo: (H, W, 3) uint8 RGB
    """
    scale = min(1.0, WORKING_SIDE / max(labels.shape))
    size = max(1, round(labels.shape[1] * scale)), max(1, round(labels.shape[0] * scale))
    colors = photo.astype(np.float32) / 255
    guide = GuidedFilter(cv2.resize(colors, size, interpolation=cv2.INTER_AREA))
    best, largest = labels.copy(), np.full(labels.shape, -np.inf, np.float32)
    for label in np.unique(labels):
        share = (labels == label).astype(np.float32)
        slope, offset = guide.fit(cv2.resize(share, size, interpolation=cv2.INTER_AREA))
        whole = labels.shape[::-1]
        value = np.einsum("hwc,hwc->hw", cv2.resize(slope, whole), colors) + cv2.resize(offset, whole)
        better = value > largest
        best[better], largest[better] = label, value[better]
    return best, largest.clip(0, 1)


class GuidedFilter:
    """Of one photo; colors: (H, W, 3) float32, 0 to 1."""

    def __init__(self, colors: np.ndarray) -> None:
        radius = max(1, round(RADIUS * max(colors.shape[:2])))
        self.window = (2 * radius + 1, 2 * radius + 1)
        self.colors = colors
        self.mean = self._around(colors)
        products = np.einsum("hwi,hwj->hwij", colors, colors).reshape(*colors.shape[:2], 9)
        covariance = self._around(products).reshape(*colors.shape[:2], 3, 3)
        covariance -= np.einsum("hwi,hwj->hwij", self.mean, self.mean)
        self.inverse = np.linalg.inv(covariance + EPSILON * np.eye(3, dtype=np.float32))

    def fit(self, values: np.ndarray) -> Pair:
        """(H, W, 3) slope and (H, W) offset of the linear functions of color that are nearest to values (H, W),
        averaged over all windows that a pixel is in.
        """
        mean = self._around(values)
        covariance = self._around(self.colors * values[..., None]) - self.mean * mean[..., None]
        slope = np.einsum("hwij,hwj->hwi", self.inverse, covariance)
        offset = mean - np.einsum("hwi,hwi->hw", slope, self.mean)
        return self._around(slope), self._around(offset)

    def _around(self, values: np.ndarray) -> np.ndarray:
        """Mean over the window of each pixel; values: (H, W) or (H, W, C) float32"""
        return cv2.boxFilter(values, -1, self.window, borderType=cv2.BORDER_REFLECT)
