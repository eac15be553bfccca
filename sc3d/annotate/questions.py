"""Where an answer of a person would change most: places of a labelled cloud, ranked. Knows nothing of photos
or pages.

A point is doubtful as far as its label is not sure, and as the views that voted on it name another class.
Doubts hang together: a place is a region of doubtful points that are said to be of one class, by their label or,
without one, by most of their votes, and of about one color, whatever speaks against it. All of it is likely right or
wrong together, so one answer settles it, and what it changes is the sum of its doubts. Of classes with few sure
examples each answer also teaches the look.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sc3d.scene.labels import CORRECTED, LOCKED

DOUBTFUL = 0.12  # doubt from which a point is asked about
LOCKED_DOUBT = 1.25  # factor on the doubt of locked points, on which the views did not agree
LINK = 3.0  # point spacings up to which doubtful points hang together
LIKE = 40.0  # distance of colors, of 255 per channel, up to which neighbors look alike
FEW = 500  # sure examples of a class; with fewer, an answer counts up to twice
SURE = 0.9  # confidence of such an example
LEAST = 3  # points of a place


@dataclass(frozen=True)
class Evidence:
    """What is known of N points. points: (N, 3) float64 world; label: (N,) uint8 ids, 0 = none; confidence:
    (N,) float32; state: (N,) uint8; votes: (N, C) float32 of the classes `ids` (C,) uint8, in views; colors:
    (N, 3) uint8 or None; spacing: of the points, world units
    """

    points: np.ndarray
    label: np.ndarray
    confidence: np.ndarray
    state: np.ndarray
    votes: np.ndarray
    ids: np.ndarray
    colors: np.ndarray | None
    spacing: float


@dataclass(frozen=True)
class Place:
    """A region to ask about. rows: (R,) of the cloud; label: id of most of its points, 0 = none; rival: id of the
    class that speaks against it at most of them, 0 = none; gain: points that an answer likely changes, more for
    rare classes
    """

    rows: np.ndarray
    label: int
    rival: int
    gain: float


def doubt_of(known: Evidence) -> np.ndarray:
    """(N,) float64, 0 to 1: how likely each label is wrong; 0 for what a person has corrected."""
    doubt = 1 - known.confidence.astype(np.float64)
    doubt[known.label == 0] = 1
    doubt = np.where(known.state == LOCKED, doubt * LOCKED_DOUBT, doubt)
    total = known.votes.sum(axis=1)
    own = np.where(known.ids == known.label[:, None], known.votes, 0).sum(axis=1)
    against = np.where(total > 0, 1 - own / np.maximum(total, 1e-9), 0)
    doubt = doubt + (1 - doubt.clip(0, 1)) * doubt.clip(0, 1) * against
    return np.where(known.state == CORRECTED, 0, doubt.clip(0, 1))


def rivals_of(known: Evidence) -> np.ndarray:
    """(N,) uint8 id of the class with the most votes but for the label; 0 where no view names another."""
    others = np.where(known.ids == known.label[:, None], 0, known.votes)
    return np.where(others.any(axis=1), known.ids[others.argmax(axis=1)], 0).astype(np.uint8)


def rank_places(known: Evidence, doubt: np.ndarray | None = None) -> list[Place]:
    """Places by what an answer would change, most first; the same for any order of equal points' neighbors.

    doubt: (N,), None = `doubt_of`
    """
    doubt = doubt_of(known) if doubt is None else doubt
    rows = np.flatnonzero(doubt >= DOUBTFUL)
    rival, label = rivals_of(known)[rows], known.label[rows]
    group = _regions(known, rows, np.where(label > 0, label, rival))
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    rare = _rarity(known)
    places = []
    for part in np.split(order, starts[1:]) if len(rows) else []:
        if len(part) < LEAST:
            continue
        own = int(np.bincount(label[part]).argmax())
        other = int(np.bincount(np.where(rival[part] == own, label[part], rival[part])).argmax())
        gain = float(doubt[rows[part]].sum()) * max(rare[own], rare[other])
        places.append(Place(rows[part], own, other, gain))
    return sorted(places, key=lambda place: (-place.gain, int(place.rows[0])))


def _regions(known: Evidence, rows: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """(R,) number of the region of each row: neighbors of one kind (R,) and about one color hang together."""
    if not len(rows):
        return np.zeros(0, np.int64)
    points = known.points[rows]
    pairs = cKDTree(points).query_pairs(LINK * known.spacing, output_type="ndarray")
    alike = kind[pairs[:, 0]] == kind[pairs[:, 1]]
    if known.colors is not None:
        colors = known.colors[rows].astype(np.float32)
        alike &= ((colors[pairs[:, 0]] - colors[pairs[:, 1]]) ** 2).sum(axis=1) <= LIKE**2
    links = pairs[alike]
    graph = coo_matrix((np.ones(len(links), np.int8), links.T), shape=(len(rows),) * 2)
    return connected_components(graph, directed=False)[1]


def _rarity(known: Evidence) -> np.ndarray:
    """(256,) factor on an answer about each class: up to 2 for those with few sure examples."""
    sure = np.bincount(known.label[known.confidence >= SURE], minlength=256)
    factor = 1 + np.maximum(0, 1 - sure / FEW)
    factor[0] = 1
    return factor
