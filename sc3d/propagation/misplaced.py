"""Votes for what stands, on what lies on the ground, and the other way round.

Where the class table says by ASPRS codes which classes lie on the ground and which stand on it, relief checks
the masks: the points voted for each class have two sides, by what the other classes' agreed points look like.
If far more of one class than of the others of its level lie on the wrong side, that is no fault of the relief:
most votes for this class are wrong, and all views share the error. On each point, as much of its votes as is
likely to be wrong then goes to the classes of the other level.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from sc3d.propagation.histogram import Histogram
from sc3d.propagation.labelled_points import MIN_EXAMPLES, LabelledPoints
from sc3d.scene.class_table import ON_GROUND, STANDING
from sc3d.scene.labels import LOCKED

MIN_GAP = 0.5  # between the shares of the two levels on one side, so that relief can judge
GROSS = 0.25  # misplaced share below which the classes of a level may simply differ
MOST = 0.99

logger = logging.getLogger(__name__)


def side_odds(relief: Histogram, counts: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """(cells,) float32 log-ratio of the densities of what stands and of what lies on the ground.

    counts: (cells, C) examples; levels: as of `ClassTable.levels`
    """
    pooled = np.stack(
        [counts[:, levels == level].sum(axis=1) for level in (ON_GROUND, STANDING)],
        axis=1,
    )
    table = relief.likelihood(pooled)
    return table[:, STANDING] - table[:, ON_GROUND]


def count_sides(
    relief: Histogram,
    halves: list[np.ndarray],
    known: LabelledPoints,
    examples: np.ndarray,
    folds: np.ndarray,
) -> np.ndarray:
    """(C, 2) int64 examples (N,) bool of each class on the side of ON_GROUND and of STANDING, as the other of
    the two folds (N,) tells. halves: (cells, C) examples of each fold, of the whole cloud
    """
    levels = known.required_levels
    odds = np.stack([side_odds(relief, halves[1 - fold], levels) for fold in (0, 1)])
    rows = np.flatnonzero(examples)
    stands = odds[folds[rows], relief.cell[rows]] > 0
    own = known.seed_labels[rows].astype(np.int64) - 1
    return np.bincount(2 * own + stands, minlength=2 * len(levels)).reshape(-1, 2)


def misplaced_shares(sides: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """(C,) share of the points voted for each class that are of the other level: of those on its side, what
    is more than the other classes of its own level have there. 0 where it is small, or relief cannot judge.

    sides: (C, 2) of `count_sides`
    """
    result = np.zeros(len(levels))
    for own in np.flatnonzero(levels >= 0):
        across = 1 - levels[own]
        peers = (levels == levels[own]) & (np.arange(len(levels)) != own)
        groups = sides[own], sides[peers].sum(axis=0), sides[levels == across].sum(axis=0)
        if min(part.sum() for part in groups) < MIN_EXAMPLES:
            continue
        share, usual, there = (part[across] / part.sum() for part in groups)
        if there - usual >= MIN_GAP:
            result[own] = np.clip((share - usual) / (there - usual), 0, MOST)
    return np.where(result < GROSS, 0, result)


@dataclass(frozen=True)
class Misplaced:
    """right: (cells, C) float32 how much votes for each class count in each cell of the relief; 1 for classes
    that are where they belong
    """

    right: np.ndarray

    @classmethod
    def measure(
        cls, relief: Histogram, halves: list[np.ndarray], sides: np.ndarray, levels: np.ndarray
    ) -> Misplaced | None:
        """None where no class is misplaced. halves, sides: as of `count_sides`, of the whole cloud

        The density of a class's examples is a mixture of its own and that of the other level, whose part, the
        share times the ratio of the two, is wrong.
        """
        shares, counts = misplaced_shares(sides, levels), halves[0] + halves[1]
        if not shares.any():
            return None
        logger.warning(
            "%d of %d classes stand where the others that stand do not, or lie where the others that lie do not (%s of"
            " their agreed points): votes for them count where the relief fits",
            (shares > 0).sum(),
            (levels >= 0).sum(),
            ", ".join(f"{share:.0%}" for share in shares[shares > 0]),
        )
        right = np.ones(counts.shape, np.float32)
        for own in np.flatnonzero(shares):
            other = counts[:, levels == 1 - levels[own]].sum(axis=1)
            table = relief.likelihood(np.stack([counts[:, own], other], axis=1))
            right[:, own] = np.clip(1 - shares[own] * np.exp(table[:, 1] - table[:, 0]), 0, 1)
        return cls(right)

    def without(self, known: LabelledPoints, cell: np.ndarray) -> LabelledPoints:
        """What is known of the points once the wrong part of these votes is for the classes of the other
        level, all alike. Seeds that are likelier of that level are in conflict, but for those that a person
        has set.

        cell: (N,) of the relief of each point
        """
        votes, seeds, levels = known.known_votes.copy(), known.seed_labels, known.required_levels
        conflict = np.zeros(len(cell), bool)
        for own in np.flatnonzero((self.right < 1).any(axis=0)):
            right = self.right[cell, own]
            across = np.flatnonzero(levels == 1 - levels[own]) + 1
            votes[:, across] += (votes[:, own + 1] * (1 - right) / len(across))[:, None]
            votes[:, own + 1] *= right
            conflict |= (seeds == own + 1) & (right < 0.5) & ~known.corrected
        label = np.where(conflict, 0, known.seeds.label).astype(np.uint8)
        state = np.where(conflict, LOCKED, known.seeds.state).astype(np.uint8)
        return replace(known, votes=votes, seeds=replace(known.seeds, label=label, state=state))
