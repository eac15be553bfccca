"""Training by blocks: the ground plane is cut into boxes that share borders, each is trained on its own, and
their cores become one model.

Memory is that of a block, and blocks can be trained at the same time; see `sc3d.splatting.block_tasks` for
where and how they run.

A photo of a block also shows ground outside. Those pixels are left out of the loss, rather than explained by
coarse Gaussians that are dropped
afterwards: such a context costs the memory and time that blocks are to save, and what it gets wrong the
    block's own Gaussians would make up for.
What a pixel shows is told by the nearest sparse points that its photo sees, so a roof before the block counts
as what it is: outside.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, in_image, project
from sc3d.settings.train import TrainSettings
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.gaussians import Gaussians

BORDER = 0.125  # of a block's side, on each side
# of the sparse points that a photo sees, or of those in the block: fewer, and the photo is not worth its time
SHARE = 0.05
MIN_POINTS = 10
NEAREST = 5  # sparse points that say what a pixel shows
CELL = 4  # px, side of the cells of which that is asked


@dataclass(frozen=True)
class Block:
    """A box of the ground plane, endless where the scene ends.

    axes: the two world axes of the ground plane; low, high: corners along them, low inclusive; border: width
        of the border along them; world units
    """

    axes: tuple[int, int]
    low: tuple[float, float]
    high: tuple[float, float]
    border: tuple[float, float]

    def holds(self, points: np.ndarray, border: bool = False) -> np.ndarray:
        """(N,) bool: which of the (N, 3) points lie in the core, or in the core and its border. Every point
        lies in the core of one block.
        """
        flat, width = np.asarray(points, np.float64)[:, self.axes], np.array(self.border) * border
        return ((flat >= self.low - width) & (flat < self.high + width)).all(axis=1)


def split_blocks(points: np.ndarray, count: int) -> list[Block]:
    """Blocks with about equal numbers of the (N, 3) sparse points, by median cuts across the longer side;
    their cores fill the plane.

    Raises InputError if there are fewer than MIN_POINTS points for each.
    """
    points = np.asarray(points, np.float64)
    if len(points) < MIN_POINTS * count:
        raise InputError(f"{len(points)} sparse points are too few for {count} blocks: lower --blocks")
    axes = tuple(sorted(np.argsort(_sides(points), kind="stable")[1:].tolist()))
    return _cut(points[:, axes], count, Block(axes, (-np.inf, -np.inf), (np.inf, np.inf), (0.0, 0.0)))


def views_of(data: TrainingData, block: Block) -> list[int]:
    """Indices of the views that see enough of a block's core."""
    inside = block.holds(data.points)
    needed = [
        max(MIN_POINTS, SHARE * min(len(rows), int(inside.sum())))
        for rows in map(data.seen, range(len(data.views)))
    ]
    return [index for index in range(len(data.views)) if inside[data.seen(index)].sum() >= needed[index]]


def restrict(data: TrainingData, block: Block, views: list[int]) -> TrainingData:
    """What a block is trained on: its views, the sparse points in core and border, masks of the pixels that
    show those.
    """
    near = block.holds(data.points, border=True)
    position = np.cumsum(near) - 1
    seen = [data.seen(index) for index in views]
    shown = [
        _shown(data.views[index], data.points[rows], near[rows])
        for index, rows in zip(views, seen, strict=True)
    ]

    def mask(row: int) -> np.ndarray:
        view, own = data.views[views[row]], data.mask(views[row])
        found = cv2.resize(shown[row], (view.width, view.height), interpolation=cv2.INTER_NEAREST).astype(
            bool
        )
        return found if own is None else found & own

    tracks = [position[rows[near[rows]]] for rows in seen]
    return TrainingData(
        [data.views[index] for index in views],
        lambda row: data.image(views[row]),
        data.points[near],
        data.colors[near],
        tracks,
        mask,
    )


def share_settings(
    settings: TrainSettings, data: TrainingData, block: Block, views: list[int]
) -> TrainSettings:
    """Settings of one block: its share of the steps, by views, and of the Gaussians, by sparse points with
    those in the border.

    So each photo is looked at as often as without blocks, and all cores together hold about `max_gaussians`.
    """
    num_views = len(data.views) - len(settings.held_out(len(data.views)))
    iterations = max(1, round(settings.iterations * len(views) / num_views))
    max_gaussians = max(
        1, round(settings.max_gaussians * float(block.holds(data.points, border=True).mean()))
    )
    return replace(settings, iterations=iterations, max_gaussians=max_gaussians, test_every=0)


def merge(parts: list[Gaussians], blocks: list[Block]) -> Gaussians:
    """The Gaussians of every part whose centers lie in the core of its block, in the order of the blocks."""
    cores = [
        part[torch.from_numpy(block.holds(part.means.numpy()))]
        for part, block in zip(parts, blocks, strict=True)
    ]
    return Gaussians(
        **{name: torch.cat([core.parameters()[name] for core in cores]) for name in cores[0].parameters()}
    )


def _sides(points: np.ndarray) -> np.ndarray:
    """(D,) extent of (N, D) points without the 2 % farthest out."""
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    return high - low


def _cut(flat: np.ndarray, count: int, block: Block) -> list[Block]:
    sides = _sides(flat)
    if count == 1:
        return [replace(block, border=tuple((BORDER * sides).tolist()))]
    axis, first = int(np.argmax(sides)), count // 2
    place = float(np.quantile(flat[:, axis], first / count))
    left = flat[:, axis] < place
    # many points at one place
    if min(left.sum() // first, (~left).sum() // (count - first)) < MIN_POINTS // 2:
        raise InputError("the sparse points cannot be cut into so many blocks: lower --blocks")
    low, high = list(block.low), list(block.high)
    low[axis] = high[axis] = place
    return _cut(flat[left], first, replace(block, high=tuple(high))) + _cut(
        flat[~left], count - first, replace(block, low=tuple(low))
    )


def _shown(view: View, points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """(H / CELL, W / CELL) uint8: cells of a photo that show core or border, by majority of the nearest
    sparse points.

    points: (T, 3) sparse points that the view sees; near: (T,) bool, those in core or border
    """
    shape = -(-view.height // CELL), -(-view.width // CELL)
    pixels, depths = project(view, points)
    usable = in_image(view, pixels) & (depths > 0)
    if not usable.any():
        return np.zeros(shape, np.uint8)
    columns, rows = np.meshgrid(
        (np.arange(shape[1]) + 0.5) * view.width / shape[1],
        (np.arange(shape[0]) + 0.5) * view.height / shape[0],
    )
    count = min(NEAREST, int(usable.sum()))
    nearest = (
        cKDTree(pixels[usable])
        .query(np.stack([columns.ravel(), rows.ravel()], 1), k=count)[1]
        .reshape(-1, count)
    )
    return (2 * near[usable][nearest].sum(axis=1) > count).astype(np.uint8).reshape(shape)
