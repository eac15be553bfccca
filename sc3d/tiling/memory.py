"""How much fits into memory."""

from __future__ import annotations

import ctypes
import os
import re
from pathlib import Path

from sc3d.errors import InputError
from sc3d.io.chunked_clouds import CloudFile
from sc3d.io.ply import read_header
from sc3d.settings.common import Resources

BASE = 900 << 20  # bytes of a process without points: libraries, a photo's masks, a few range maps
TRIANGLE = 300  # bytes of a triangle while rays are cast
LEAST = 20_000  # points of a tile; with fewer, most of the work would be on margins
UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}


def memory_of(resources: Resources) -> int:
    """Bytes that one process may use; InputError if the option is no amount of memory, or too small."""
    if resources.max_memory:
        found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)i?B?", resources.max_memory.strip(), re.IGNORECASE)
        if not found:
            raise InputError(f"--max-memory {resources.max_memory}: an amount such as 6G or 800M is expected")
        if not found[2] and float(found[1]) < UNITS["M"]:
            raise InputError(
                f"--max-memory {resources.max_memory}: the unit is missing, such as {found[1]}M or {found[1]}G"
            )
        total = int(float(found[1]) * UNITS[found[2].upper()])
    else:
        total = system_memory() // 2
    # this process is there beside its workers
    share = total // max(resources.workers + 1, 1) if not resources.cluster else total
    if share <= BASE + (100 << 20):
        raise InputError(
            f"--max-memory: {total >> 20} MiB are too little for {resources.workers + 1} processes of at least {(BASE >> 20) + 100} MiB"
        )
    return share


class _MemoryStatus(ctypes.Structure):
    """MEMORYSTATUSEX of the Windows API."""

    _fields_ = [
        ("length", ctypes.c_uint32),
        ("load", ctypes.c_uint32),
        *(
            (name, ctypes.c_uint64)
            for name in ("memory", "free", "file", "file_free", "space", "space_free", "more")
        ),
    ]


def system_memory() -> int:
    """Bytes of memory that the machine has."""
    if hasattr(os, "sysconf"):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    status = _MemoryStatus(length=ctypes.sizeof(_MemoryStatus))
    ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status))  # type: ignore[attr-defined, unused-ignore]
    return status.memory


def fits(needed: int, resources: Resources) -> bool:
    """Whether work of so many bytes fits into memory as a whole, and nobody asked for workers."""
    return resources.workers < 1 and not resources.cluster and needed + BASE <= memory_of(resources)


def max_points(resources: Resources, bytes_per_point: int) -> int:
    """Points that a process has room for."""
    return max((memory_of(resources) - BASE) // bytes_per_point, LEAST)


def num_points(path: Path) -> int | None:
    """Points of a file that can be read in parts; None for other kinds, which are read as a whole."""
    kind = path.suffix.lower()
    if kind == ".ply" and path.is_file():
        vertex = read_header(path).element("vertex")
        return vertex.rows if vertex is not None else None
    return CloudFile.open(path).num_points if kind in (".las", ".laz") else None
