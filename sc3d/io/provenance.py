"""Where a result comes from and what it cost: content hashes, versions, peak memory."""

from __future__ import annotations

import hashlib
import platform
from contextlib import suppress
from importlib import metadata
from pathlib import Path

import sc3d
from sc3d.io.folders import files_below


def digest(path: Path) -> str:
    """Content hash of a file, or of all files of a folder with their names, but for what sc3d has written
    there; "" if it does not exist.
    """
    state = hashlib.blake2b(digest_size=16)
    files = [path] if path.is_file() else files_below(path)[0] if path.is_dir() else []
    if not files:
        return ""
    for file in files:
        if path.is_dir():
            state.update(str(file.relative_to(path)).encode() + b"\0")
        with file.open("rb") as stream:
            while chunk := stream.read(1 << 20):
                state.update(chunk)
    return state.hexdigest()


PACKAGES = ("open3d", "numpy", "scipy", "torch", "numba", "pycolmap", "opencv-python-headless")


def versions() -> dict[str, str]:
    """Versions of sc3d, Python and the packages that decide results."""
    found = {"sc3d": sc3d.__version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def reset_peak_memory() -> None:
    """Start measuring the peak anew (Linux; elsewhere it stays that of the whole process)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory_mb() -> int:
    """Largest resident memory since `reset_peak_memory`, MB."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) // 1024
    return process_peak_mb()


def process_peak_mb() -> int:
    """Largest resident memory since the process began, MB; 0 where the system does not tell (Windows)."""
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
