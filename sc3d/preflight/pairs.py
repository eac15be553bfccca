"""Photos that show the same: by matches of their features, or by the sparse points of a model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import csr_matrix

from sc3d.geometry.cameras import project
from sc3d.geometry.shortlist import neighbors_by_look, neighbors_by_place, neighbors_in_order
from sc3d.io.progress import progress
from sc3d.preflight.looks import GRID, QUICK, THOROUGH, Effort, Look, features, in_threads
from sc3d.scene.scene import SparseModel

ALL_PAIRS = 40  # photos up to which each is compared with every other
IN_ORDER, NEAREST, ALIKE = 3, 8, 6  # partners of each beyond that: by name, on the map, by look
MORE = 2  # times as many for a second look
RATIO = 0.8  # of the distances to the first and second in the other photo (Lowe 2004)
TOLERANCE = 2.0  # px at the size of the look, off the epipolar line
LEAST = 15  # matches along one epipolar geometry that make a pair, as in COLMAP
LEAST_THOROUGH = 30  # after a second look: what COLMAP's mapper needs to add a photo
STRONGEST = 12  # pairs of each photo that are taken from a model


@dataclass(frozen=True)
class Pair:
    """Two photos, by rows, and (K, 2) points that both show, as shares of width and height."""

    first: int
    second: int
    points: np.ndarray
    others: np.ndarray

    def of(self, row: int) -> tuple[int, np.ndarray, np.ndarray]:
        """The other photo, the points in photo `row`, those in the other."""
        if row == self.first:
            return self.second, self.points, self.others
        return self.first, self.others, self.points


Found = tuple[np.ndarray, np.ndarray]  # points and descriptors


def match_photos(
    folder: Path, names: list[str], looks: list[Look], positions: dict[int, np.ndarray]
) -> list[Pair]:
    """Pairs of photos by their features. Those that fit no other, or only a few, get a second, closer look.

    names: relative to `folder`, in the order of `looks`; positions: (3,) m by row, for photos with GPS
    """
    wanted = sorted(_candidates(looks, positions, 1))
    found: list[Found] = [(look.points, look.descriptors) for look in looks]
    sizes = [look.size for look in looks]
    compare = partial(_compare, found, sizes, QUICK, LEAST)
    pairs = [pair for pair in in_threads(compare, progress(wanted, "comparing", "pair")) if pair]
    alone = set(range(len(looks))) - max(groups(len(looks), pairs), key=len) | _lonely(len(looks), pairs)
    again = sorted(pair for pair in _candidates(looks, positions, MORE) if alone & set(pair))
    return _merged(pairs, _closer(folder, names, sizes, again)) if again else pairs


def _closer(
    folder: Path, names: list[str], sizes: list[tuple[int, int]], wanted: list[tuple[int, int]]
) -> list[Pair]:
    rows = sorted({row for pair in wanted for row in pair})
    read = in_threads(
        lambda row: features(folder / names[row], folder, THOROUGH),
        progress(rows, "looking closer", "photo"),
    )
    found = dict(zip(rows, read, strict=True))
    compare = partial(_compare, found, sizes, THOROUGH, LEAST_THOROUGH)
    return [pair for pair in in_threads(compare, progress(wanted, "comparing closely", "pair")) if pair]


def _lonely(number: int, pairs: list[Pair]) -> set[int]:
    """Photos that fit fewer than two others."""
    times = np.bincount([row for pair in pairs for row in (pair.first, pair.second)], minlength=number)
    return set(np.flatnonzero(times < 2).tolist())


def _merged(pairs: list[Pair], closer: list[Pair]) -> list[Pair]:
    by_rows = {(pair.first, pair.second): pair for pair in [*pairs, *closer]}
    return [by_rows[rows] for rows in sorted(by_rows)]


def groups(number: int, pairs: list[Pair]) -> list[set[int]]:
    """Photos that hang together by pairs."""
    member = [{row} for row in range(number)]
    for pair in pairs:
        one, other = member[pair.first], member[pair.second]
        if one is not other:
            one |= other
            for row in other:
                member[row] = one
    return list({id(group): group for group in member}.values())


def _candidates(looks: list[Look], positions: dict[int, np.ndarray], times: int) -> set[tuple[int, int]]:
    """Rows of photos that may show the same."""
    number = len(looks)
    if number <= ALL_PAIRS:
        return set(combinations(range(number), 2))
    return (
        neighbors_in_order(number, times * IN_ORDER)
        | neighbors_by_place(positions, times * NEAREST)
        | neighbors_by_look([look.descriptors for look in looks], times * ALIKE)
    )


def _compare(
    found: list[Found] | dict[int, Found],
    sizes: list[tuple[int, int]],
    effort: Effort,
    least: int,
    rows: tuple[int, int],
) -> Pair | None:
    """The pair, if `least` matches follow one epipolar geometry."""
    (points, descriptors), (others, other_descriptors) = found[rows[0]], found[rows[1]]
    first, second = _mutual(descriptors, other_descriptors)
    if len(first) < least:
        return None
    scaled = [
        (where[which] * np.array(size) * min(1.0, effort.side / max(size))).astype(np.float64)
        for where, which, size in (
            (points, first, sizes[rows[0]]),
            (others, second, sizes[rows[1]]),
        )
    ]
    options = pycolmap.RANSACOptions(max_error=TOLERANCE, max_num_trials=2000, random_seed=0)
    geometry = pycolmap.estimate_fundamental_matrix(*scaled, options)
    if geometry is None or geometry["num_inliers"] < least:
        return None
    kept = np.asarray(geometry["inlier_mask"], bool)
    return Pair(*rows, points[first[kept]], others[second[kept]])


def _mutual(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of unit descriptors that are one another's nearest, clearly nearer than the second."""
    if min(len(one), len(other)) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    likeness = one @ other.T
    best, back = likeness.argmax(axis=1), likeness.argmax(axis=0)
    rows = np.arange(len(one))
    first = likeness[rows, best]
    likeness[rows, best] = -1
    clear = 2 - 2 * first < RATIO**2 * (2 - 2 * likeness.max(axis=1))
    kept = rows[clear & (back[best] == rows)]
    return kept, best[kept]


