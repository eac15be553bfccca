"""A forest of decision trees as plain arrays: what scikit-learn grew, kept and asked without it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np

if TYPE_CHECKING:
    from sklearn.ensemble import ExtraTreesClassifier


@dataclass(frozen=True)
class Forest:
    """All trees' nodes, one tree after the other. starts: (T + 1,) int64 first node of each tree

    feature, children: (M,), (M, 2) int32, rows of `children` within the tree, -1 = leaf; threshold: (M,)
    float64; values: (M, C) float64 shares of the codes
    """

    starts: np.ndarray
    feature: np.ndarray
    threshold: np.ndarray
    children: np.ndarray
    values: np.ndarray

    @classmethod
    def from_sklearn(cls, forest: ExtraTreesClassifier) -> Forest:
        trees = [estimator.tree_ for estimator in forest.estimators_]
        sizes = [tree.node_count for tree in trees]
        children = [np.stack([tree.children_left, tree.children_right], axis=1) for tree in trees]
        values = [tree.value[:, 0] for tree in trees]
        return cls(
            np.cumsum([0, *sizes]),
            np.concatenate([tree.feature for tree in trees]).astype(np.int32),
            np.concatenate([tree.threshold for tree in trees]),
            np.concatenate(children).astype(np.int32),
            np.concatenate([part / part.sum(axis=1, keepdims=True) for part in values]),
        )

    def probabilities(self, rows: np.ndarray) -> np.ndarray:
        """(N, C) float32 probability of each code; rows: (N, F) float32."""
        result = np.zeros((len(rows), self.values.shape[1]))
        _descend(
            np.ascontiguousarray(rows, np.float32),
            self.starts,
            self.feature,
            self.threshold,
            self.children,
            self.values,
            result,
        )
        return (result / (len(self.starts) - 1)).astype(np.float32)

    def fits(self, num_features: int, num_codes: int) -> bool:
        """Whether every way through a tree ends at a leaf, and asks for features that there are."""
        sizes = np.diff(self.starts)
        count = int(self.starts[-1]) if len(self.starts) > 1 else 0
        if (
            not count
            or self.starts[0] != 0
            or (sizes < 1).any()
            or any(len(part) != count for part in (self.feature, self.threshold, self.children, self.values))
            or self.values.shape != (count, num_codes)
            or self.children.shape != (count, 2)
        ):
            return False
        own = np.arange(count) - np.repeat(self.starts[:-1], sizes)
        inner = self.children[:, 0] >= 0
        onward = (self.children > own[:, None]) & (self.children < np.repeat(sizes, sizes)[:, None])
        asked = (self.feature >= 0) & (self.feature < num_features)
        leaf = (self.children == -1).all(axis=1)
        return bool(
            (onward.all(axis=1) & asked)[inner].all()
            and leaf[~inner].all()
            and np.isfinite(self.values).all()
            and (self.values >= 0).all()
        )


@numba.njit(parallel=True, cache=True)
def _descend(rows, starts, feature, threshold, children, values, result):
    """Add the shares at each row's leaf of every tree, in the order of the trees."""
    for row in numba.prange(len(rows)):
        for tree in range(len(starts) - 1):
            first = starts[tree]
            node = first
            while children[node, 0] >= 0:
                side = 0 if rows[row, feature[node]] <= threshold[node] else 1
                node = first + children[node, side]
            for code in range(values.shape[1]):
                result[row, code] += values[node, code]
