"""What votes say of the labels of their points.

Alone, each vote counts (`evidence_of`). Beside looks, which see what all views get wrong together, the votes
of a point count as those of one view, because disagreement tells how often one view is wrong, but not how
often all are (`one_view_evidence`).
"""

from __future__ import annotations

import numpy as np

from sc3d.propagation.labelled_points import LabelledPoints

MAX_EVIDENCE = 5.0  # a point's votes count as at most this many
SMOOTHING = 0.25  # added to the votes of each class
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


def one_view_evidence(known: LabelledPoints, errors: np.ndarray) -> np.ndarray:
    """(N, C) float32, as `evidence_of`, of one view that says what the views of the point say on average;
    errors: (C,) share of the votes for each class that are wrong. Without votes a seed has one view.
    """
    votes = known.votes
    if votes is None:
        votes = np.eye(known.num_classes + 1, dtype=np.float32)[known.seed_labels]
    classes = votes[:, 1 : -1 if known.none else None]
    worth = np.log((1 - errors) / errors).astype(np.float32)[: classes.shape[1]]
    result = worth * classes / np.maximum(classes.sum(axis=1, keepdims=True), np.float32(1e-9))
    result -= result.max(axis=1, keepdims=True)
    if known.rates is None:
        return result
    return np.concatenate([result, known.rates.log_odds_of_one(votes)[:, None]], axis=1)


def vote_shares(known: LabelledPoints) -> np.ndarray:
    """(N, C) float32 share of the votes of each point for each label; without votes a seed has one."""
    votes = known.votes
    if votes is None:
        return np.eye(known.num_classes + 1, dtype=np.float32)[known.seed_labels][:, 1:]
    return votes[:, 1:] / np.maximum(votes[:, 1:].sum(axis=1, keepdims=True), np.float32(1e-9))


def count_disagreement(known: LabelledPoints, core: np.ndarray | None = None) -> np.ndarray:
    """(2,) int64 points that several views gave a class, and how many of those the views of a pair disagree
    on, in fixed point. core: (N,) bool points to count, None = all.

    The views of a point are taken to weigh the same.
    """
    if known.votes is None:
        return np.zeros(2, np.int64)
    votes = known.votes[:, 1 : -1 if known.none else None].astype(np.float64)
    every, total = known.votes[:, 1:].sum(axis=1, dtype=np.float64), votes.sum(axis=1)
    views = known.seeds.num_views * total / np.maximum(every, 1e-9)
    several = (views > 1.5) & (True if core is None else core)
    shares, views = votes[several] / total[several, None], views[several]
    agreeing = (shares * np.maximum(shares - 1 / views[:, None], 0)).sum(axis=1) / (1 - 1 / views)
    return np.array([FIXED * len(views), np.rint(FIXED * np.maximum(1 - agreeing, 0)).sum()], np.int64)


def error_of(disagreement: np.ndarray) -> float:
    """Share of the views that are wrong, by `count_disagreement`: two disagree in 2 e (1 - e) of two classes."""
    points, differing = (disagreement / FIXED).tolist()
    prior = 2 * PRIOR_ERROR * (1 - PRIOR_ERROR)
    rate = (differing + PRIOR_POINTS * prior) / (points + PRIOR_POINTS)
    return float((1 - np.sqrt(max(1 - 2 * rate, 0))) / 2)


def softmax(values: np.ndarray) -> np.ndarray:
    """(N, C) float32 probabilities of (N, C) logarithms."""
    result = values - values.max(axis=1, keepdims=True)
    np.exp(result, out=result)
    result /= result.sum(axis=1, keepdims=True)
    return result.astype(np.float32, copy=False)
