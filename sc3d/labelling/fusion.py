"""Masks to labels on the cloud (paper sections 3.3 and 4.3): `fuse` is the whole method, in the paper's order.

One vote per view and voxel side; votes are fixed-point integers, so the result does not depend on the order of views
or points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sc3d.geometry.cameras import View, may_see
from sc3d.geometry.raycast import RayTarget
from sc3d.geometry.voxels import LabelGrid
from sc3d.io.progress import progress
from sc3d.labelling.cloud import Cloud
from sc3d.labelling.observation import ReadMask, observations
from sc3d.labelling.prior_cloud import PriorVotes
from sc3d.labelling.voting import SCALE, VoteAccumulator, VoteWeighting
from sc3d.scene.labels import LOCKED, SEED, UNLOCKED, UNSEEN, Labels
from sc3d.settings.labels import Label

ROUNDING = 1e-6  # of a share of votes


@dataclass(frozen=True)
class Fusion:
    """Result of `fuse`: labels per point, the label field, and (N,) int64 the row of the field's votes that each point
    belongs to.
    """

    labels: Labels
    grid: LabelGrid
    rows: np.ndarray

    @property
    def votes(self) -> np.ndarray:
        """(N, num_channels) float32 votes of the points' cells, in views of full weight; column 0 counts views."""
        return np.divide(self.grid.votes[self.rows], SCALE, dtype=np.float32)


def fuse(
    cloud: Cloud,
    views: list[View],
    read_mask: ReadMask,
    surface: RayTarget | None,
    num_channels: int,
    settings: Label,
    none: bool = False,
    prior: PriorVotes | None = None,
) -> Fusion:
    """Fuse the masks of all views into labels of the cloud.

    read_mask: mask of a view, any size of the photo's aspect; masks are streamed
    surface: what blocks the view; None (or settings.depth_filter off) = labels penetrate
    num_channels: as masks and labels hold channels, see `sc3d.scene.channels`, of which with `none` the last
        stands for "looked at, none of the classes"; settings.voxel_size must be set; prior: more votes
    """
    settings = settings.resolved
    last = num_channels - 1 if none else 0
    weighting = VoteWeighting.from_settings(settings, cloud.extent, views, last)
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    views = [view for view in views if may_see(view, low, high)]
    # multi-level voxel field: the rows of the grid are the accumulator
    accumulator = VoteAccumulator.for_cloud(
        cloud, settings.voxel_size, num_channels, settings.mechanisms.reproject
    )
    # pixel to first surface (eq. 4), semantic confidence voting
    seen = observations(views, read_mask, surface if settings.depth_filter else None, settings)
    for view, observation in progress(seen, "voting", "view", total=len(views)):
        accumulator.add_view(view, observation, weighting)
    if prior is not None:
        accumulator.add_prior(prior.label, prior.weight)
    if settings.method == "direct":
        return _fusion(_last_photo_wins(accumulator), accumulator)
    winner, share = most_voted(accumulator.votes, last)
    doubted = np.zeros(len(winner), bool)
    if settings.verify != "no" and settings.method != "majority":  # two-way verification
        doubted = ~accumulator.verify(winner, settings.verify == "weigh", last)
        winner, share = most_voted(accumulator.votes, last)
    state = np.where(winner > 0, SEED, UNSEEN).astype(np.uint8)
    if settings.method != "majority":  # conflict, reset, lock; once all views have voted
        locked = (accumulator.votes[:, 0] >= 2) & ((share < settings.consensus - ROUNDING) | doubted)
        state[locked], winner[locked] = LOCKED, 0
        if settings.mechanisms.reproject:  # reprojection optimization: a second, stricter vote
            again, agreed = most_voted(accumulator.strict, last)
            freed = locked & (accumulator.strict[:, 0] >= 2) & (agreed >= settings.consensus - ROUNDING)
            state[freed], winner[freed], share[freed] = UNLOCKED, again[freed], agreed[freed]
    num_views = accumulator.votes[:, 0]
    if none:  # where most of the votes are for none of the classes: agreed upon, or a conflict
        silent = none_share(accumulator.votes)
        mostly = silent > 0.5
        agreed = mostly & (silent >= settings.consensus - ROUNDING) & (accumulator.looked >= 2)
        winner, share = np.where(mostly, np.where(agreed, last, 0), winner), np.where(agreed, silent, share)
        state = np.where(mostly, np.where(agreed, SEED, LOCKED), state)
        num_views = np.where(mostly, accumulator.looked, num_views)
    winner, state = winner.astype(np.uint8), state.astype(np.uint8)
    share = np.where(winner > 0, share, 0).astype(np.float32)
    cells = Labels(winner, share, state, num_views)
    return _fusion(cells.map(accumulator.to_points), accumulator)


def most_voted(votes: np.ndarray, none: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Winner of each cell among the classes. votes: (K, num_channels), column 0 is ignored; none: as in
    `VoteWeighting`.

    returns: (K,) uint8 label with most votes (0 = no votes; ties: smallest id), (K,) float32 its share of the votes
    """
    votes = votes[:, :none] if none else votes
    label = votes[:, 1:].argmax(axis=1) + 1
    total = votes[:, 1:].sum(axis=1)
    share = votes[np.arange(len(votes)), label] / np.maximum(total, 1)
    return np.where(total > 0, label, 0).astype(np.uint8), share.astype(np.float32)


def none_share(votes: np.ndarray) -> np.ndarray:
    """(K,) float32 share of the last channel in votes (K, num_channels), of which column 0 is ignored; 0
    without votes.
    """
    total = votes[:, 1:].sum(axis=1, dtype=np.float64)
    return (votes[:, -1] / np.maximum(total, 1e-9)).astype(np.float32)


def _last_photo_wins(accumulator: VoteAccumulator) -> Labels:
    """Direct overlay, the paper's baseline: a point has the label of the last view that saw it."""
    overlay = np.empty_like(accumulator.overlay)
    overlay[accumulator.order] = accumulator.overlay
    seen, num_views = overlay > 0, accumulator.to_points(accumulator.votes[:, 0])
    return Labels(overlay, seen.astype(np.float32), np.where(seen, SEED, UNSEEN).astype(np.uint8), num_views)


def _fusion(labels: Labels, accumulator: VoteAccumulator) -> Fusion:
    return Fusion(labels, accumulator.grid, accumulator.to_points(accumulator.cloud.rows))