def pairs_of_model(model: SparseModel, rows: dict[str, int]) -> list[Pair]:
    """Pairs of photos that see the same sparse points; rows: of the photos by name."""
    seen = csr_matrix(
        (
            np.ones(sum(map(len, model.tracks)), np.int32),
            np.concatenate([*model.tracks, np.zeros(0, int)]).astype(int),
            np.cumsum([0, *map(len, model.tracks)]),
        ),
        shape=(len(model.views), len(model.points)),
    )
    shared = (seen @ seen.T).toarray()
    np.fill_diagonal(shared, 0)
    wanted = set()
    for view, counts in enumerate(shared):
        best = np.argsort(-counts, kind="stable")[:STRONGEST]
        wanted |= {(min(view, int(other)), max(view, int(other))) for other in best if counts[other] >= LEAST}
    return list(_seen_by_both(model, rows, sorted(wanted)))


def _seen_by_both(model: SparseModel, rows: dict[str, int], wanted: list[tuple[int, int]]) -> Iterator[Pair]:
    for first, second in wanted:
        views = model.views[first], model.views[second]
        if not all(view.name in rows for view in views):
            continue
        both = model.points[np.intersect1d(model.tracks[first], model.tracks[second])]
        points, others = (project(view, both)[0] / (view.width, view.height) for view in views)
        inside = ((points > 0) & (points < 1) & (others > 0) & (others < 1)).all(axis=1)
        if inside.sum() >= LEAST:
            yield Pair(rows[views[0].name], rows[views[1].name], points[inside], others[inside])


def cells(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the cells of a photo that points (K, 2), shares of width and height, lie in."""
    column, row = np.clip((points * GRID).astype(int), 0, GRID - 1).T
    return row, column
