"""The points of a cloud sorted into square tiles of the ground plane, on disk; a tile is read with a margin
of its neighbors' points.

Memory: one chunk while sorting; one tile with its margin, and one neighbor, while reading.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path
from sc3d.io.chunked_clouds import CloudFile, positions
from sc3d.io.json_files import write_json
from sc3d.labelling.cloud import STEPS, CloudExtent, histogram_median, position_histogram

RASTER = 512  # cells per side in which points are counted, to choose the tiles
MAX_TILES = 4096


@dataclass(frozen=True)
class TileGrid:
    """Square tiles. low: (2,) corner of the first; size: side, world units; shape: tiles along both axes;
    axes: the two world axes of the ground plane.
    """

    low: np.ndarray
    size: float
    shape: tuple[int, int]
    axes: tuple[int, int]

    def tile_of(self, points: np.ndarray) -> np.ndarray:
        """(N,) int32 tile of each (N, 3) point; points outside belong to the nearest."""
        cells = [
            np.clip((points[:, axis] - self.low[k]) // self.size, 0, self.shape[k] - 1).astype(np.int32)
            for k, axis in enumerate(self.axes)
        ]
        return cells[0] * self.shape[1] + cells[1]

    def box(self, tile: int) -> tuple[np.ndarray, np.ndarray]:
        """(2,) lower and (2,) upper corner of a tile, along `axes`; the outer sides lie at infinity, as
        `tile_of` has it.
        """
        cell = np.array(divmod(tile, self.shape[1]))
        low = np.where(cell == 0, -np.inf, self.low + cell * self.size)
        high = np.where(cell == np.array(self.shape) - 1, np.inf, self.low + (cell + 1) * self.size)
        return low, high

    def within(self, points: np.ndarray, tile: int, margin: float) -> np.ndarray:
        """(N,) bool: points less than `margin` outside a tile, or in it."""
        low, high = self.box(tile)
        flat = points[:, self.axes]
        return np.all((flat >= low - margin) & (flat < high + margin), axis=1)

    def neighbors(self, tile: int, margin: float) -> list[int]:
        """The tiles that the margin around a tile reaches into, itself first."""
        reach, (row, column) = (
            int(np.ceil(margin / self.size)) if margin > 0 else 0,
            divmod(tile, self.shape[1]),
        )
        around = [
            (i, j)
            for i in range(row - reach, row + reach + 1)
            for j in range(column - reach, column + reach + 1)
        ]
        inside = [
            i * self.shape[1] + j for i, j in around if 0 <= i < self.shape[0] and 0 <= j < self.shape[1]
        ]
        return [tile, *(other for other in inside if other != tile)]


@dataclass(frozen=True)
class CloudStatistics:
    """What one pass over a cloud tells: its box and median, and points per cell of a raster over the ground
    plane (RASTER, RASTER) int64.
    """

    extent: CloudExtent
    axes: tuple[int, int]
    counts: np.ndarray

    @classmethod
    def from_cloud(cls, cloud: CloudFile) -> CloudStatistics:
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for _, records in cloud.chunks():
            points = positions(records)
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
        axes = tuple(sorted(np.argsort(high - low, kind="stable")[1:].tolist()))
        steps, counts = np.zeros((3, STEPS), np.int64), np.zeros(RASTER * RASTER, np.int64)
        fine = TileGrid(low[list(axes)], float((high - low).max()) / RASTER or 1.0, (RASTER, RASTER), axes)
        for _, records in cloud.chunks():
            points = positions(records)
            steps += position_histogram(points, low, high)
            counts += np.bincount(fine.tile_of(points), minlength=RASTER * RASTER)
        return cls(
            CloudExtent(low, high, histogram_median(steps, low, high)), axes, counts.reshape(RASTER, RASTER)
        )

    @property
    def spacing(self) -> float:
        """About the distance between points, world units: from the cells that hold any, so too large for
        clouds with gaps smaller than a cell.
        """
        side = float((self.extent.high - self.extent.low)[list(self.axes)].max()) / RASTER
        return side * float(np.sqrt((self.counts > 0).sum() / max(self.counts.sum(), 1)))

    def grid(self, max_points: int, margin: float = 0.0) -> TileGrid:
        """The largest tiles such that none holds more than about `max_points`, the margin around it (world
        units) included.

        InputError if the margin would be wider than the tile.
        """
        extent = float((self.extent.high - self.extent.low)[list(self.axes)].max()) or 1.0
        sums = np.pad(self.counts.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
        for parts in range(1, int(MAX_TILES**0.5) + 1):
            side, around = RASTER / parts, margin / extent * RASTER
            if parts > 1 and around > side:
                raise InputError(
                    f"--max-memory leaves room for tiles of {extent / parts:g} only, too little beside margins of {margin:g}: allow more memory"
                )
            low, high = (
                np.clip(edges, 0, RASTER).astype(int)
                for edges in (
                    np.arange(parts) * side - around,
                    np.ceil((np.arange(parts) + 1) * side + around),
                )
            )
            held = (
                sums[np.ix_(high, high)]
                - sums[np.ix_(low, high)]
                - sums[np.ix_(high, low)]
                + sums[np.ix_(low, low)]
            )
            if held.max() <= max_points:
                break
        return _square_grid(self.extent, self.axes, parts)


def _square_grid(extent: CloudExtent, axes: tuple[int, int], parts: int) -> TileGrid:
    """So many tiles along the longer side; along the shorter, as many as are needed."""
    sides = (extent.high - extent.low)[list(axes)]
    size = float(sides.max()) / parts or 1.0
    first, second = np.clip(np.ceil(sides / size - 1e-9), 1, parts).astype(int).tolist()
    return TileGrid(extent.low[list(axes)], size, (first, second), axes)


@dataclass(frozen=True)
class TileWithHalo:
    """A tile and the points around it, by row. parts: (tile, which of its points) in turn; order: (N,) that
    sorts them; rows: (N,) int64 sorted rows in the cloud; core: (N,) bool, points of the tile itself.
    """

    parts: list[tuple[int, np.ndarray | slice]]
    order: np.ndarray
    rows: np.ndarray
    core: np.ndarray

    def gather(self, read: Callable[[int], np.ndarray]) -> np.ndarray:
        """(N, ...) values of the window's points; read: values of all points of a tile."""
        return np.concatenate([read(tile)[kept] for tile, kept in self.parts])[self.order]


