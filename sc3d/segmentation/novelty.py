"""What is unlike every stroke: a classifier would be sure of it all the same, so it is found by its distance to all pixels under strokes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

_DIMENSIONS = 6  # principal components: more only make distances more alike
_QUANTILE = 0.995  # of the distances of held-out strokes that still pass for known
_STEP = 4  # px between the places looked at
_MOST = 15_000  # pixels to compare with


@dataclass(frozen=True)
class Novelty:
    """centre: (F,) mean; projection: (F, 6) to principal components; known: index of pixels under strokes; reach: distance beyond which nothing is known."""

    centre: np.ndarray
    projection: np.ndarray
    known: cKDTree
    reach: float

    def share(self, features: np.ndarray) -> np.ndarray:
        """How far each pixel is unknown.

        features: (H, W, F) float32
        returns: (H, W) float32: 0 within reach of a stroke's pixel, 1 from twice the reach on
        """
        sparse = features[::_STEP, ::_STEP]
        distances = self.known.query((sparse.reshape(-1, features.shape[-1]) - self.centre) @ self.projection)[0]
        share = np.clip(distances / self.reach - 1, 0, 1).reshape(sparse.shape[:2]).astype(np.float32)
        return cv2.resize(share, features.shape[1::-1], interpolation=cv2.INTER_LINEAR)


def learn_novelty(features: np.ndarray, folds: np.ndarray) -> Novelty | None:
    """Learn what strokes look like, and how far apart those of different parts are; None if there are not two parts to compare.

    features: (N, F) float32 of pixels under strokes; folds: (N,) int part of each, -1 = none
    """
    parts = np.unique(folds[folds >= 0])
    if len(parts) < 2:
        return None
    centre = features.mean(axis=0)
    scale = features.std(axis=0) + 1e-3
    _, sizes, axes = np.linalg.svd((features - centre) / scale, full_matrices=False)
    sizes = np.sqrt(np.maximum(sizes[:_DIMENSIONS] / np.sqrt(len(features)), 1e-3))  # half whitened: the first components say most
    projection = (axes[:_DIMENSIONS] / sizes[:, None]).T / scale[:, None]
    projected = (features - centre) @ projection
    thinned = slice(None, None, -(-len(features) // _MOST))
    distances = [_index(projected[folds != part][thinned]).query(projected[folds == part])[0] for part in parts]
    return Novelty(centre, projection, _index(projected[thinned]), max(float(np.quantile(np.concatenate(distances), _QUANTILE)), 1e-6))


def _index(points: np.ndarray) -> cKDTree:
    return cKDTree(points)
