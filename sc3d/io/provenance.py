"""Where a result comes from and what it cost: content hashes, versions, peak memory."""

from __future__ import annotations

import hashlib
import platform
import sys
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import sc3d
from sc3d.errors import InputError
from sc3d.io.folders import files_below
from sc3d.io.images import frame_of_photo
from sc3d.io.limits import HOLLOW, SOLID
from sc3d.io.photo_folder import IMAGE_SUFFIXES

if TYPE_CHECKING:
    from hashlib import blake2b


@dataclass(frozen=True)
class PhotoFrames:
    """A folder of photos, of which only that counts which says how masks and the world lie on them: names, sizes,
    EXIF orientation, XMP and alpha. Much cheaper than their content, and other colors change no labels.
    """

    folder: Path


Input = Path | PhotoFrames


def digest(item: Input) -> str:
    """Content hash of a file, of all files of a folder with their names, but for what sc3d has written there,
    or of what `PhotoFrames` says; "" if it does not exist. A file is read once by a process, unless it changes.

    Raises InputError for a large file of which next to nothing is on the disk.
    """
    if isinstance(item, PhotoFrames):
        files = [file for file in _files(item.folder) if file.suffix.lower() in IMAGE_SUFFIXES]
    else:
        files = _files(item)
    return _digest(item, tuple((file, *_version(file)) for file in files)) if files else ""


def _files(path: Path) -> list[Path]:
    return [path] if path.is_file() else files_below(path)[0] if path.is_dir() else []


def _version(file: Path) -> tuple[int, ...]:
    """Changes with the content of a file; also where `cp -p` gives another one the same time and size."""
    found = file.stat()
    if found.st_size > SOLID and getattr(found, "st_blocks", found.st_size) * 512 < found.st_size * HOLLOW:
        raise InputError(
            f"{file} says that it has {found.st_size / 1e9:.1f} GB, but next to nothing is on the disk: "
            "it is not whole, copy it again"
        )
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


@lru_cache(maxsize=64)
def _digest(item: Input, versions: tuple[tuple, ...]) -> str:
    state = hashlib.blake2b(digest_size=16)
    folder = item.folder if isinstance(item, PhotoFrames) else item
    for file, *_ in versions:
        if file != folder:
            state.update(str(file.relative_to(folder)).encode() + b"\0")
        frame = frame_of_photo(file) if isinstance(item, PhotoFrames) else None
        if frame is not None:
            state.update(repr(frame).encode())
        else:
            _add_content(state, file)
    return state.hexdigest()


def _add_content(state: blake2b, file: Path) -> None:
    with file.open("rb") as stream:
        while chunk := stream.read(1 << 20):
            state.update(chunk)


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


_children = [0]  # MB, largest of the processes that work was left to


def note_peak_of_child(megabytes: int) -> None:
    """Another process that works for this one needed as much."""
    _children[0] = max(_children[0], megabytes)


def reset_peak_memory() -> None:
    """Start measuring the peak anew (Linux; elsewhere it stays that of the whole process)."""
    _children[0] = 0
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory_mb() -> int:
    """Largest resident memory since `reset_peak_memory`, MB: of this process, or of one whose peak was noted."""
    return max(_own_peak_mb(), _children[0])


def _own_peak_mb() -> int:
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
    unit = 1 << 20 if sys.platform == "darwin" else 1 << 10  # bytes there, KiB elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // unit
