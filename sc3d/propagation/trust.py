"""How far looks and votes are believed, as measured in each scene.

Votes are judged by one another: how often views disagree. Looks are judged on blocks of space that they
were not learned from, class against class: two classes that they do not tell apart share one look and are
left to the votes; the groups of features are weighted so that the held-out points are likeliest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sc3d.propagation.vote_evidence import error_of

# of the log-ratio of two classes' densities, per group of features; beyond: the last bin
BINS, REACH = 17, 6.0
MIN_SKILL = 0.5  # share of the errors of guessing that looks must avoid on points held out, of two classes alike in number
WEIGHTS = np.linspace(0.0, 1.0, 11)  # tried for each group of features


@dataclass(frozen=True)
class Trust:
    """What was measured, of C classes.

    error: share of the views that are wrong; weights: (G,) of the groups of features, 1 = as if their
        log-likelihoods were right; look: (C,) int, the same for classes that are not told apart, -1 = left
        to the votes
    """

    error: float
    weights: np.ndarray
    look: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """(C,) bool classes whose look is known."""
        return self.look >= 0

    @property
    def shared(self) -> np.ndarray:
        """(C,) bool classes that look like another."""
        return self.known & ((self.look[:, None] == self.look).sum(axis=1) > 1)

    def describe(self) -> str:
        """In one line."""
        weights, looks = (
            ", ".join(f"{weight:.1f}" for weight in self.weights),
            len(np.unique(self.look[self.known])),
        )
        return f"{looks} looks of {self.known.sum()} classes told apart, weights {weights}; views are wrong in {100 * self.error:.1f} %"

    def without(self, classes: np.ndarray) -> Trust:
        """classes: (C,) bool, to be left to the votes."""
        return replace(self, look=np.where(classes, -1, self.look))


def bins_of(ratios: np.ndarray) -> np.ndarray:
    """Bins (int) of log-ratios, symmetric around 0."""
    return np.rint(np.clip(ratios / REACH, -1, 1) * (BINS // 2)).astype(np.int64) + BINS // 2


def measure_trust(contrasts: np.ndarray, known: np.ndarray, disagreement: np.ndarray) -> Trust | None:
    """What held-out points and the views' disagreement say; None if no two classes are told apart.

    contrasts: (C, C, BINS per group) of `AppearanceModel.contrasts`; known: (C,) bool classes with enough
        examples; disagreement: of `count_disagreement`
    """
    error, ids = error_of(disagreement), np.flatnonzero(known).tolist()
    pairs = [(first, second) for first in ids for second in ids if second < first]
    weights = _fit_weights(contrasts, pairs, error)
    alike = [pair for pair in pairs if _skill(contrasts, pair, weights) < MIN_SKILL]
    look = np.where(known, np.arange(len(known)), -1)
    for first, second in alike:
        look[look == look[first]] = look[second]
    if len(np.unique(look[known])) < 2:
        return None
    apart = [pair for pair in pairs if pair not in alike]
    return Trust(error, _fit_weights(contrasts, apart, error), look)


def _shares(contrasts: np.ndarray, pair: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Shares of the points of k and of c, pair (k, c), in each bin of how much more they look like c."""
    own, other = contrasts[pair], np.flip(contrasts[pair[::-1]])
    return own / max(own.sum(), 1), other / max(other.sum(), 1)


def _scores(weights: np.ndarray) -> np.ndarray:
    """Weighted log-ratio of each bin."""
    centers = np.linspace(-REACH, REACH, BINS)
    return sum(np.ix_(*(weight * centers for weight in weights)))  # type: ignore[return-value]


def _skill(contrasts: np.ndarray, pair: tuple[int, int], weights: np.ndarray) -> float:
    """Balanced accuracy over chance, at most 1, on points held out."""
    own, other = _shares(contrasts, pair)
    return float(((other - own) * np.sign(np.round(_scores(weights), 9))).sum() / 2)


def _fit_weights(contrasts: np.ndarray, pairs: list[tuple[int, int]], error: float) -> np.ndarray:
    """Weights of the groups under which the held-out points of all pairs are likeliest, if the share `error` of
    them has the label of the other class.
    """
    groups = contrasts.ndim - 2
    options = np.stack(np.meshgrid(*[WEIGHTS] * groups, indexing="ij"), axis=-1).reshape(-1, groups)
    losses = np.zeros(len(options))
    for number, score in enumerate(map(_scores, options)):
        for first, second in (order for pair in pairs for order in (pair, pair[::-1])):
            counts = contrasts[first, second]
            odds = np.log((contrasts[second, first].sum() + 1) / (counts.sum() + 1))
            right = 1 / (1 + np.exp(score + odds))
            losses[number] -= (counts * np.log(error + (1 - 2 * error) * right)).sum()
    return options[int(np.argmin(losses))]
