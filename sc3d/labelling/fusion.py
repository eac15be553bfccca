"""Masks to labels on the cloud: project, vote per voxel, find conflicts, lock (paper sections 3.3 and 4.3).

One vote per view and voxel side; votes are fixed-point integers, so the result does not depend on the order
of views or points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numba
import numpy as np
from tqdm import tqdm

from sc3d.geometry.cameras import View, may_see
from sc3d.geometry.raycast import RayTarget, first_surface
from sc3d.geometry.voxels import LabelGrid, voxel_origin
from sc3d.labelling.voting import VoteAccumulator, open_accumulator
from sc3d.labelling.voting_kernels import SCALE, Observation, VoteWeighting
from sc3d.scene.labels import LOCKED, SEED, UNLOCKED, UNSEEN, Labels
from sc3d.settings.labels import Label

DISTANCE_STEPS = 16  # of a pixel
MIDDLE_STEPS = 1 << 16

AS_PRINTED = {  # the paper's own choices, whatever the defaults are
    "consensus": 1.0,
    "edge_width": 3.0,
    "depth_excess": True,
    "incidence": True,
    "range": True,
    "verify": "lock",
    "reproject": True,
}

Mask = tuple[np.ndarray, np.ndarray | None]  # (h, w) uint8 labels; (h, w) uint8 confidence or None


@dataclass(frozen=True)
class Extent:
    """Of a whole cloud, which decides the voxels and the range at which a vote has full weight. low, high:
    (3,) world, box around the points; middle: (3,) their median along each axis, to 1 / MIDDLE_STEPS of the
    box.
    """

    low: np.ndarray
    high: np.ndarray
    middle: np.ndarray

    @classmethod
    def from_points(cls, points: np.ndarray) -> Extent:
        """points: (N, 3) world."""
        low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
        return cls(low, high, histogram_median(count_steps(points, low, high), low, high))


@dataclass(frozen=True)
class Cloud:
    """What is to be labelled.

    points: (N, 3) float64 world; normals: (N, 3) float32 unit, towards the outside, or None
    density: (N,) float32 how much matter there is, for the points' weights inside a voxel, or None = all
        weigh the same
    whole: of the cloud that these points are a part of; None = they are all
    """

    points: np.ndarray
    normals: np.ndarray | None
    density: np.ndarray | None = None
    whole: Extent | None = None

    @property
    def extent(self) -> Extent:
        return self.whole or Extent.from_points(self.points)


@dataclass(frozen=True)
class Fusion:
    """Result of `fuse`: labels per point, the voxel field, and the cell of the field that each point belongs
    to.
    """

    labels: Labels
    field: LabelGrid
    cells: np.ndarray

    @property
    def votes(self) -> np.ndarray:
        """(N, num_ids) float32 votes of the points' cells, in views of full weight; column 0 counts views."""
        return self.field.votes[self.cells].astype(np.float32) / SCALE


def fuse(
    cloud: Cloud,
    views: list[View],
    read_mask: Callable[[View], Mask],
    surface: RayTarget | None,
    num_ids: int,
    settings: Label,
) -> Fusion:
    """Fuse the masks of all views into labels of the cloud.

    read_mask: mask of a view, any size of the photo's aspect; masks are streamed
    surface: what blocks the view; None (or settings.depth_filter off) = labels penetrate
    num_ids: largest class id + 1; settings.voxel_size must be set
    """
    if settings.method == "paper":
        settings = replace(settings, **AS_PRINTED)
    extent = cloud.extent
    ballot, field = open_accumulator(
        cloud, voxel_origin(extent.low, settings.voxel_size), settings.voxel_size, num_ids
    )
    rules = _weighting(extent.middle, views, settings)
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    views = [view for view in views if may_see(view, low, high)]
    pictures = _observations(views, read_mask, surface if settings.depth_filter else None, settings)
    for view, picture in tqdm(pictures, desc="voting", unit="view", total=len(views), disable=None):
        ballot.cast(view, picture, rules)
    labels = _decide(ballot, settings)
    field.votes[ballot.field_cells] = ballot.votes
    return Fusion(labels, field, ballot.to_points(ballot.field_cells))


