"""Two-way verification: what the fused labels say is held against what each view said, place by
place.

A segmenter errs by whole segments, so a view that contradicts the fused labels around a place is doubted in
all it says there. The votes of each view and cell wait in a temporary file: memory does not grow with the number of views, and
no ray is cast again.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

import numba
import numpy as np

from sc3d.geometry.voxels import SIDES, VOXELS, LabelGrid

# belief in a view where it says little: as if so many of its votes had been right at this rate
PRIOR_VIEWS, PRIOR_SHARE = 2.0, 0.8
MIN_RELIABILITY = 0.05
NEIGHBOR_WEIGHTS = (8, 4, 2, 1)  # of the blocks around a place, by the number of axes along which they differ


@dataclass
class VoteLog:
    """One entry per view: the cells that it voted on, their label with the most weight, and that weight in
    fixed point.
    """

    counts: list[int] = field(default_factory=list)
    file: BinaryIO = field(default_factory=tempfile.TemporaryFile)

    def append(self, labels: np.ndarray, weights: np.ndarray) -> None:
        """labels: (K,) uint8, weights: (K,) uint16 for every cell; label 0 = no vote."""
        cells = np.flatnonzero(labels).astype(np.int32)
        self.counts.append(len(cells))
        for values in (cells, labels[cells], weights[cells]):
            self.file.write(values.tobytes())

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Cells int32, labels uint8 and weights uint16 of each view, in turn."""
        self.file.seek(0)
        for count in self.counts:
            cells, labels, weights = (
                np.frombuffer(self.file.read(count * np.dtype(kind).itemsize), kind)
                for kind in (np.int32, np.uint8, np.uint16)
            )
            yield cells, labels, weights


def verify(
    log: VoteLog, winner: np.ndarray, grid: LabelGrid, rows: np.ndarray, full_vote: int, reweigh: bool
) -> np.ndarray:
    """Hold each view's votes against the winners around each place; a place is a block of the grid.

    A view's reliability there is the share of its votes in the block and the 26 around it that agree with the winners.
    winner: (K,) uint8 fused labels; rows: (K,) int64 rows of the cells in the grid's votes; full_vote: largest weight
    reweigh: vote again, in the grid: each view's vote times the square of its reliability
    returns: (K,) bool, at least half of the views that voted for the winner are reliable (above 1/2) around the cell
    """
    block_of_cell, neighbors, votes = rows // (VOXELS * SIDES), grid.neighbors(), grid.votes
    balance, prior = np.zeros(len(winner), np.int32), PRIOR_VIEWS * full_vote * NEIGHBOR_WEIGHTS[0]
    if reweigh:
        votes[rows, 1:] = 0
    for cells, labels, weights in log:
        reliability = _reliability(cells, labels, weights, winner, block_of_cell, neighbors, prior)
        reliability = reliability[block_of_cell[cells]]
        _weigh_views(cells, labels, winner, reliability, balance)
        if reweigh:
            _add_again(rows[cells], labels, weights, reliability, votes)
    return balance >= 0


@numba.njit(cache=True, error_model="numpy")
def _reliability(cells, labels, weights, winner, block_of_cell, neighbors, prior):
    """(B,) share of the view's votes in and around each block that agree with the winners; integer sums, so
    no order matters.
    """
    sums = np.zeros((len(neighbors), 2), np.int64)
    for k in range(len(cells)):
        cell = cells[k]
        sums[block_of_cell[cell], 0] += weights[k] if labels[k] == winner[cell] else 0
        sums[block_of_cell[cell], 1] += weights[k]
    result = np.zeros(len(neighbors))
    for block in range(len(neighbors)):
        if sums[block, 1] == 0:
            continue
        agreeing = total = 0
        for around in range(27):
            other = neighbors[block, around]
            if other >= 0:
                differing = (around // 9 != 1) + (around // 3 % 3 != 1) + (around % 3 != 1)
                agreeing += NEIGHBOR_WEIGHTS[differing] * sums[other, 0]
                total += NEIGHBOR_WEIGHTS[differing] * sums[other, 1]
        result[block] = (agreeing + prior * PRIOR_SHARE) / (total + prior)
    return result


@numba.njit(cache=True)
def _weigh_views(cells, labels, winner, reliability, balance):
    """Count for and against each cell whether a view is reliable where it voted for the winner."""
    for k in range(len(cells)):
        if labels[k] == winner[cells[k]]:
            balance[cells[k]] += 1 if reliability[k] >= 0.5 else -1


@numba.njit(cache=True)
def _add_again(rows, labels, weights, reliability, votes):
    """Add a view's votes, weighed by its reliability, to channel `label` of its rows."""
    for k in range(len(rows)):
        trusted = max(reliability[k], MIN_RELIABILITY)
        votes[rows[k], labels[k]] += np.int32(weights[k] * trusted * trusted + 0.5)
