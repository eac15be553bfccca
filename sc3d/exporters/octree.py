"""Points of any number in an octree whose coarse nodes thin them evenly: each point is in exactly one node, and
the nodes down to a level show the whole cloud at the spacing of that level.

The cloud is split on disk into parts, octants small enough for the memory. A node takes one point from each of
its SIDE x SIDE x SIDE cells, or all that are left if they are few. As cells lie on a common grid, an octant
gives its share to the nodes above it without looking at others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sc3d.geometry.graph import MORTON_BITS, morton_codes
from sc3d.io.progress import progress

SIDE_BITS = 7
SIDE = 1 << SIDE_BITS  # cells along a side of a node
FEW = 50_000  # points that a node takes without thinning
DEEPEST = MORTON_BITS - SIDE_BITS  # level at which a node takes all that is left
PART_LEVEL = 10  # parts are no smaller than nodes of this level
BYTES = 400  # of a point of a part while it is sorted into nodes

Chunks = Callable[[], Iterator[np.ndarray]]


class Node(NamedTuple):
    """level: 0 = the root; x, y, z: place among the nodes of its level."""

    level: int
    x: int
    y: int
    z: int

    @property
    def parent(self) -> Node:
        return Node(self.level - 1, self.x >> 1, self.y >> 1, self.z >> 1)


@dataclass(frozen=True)
class Octree:
    """low: (3,) int64 corner of the root and its side, in the units of the records' X, Y and Z; a position on a
    far face lies in the last node.
    """

    low: np.ndarray
    side: int

    @classmethod
    def around(cls, low: np.ndarray, high: np.ndarray) -> Octree:
        """The smallest that holds whole-number positions from low to high (3,), less than 2**42 apart."""
        return cls(low.astype(np.int64), max(int((high - low).max()), 1))

    def spacing(self, level: int) -> float:
        """Distance between points of a level on a surface."""
        return self.side / SIDE / 2**level

    def nodes(self, chunks: Chunks, folder: Path, most: int) -> Iterator[tuple[Node, np.ndarray]]:
        """Every node that has points, with its records; those above the parts come last.

        chunks: gives the cloud, each time it is called, as arrays of one record type with whole-number fields
            X, Y and Z
        folder: an empty one, for what lies on disk meanwhile; most: points to work on at a time
        """
        parts = find_parts(*self._count(chunks), most)
        dtype = self._spread(chunks, parts, folder)
        above: dict[Node, Path] = {}
        for number, part in enumerate(progress(parts, "building the octree", "part")):
            file = folder / f"part{number}"
            records = np.fromfile(file, dtype)
            file.unlink()
            for node, rows in self._sort(records, part.level):
                if node.level >= part.level:
                    yield node, records[rows]
                    continue
                above[node] = folder / "-".join(map(str, node))
                with above[node].open("ab") as store:
                    store.write(records[rows].tobytes())
        for node in sorted(above):
            yield node, np.fromfile(above[node], dtype)
            above[node].unlink()

    def _cells(self, records: np.ndarray) -> np.ndarray:
        """(N, 3) int64 places of records among the finest cells."""
        positions = np.stack([records[axis] for axis in "XYZ"], axis=1).astype(np.int64) - self.low
        return np.minimum((positions << MORTON_BITS) // self.side, (1 << MORTON_BITS) - 1)

    def _codes(self, records: np.ndarray) -> np.ndarray:
        """(N,) uint64 places on the Z-order curve of the finest cells."""
        return morton_codes(self._cells(records))

    def _count(self, chunks: Chunks) -> tuple[np.ndarray, np.ndarray]:
        """Octants of PART_LEVEL that hold points, in the order of the curve, and how many they hold."""
        octants, counts = np.zeros(0, np.uint64), np.zeros(0, np.int64)
        for records in progress(chunks(), "counting points", "chunk"):
            found, number = np.unique(_above(self._codes(records), PART_LEVEL), return_counts=True)
            octants, place = np.unique(np.concatenate([octants, found]), return_inverse=True)
            counts = np.bincount(place, np.concatenate([counts, number])).astype(np.int64)
        return octants, counts

    def _spread(self, chunks: Chunks, parts: list[Part], folder: Path) -> np.dtype:
        """Write the records of each part to a file of its own; returns their type."""
        starts, dtype = np.array([part.start for part in parts], np.uint64), np.dtype(np.uint8)
        for records in progress(chunks(), "splitting the cloud", "chunk"):
            dtype = records.dtype
            owner = np.searchsorted(starts, _above(self._codes(records), PART_LEVEL), side="right") - 1
            order = np.argsort(owner, kind="stable")
            first, counts = _runs(owner[order])
            for begin, count in zip(first.tolist(), counts.tolist()):
                rows = order[begin : begin + count]
                with (folder / f"part{owner[rows[0]]}").open("ab") as store:
                    store.write(records[rows].tobytes())
        return dtype

    def _sort(self, records: np.ndarray, part_level: int) -> Iterator[tuple[Node, np.ndarray]]:
        """Nodes and the rows of a part's records that they take, from the root down."""
        codes = self._codes(records)
        left = np.argsort(codes, kind="stable")
        codes = codes[left]
        chance = np.random.default_rng(0).permutation(len(codes))
        for level in range(DEEPEST + 1):
            first, counts = _runs(_above(codes, level))
            few = (counts <= FEW) & (level >= part_level) | (level == DEEPEST)
            taken = np.repeat(few, counts)
            cells, sizes = _runs(_above(codes, level + SIDE_BITS))
            taken |= chance == np.repeat(np.minimum.reduceat(chance, cells), sizes)
            for begin, count in zip(first.tolist(), counts.tolist()):
                rows = left[begin : begin + count][taken[begin : begin + count]]
                yield self._node(records[rows[:1]], level), rows
            left, codes, chance = left[~taken], codes[~taken], chance[~taken]
            if not len(left):
                return

    def _node(self, record: np.ndarray, level: int) -> Node:
        """The node of a level that a record (1,) lies in."""
        x, y, z = (self._cells(record)[0] >> (MORTON_BITS - level)).tolist()
        return Node(level, x, y, z)


class Part(NamedTuple):
    """An octant of a level, from `start` on the curve of PART_LEVEL."""

    level: int
    start: int


def find_parts(octants: np.ndarray, counts: np.ndarray, most: int) -> list[Part]:
    """The largest octants with at most `most` points each, in the order of the curve.

    octants, counts: (N,) those of PART_LEVEL that hold points, sorted, and how many; one that holds more by
        itself is a part all the same
    """
    parts = []
    for level in range(PART_LEVEL + 1):
        if not len(octants):
            break
        shift = np.uint64(3 * (PART_LEVEL - level))
        first, lengths = _runs(octants >> shift)
        whole = (np.add.reduceat(counts, first) <= most) | (level == PART_LEVEL)
        parts += [Part(level, int(octant >> shift << shift)) for octant in octants[first[whole]]]
        left = ~np.repeat(whole, lengths)
        octants, counts = octants[left], counts[left]
    return sorted(parts, key=lambda part: part.start)


def _above(codes: np.ndarray, level: int) -> np.ndarray:
    """Places of finest cells on the curve of a level."""
    return codes >> np.uint64(3 * (MORTON_BITS - level))


def _runs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First rows and lengths of runs of equal values."""
    first = np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1]]))
    return first, np.diff(first, append=len(values))