def count_steps(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(3, MIDDLE_STEPS) int64 points in each of the steps between low and high (3,) along each axis: counts
    of parts of a cloud add up to those of the whole.
    """
    size = np.maximum(high - low, 1e-300)
    return np.stack(
        [
            np.bincount(
                np.minimum(
                    (points[:, axis] - low[axis]) / size[axis] * MIDDLE_STEPS, MIDDLE_STEPS - 1
                ).astype(np.int32),
                minlength=MIDDLE_STEPS,
            )
            for axis in range(3)
        ]
    )


def histogram_median(counts: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(3,) median position from the counts of `count_steps`."""
    below = np.cumsum(counts, axis=1)
    step = (below < (below[:, -1:] + 1) // 2).sum(axis=1)
    return low + (step + 0.5) / MIDDLE_STEPS * (high - low)


def _weighting(middle: np.ndarray, views: list[View], settings: Label) -> VoteWeighting:
    reference_depth = (
        float(np.median([np.linalg.norm(view.center - middle) for view in views])) if views else 1.0
    )
    equal = settings.method in ("direct", "majority")
    return VoteWeighting(
        settings.voxel_size,
        reference_depth,
        settings.depth_excess,
        settings.incidence,
        settings.range,
        equal,
        settings.reproject,
    )


def _observations(
    views: list[View], read_mask: Callable[[View], Mask], surface: RayTarget | None, settings: Label
) -> Iterator[tuple[View, Observation]]:
    """Views in the order of their names, at the size of their masks, with what they say; the next one is
    prepared meanwhile.
    """
    ordered = sorted(views, key=lambda view: view.name)

    def prepare(view: View) -> tuple[View, Observation]:
        mask, confidence = read_mask(view)
        sized = view.resized(mask.shape[1], mask.shape[0])
        ranges = np.empty((0, 0), np.float32) if surface is None else first_surface(surface, sized).range
        return sized, observe(
            mask, confidence if settings.use_confidence else None, edge_distance(mask), ranges, settings
        )

    # what runs on one core only overlaps with the votes of the view before
    with ThreadPoolExecutor(1) as worker:
        pending = [worker.submit(prepare, view) for view in ordered[:1]]
        for following in [*ordered[1:], None]:
            ready = pending.pop().result() if pending else None
            if following is not None:
                pending.append(worker.submit(prepare, following))
            if ready is not None:
                yield ready


def observe(
    mask: np.ndarray, confidence: np.ndarray | None, edge: np.ndarray, ranges: np.ndarray, settings: Label
) -> Observation:
    """Weight of each mask pixel: confidence x distance to the mask's edges.

    mask: (H, W) uint8; confidence: (H, W) uint8 or None; edge: (H, W) float32 px; ranges: (H, W) float32 or
        (0, 0)
    """
    weights = np.ones(mask.shape, np.float32) if confidence is None else confidence * np.float32(1 / 255)
    if settings.edge_width > 0:
        weigh_distance(edge, distance_weights(settings.edge_width), weights)
    return Observation(mask, weights, edge >= settings.edge_width, ranges)


def distance_weights(width: float) -> np.ndarray:
    """(T,) float32 table of 1 - exp(-distance / width), distance in steps of 1 / DISTANCE_STEPS px; the last
    entry, 1, holds from there on.
    """
    table = -np.expm1(-np.arange(int(12 * width * DISTANCE_STEPS) + 2) / (width * DISTANCE_STEPS)).astype(
        np.float32
    )
    table[-1] = 1
    return table


@numba.njit(parallel=True, cache=True)
def weigh_distance(distance, table, weights):
    """Multiply weights (H, W) float32 by the table's entry for each distance (H, W) float32, px; exponentials
    of all pixels would cost 5 times as much.
    """
    for row in numba.prange(distance.shape[0]):
        for column in range(distance.shape[1]):
            step = int(
                min(distance[row, column] * DISTANCE_STEPS + np.float32(0.5), np.float32(len(table) - 1))
            )
            weights[row, column] *= table[step]


def edge_distance(mask: np.ndarray) -> np.ndarray:
    """(H, W) float32 distance of each pixel to the nearest pixel of another label, px; large where there is
    only one label.
    """
    differs = np.zeros(mask.shape, bool)
    differs[:, 1:] |= mask[:, 1:] != mask[:, :-1]
    differs[:, :-1] |= differs[:, 1:]
    vertical = mask[1:] != mask[:-1]
    differs[1:] |= vertical
    differs[:-1] |= vertical
    if not differs.any():
        return np.full(mask.shape, np.float32(sum(mask.shape)))
    return cv2.distanceTransform((~differs).astype(np.uint8), cv2.DIST_L2, 5) + np.float32(0.5)


def _decide(ballot: VoteAccumulator, settings: Label) -> Labels:
    """Winner, conflict, reset, lock and unlock per cell, once all views have voted; then per point."""
    num_views = ballot.to_points(ballot.votes[:, 0])
    if settings.method == "direct":
        overlay = np.empty_like(ballot.overlay)
        overlay[ballot.order] = ballot.overlay
        seen = overlay > 0
        return Labels(
            overlay, seen.astype(np.float32), np.where(seen, SEED, UNSEEN).astype(np.uint8), num_views
        )
    winner, share = _winner(ballot.votes)
    doubted = np.zeros(len(winner), bool)
    if settings.verify != "no" and settings.method != "majority":
        votes, passed = ballot.verified(winner)
        doubted = ~passed
        if settings.verify == "weigh":
            ballot.votes[:] = votes
            winner, share = _winner(votes)
    state = np.where(winner > 0, SEED, UNSEEN).astype(np.uint8)
    if settings.method != "majority":
        locked = (ballot.votes[:, 0] >= 2) & ((share < settings.consensus - 1e-6) | doubted)
        state[locked], winner[locked] = LOCKED, 0
        if settings.reproject:
            again, agreed = _winner(ballot.strict)
            unlocked = locked & (ballot.strict[:, 0] >= 2) & (agreed >= settings.consensus - 1e-6)
            state[unlocked], winner[unlocked], share[unlocked] = UNLOCKED, again[unlocked], agreed[unlocked]
    share = np.where(winner > 0, share, np.float32(0))
    return Labels(ballot.to_points(winner), ballot.to_points(share), ballot.to_points(state), num_views)


def _winner(votes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(cells,) uint8 label with most votes (0 = no votes; ties: smallest id) and its float32 share of the
    votes.
    """
    label = votes[:, 1:].argmax(axis=1) + 1
    total = votes[:, 1:].sum(axis=1)
    share = votes[np.arange(len(votes)), label] / np.maximum(total, 1)
    return np.where(total > 0, label, 0).astype(np.uint8), share.astype(np.float32)
