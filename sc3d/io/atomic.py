"""Files that are whole or not there: written under a temporary name, brought to the disk, renamed; what
killed runs leave behind is found and removed.
"""

from __future__ import annotations

import errno
import logging
import os
import platform
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sc3d.errors import InputError
from sc3d.io.folders import resolved

logger = logging.getLogger(__name__)

HOST = re.sub(r"\W+", "_", platform.node(), flags=re.ASCII)[:32] or "host"
LEFTOVER = re.compile(r"\..*\.(?P<host>\w+)-(?P<process>\d+)\.tmp")
STARTED = time.time()
OLD = 24 * 3600  # s: temporary files of other machines are dead after that
MARGIN = 60  # s: what is this much older than this process was made by another one of the same number
# bytes; with less left on the disk, what was written may not be whole, which not every library notices
ROOM = 1 << 16


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` with the same suffix (file or folder); it replaces `path` only if
    the block succeeds.

    Then all of it is on the disk: a crash of the machine leaves the old or the new, not a part. OSError if
    the disk is full.
    """
    path = Path(path)
    temporary = path.with_name(temporary_name(path.stem) + path.suffix)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not _is_writable(path.parent):
            raise PermissionError
    except (PermissionError, NotADirectoryError, FileExistsError):
        raise InputError(
            f"cannot write to {path.parent}: check its permissions or choose another folder"
        ) from None
    try:
        remove(temporary)  # of a killed process that had the same number, as all have in containers
        try:
            yield temporary
            if not os.path.lexists(temporary):
                raise OSError(f"nothing was written to {temporary}")
        finally:
            require_room(path)
        _sync(temporary)
        _replace(temporary, path)
    finally:
        remove(temporary)


def temporary_name(name: str) -> str:
    """A hidden name for something unfinished, which tells the process that makes it."""
    return f".{name}.{HOST}-{os.getpid()}.tmp"


def file_state(path: Path) -> tuple[int, ...] | None:
    """Changes whenever a file is replaced or written, or the entries of a folder; None while there is
    none.
    """
    with suppress(OSError):
        found = path.lstat()
        return found.st_ino, found.st_mtime_ns, found.st_size
    return None


def remove(path: Path) -> None:
    """Remove a file, link or folder, if it is there; of a link, not what it leads to."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def discard(folder: Path) -> None:
    """Remove a folder in one step, so that no part of it can be taken for the whole; of a link, not what it
    leads to.
    """
    if folder.is_symlink():
        folder.unlink()
    elif folder.is_dir():
        hidden = folder.with_name(temporary_name(folder.name))
        remove(hidden)
        folder.rename(hidden)
        remove(hidden)


def claim(path: Path) -> Path:
    """What a run leaves under a name that the next one finds again (`path`, a file or folder), before it is
    gone on with: it must be this user's own, without links, pipes or other names for its files in it.

    A scene of somebody else may hold a link of that name, and what it leads to would be overwritten: it is
    removed, not followed, and a warning says so. Returns `path`.
    Raises InputError for what belongs to another user, who could change it at any time.
    """
    if not os.path.lexists(path):
        return path
    owner = _new_owner(path.parent)
    for entry in _entries(path):
        found = entry.lstat()
        if found.st_uid != owner:
            raise InputError(
                f"{entry} belongs to another user: let them finish, or remove it, and the work that waits there is done anew"
            )
        if not _is_plain(found):
            reject(path, f"{entry.name} leads elsewhere")
            break
    return path


def reject(path: Path, reason: str) -> None:
    """Remove what was to be gone on with but is not from sc3d, and say so. InputError if that is not possible."""
    logger.warning("%s is not from sc3d (%s): removed, its work is done anew", path, reason)
    remove(path)
    if os.path.lexists(path):
        raise InputError(f"{path} cannot be removed by sc3d: remove it")


def _entries(path: Path) -> Iterator[Path]:
    """A file or folder and all that is in it; links are not followed."""
    yield path
    if path.is_dir() and not path.is_symlink():
        for entry in path.iterdir():
            yield from _entries(entry)


def _is_plain(entry: os.stat_result) -> bool:
    """Whether something is a folder, or a file that has one name only."""
    return stat.S_ISDIR(entry.st_mode) or (stat.S_ISREG(entry.st_mode) and entry.st_nlink <= 1)


def _new_owner(folder: Path) -> int:
    """Who owns what this process makes in a folder: not always its user, on network file systems."""
    with tempfile.TemporaryDirectory(prefix=temporary_name("owner"), dir=folder) as probe:
        return os.lstat(probe).st_uid


def remove_leftovers(folder: Path) -> None:
    """Remove what killed processes of this machine, or of others more than a day ago, left unfinished in a
    folder. Linked folders are let alone.
    """
    if folder.is_symlink() or not folder.is_dir():
        return
    for entry in folder.iterdir():
        found = LEFTOVER.match(entry.name)
        if found and _is_dead(found["host"], int(found["process"]), entry):
            with suppress(OSError):  # another user's, where all may write
                remove(entry)


def require_room(path: Path, num_bytes: int = 0) -> None:
    """OSError if there is no room for so many bytes, or none at all: some libraries then fail in other words,
    do not notice, or end the process.
    """
    free = _free_bytes(path.parent)
    if free is not None and free < num_bytes + ROOM:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from None


def _free_bytes(folder: Path) -> int | None:
    """Room on the disk of a folder; None where it is not known."""
    try:
        if not hasattr(os, "statvfs"):  # Windows
            return shutil.disk_usage(folder).free
        found = os.statvfs(folder)
    except OSError:
        return None
    free = found.f_bfree if os.geteuid() == 0 else found.f_bavail
    return free * found.f_frsize if found.f_blocks else None


FULL = re.compile(r"disk is full|No space left|quota exceeded|requested and \d+ written", re.IGNORECASE)


def full_folder(error: Exception, folders: list[Path]) -> Path | None:
    """Which folder has no room left, if that is what an error says: that of the file it names, else that of the
    folders with the least room; None for other errors.
    """
    if getattr(error, "errno", None) not in (errno.ENOSPC, errno.EDQUOT) and not FULL.search(str(error)):
        return None
    name = getattr(error, "filename", None)
    if name and not isinstance(name, int):
        return Path(os.fsdecode(name)).parent
    return min(folders, key=lambda folder: room if (room := _free_bytes(folder)) is not None else sys.maxsize)


@contextmanager
def telling_of_full_disk(path: Path) -> Iterator[None]:
    """Errors in the block become `OSError` (ENOSPC) if there is no room beside `path`, in whatever words a
    library puts them.
    """
    try:
        yield
    except Exception:
        require_room(path)
        raise


def require_inside(folder: Path, path: Path) -> None:
    """InputError if writing `path`, which lies in `folder` by name, would lead out of it by a link."""
    if folder not in path.parents:
        return
    if path.is_symlink() and path.is_dir():
        raise InputError(f"{path} is a link to {resolved(path)}, which would be overwritten: remove the link")
    outer = next((parent for parent in path.parents if parent.exists()), folder)
    if folder in (outer, *outer.parents) and not resolved(outer).is_relative_to(resolved(folder)):
        raise InputError(
            f"{outer} is a link that leads out of {folder}: what lies there is not overwritten, remove the link"
        )


def require_replaceable(path: Path, is_folder: bool) -> None:
    """InputError, before any work, if a folder cannot be replaced as it is something else, or a file as it is a
    folder.
    """
    if is_folder and os.path.lexists(path) and (path.is_symlink() or not path.is_dir()):
        kind = "link" if path.is_symlink() else "file" if path.is_file() else "pipe or device"
        raise InputError(f"{path} is a {kind}, but a folder is to be written there: remove it")
    if not is_folder and path.is_dir() and not path.is_symlink():
        raise InputError(f"{path} is a folder, but a file is to be written there: remove it or rename it")


def _is_writable(folder: Path) -> bool:
    return os.access(folder, os.W_OK, effective_ids=os.access in os.supports_effective_ids)


def _is_dead(host: str, process: int, entry: Path) -> bool:
    if host == HOST and process != os.getpid() and not _runs(process):
        return True
    with suppress(OSError):
        changed = entry.lstat().st_mtime
        return changed < STARTED - OLD if process != os.getpid() else changed < STARTED - MARGIN
    return False


def _runs(process: int) -> bool:
    if os.name == "nt":  # where a signal ends the process, whichever it is
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def _replace(temporary: Path, path: Path) -> None:
    is_folder = temporary.is_dir() and not temporary.is_symlink()
    if is_folder and path.is_symlink():
        raise InputError(f"{path} is a link: remove it, so that the folder it leads to is not overwritten")
    if is_folder and path.is_dir():  # folders cannot be replaced in one step
        before = temporary.with_name(f"{temporary.name}.before")
        remove(before)
        path.rename(before)
        try:
            temporary.rename(path)
        except OSError:
            before.rename(path)
            raise
        shutil.rmtree(before, ignore_errors=True)
    else:
        os.replace(temporary, path)
    _sync_one(path.parent)


def _sync(path: Path) -> None:
    """Bring a file, or a folder with all that is in it, to the disk."""
    if path.is_symlink():
        return
    for entry in [*path.rglob("*"), path] if path.is_dir() else [path]:
        if not entry.is_symlink():
            _sync_one(entry)


def _sync_one(path: Path) -> None:
    if os.name == "nt":  # which opens no folders, and brings no file to the disk that is open for reading
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # file systems that know no such thing
            raise
    finally:
        os.close(handle)


def require_writable(folder: Path) -> None:
    """Raise InputError, before any work, if a scene folder cannot be written."""
    existing = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
    if not existing.is_dir() or not _is_writable(existing):
        raise InputError(f"cannot write to {existing}: check its permissions or choose another folder")
