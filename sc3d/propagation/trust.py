"""How far looks and votes are believed, as measured in each scene.

Looks are judged on blocks of space that they were not learned from, class against class: two classes that
they do not tell apart share one look and are left to the votes. Votes are judged by how often views disagree,
and, where all views err together, by the looks: if part of the points voted k are in truth c, their looks are
a mixture. The share of c in it is at most the smallest ratio of the two densities (mixture proportion
estimation: Blanchard, Lee, Scott, JMLR 11, 2010). As a class may look in part like another one, that counts
only as far as color and relief, which hardly depend on one another within a class, both say c of the same
points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from sc3d.propagation.vote_evidence import error_of

# of the log-ratio of two classes' densities, per group of features; beyond: the last bin
BINS, REACH = 17, 6.0
MIN_SKILL = 0.5  # share of the errors of guessing that looks must avoid on points held out, of two classes alike in number
MIN_GAP = 0.25  # between the rates at which color, or relief, says c of points voted c and of points voted k
TAIL = 0.1  # densities are compared on at least this share of a class's points
# of the votes for a class with a look of its own: views share errors that no disagreement shows (of the real masks that
# are judged by hand 2.5 % disagree, and 7 % are wrong)
MIN_ERROR = 0.05
MAX_ERROR = 0.5  # of a class's votes: believed no less than not at all


@dataclass(frozen=True)
class Trust:
    """What was measured, of C classes.

    errors: (C,) share of the views' votes for each class that are wrong; look: (C,) int, the same for classes
        that are not told apart, -1 = left to the votes
    """

    errors: np.ndarray
    look: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """(C,) bool classes whose look is known."""
        return self.look >= 0

    @property
    def shared(self) -> np.ndarray:
        """(C,) bool classes that look like another."""
        return self.known & ((self.look[:, None] == self.look).sum(axis=1) > 1)

    @classmethod
    def unmeasured(cls, known: np.ndarray, disagreement: np.ndarray) -> Trust:
        """Of looks that another site taught: each of the known classes (C,) bool has its own."""
        return cls(np.full(len(known), error_of(disagreement)), np.where(known, np.arange(len(known)), -1))

    def describe(self) -> str:
        """In one line."""
        looks = len(np.unique(self.look[self.known]))
        low, high = 100 * self.errors.min(), 100 * self.errors.max()
        return (
            f"{looks} looks of {len(self.look)} classes told apart; {low:.1f} to {high:.1f} % of the votes for a"
            " class are taken to be wrong"
        )

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
    alike = np.zeros((len(known), len(known)), bool)
    for first, second in combinations(np.flatnonzero(known).tolist(), 2):
        alike[first, second] = alike[second, first] = _skill(contrasts, (first, second)) < MIN_SKILL
    look = looks_of(alike, known)
    if len(np.unique(look[look >= 0])) < 2:
        return None
    pairs = combinations(np.flatnonzero(look >= 0).tolist(), 2)
    apart = [pair for pair in pairs if look[pair[0]] != look[pair[1]]]
    error = error_of(disagreement)
    trust = Trust(np.full(len(known), error), look)
    errors = np.maximum(np.maximum(error, MIN_ERROR), _shared_errors(contrasts, apart))
    return replace(trust, errors=np.where(trust.known & ~trust.shared, errors, error))


def looks_of(alike: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(C,) int as `Trust.look`; alike: (C, C) bool pairs that are not told apart; known: (C,) bool

    Classes that are all alike share a look. A class that is like two which are told apart has none: it would
    join what can be told.
    """
    alike = alike.copy()
    look = np.where(known, np.arange(len(known)), -1)
    while True:
        between = (~alike & ~np.eye(len(alike), dtype=bool)).astype(int)
        torn = np.einsum("ab,ac,bc->a", alike.astype(int), alike.astype(int), between)
        if not torn.any():
            break
        worst = int(torn.argmax())
        look[worst] = -1
        alike[worst] = alike[:, worst] = False
    for first, second in np.argwhere(np.triu(alike)).tolist():
        look[second] = look[first]
    return look


def _shares(contrasts: np.ndarray, pair: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Shares of the points of k and of c, pair (k, c), in each bin of how much more they look like c."""
    own, other = contrasts[pair], np.flip(contrasts[pair[::-1]])
    return own / max(own.sum(), 1), other / max(other.sum(), 1)


def _scores(groups: int) -> np.ndarray:
    """Log-ratio of each bin, of as many groups of features."""
    centers = np.linspace(-REACH, REACH, BINS)
    return sum(np.ix_(*[centers] * groups))  # type: ignore[return-value]


def _skill(contrasts: np.ndarray, pair: tuple[int, int]) -> float:
    """Balanced accuracy over chance, at most 1, on points held out."""
    own, other = _shares(contrasts, pair)
    return float(((other - own) * np.sign(np.round(_scores(contrasts.ndim - 2), 9))).sum() / 2)


def _shared_errors(contrasts: np.ndarray, pairs: list[tuple[int, int]]) -> np.ndarray:
    """(C,) shares of the votes for each class that all views get wrong together: of each pair, what both the
    densities and the joint answers of color and relief allow.
    """
    result = np.zeros(len(contrasts))
    for own, other in (order for pair in pairs for order in (pair, pair[::-1])):
        share = min(_corroborated(contrasts, (own, other)), _largest_share(contrasts, (own, other)))
        # to half an octave: no better is known, and noise in the last bits of the features changes nothing
        result[own] += 2.0 ** (np.rint(2 * np.log2(share)) / 2) if share > 0 else 0
    return np.minimum(result, MAX_ERROR)


def _largest_share(contrasts: np.ndarray, pair: tuple[int, int]) -> float:
    """Largest share of c among points voted k, pair (k, c), that their looks allow: the smallest ratio of the
    two densities (mixture proportion estimation: Blanchard, Lee, Scott, JMLR 11, 2010).
    """
    voted, other = _shares(contrasts, pair)
    order = np.argsort(-_scores(contrasts.ndim - 2), axis=None, kind="stable")
    voted, other = np.cumsum(voted.ravel()[order]), np.cumsum(other.ravel()[order])
    enough = other >= TAIL
    return float(np.min(voted[enough] / other[enough], initial=1.0))


def _corroborated(contrasts: np.ndarray, pair: tuple[int, int]) -> float:
    """Share of c among points voted k, pair (k, c), if the groups' joint answers come from mixing two
    classes within which they are independent; 0 with one group, or where a group does not tell the two apart.
    """
    if contrasts.ndim - 2 < 2:
        return 0.0
    says = np.arange(BINS) > BINS // 2
    voted, other = _shares(contrasts, pair)
    both = voted[np.ix_(says, says)].sum()
    rates = np.array([[part[says].sum(), part[:, says].sum()] for part in (voted, other)])
    gaps = rates[1] - rates[0]
    if (gaps < MIN_GAP).any():
        return 0.0
    odds = max(both - rates[0].prod(), 0.0) / gaps.prod()
    return float(odds / (1 + odds))
