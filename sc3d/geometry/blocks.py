"""The ground plane cut into blocks that share borders, to work on what is large part by part."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sc3d.errors import InputError

BORDER = 0.125  # of a block's side, on each side
MIN_POINTS = 10  # of a block
# of the sparse points that a photo sees, or of those in the block: fewer, and the photo is not worth its time
SHARE = 0.05


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
        return np.all((flat >= self.low - width) & (flat < self.high + width), axis=1)


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


def views_of(block: Block, points: np.ndarray, tracks: list[np.ndarray]) -> list[int]:
    """Indices of the views that see enough of a block's core. points: (N, 3) sparse points; tracks: per view
    the rows of those that it sees
    """
    inside, chosen = block.holds(points), []
    for index, rows in enumerate(tracks):
        if inside[rows].sum() >= max(MIN_POINTS, SHARE * min(len(rows), int(inside.sum()))):
            chosen.append(index)
    return chosen


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
    lower = replace(block, high=_moved(block.high, axis, place))
    upper = replace(block, low=_moved(block.low, axis, place))
    return _cut(flat[left], first, lower) + _cut(flat[~left], count - first, upper)


def _moved(corner: tuple[float, float], axis: int, place: float) -> tuple[float, float]:
    return (corner[0], place) if axis else (place, corner[1])
