"""What votes say of the labels of their points.

Alone, each vote counts (`evidence_of`). Beside looks, which see what all views get wrong together, the votes of a
point count as those of one view, because disagreement tells how often one view is wrong, but not how often all
are (`one_view_evidence`).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import isotonic_regression

from sc3d.propagation.labelled_points import LabelledPoints

MAX_EVIDENCE = 5.0  # a point's votes count as at most this many
SMOOTHING = 0.25  # added to the votes of each class
LEVELS = 13  # of a view's weight: 1 and more, then half an octave less each
FIXED = 4096  # shares are summed in these parts, so that no order matters
PRIOR_POINTS, PRIOR_ERROR = 100.0, 0.15  # what is believed of views that no other view checks


def evidence_of(known: LabelledPoints) -> np.ndarray:
    """(N, C) float32 log-likelihood of all labels from the votes: of the classes among themselves, and of
    none of them against the best.
    """
    votes = known.known_votes
    if known.rates is None:
        return vote_likelihood(votes)
    none = known.rates.log_odds(votes)
    return np.concatenate([vote_likelihood(votes[:, :-1]), none[:, None]], axis=1)


def vote_likelihood(votes: np.ndarray) -> np.ndarray:
    """(N, C) float32 log-likelihood of the classes 1..C from the votes (N, C + 1); 0 for points without
    votes.
    """
    total = votes[:, 1:].sum(axis=1, keepdims=True)
    result = votes[:, 1:] + np.float32(SMOOTHING)
    result /= total + np.float32(SMOOTHING * (votes.shape[1] - 1))
    np.log(result, out=result)
    result *= np.minimum(1 + total, np.float32(MAX_EVIDENCE))
    result -= result.max(axis=1, keepdims=True)
    return result.astype(np.float32, copy=False)


def one_view_evidence(known: LabelledPoints, worth: np.ndarray) -> np.ndarray:
    """(N, C) float32, as `evidence_of`, of one view that is as sure as the mean of the point's views and says what
    they say on average. worth: of `worth_of`
    """
    votes = votes_or_seeds(known)
    classes = votes[:, 1 : -1 if known.none else None]
    total = classes.sum(axis=1, keepdims=True)
    nats = np.interp(_levels(*class_views(known)), np.arange(LEVELS), worth).astype(np.float32)
    result = nats[:, None] * classes / np.maximum(total, np.float32(1e-9))
    result -= result.max(axis=1, keepdims=True)
    if not known.none:
        return result
    none = (
        known.rates.log_odds_of_share(votes) if known.rates is not None else np.zeros(len(votes), np.float32)
    )
    return np.concatenate([result, none[:, None]], axis=1)


def votes_or_seeds(known: LabelledPoints) -> np.ndarray:
    """(N, C + 1) float32 votes; without, each seed has one, of its confidence."""
    if known.votes is not None:
        return known.votes
    seeds = known.seed_labels
    own = np.eye(known.num_classes + 1, dtype=np.float32)[seeds]
    return own * (known.seeds.confidence * (seeds > 0))[:, None]


def class_views(known: LabelledPoints) -> tuple[np.ndarray, np.ndarray]:
    """(N,) float64 weight of the votes for classes, and how many views gave them."""
    votes = votes_or_seeds(known)[:, 1:]
    every = votes.sum(axis=1, dtype=np.float64)
    total = every - votes[:, -1] if known.none else every
    return total, known.seeds.num_views * total / np.maximum(every, 1e-9)


def _levels(total: np.ndarray, views: np.ndarray) -> np.ndarray:
    """(N,) float64 level of the mean weight of a view."""
    weight = total / np.maximum(views, 1)
    return np.clip(-2 * np.log2(np.maximum(weight, 1e-9)), 0, LEVELS - 1)


def count_disagreement(known: LabelledPoints, core: np.ndarray | None = None) -> np.ndarray:
    """(2, LEVELS) int64 points that several views gave a class, and sum of the shares of pairs of their views that
    disagree, in fixed point, by the views' weight. core: (N,) bool points to count, None = all.

    The views of a point are taken to weigh the same.
    """
    total, views = class_views(known)
    several = np.flatnonzero((views > 1.5) & (True if core is None else core))
    total, views = total[several], views[several]
    shares = votes_or_seeds(known)[several, 1 : -1 if known.none else None] / total[:, None]
    agreeing = (shares * np.clip(shares - 1 / views[:, None], 0, None)).sum(axis=1) / (1 - 1 / views)
    level = np.rint(_levels(total, views)).astype(np.int64)
    differing = np.rint(FIXED * np.clip(1 - agreeing, 0, 1)).astype(np.int64)
    result = np.zeros((2, LEVELS), np.int64)
    np.add.at(result[0], level, 1)
    np.add.at(result[1], level, differing)
    return result


def error_of(disagreement: np.ndarray) -> float:
    """Share of views that are wrong, by `count_disagreement`."""
    points, differing = disagreement.sum(axis=1).tolist()
    prior = 2 * PRIOR_ERROR * (1 - PRIOR_ERROR)
    return float(_wrong((differing / FIXED + PRIOR_POINTS * prior) / (points + PRIOR_POINTS)))


def _wrong(differing: np.ndarray | float) -> np.ndarray:
    """How often one view is wrong, if two disagree so often: 2 e (1 - e), of two classes."""
    return (1 - np.sqrt(np.maximum(1 - 2 * np.asarray(differing), 0))) / 2


def worth_of(disagreement: np.ndarray) -> np.ndarray:
    """(LEVELS,) nats by which one view prefers its class: log-odds that it is right; not less for a view that is
    surer.
    """
    points, differing = disagreement
    overall = error_of(disagreement)
    prior = PRIOR_POINTS * 2 * overall * (1 - overall)
    rates = (differing / FIXED + prior) / (points + PRIOR_POINTS)
    error = _wrong(isotonic_regression(rates, weights=points + 1).x)
    return np.log((1 - error) / error)


def softmax(values: np.ndarray) -> np.ndarray:
    """(N, C) float32 probabilities of (N, C) logarithms."""
    result = values - values.max(axis=1, keepdims=True)
    np.exp(result, out=result)
    result /= result.sum(axis=1, keepdims=True)
    return result.astype(np.float32, copy=False)
