"""The voxel field of a whole cloud from those of its tiles, in the file that Open3D's `VoxelBlockGrid` reads,
without holding it in memory.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sc3d.io.atomic import atomic_path
from sc3d.tiling.store import Results

HELD = 64 << 20  # bytes of blocks at a time


def write_field(results: Results, tiles: list[int], header: dict[str, np.ndarray], path: Path) -> None:
    """The blocks of all tiles (`keys` (B, 3) and `field` of each), sorted by position, as one
    `VoxelBlockGrid` npz; header: as `file_header` gives it.
    """
    keys = [results.read(tile, "keys") for tile in tiles]
    owner, row = (
        np.repeat(np.arange(len(tiles)), [len(part) for part in keys]),
        np.concatenate([np.arange(len(part)) for part in keys]),
    )
    joined = np.concatenate(keys)
    order = np.lexsort(joined.T[::-1])
    shape = results.read(tiles[0], "field", mapped=True).shape[1:]
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        _array(
            archive,
            "value_000",
            (len(joined), *shape),
            np.int32,
            _sorted(results, tiles, owner[order], row[order], shape),
        )
        _array(archive, "key", joined.shape, np.int32, [joined[order]])
        for name, value in header.items():
            _array(archive, name, value.shape, value.dtype, [value])


def _sorted(
    results: Results, tiles: list[int], owner: np.ndarray, row: np.ndarray, shape: tuple[int, ...]
) -> Iterator[np.ndarray]:
    """Counts of some blocks at a time; owner: (B,) place of each block's tile in `tiles`; row: (B,) its row
    there.
    """
    at_once = max(1, HELD // (4 * int(np.prod(shape))))
    for start in range(0, len(owner), at_once):
        part = slice(start, start + at_once)
        values = np.empty((len(owner[part]), *shape), np.int32)
        for place in np.unique(owner[part]):
            mine = owner[part] == place
            values[mine] = results.read(tiles[place], "field", mapped=True)[row[part][mine]]
        yield values


def _array(
    archive: zipfile.ZipFile,
    name: str,
    shape: tuple[int, ...],
    dtype: npt.DTypeLike,
    parts: Iterable[np.ndarray],
) -> None:
    # without a date, so that equal fields are equal files
    with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as file:
        np.lib.format.write_array_header_1_0(
            file,
            {"descr": np.lib.format.dtype_to_descr(np.dtype(dtype)), "fortran_order": False, "shape": shape},
        )
        for part in parts:
            file.write(np.ascontiguousarray(part, dtype).tobytes())
