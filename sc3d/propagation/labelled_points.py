"""What is known of the points before labels spread: seeds, votes, colors; which of them can teach the classes' look."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sc3d.propagation.none_evidence import NoneRates
from sc3d.scene.labels import CORRECTED, SEED, UNLOCKED, Labels

# seeds to learn from: seen by so many views, this share of their votes
AGREED_VIEWS, AGREED_SHARE = 3, 0.9
MIN_EXAMPLES = 500  # agreed points of a class; with fewer, its look is not known


@dataclass(frozen=True)
class LabelledPoints:
    """What is known of N points, canonical order.

    points: (N, 3) world; seeds: labels of fusion, which are channels (`sc3d.scene.channels`); votes: (N, C + 1)
        float32 or None, column 0 is ignored; colors: (N, 3) uint8 or None
    up: (3,) of the cameras, None = not known
    none: the last of the C labels, and the last column of the votes, stand for none of the classes; rates:
    what is known of the votes for it; levels: (C,) of `ClassTable.levels`, None = nobody knows
    """

    points: np.ndarray
    seeds: Labels
    votes: np.ndarray | None
    colors: np.ndarray | None
    up: np.ndarray | None = None
    none: bool = False
    rates: NoneRates | None = None
    levels: np.ndarray | None = None

    def ordered(self, order: np.ndarray) -> LabelledPoints:
        votes, colors = (None if part is None else part[order] for part in (self.votes, self.colors))
        return replace(self, points=self.points[order], seeds=self.seeds[order], votes=votes, colors=colors)

    @property
    def known_votes(self) -> np.ndarray:
        """(N, C + 1) float32 votes, where the method needs them; ValueError if there are none."""
        if self.votes is None:
            raise ValueError("these points have no votes, which the map method needs")
        return self.votes

    @property
    def required_levels(self) -> np.ndarray:
        """(C,) levels; ValueError if there are none."""
        if self.levels is None:
            raise ValueError("nobody knows which classes stand on the ground")
        return self.levels

    @property
    def seed_labels(self) -> np.ndarray:
        """(N,) uint8 labels of the seeds, 0 elsewhere."""
        known = np.isin(self.seeds.state, (SEED, UNLOCKED, CORRECTED))
        return np.where(known, self.seeds.label, 0).astype(np.uint8)

    @property
    def corrected(self) -> np.ndarray:
        """(N,) bool points whose label a person has set; of these, label 0 means none of the classes."""
        return self.seeds.state == CORRECTED

    @property
    def sightings(self) -> np.ndarray:
        """(N,) views that saw each point; a person counts as many."""
        return np.where(self.corrected, np.maximum(self.seeds.num_views, AGREED_VIEWS), self.seeds.num_views)

    @property
    def sure(self) -> np.ndarray:
        """(N,) bool seeds with hardly a vote against them."""
        agreed = np.isin(self.seeds.state, (SEED, CORRECTED)) & (self.seeds.confidence >= AGREED_SHARE)
        return agreed & (self.seed_labels > 0)

    def agreement(self, core: np.ndarray | None = None) -> np.ndarray:
        """(AGREED_VIEWS, 256) int64: sure seeds of each class that at least 1, 2, ... views saw; core: (N,)
        bool points to count, None = all.
        """
        sure, start = self.sure if core is None else self.sure & core, self.seed_labels
        sightings = self.sightings
        if self.none:
            sure = sure & (start < self.num_classes)
        return np.stack(
            [
                np.bincount(start[sure & (sightings >= least)], minlength=256)
                for least in range(1, AGREED_VIEWS + 1)
            ]
        )

    def agreed_by(self, least: int) -> np.ndarray:
        """(N,) bool sure seeds that at least so many views saw."""
        return self.sure & (self.sightings >= least)

    @property
    def agreed(self) -> np.ndarray:
        """(N,) bool seeds that many views agree on."""
        return self.agreed_by(views_to_agree(self.agreement()))

    @property
    def num_classes(self) -> int:
        return (int(self.seeds.label.max(initial=1)) + 1 if self.votes is None else self.votes.shape[1]) - 1


def views_to_agree(agreement: np.ndarray) -> int:
    """How many views must have seen an example: AGREED_VIEWS, or fewer, where some class would have too few
    examples: to the appearance model it would not exist.

    agreement: (AGREED_VIEWS, 256) of the whole cloud
    """
    wanted = agreement[0] >= MIN_EXAMPLES
    return next(
        (
            least
            for least in range(AGREED_VIEWS, 1, -1)
            if (agreement[least - 1][wanted] >= MIN_EXAMPLES).all()
        ),
        1,
    )


def tie_breakers(evidence: LabelledPoints, normals: np.ndarray | None) -> tuple[np.ndarray, ...]:
    """Arrays (N,) that tell points of equal position apart, for `build_graph`."""
    seeds = evidence.seeds
    tables = (part for part in (evidence.votes, evidence.colors, normals) if part is not None)
    return (
        seeds.label,
        seeds.state,
        seeds.num_views,
        seeds.confidence,
        *(column for table in tables for column in table.T),
    )
