"""What votes say of the labels of their points, and how often a view is wrong, by how often views disagree."""

from __future__ import annotations

import numpy as np

from sc3d.propagation.labelled_points import LabelledPoints

MAX_EVIDENCE = 5.0  # a point's votes count as at most this many
SMOOTHING = 0.25  # added to the votes of each class
FULL_VOTE = float(2 * np.log(1 + 1 / SMOOTHING))  # nats by which one vote of full weight prefers its class
FIXED = 4096  # votes are summed in these parts, so that no order matters
PRIOR_VOTES, PRIOR_ERROR = 100.0, 0.15  # what is believed of views that no other view checks


def evidence_of(known: LabelledPoints) -> np.ndarray:
    """(N, C) float32 log-likelihood of all labels from the votes: of the classes among themselves, and of
    none of them against the best. Without votes, each seed has one, of its confidence.
    """
    if known.votes is None:
        seeds = known.seed_labels
        own = np.eye(known.num_classes + 1, dtype=np.float32)[seeds]
        return vote_likelihood(own * (known.seeds.confidence * (seeds > 0))[:, None])
    if known.rates is None:
        return vote_likelihood(known.votes)
    none = known.rates.log_odds(known.votes)
    return np.concatenate([vote_likelihood(known.votes[:, :-1]), none[:, None]], axis=1)


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


def count_disagreement(known: LabelledPoints, core: np.ndarray | None = None) -> np.ndarray:
    """(2,) int64 votes for classes of points that several views gave a class, in fixed point: all, and
    those that another view of the point would contradict. core: (N,) bool points to count, None = all.

    The views of a point are taken to weigh the same.
    """
    if known.votes is None:
        return np.zeros(2, np.int64)
    votes = known.votes[:, 1 : -1 if known.none else None].astype(np.float64)
    total, every = votes.sum(axis=1), known.votes[:, 1:].sum(axis=1, dtype=np.float64)
    views = known.seeds.num_views * total / np.maximum(every, 1e-9)
    several = (views > 1.5) & (True if core is None else core)
    votes, total, single = votes[several], total[several], total[several] / views[several]
    others = np.maximum(votes - single[:, None], 0).clip(max=(total - single)[:, None])
    agreeing = (votes * others).sum(axis=1) / (total - single)
    return np.rint(FIXED * np.stack([total, total - agreeing])).astype(np.int64).sum(axis=1)


def error_of(disagreement: np.ndarray) -> float:
    """Share of the votes that are wrong, from counts of `count_disagreement`: of two views that disagree one is."""
    total, differing = (disagreement / FIXED).tolist()
    return float((differing / 2 + PRIOR_ERROR * PRIOR_VOTES) / (total + PRIOR_VOTES))


def weight_of(error: float) -> float:
    """Of the evidence of votes of which this share is wrong, so that one full vote says what it is worth."""
    return max(float(np.log((1 - error) / error)), 0.0) / FULL_VOTE


def softmax(values: np.ndarray) -> np.ndarray:
    """(N, C) float32 probabilities of (N, C) logarithms."""
    result = values - values.max(axis=1, keepdims=True)
    np.exp(result, out=result)
    result /= result.sum(axis=1, keepdims=True)
    return result.astype(np.float32, copy=False)
