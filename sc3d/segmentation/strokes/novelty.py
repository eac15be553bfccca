"""What is unlike every stroke: a classifier would be sure of it all the same, so it is found by its distance
to all pixels under strokes.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

_DIMENSIONS = 6  # principal components: more only make distances more alike
_QUANTILE = 0.995  # of the distances of held-out strokes that still pass for known
_PIXEL_STEP = 4  # px between the places looked at
# of features: a difference that another photo of the same thing may well show, although strokes do not
_UNIT = 1.0
_NARROW_STEPS = 5  # such steps: what is narrower is no object
_MAX_SAMPLES = 15_000  # pixels to compare with


@dataclass(frozen=True)
class FeatureSpace:
    """Where distances are measured: principal components, half whitened because the first say most, and what
    they leave over.

    center, scale: (F,) of the features; axes: (6, F) orthonormal; sizes: (6,) divisors; rest: divisor of the
        remainder
    """

    center: np.ndarray
    scale: np.ndarray
    axes: np.ndarray
    sizes: np.ndarray
    rest: float = 1.0

    def place(self, features: np.ndarray) -> np.ndarray:
        """(N, 7) places of (N, F) features; the last coordinate is the distance from the plane of the
        components, where strange colors show.
        """
        scaled = (features - self.center) / self.scale
        components = scaled @ self.axes.T
        rest = np.sqrt(np.maximum((scaled**2).sum(axis=1) - (components**2).sum(axis=1), 0))
        return np.concatenate([components / self.sizes, rest[:, None] / self.rest], axis=1)


@dataclass(frozen=True)
class Novelty:
    """known: places of pixels under strokes; reach: distance from them up to which a pixel is known."""

    space: FeatureSpace
    known: cKDTree
    reach: float

    def share(self, features: np.ndarray) -> np.ndarray:
        """How far each pixel is unknown.

        features: (H, W, F) float32
        returns: (H, W) float32: 0 within reach of a stroke's pixel, 1 from twice the reach on
        """
        sparse = features[::_PIXEL_STEP, ::_PIXEL_STEP]
        distances = self.known.query(self.space.place(sparse.reshape(-1, features.shape[-1])))[0]
        share = np.clip(distances / self.reach - 1, 0, 1).reshape(sparse.shape[:2]).astype(np.float32)
        # windows across an edge are unlike both sides
        share = cv2.morphologyEx(share, cv2.MORPH_OPEN, np.ones((_NARROW_STEPS, _NARROW_STEPS), np.uint8))
        return cv2.resize(share, features.shape[1::-1], interpolation=cv2.INTER_LINEAR)


def fit_novelty(features: np.ndarray, folds: np.ndarray) -> Novelty | None:
    """Learn what strokes look like, and how far apart those of different parts are; None if there are not two
    parts to compare.

    features: (N, F) float32 of pixels under strokes; folds: (N,) int part of each, -1 = none
    """
    parts = np.unique(folds[folds >= 0])
    if len(parts) < 2:
        return None
    space = _fit(features)
    places = space.place(features)
    thinned = slice(None, None, -(-len(features) // _MAX_SAMPLES))
    distances = [cKDTree(places[folds != part][thinned]).query(places[folds == part])[0] for part in parts]
    return Novelty(
        space, cKDTree(places[thinned]), max(float(np.quantile(np.concatenate(distances), _QUANTILE)), _UNIT)
    )


def _fit(features: np.ndarray) -> FeatureSpace:
    center, scale = features.mean(axis=0), features.std(axis=0) + _UNIT
    _, sizes, axes = np.linalg.svd((features - center) / scale, full_matrices=False)
    space = FeatureSpace(
        center,
        scale,
        axes[:_DIMENSIONS],
        np.sqrt(np.maximum(sizes[:_DIMENSIONS] / np.sqrt(len(features)), _UNIT)),
    )
    rest = max(float(space.place(features)[:, -1].std()), _UNIT)
    return FeatureSpace(space.center, space.scale, space.axes, space.sizes, rest)
