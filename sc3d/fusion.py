"""Masks to labels on the cloud: project, vote per voxel, find conflicts, lock (paper sections 3.3 and 4.3).

One vote per view and voxel side; votes are fixed-point integers, so the result does not depend on the order of views or points.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numba
import numpy as np
from tqdm import tqdm

from sc3d.geometry.cameras import View
from sc3d.geometry.raycast import FirstSurface, Sighting, Surface, first_surface, see_points
from sc3d.geometry.voxels import VoxelField, normal_sides
from sc3d.settings import Label

logger = logging.getLogger(__name__)

UNSEEN, SEED, LOCKED, PROPAGATED, UNLOCKED = range(5)  # `state` of a point
STATE_NAMES = ("unseen", "seed", "locked", "propagated", "unlocked")
SCALE = 4096  # one full vote in fixed point
MIN_WEIGHT = 0.05
GRAZING = np.cos(np.deg2rad(75.0))
STRICT_EXCESS = 0.5  # reprojection halves the depth tolerance

Mask = tuple[np.ndarray, np.ndarray | None]  # (h, w) uint8 labels; (h, w) uint8 confidence or None


@dataclass(frozen=True)
class Cloud:
    """What is to be labelled. points: (N, 3) float64 world; normals: (N, 3) float32 unit, towards the outside, or None."""

    points: np.ndarray
    normals: np.ndarray | None


@dataclass(frozen=True)
class Labels:
    """One entry per point: label uint8 (0 = none), confidence float32 in [0, 1], state uint8, num_views int32."""

    label: np.ndarray
    confidence: np.ndarray
    state: np.ndarray
    num_views: np.ndarray


@dataclass(frozen=True)
class Fusion:
    """Result of `fuse`: labels per point, the voxel field, and the cell of the field that each point belongs to."""

    labels: Labels
    field: VoxelField
    cells: np.ndarray


def fuse(cloud: Cloud, views: list[View], read_mask: Callable[[View], Mask], surface: Surface | None, num_ids: int, settings: Label) -> Fusion:
    """Fuse the masks of all views into labels of the cloud.

    read_mask: mask of a view, any size of the photo's aspect; masks are streamed
    surface: what blocks the view; None (or settings.depth_filter off) = labels penetrate
    num_ids: largest class id + 1; settings.voxel_size must be set
    """
    field = VoxelField.around(cloud.points, settings.voxel_size, num_ids)
    sides = None if cloud.normals is None else normal_sides(cloud.points, cloud.normals, field.origin, settings.voxel_size)
    cells = field.find(cloud.points, sides)
    reference_depth = float(np.median([np.linalg.norm(view.centre - np.median(cloud.points, axis=0)) for view in views]))
    overlay = np.zeros(len(cloud.points), np.uint8)
    ballot = _Ballot(field.votes, np.zeros_like(field.votes))
    for view in tqdm(sorted(views, key=lambda view: view.name), desc="voting", unit="view", disable=None):
        mask, confidence = read_mask(view)
        view = view.resized(mask.shape[1], mask.shape[0])
        first = first_surface(surface, view) if surface is not None and settings.depth_filter else None
        seen = see_points(view, cloud.points, cloud.normals, first, settings.voxel_size)
        labels = mask[seen.rows, seen.columns]
        overlay[seen.points[labels > 0]] = labels[labels > 0]
        edge = edge_distance(mask)[seen.rows, seen.columns]
        weights = vote_weights(seen, first, edge, confidence, reference_depth, settings)
        strict = (seen.excess <= STRICT_EXCESS) & (edge >= settings.edge_width) & (seen.incidence >= GRAZING)
        ballot.cast(cells[seen.points], labels, weights, strict)
    return Fusion(_decide(ballot, cells, overlay, settings), field, cells)


def vote_weights(
    seen: Sighting, first: FirstSurface | None, edge: np.ndarray, confidence: np.ndarray | None, reference_depth: float, settings: Label
) -> np.ndarray:
    """(K,) weight of each sighting in [MIN_WEIGHT, 1]: mask confidence x mask edge x depth excess x incidence x range.

    1 for the direct and majority baselines.
    """
    if settings.method in ("direct", "majority"):
        return np.ones(len(seen.points), np.float32)
    weights = np.exp(-seen.excess) if first is not None else np.ones(len(seen.points), np.float32)
    if settings.use_confidence and confidence is not None:
        weights = weights * confidence[seen.rows, seen.columns] / np.float32(255)
    if settings.edge_width > 0:
        weights = weights * (1 - np.exp(-edge / settings.edge_width))
    if settings.incidence:
        weights = weights * seen.incidence
    if settings.range:
        weights = weights * np.minimum(reference_depth / seen.depth, 1)
    return np.clip(weights, MIN_WEIGHT, 1).astype(np.float32)


def edge_distance(mask: np.ndarray) -> np.ndarray:
    """(H, W) float32 distance of each pixel to the nearest pixel of another label, px; large where there is only one label."""
    differs = np.zeros(mask.shape, bool)
    differs[:, 1:] |= mask[:, 1:] != mask[:, :-1]
    differs[:, :-1] |= differs[:, 1:]
    vertical = mask[1:] != mask[:-1]
    differs[1:] |= vertical
    differs[:-1] |= vertical
    if not differs.any():
        return np.full(mask.shape, np.float32(sum(mask.shape)))
    return cv2.distanceTransform((~differs).astype(np.uint8), cv2.DIST_L2, 5) + np.float32(0.5)


@dataclass
class _Ballot:
    """Votes of all views; channel 0 counts the views, because label 0 never votes.

    votes, strict: (cells, num_ids) int32, the second without mask edges, grazing views and doubtful depth
    """

    votes: np.ndarray
    strict: np.ndarray

    def __post_init__(self) -> None:
        self._sums = np.zeros(self.votes.shape, np.int64)
        self._counts = np.zeros(len(self.votes), np.int32)

    def cast(self, cells: np.ndarray, labels: np.ndarray, weights: np.ndarray, strict: np.ndarray) -> None:
        """Add one view: each cell gets the mean of its sightings. Arrays (K,)."""
        fixed = np.round(weights * SCALE).astype(np.int64)
        _cast(cells, labels, fixed, self._sums, self._counts, self.votes)
        _cast(cells[strict], labels[strict], fixed[strict], self._sums, self._counts, self.strict)


@numba.njit(cache=True)
def _cast(cells, labels, weights, sums, counts, votes):  # noqa: ANN001, ANN202 - numba kernel, arrays as in _Ballot.cast
    touched = np.empty(len(cells), np.int64)
    num_touched = 0
    for k in range(len(cells)):
        cell, label = cells[k], labels[k]
        if label == 0 or cell < 0:
            continue
        if counts[cell] == 0:
            touched[num_touched] = cell
            num_touched += 1
        counts[cell] += 1
        sums[cell, label] += weights[k]
    for k in range(num_touched):
        cell = touched[k]
        for label in range(1, sums.shape[1]):
            votes[cell, label] += sums[cell, label] // counts[cell]
            sums[cell, label] = 0
        votes[cell, 0] += 1
        counts[cell] = 0


def _decide(ballot: _Ballot, cells: np.ndarray, overlay: np.ndarray, settings: Label) -> Labels:
    num_views = ballot.votes[cells, 0]
    winner, share = _winner(ballot.votes)
    if settings.method == "direct":
        seen = overlay > 0
        return Labels(overlay, seen.astype(np.float32), np.where(seen, SEED, UNSEEN).astype(np.uint8), num_views)
    state = np.where(winner > 0, SEED, UNSEEN).astype(np.uint8)
    if settings.method != "majority":
        consensus = 1.0 if settings.method == "paper" else settings.consensus
        locked = (ballot.votes[:, 0] >= 2) & (share < consensus - 1e-6)
        state[locked], winner[locked] = LOCKED, 0
        if settings.reproject:
            again, agreed = _winner(ballot.strict)
            unlocked = locked & (again > 0) & (agreed >= consensus - 1e-6)
            state[unlocked], winner[unlocked], share[unlocked] = UNLOCKED, again[unlocked], agreed[unlocked]
    return Labels(winner[cells], np.where(winner > 0, share, 0).astype(np.float32)[cells], state[cells], num_views)


def _winner(votes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(cells,) uint8 label with most votes (0 = no votes; ties: smallest id) and its float32 share of the votes."""
    label = votes[:, 1:].argmax(axis=1) + 1
    total = votes[:, 1:].sum(axis=1)
    share = votes[np.arange(len(votes)), label] / np.maximum(total, 1)
    return np.where(total > 0, label, 0).astype(np.uint8), share.astype(np.float32)
