"""How far looks and votes are believed, as measured in each scene.

Looks are judged on blocks of space that they were not learned from, class against class: two classes that they do
not tell apart share one look and are left to the votes; color and relief are weighted so that the held-out points are
likeliest. Votes are judged by how often views disagree, and, where all views err together, by the looks: if part of
the points voted k are in truth c, their looks are a mixture. The share of c in it is at most the smallest ratio of
the two densities (mixture proportion estimation: Blanchard, Lee, Scott, JMLR 11, 2010). As a class may look in part
like another one, that counts only as far as color and relief, which hardly depend on one another within a class,
both say c of the same points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sc3d.propagation.vote_evidence import error_of

# of the log-ratio of two classes' densities, per group of features; beyond: the last bin
BINS, REACH = 17, 6.0
MIN_SKILL = 0.25  # share of the errors of guessing that looks must avoid on points held out, of two classes alike in number
MIN_GAP = 0.25  # between the rates at which color, or relief, says c of points voted c and of points voted k
TAIL = 0.1  # densities are compared on at least this share of a class's points
MAX_ERROR = 0.5  # of a class's votes: believed no less than not at all
WEIGHTS = np.linspace(0.0, 1.0, 11)  # tried for each group of features


@dataclass(frozen=True)
class Trust:
    """What was measured, of C classes.

    errors: (C,) share of the views' votes for each class that are wrong; weights: (G,) of the groups of features, 1 = as if their
        log-likelihoods were right; look: (C,) int, the same for classes that are not told apart, -1 = left
        to the votes
    """

    errors: np.ndarray
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

    @classmethod
    def unmeasured(cls, known: np.ndarray, num_groups: int, disagreement: np.ndarray) -> Trust:
        """Of looks that another site taught: full weight, each of the known classes (C,) bool a look of its own."""
        errors = np.full(len(known), error_of(disagreement))
        return cls(errors, np.ones(num_groups), np.where(known, np.arange(len(known)), -1))

    def describe(self) -> str:
        """In one line."""
        weights, looks = (
            ", ".join(f"{weight:.1f}" for weight in self.weights),
            len(np.unique(self.look[self.known])),
        )
        return f"{looks} looks of {self.known.sum()} classes told apart, weights {weights}; {100 * self.errors.min():.1f} to {100 * self.errors.max():.1f} % of the votes for a class are wrong"

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
    weights = _fit_weights(contrasts, apart, error)
    return Trust(np.maximum(error, _shared_errors(contrasts, apart, weights)), weights, look)


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


def _shared_errors(contrasts: np.ndarray, pairs: list[tuple[int, int]], weights: np.ndarray) -> np.ndarray:
    """(C,) shares of the votes for each class that all views get wrong together: of each pair, what both the
    densities and the joint answers of color and relief allow.
    """
    result = np.zeros(len(contrasts))
    for own, other in (order for pair in pairs for order in (pair, pair[::-1])):
        share = min(_corroborated(contrasts, (own, other)), _largest_share(contrasts, (own, other), weights))
        # to half an octave: no better is known, and noise in the last bits of the features changes nothing
        result[own] += 2.0 ** (np.rint(2 * np.log2(share)) / 2) if share > 0 else 0
    return np.minimum(result, MAX_ERROR)


def _largest_share(contrasts: np.ndarray, pair: tuple[int, int], weights: np.ndarray) -> float:
    """Largest share of c among points voted k, pair (k, c), that their looks allow: the smallest ratio of the two
    densities (mixture proportion estimation: Blanchard, Lee, Scott, JMLR 11, 2010).
    """
    voted, other = _shares(contrasts, pair)
    order = np.argsort(-_scores(weights), axis=None, kind="stable")
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
