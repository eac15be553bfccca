"""E57 clouds (ASTM E2807) by pye57: the points of all scans, each placed by its pose.

Spherical coordinates are range, azimuth and elevation, m and radians.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sc3d.errors import InputError, MissingPackageError, Sc3dError
from sc3d.io.colors import to_bytes
from sc3d.io.crs import FileCrs, describe_crs

logger = logging.getLogger(__name__)

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
COLORS = ("colorRed", "colorGreen", "colorBlue")
INVALID = ("cartesianInvalidState", "sphericalInvalidState")
RATIO, SLACK = 2000, 1 << 20  # points per byte of the file beyond which a count is refused
GRAY = 128


class E57Cloud(NamedTuple):
    """positions: (N, 3) float64; colors: (N, 3) uint8, None = no scan has any; intensity: (N,) float32, None =
    not all scans have it; scan: (N,) uint16 number of the scan of each point
    """

    positions: np.ndarray
    colors: np.ndarray | None
    intensity: np.ndarray | None
    scan: np.ndarray
    crs: FileCrs


def read_e57(path: Path) -> E57Cloud:
    """All points that are valid. InputError for a file that cannot be read; warnings, each with a count, for
    points that are left out as invalid and for scans without colors.
    """
    with _open(path) as file:
        scans = [_Scan(file, number, path) for number in range(file.scan_count)]
        tables = [scan.table() for scan in scans if scan.count]
        crs = _crs(file, path)
    if not tables:
        raise InputError(f"{path} holds no points")
    valid = [table.pop("valid") for table in tables]
    left_out, total = sum(int((~kept).sum()) for kept in valid), sum(map(len, valid))
    if left_out:
        logger.warning("%s: %d of %d points are marked as invalid and are left out", path, left_out, total)
    numbers = np.repeat(np.arange(len(valid)), [np.count_nonzero(kept) for kept in valid]).astype(np.uint16)
    positions = np.concatenate([table["positions"][kept] for table, kept in zip(tables, valid)])
    positions[:, 2] *= crs.height_scale
    return E57Cloud(positions, _colors(tables, valid, path), _intensity(tables, valid), numbers, crs)


class _Scan:
    """One scan of a file."""

    def __init__(self, file: Any, number: int, path: Path) -> None:
        self._file, self._header = file, file.get_header(number)
        self._fields, self.count = set(self._header.point_fields), int(self._header.point_count)
        self._where = f"{path}, scan {number + 1}"
        if self.count > RATIO * path.stat().st_size + SLACK:
            raise InputError(f"{self._where} announces {self.count} points, which cannot be in this file")

    def table(self) -> dict[str, np.ndarray]:
        """positions (N, 3) in the frame of the file, valid (N,) bool; colors (N, 3) and intensity (N,) float64
        where it has them.
        """
        axes = next((names for names in (CARTESIAN, SPHERICAL) if set(names) <= self._fields), None)
        if axes is None:
            raise InputError(
                f"{self._where} has neither x, y, z nor range, azimuth and elevation of its points"
            )
        extra = [name for name in (*COLORS, "intensity", INVALID[axes is SPHERICAL]) if name in self._fields]
        columns = self._read([*axes, *extra])
        points = np.stack([columns[name] for name in axes], axis=1)
        if axes is SPHERICAL:
            reach, azimuth, elevation = points.T
            flat = reach * np.cos(elevation)
            points = np.stack(
                [flat * np.cos(azimuth), flat * np.sin(azimuth), reach * np.sin(elevation)], axis=1
            )
        table = {"positions": self._placed(points), "valid": np.ones(len(points), bool)}
        if (state := columns.get(INVALID[axes is SPHERICAL])) is not None:
            table["valid"] = state == 0
        if set(COLORS) <= columns.keys():
            table["colors"] = np.stack([columns[name] for name in COLORS], axis=1)
        return table | ({"intensity": columns["intensity"]} if "intensity" in columns else {})

    def _placed(self, points: np.ndarray) -> np.ndarray:
        if not self._header.has_pose():
            return points
        w, *rest = np.array(self._header.rotation, np.float64)
        turned = Rotation.from_quat([*rest, w]).apply(points)
        return turned + np.array(self._header.translation, np.float64)

    def _read(self, names: list[str]) -> dict[str, np.ndarray]:
        """(N,) float64 of fields, whatever they are stored as."""
        library = load_pye57().libe57
        columns = {name: np.zeros(self.count, np.float64) for name in names}
        buffers = library.VectorSourceDestBuffer()
        for name, column in columns.items():
            buffers.append(
                library.SourceDestBuffer(self._file.image_file, name, column, self.count, True, True)
            )
        found = self._header.points.reader(buffers).read()
        if found != self.count:
            raise InputError(f"{self._where} holds {found} points, {self.count} are announced")
        return columns


def _colors(tables: list[dict[str, np.ndarray]], valid: list[np.ndarray], path: Path) -> np.ndarray | None:
    bare = [row for row, table in enumerate(tables) if "colors" not in table]
    if len(bare) == len(tables):
        return None
    if bare:
        logger.warning(
            "%s: %d of %d scans have no colors: their points are gray", path, len(bare), len(tables)
        )
    stored = np.concatenate(
        [table["colors"][kept] for table, kept in zip(tables, valid) if "colors" in table]
    )
    whole = stored.max(initial=0) > 1 and bool((stored == np.rint(stored)).all())
    made = iter(np.split(to_bytes(stored.astype(np.int64) if whole else stored, path), _ends(tables, valid)))
    return np.concatenate(
        [
            next(made) if "colors" in table else np.full((np.count_nonzero(kept), 3), GRAY, np.uint8)
            for table, kept in zip(tables, valid)
        ]
    )


def _ends(tables: list[dict[str, np.ndarray]], valid: list[np.ndarray]) -> np.ndarray:
    """Where the scans that have colors end, but the last."""
    return np.cumsum([np.count_nonzero(kept) for table, kept in zip(tables, valid) if "colors" in table])[:-1]


def _intensity(tables: list[dict[str, np.ndarray]], valid: list[np.ndarray]) -> np.ndarray | None:
    if not all("intensity" in table for table in tables):
        return None
    return np.concatenate([table["intensity"][kept] for table, kept in zip(tables, valid)]).astype(np.float32)


def _crs(file: Any, path: Path) -> FileCrs:
    """What the file says of its CRS, as WKT."""
    import pyproj

    text = str(file.root["coordinateMetadata"].value()) if file.root.isDefined("coordinateMetadata") else ""
    if not text.strip():
        return FileCrs()
    try:
        crs = pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError:
        logger.warning("%s: its CRS cannot be understood and is not used: %.80s", path, text)
        return FileCrs()
    return describe_crs(crs, path)


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    """A reader; InputError for whatever is wrong with the file, also while it is read."""
    library = load_pye57()
    try:
        with library.E57(str(path)) as file:
            yield file
    except (Sc3dError, MemoryError):
        raise
    except Exception as error:  # libE57Format raises many kinds
        what = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"cannot read {path}: {what}; write or copy it again") from None


def load_pye57() -> ModuleType:
    """Import pye57; MissingPackageError says how to install it."""
    try:
        import pye57
    except ModuleNotFoundError:
        raise MissingPackageError("E57 files need pye57: pip install 'sc3d[e57]'") from None
    return pye57
