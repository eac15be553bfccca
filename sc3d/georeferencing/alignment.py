"""Similarities between frames, and how well positions along a flight can define one."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

LEVEL_SHARE = 0.9  # nearest share of the points that the ground plane is fitted to
NUM_SUBSETS = 500  # at most, tried by the robust fit


@dataclass(frozen=True)
class Similarity:
    """target = scale * rotation @ source + translation; rotation (3, 3), translation (3,)."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) source to (N, 3) target."""
        return self.scale * points @ self.rotation.T + self.translation

    @property
    def matrix(self) -> np.ndarray:
        """(4, 4) homogeneous matrix."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.translation
        return matrix

    @property
    def angle(self) -> float:
        """Angle of the rotation, radians."""
        return float(np.arccos(np.clip((np.trace(self.rotation) - 1) / 2, -1, 1)))


# pycolmap 4.2 has `estimate_sim3d`, which gives the same to 1e-15 in 2 us for 20 points instead of 26, and
# `estimate_sim3d_robust`, 1 ms for 60 photos instead of 24, once per model. But both refuse points that lie
# exactly on a plane or a line, as the cameras of a flight at one height may.
def fit_similarity(source: np.ndarray, target: np.ndarray) -> Similarity:
    """Least-squares similarity from (N, 3) to (N, 3), N >= 3 (Umeyama 1991)."""
    share = np.full(len(source), 1 / len(source))
    source_mean, target_mean = share @ source, share @ target
    source, target = source - source_mean, target - target_mean
    left, singular, right = np.linalg.svd((target * share[:, None]).T @ source)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = left * signs @ right
    scale = float(singular @ signs / max((share @ source**2).sum(), 1e-300))
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def fit_similarity_robust(
    source: np.ndarray, target: np.ndarray, max_error: float
) -> tuple[Similarity, np.ndarray]:
    """Similarity that most of the (N, 3) pairs agree on.

    Starts from the triple whose fit has the smallest median residual, keeps the pairs within `max_error`
    (units of the target) and refits.
    returns: the similarity; (N,) bool, the pairs kept. Fewer than three may be left.
    """
    fit, kept = fit_similarity(source, target), np.zeros(len(source), bool)
    if len(source) > 3:
        fits = [fit_similarity(source[triple], target[triple]) for triple in subsets(len(source), 3)]
        fit = min(
            fits, key=lambda candidate: np.median(np.linalg.norm(candidate.apply(source) - target, axis=1))
        )
    for _ in range(10):
        agreed = np.linalg.norm(fit.apply(source) - target, axis=1) <= max_error
        if agreed.sum() < 3 or (agreed == kept).all():
            return fit, agreed
        fit, kept = fit_similarity(source[agreed], target[agreed]), agreed
    return fit, kept


def subsets(count: int, size: int) -> list[np.ndarray]:
    """All choices of `size` rows, or a fixed random choice of NUM_SUBSETS of them."""
    if math.comb(count, size) <= NUM_SUBSETS:
        return [np.array(rows) for rows in itertools.combinations(range(count), size)]
    rng = np.random.default_rng(0)
    return [rng.choice(count, size, replace=False) for _ in range(NUM_SUBSETS)]


def flight_shape(positions: np.ndarray, sigma: float) -> str:
    """What positions (N, 3) with standard deviation `sigma` (m) can define: "point" (nothing), "line" (all
    but the roll about it), "area" (a frame).
    """
    spread = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False) / np.sqrt(len(positions))
    if len(positions) < 3 or spread[0] < 3 * sigma:
        return "point"
    return "line" if spread[1] < max(2 * sigma, 0.01 * spread[0]) else "area"


def main_plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(3, 3) rows: two directions in the main plane of (N, 3) points and its normal, right-handed; (3,)
    median point on it.
    """
    middle = np.median(points, axis=0)
    distance = np.linalg.norm(points - middle, axis=1)
    near = points[distance <= np.quantile(distance, LEVEL_SHARE)]
    axes = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2]
    axes[1] = np.cross(axes[2], axes[0])
    return axes, middle


def roll_upright(normal: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """(3, 3) rotation about `axis` (3,) that turns `normal` (3,) as close to +z as such a rotation can."""
    axis = axis / np.linalg.norm(axis)
    up = np.array([0.0, 0.0, 1.0])
    flat, target = normal - (normal @ axis) * axis, up - axis[2] * axis
    angle = np.arctan2(np.cross(flat, target) @ axis, flat @ target)
    cross = np.cross(np.eye(3), axis)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
