"""Arrays of a .npz file, which may be from anyone."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from pathlib import Path
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.lib import format as npy

from sc3d.io.limits import MAX_PIXELS, MAX_SIDE, DamagedFileError

CHANNELS, ITEM = 4, 8  # values of a pixel and bytes of a value, at most


def read_arrays(path: Path, names: Sequence[str]) -> list[np.ndarray]:
    """Arrays of the size of photos by name. DamagedFileError if one is not there, not of numbers, or larger: a
    few compressed bytes may announce more than fits into the memory.
    """
    try:
        if not path.is_file():  # a pipe could be waited for
            raise DamagedFileError("it is no file")
        with ZipFile(path) as archive:
            return [_read(archive, f"{name}.npy") for name in names]
    # zipfile raises RuntimeError for encryption and NotImplementedError for methods that it does not know
    except (OSError, ValueError, KeyError, EOFError, RuntimeError, BadZipFile, zlib.error) as error:
        raise DamagedFileError(str(error)) from None


def _read(archive: ZipFile, name: str) -> np.ndarray:
    with archive.open(name) as stream:
        version = npy.read_magic(stream)
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = read_header(stream)
    too_large = math.prod(shape[:2]) > MAX_PIXELS or max(shape[:2], default=0) > MAX_SIDE
    if too_large or math.prod(shape[2:]) > CHANNELS or dtype.kind not in "biuf" or dtype.itemsize > ITEM:
        raise DamagedFileError(f"{name} has the shape {shape} and type {dtype}")
    with archive.open(name) as stream:
        return npy.read_array(stream, allow_pickle=False)
