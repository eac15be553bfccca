"""Evidence that a point belongs to none of the classes: how often the views that look at it find nothing
there, against how often they miss what is there.

Masks have holes, and they have more of them on some classes than on others. How many is learned from the
votes themselves: on points whose votes for classes name class c, the share h_c of all votes that name none;
on points where most votes name none, that share g. A point of N votes, a share s of which names none, then
speaks for "none" against its own best class by N (s log(g / h) + (1 - s) log((1 - g) / (1 - h))), which
changes sign at some s, and never below one half. Whatever the class, it is held against its own rate:
otherwise the class with the most holes would attract all that has no label.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MAX_EVIDENCE = 5.0  # a point's votes count as at most this many, as views that look alike err alike
UNIT = 256  # of a vote, in whole numbers, which add up in any order
PRIOR_VOTES = 100.0  # of each rate, beside what is counted
MISSED, SILENT = 0.2, 0.8  # rates that these have: holes in a class; of votes on what is none of them
EVEN = 0.5  # share of votes for none below which they never win


@dataclass(frozen=True)
class NoneRates:
    """How often views find nothing. missed: (C + 1,) on points of each class, entry 0 = on those without a
    vote for one; silent: on what is none of the classes; prior: share of all votes that fall on what is
    none of the classes.
    """

    missed: np.ndarray
    silent: float
    prior: float

    @classmethod
    def from_counts(cls, counts: np.ndarray) -> NoneRates:
        """counts: as `count_votes` gives them, of a whole cloud."""
        seen, prior = counts / UNIT, np.full(len(counts), MISSED)
        prior[0] = SILENT
        rates = (seen[:, 0] + PRIOR_VOTES * prior) / (seen.sum(axis=1) + PRIOR_VOTES)
        silent = max(float(rates[0]), EVEN + 0.01)
        missed = np.clip(rates, 0.01, silent - 0.01)
        missed[0] = missed[1:].max()
        share = (seen[0].sum() + 1) / (seen[1:].sum() + seen[0, 0] + 2)
        return cls(missed, silent, float(np.clip(share, 0.001, 0.5)))

    @property
    def prior_odds(self) -> float:
        """Natural logarithm."""
        return float(np.log(self.prior / (1 - self.prior)))

    def log_odds(self, votes: np.ndarray) -> np.ndarray:
        """(N,) float32 log-odds of none against the best class, by votes (N, C + 2) as in `LabelledPoints`;
        0 without votes.
        """
        total = votes[:, 1:].sum(axis=1)
        return np.minimum(total, np.float32(MAX_EVIDENCE)) * self.log_odds_of_one(votes)

    def log_odds_of_one(self, votes: np.ndarray) -> np.ndarray:
        """The same of a single vote, divided among the classes and none as the votes are; 0 without votes."""
        share = none_share(votes)
        missed, silent = self.missed[best_class(votes)], self.silent
        gain, loss = np.log(silent / missed), np.log((1 - silent) / (1 - missed))
        border = np.maximum(-loss / (gain - loss), EVEN)
        odds = (gain - loss) * (share - border) * votes[:, 1:].any(axis=1)
        return odds.astype(np.float32)


def none_share(votes: np.ndarray) -> np.ndarray:
    """(N,) float32 share of the votes (N, C + 2) that name none of the classes, the last column; 0 without
    votes.
    """
    return (votes[:, -1] / np.maximum(votes[:, 1:].sum(axis=1), np.float32(1e-9))).astype(np.float32)


def best_class(votes: np.ndarray) -> np.ndarray:
    """(N,) int64 class with the most votes (N, C + 2); 0 where none has any."""
    return np.where(votes[:, 1:-1].any(axis=1), votes[:, 1:-1].argmax(axis=1) + 1, 0)


def count_votes(votes: np.ndarray) -> np.ndarray:
    """(C + 1, 2) int64 votes for none and for classes, in UNITs: row c on points whose best class is c, row
    0 on points where most votes name none. votes: (N, C + 2) as in `LabelledPoints`; parts of a cloud add
    up.
    """
    num_classes = votes.shape[1] - 2
    pair = np.rint(np.stack([votes[:, -1], votes[:, 1:-1].sum(axis=1)], axis=1) * UNIT).astype(np.int64)
    best, result = best_class(votes), np.zeros((num_classes + 1, 2), np.int64)
    result[0] = pair[pair[:, 0] > pair[:, 1]].sum(axis=0)
    for label in range(1, num_classes + 1):
        result[label] = pair[best == label].sum(axis=0)
    return result
