"""Votes have a channel per class, not per id: a table of the ids 1, 2, 3 and 255 needs four."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sc3d.errors import InputError


@dataclass(frozen=True)
class Channels:
    """Which class each channel stands for. ids: (C + 1,) uint8 rising, of which the first, 0, is no class.

    With the ids 1, 2, ..., C, as most tables have them, channels are ids.
    none: one more channel, the last, for what views looked at and found none of the classes on; its id is
    0, too
    """

    ids: np.ndarray
    none: bool = False

    @classmethod
    def of_classes(cls, ids: list[int], none: bool = False) -> Channels:
        """ids: of the classes, in any order."""
        return cls(np.array([0, *sorted(set(ids) - {0})], np.uint8), none)

    @property
    def count(self) -> int:
        """The length of arrays indexed by channel: C + 1, or C + 2 with `none`."""
        return len(self.ids) + self.none

    @property
    def names(self) -> list[str]:
        """Of all channels: the ids, and "none"."""
        return [*map(str, self.ids.tolist()), *(["none"] if self.none else [])]

    def with_none(self, labels: np.ndarray, found: np.ndarray) -> np.ndarray:
        """Channels (any shape, uint8) with the last one where `found` (bool) says so and no class is."""
        return np.where(found & (labels == 0), np.uint8(self.count - 1), labels) if self.none else labels

    @property
    def are_ids(self) -> bool:
        return int(self.ids[-1]) == len(self.ids) - 1

    def from_ids(self, labels: np.ndarray, origin: Path | str = "a mask") -> np.ndarray:
        """Channels of ids (any shape, uint8), the array itself where both are the same; InputError that names
        `origin` for an id without a channel.
        """
        if int(labels.max(initial=0)) <= int(self.ids[-1]) and self.are_ids:
            return labels
        table = np.zeros(256, np.uint8)
        table[self.ids] = np.arange(len(self.ids))
        known = np.isin(np.arange(256), self.ids)
        if not known[labels].all():
            first = int(labels[~known[labels]].min())
            raise InputError(
                f"{origin} has class id {first}, of which there are no votes (votes_{first}): run `sc3d label` again"
            )
        return table[labels]

    def to_ids(self, channels: np.ndarray) -> np.ndarray:
        """The opposite: ids (uint8) of channels of any shape."""
        if self.none:
            return np.append(self.ids, np.uint8(0))[channels]
        return channels if self.are_ids else self.ids[channels]
