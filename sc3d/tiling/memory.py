"""How much fits into memory."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from pathlib import Path

from sc3d.errors import InputError
from sc3d.io.chunked_clouds import CloudFile
from sc3d.io.memory_limit import BASE, amount
from sc3d.io.ply import num_triangles, read_header
from sc3d.settings.common import Memory, Workers

TRIANGLE = 300  # bytes of a triangle while rays are cast, with half a vertex
VERTEX = 150  # bytes of a vertex beyond these, as where triangles share none
SHOWN_BYTES = 300  # of a point of a cloud that a viewer has
LEAST = 20_000  # points of a tile; with fewer, most of the work would be on margins


def memory_of(resources: Memory) -> int:
    """Bytes that one process may use; InputError if the option is no amount of memory, or too small."""
    total = amount(resources.max_memory) if resources.max_memory else system_memory() // 2
    workers, cluster = _elsewhere(resources)
    # this process is there beside its workers
    share = total // max(workers + 1, 1) if not cluster else total
    if share <= BASE + (100 << 20):
        raise InputError(
            f"--max-memory: {total >> 20} MiB are too little for {workers + 1} processes of at least {(BASE >> 20) + 100} MiB"
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


def _elsewhere(resources: Memory) -> tuple[int, str]:
    """Workers on this machine, and address of a cluster, of stages that can have them."""
    return (resources.workers, resources.cluster) if isinstance(resources, Workers) else (0, "")


def fits(needed: int, resources: Memory) -> bool:
    """Whether work of so many bytes fits into memory as a whole, and nobody asked for workers."""
    workers, cluster = _elsewhere(resources)
    return workers < 1 and not cluster and needed + BASE <= memory_of(resources)


def require_fit(needed: int, resources: Memory, what: str, advice: str) -> None:
    """InputError, before the work, if it takes the whole of something in memory, and that does not fit."""
    if not fits(needed, resources):
        raise InputError(
            f"{what} needs about {(needed + BASE) >> 20} MiB, and --max-memory leaves {memory_of(resources) >> 20}: {advice}"
        )


def max_points(resources: Memory, bytes_per_point: int) -> int:
    """Points that a process has room for."""
    return max((memory_of(resources) - BASE) // bytes_per_point, LEAST)


def surface_bytes(files: Sequence[Path]) -> int:
    """What a surface takes in memory while rays are cast or it is drawn."""
    triangles, there = num_triangles(files), [path for path in files if path.is_file()]
    vertices = sum(vertex.rows for path in there if (vertex := read_header(path).element("vertex")))
    return triangles * TRIANGLE + max(0, vertices - triangles // 2) * VERTEX


def num_points(path: Path) -> int | None:
    """Points of a file that can be read in parts; None for other kinds, which are read as a whole."""
    kind = path.suffix.lower()
    if kind == ".ply" and path.is_file():
        vertex = read_header(path).element("vertex")
        return vertex.rows if vertex is not None else None
    return CloudFile.open(path).num_points if kind in (".las", ".laz") else None
