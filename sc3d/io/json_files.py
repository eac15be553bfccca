"""Text and JSON, whole or not there."""

from __future__ import annotations

import errno
import json
from pathlib import Path

from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path


def write_text(path: Path, content: str) -> None:
    """Write UTF-8 text, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(content, encoding="utf-8")


def write_json(path: Path, content: object) -> None:
    """Write JSON, indented, atomically."""
    write_text(path, json.dumps(content, indent=1) + "\n")


def read_json(path: Path, max_bytes: int | None = None) -> object:
    """Read JSON; InputError if missing, broken or larger than `max_bytes` (decoded, it takes up to 30 times
    as much).
    """
    try:
        if not path.is_file():  # a pipe could be waited for
            raise FileNotFoundError(errno.ENOENT, "No such file")
        if max_bytes is not None and path.stat().st_size > max_bytes:
            raise InputError(f"{path} is larger than {max_bytes >> 20} MiB: that is no file of this kind")
        return json.loads(path.read_bytes())  # UTF-8, 16 or 32, with or without a byte order mark
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid JSON ({error})") from None
