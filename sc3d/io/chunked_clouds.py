"""Tables of points on disk, read in chunks: PLY (binary), LAS and LAZ."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.colors import COLORS, color_names, color_unit, to_bytes
from sc3d.io.crs import read_las_crs
from sc3d.io.las import open_las, warn_of_spare
from sc3d.io.limits import FARTHEST
from sc3d.io.ply import check_ply
from sc3d.io.splats import SPLATS, is_splat_ply

RECORDS_AT_ONCE, BYTES_AT_ONCE = 1_000_000, 128 << 20  # rows held at a time
LAS_FIELDS = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
LAS_COLORS = [("red", "u1"), ("green", "u1"), ("blue", "u1")]
LAS_CLASSES = [("classification", "u1"), ("label", "u1")]  # ASPRS codes; class ids, where sc3d wrote the file


@dataclass(frozen=True)
class CloudFile:
    """A cloud on disk. dtype: of a record as it is given, fields x, y, z and whatever else the file has,
    colors as bytes; stored: of a record in the file, and offset: bytes before the first one (PLY).
    """

    path: Path
    dtype: np.dtype
    num_points: int
    offset: int = 0
    stored: np.dtype | None = None

    @classmethod
    def open(cls, path: Path) -> CloudFile:
        """InputError if the file is damaged, empty, or of a kind that cannot be read in chunks."""
        kind = path.suffix.lower()
        if kind in (".las", ".laz"):
            las = warn_of_spare(path)
            if not las.num_points:
                raise InputError(f"{path} holds no points")
            with open_las(path) as file:
                names = set(file.header.point_format.dimension_names)
            classes = [field for field in LAS_CLASSES if field[0] in names]
            return cls(path, np.dtype(LAS_FIELDS + LAS_COLORS * las.has_colors + classes), las.num_points)
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
        if is_splat_ply(header):
            raise InputError(f"{path} {SPLATS}")
        cloud = cls(path, _with_bytes(record), header.elements[0].rows, header.size, record)
        if not {"x", "y", "z"} <= set(cloud.names):
            raise InputError(f"{path} has no properties x, y and z: name its positions so")
        if not cloud.num_points:
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
        """First row and records of each chunk, of `at_once` rows if given; InputError at positions that are
        not finite or too far away.
        """
        for start, records in self._read(at_once or self.rows_at_once):
            for axis in "xyz":
                if not (np.abs(records[axis]) <= FARTHEST).all():
                    raise InputError(
                        f"{self.path} has positions that are not finite, or more than {FARTHEST:g} from the origin: remove those points first"
                    )
            yield start, records

    def _read(self, at_once: int) -> Iterator[tuple[int, np.ndarray]]:
        for start, columns in self._stored(at_once):
            if isinstance(columns, np.ndarray) and columns.dtype == self.dtype:
                yield start, columns
                continue
            records = np.empty(len(columns["x"]), self.dtype)
            for name in self.names:
                source = columns[self._source(name)]
                records[name] = to_bytes(source, self.path, self._unit) if name in COLORS else source
            yield start, records

    def _stored(self, at_once: int) -> Iterator[tuple[int, Mapping[str, np.ndarray] | np.ndarray]]:
        """First row and columns of each chunk as they are in the file."""
        if self.stored is None:
            yield from _read_las(self, at_once)
            return
        with self.path.open("rb") as file:
            file.seek(self.offset)
            for start in range(0, self.num_points, at_once):
                yield start, np.fromfile(file, self.stored, min(at_once, self.num_points - start))

    def _source(self, name: str) -> str:
        """Name in the file."""
        found = None if self.stored is None else color_names(self.stored.names or ())
        return found[COLORS.index(name)] if found is not None and name in COLORS else name

    @cached_property
    def _unit(self) -> float:
        """Of all colors of the file, as `color_unit` says."""
        names = [self._source(name) for name in COLORS]
        stored = (columns for _, columns in self._stored(self.rows_at_once))
        return color_unit(
            (np.stack([columns[name] for name in names], axis=1) for columns in stored), self.path
        )


def rows_at_once(dtype: np.dtype) -> int:
    """How many records to hold at a time."""
    return min(RECORDS_AT_ONCE, max(1, BYTES_AT_ONCE // dtype.itemsize))


def _with_bytes(record: np.dtype) -> np.dtype:
    """A record with its colors, whatever they are called, as bytes named red, green and blue."""
    found = color_names(record.names or ())
    if found is None:
        return record
    place = dict(zip(found, COLORS, strict=True))
    fields = [(place.get(name, name), "u1" if name in place else record[name]) for name in record.names or ()]
    return record if found == COLORS and record["red"] == np.uint8 else np.dtype(fields)


def _read_las(cloud: CloudFile, at_once: int) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    start = 0
    with open_las(cloud.path) as file:
        scale = read_las_crs(file.header, cloud.path).height_scale
        for points in file.chunk_iterator(at_once):
            columns = {axis: np.asarray(getattr(points, axis)) for axis in "xyz"}
            columns["z"] = columns["z"] * scale
            yield start, columns | {name: np.asarray(points[name]) for name in cloud.names[3:]}
            start += len(points)
    if start != cloud.num_points:
        raise InputError(f"{cloud.path} holds {start} points, {cloud.num_points} are announced")


def positions(records: np.ndarray) -> np.ndarray:
    """(N, 3) float64."""
    return np.stack([records[axis].astype(np.float64) for axis in "xyz"], axis=1)


def columns(records: np.ndarray, names: Iterable[str]) -> np.ndarray | None:
    """(N, K) of the named fields, of their common type; None if the records lack one."""
    names = list(names)
    if not set(names) <= set(records.dtype.names or ()):
        return None
    return np.stack([records[name] for name in names], axis=1)
