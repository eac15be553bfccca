"""Where compiled kernels are kept between runs, also where neither the package nor the home folder can be
written: containers, clusters.
"""

from __future__ import annotations

import atexit
import os
import shutil
import stat
import tempfile
from pathlib import Path

PREFIX = "sc3d-cache"
PACKAGE = Path(__file__).parents[1]
# variable: name of the cache below the user's cache folder
CACHES = {"NUMBA_CACHE_DIR": "numba", "TORCH_EXTENSIONS_DIR": "torch_extensions"}


def provide_caches() -> None:
    """Send the caches that have no place to a private temporary folder; to be called before numba is loaded,
    which else refuses to load a kernel. What the user has set stays.
    """
    for variable, name in CACHES.items():
        in_package = variable == "NUMBA_CACHE_DIR" and can_be_made(PACKAGE / "__pycache__")
        if not os.environ.get(variable) and not in_package and not can_be_made(_user_caches() / name):
            folder = private_folder()
            if folder is not None:
                os.environ[variable] = str(folder / name)


def kernel_cache() -> str:
    """Where compiled kernels are kept, in words."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        known = Path(given).parent.name.startswith(PREFIX)
        return f"kept in {given}{' (neither the package nor the home folder can be written; NUMBA_CACHE_DIR names another)' if known else ''}"
    if can_be_made(PACKAGE / "__pycache__"):
        return f"kept in {PACKAGE}"
    caches = _user_caches() / "numba"
    return f"kept in {caches}" if can_be_made(caches) else "have no place: set NUMBA_CACHE_DIR"


def has_kernels() -> bool:
    """Whether any kernel has been compiled already, so that this is not the first run."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    folders = [Path(given)] if given else [PACKAGE, _user_caches() / "numba"]
    return any(True for folder in folders for _ in folder.rglob("*.nbi"))


def _user_caches() -> Path:
    """The user's cache folder; one that cannot be where no home folder is known."""
    given = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(given if os.path.isabs(given) else "/dev/null/.cache")


def can_be_made(folder: Path) -> bool:
    """Whether files can be written in a folder, or it can be made."""
    existing = next((path for path in (folder, *folder.parents) if os.path.lexists(path)), None)
    return existing is not None and existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)


def private_folder() -> Path | None:
    """This user's own folder among the temporary files, the same in every run, as compiling takes a minute; None
    if there is none. Code is loaded from it: it must be nobody else's, by owner and mode, and not a link.
    """
    if not hasattr(os, "geteuid"):  # Windows, where the temporary folder is the user's own
        return Path(tempfile.gettempdir()) / PREFIX
    try:
        parent = Path(tempfile.gettempdir())
        folder = parent / f"{PREFIX}-{os.geteuid()}"
        try:
            folder.mkdir(mode=0o700)
        except FileExistsError:
            pass
        if _is_mine(folder) and _is_safe(parent):
            return folder
        once = Path(tempfile.mkdtemp(prefix=f"{PREFIX}-"))
        atexit.register(_discard, once, os.getpid())
        return once
    except OSError:
        return None


def _discard(folder: Path, process: int) -> None:
    if os.getpid() == process:  # not in a fork
        shutil.rmtree(folder, ignore_errors=True)


def _is_mine(folder: Path) -> bool:
    found = folder.lstat()
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o077


def _is_safe(parent: Path) -> bool:
    """Nobody else can rename what lies in a folder."""
    found = parent.stat()
    is_owned, is_sticky = found.st_uid in (0, os.geteuid()), bool(found.st_mode & stat.S_ISVTX)
    return is_owned and (is_sticky or not found.st_mode & 0o022)
