"""What is known of each point: its class, how sure that is, and where it comes from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

UNSEEN, SEED, LOCKED, PROPAGATED, UNLOCKED, CORRECTED = range(6)  # `state` of a point
STATE_NAMES = ("unseen", "seed", "locked", "propagated", "unlocked", "corrected")


@dataclass(frozen=True)
class Labels:
    """One entry per point: label uint8 (0 = none), confidence float32 in [0, 1], state uint8, num_views int32."""

    label: np.ndarray
    confidence: np.ndarray
    state: np.ndarray
    num_views: np.ndarray

    def map(self, function: Callable[[np.ndarray], np.ndarray]) -> Labels:
        """The labels with a function applied to each array."""
        return Labels(
            *(function(values) for values in (self.label, self.confidence, self.state, self.num_views))
        )

    @property
    def of_no_class(self) -> np.ndarray:
        """(N,) bool points known to be of none of the classes; of others with label 0 nothing is known. Labels
        are ids.
        """
        return (self.label == 0) & np.isin(self.state, (SEED, PROPAGATED, UNLOCKED, CORRECTED))

    def __getitem__(self, rows: np.ndarray) -> Labels:
        """Labels of some points, or of all in another order."""
        return self.map(lambda values: values[rows])
