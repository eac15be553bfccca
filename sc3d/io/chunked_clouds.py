"""Tables of points on disk, read in chunks: PLY (binary), LAS and LAZ."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.las import check_las
from sc3d.io.limits import FARTHEST
from sc3d.io.ply import check_ply

RECORDS_AT_ONCE, BYTES_AT_ONCE = 1_000_000, 128 << 20  # rows held at a time
LAS_FIELDS = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
LAS_COLORS = [("red", "u1"), ("green", "u1"), ("blue", "u1")]


@dataclass(frozen=True)
class CloudFile:
    """A cloud on disk. dtype: of a record, fields x, y, z and whatever else the file has; offset: bytes
    before the first one (PLY).
    """

    path: Path
    dtype: np.dtype
    num_points: int
    offset: int = 0

    @classmethod
    def open(cls, path: Path) -> CloudFile:
        """InputError if the file is damaged, empty, or of a kind that cannot be read in chunks."""
        kind = path.suffix.lower()
        if kind in (".las", ".laz"):
            las = check_las(path)
            return cls(path, np.dtype(LAS_FIELDS + LAS_COLORS * las.has_colors), las.num_points)
        if kind != ".ply":
            raise InputError(
                f"{path} does not fit into --max-memory, and can be read in parts as PLY, LAS or LAZ only: convert it, or allow more memory"
            )
        header = check_ply(path)
        record = header.record
        if record is None:
            raise InputError(
                f"{path} does not fit into --max-memory, and can be read in parts as binary PLY with the vertices first only: write it anew"
            )
        cloud = cls(path, record, header.elements[0].rows, header.size)
        if not cloud.num_points or not {"x", "y", "z"} <= set(cloud.names):
            raise InputError(f"{path} holds no points")
        return cloud

    @property
    def names(self) -> tuple[str, ...]:
        """Of the fields of a record."""
        return self.dtype.names or ()

    @property
    def rows_at_once(self) -> int:
        return rows_at_once(self.dtype)

    def chunks(self, at_once: int = 0) -> Iterator[tuple[int, np.ndarray]]:
        """First row and records of each chunk, of `at_once` rows if given; InputError at positions that are not finite or too far away."""
        for start, records in self._read(at_once or self.rows_at_once):
            for axis in "xyz":
                if not (np.abs(records[axis]) <= FARTHEST).all():
                    raise InputError(
                        f"{self.path} has positions that are not finite, or more than {FARTHEST:g} from the origin: remove those points first"
                    )
            yield start, records

    def _read(self, at_once: int) -> Iterator[tuple[int, np.ndarray]]:
        if self.path.suffix.lower() in (".las", ".laz"):
            yield from _read_las(self, at_once)
            return
        with self.path.open("rb") as file:
            file.seek(self.offset)
            for start in range(0, self.num_points, at_once):
                yield start, np.fromfile(file, self.dtype, min(at_once, self.num_points - start))


def rows_at_once(dtype: np.dtype) -> int:
    """How many records to hold at a time."""
    return min(RECORDS_AT_ONCE, max(1, BYTES_AT_ONCE // dtype.itemsize))


def _read_las(cloud: CloudFile, at_once: int) -> Iterator[tuple[int, np.ndarray]]:
    import laspy

    start = 0
    with laspy.open(cloud.path) as file:
        for points in file.chunk_iterator(at_once):
            records = np.empty(len(points), cloud.dtype)
            for axis in "xyz":
                records[axis] = getattr(points, axis)
            for name in cloud.names[3:]:
                records[name] = np.asarray(points[name]) >> 8  # 16 bits, by the standard
            yield start, records
            start += len(records)


def positions(records: np.ndarray) -> np.ndarray:
    """(N, 3) float64."""
    return np.stack([records[axis].astype(np.float64) for axis in "xyz"], axis=1)


def columns(records: np.ndarray, names: Iterable[str]) -> np.ndarray | None:
    """(N, K) of the named fields, of their common type; None if the records lack one."""
    names = list(names)
    if not set(names) <= set(records.dtype.names or ()):
        return None
    return np.stack([records[name] for name in names], axis=1)