@dataclass(frozen=True)
class TileStore:
    """Records by tile. folder/<tile>.bin: records; folder/<tile>.row: their rows in the cloud, rising, int64;
    counts: points of each tile, empty ones left out.
    """

    folder: Path
    grid: TileGrid
    dtype: np.dtype
    counts: dict[int, int]

    @classmethod
    def build(cls, cloud: CloudFile, grid: TileGrid, folder: Path) -> TileStore:
        """Sort a cloud into tiles. A store that is there already is taken as it is: the folder's name says
        what it holds.
        """
        index = folder / "index.json"
        if not index.exists():
            folder.mkdir(parents=True, exist_ok=True)
            for old in folder.iterdir():
                old.unlink()
            counts = np.zeros(grid.shape[0] * grid.shape[1], np.int64)
            for start, records in cloud.chunks():
                tiles = grid.tile_of(positions(records))
                order, found = np.argsort(tiles, kind="stable"), np.bincount(tiles, minlength=len(counts))
                ends = np.cumsum(found)
                for tile in np.flatnonzero(found):
                    rows = order[ends[tile] - found[tile] : ends[tile]]
                    _append(folder / f"{tile}.bin", records[rows])
                    _append(folder / f"{tile}.row", start + rows)
                counts += found
            write_json(index, {int(tile): int(counts[tile]) for tile in np.flatnonzero(counts)})
        return cls(
            folder,
            grid,
            cloud.dtype,
            {int(tile): count for tile, count in json.loads(index.read_text()).items()},
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Of the fields of a record."""
        return self.dtype.names or ()

    @property
    def tiles(self) -> list[int]:
        return sorted(self.counts)

    def records(self, tile: int) -> np.ndarray:
        return np.memmap(self.folder / f"{tile}.bin", self.dtype, "r")

    def rows(self, tile: int) -> np.ndarray:
        return np.memmap(self.folder / f"{tile}.row", np.int64, "r")

    def with_halo(self, tile: int, margin: float) -> TileWithHalo:
        """The points of a tile, and those less than `margin` (world units) around it; which these are is
        remembered in a file.
        """
        file = self.folder / f"{tile}.margin-{margin:.9g}.npz"
        if not file.exists():
            around = {}
            for other in self.grid.neighbors(tile, margin)[1:]:
                if other in self.counts:
                    around[str(other)] = np.flatnonzero(
                        self.grid.within(positions(self.records(other)), tile, margin)
                    ).astype(np.int32)
            with atomic_path(file) as temporary:
                np.savez(temporary, **around)  # type: ignore[arg-type]  # the stub takes keywords for options
        with np.load(file, allow_pickle=False) as around:
            parts = [
                (tile, slice(None)),
                *((int(other), around[other]) for other in around.files if len(around[other])),
            ]
        rows = np.concatenate([self.rows(other)[kept] for other, kept in parts])
        order = np.argsort(rows)
        core = np.zeros(len(rows), bool)
        core[: self.counts[tile]] = True
        return TileWithHalo(parts, order, rows[order], core[order])


def _append(path: Path, values: np.ndarray) -> None:
    with path.open("ab") as file:
        file.write(np.ascontiguousarray(values).data)


@dataclass(frozen=True)
class Results:
    """Arrays of each tile, in the order of its points: folder/<name>.<tile>.npy, whole or not there."""

    folder: Path
    store: TileStore

    def has(self, tile: int, name: str) -> bool:
        return self._path(tile, name).exists()

    def write(self, tile: int, **arrays: np.ndarray) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, values in arrays.items():
            with atomic_path(self._path(tile, name)) as temporary, temporary.open("wb") as file:
                np.lib.format.write_array(file, np.ascontiguousarray(values), allow_pickle=False)

    def read(self, tile: int, name: str, mapped: bool = False) -> np.ndarray:
        return np.load(self._path(tile, name), mmap_mode="r" if mapped else None, allow_pickle=False)

    def around(self, halo: TileWithHalo, name: str) -> np.ndarray:
        """Values of the window's points."""
        return halo.gather(lambda tile: self.read(tile, name, mapped=True))

    def in_order(self, names: list[str], at_once: int) -> Iterator[dict[str, np.ndarray]]:
        """The values of all points in the order of the cloud, so many at a time."""
        total = sum(self.store.counts.values())
        for start in range(0, total, at_once):
            stop, chunk = min(start + at_once, total), dict[str, np.ndarray]()
            for tile in self.store.tiles:
                rows = self.store.rows(tile)
                first, last = np.searchsorted(rows, (start, stop))
                for name in names if first < last else ():
                    values = self.read(tile, name, mapped=True)[first:last]
                    target = chunk.setdefault(name, np.empty((stop - start, *values.shape[1:]), values.dtype))
                    target[rows[first:last] - start] = values
            yield chunk

    def _path(self, tile: int, name: str) -> Path:
        return self.folder / f"{name}.{tile}.npy"
