"""Text and JSON, whole or not there."""

from __future__ import annotations

import codecs
import errno
import json
import re
from contextlib import suppress
from pathlib import Path

from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path


def write_text(path: Path, content: str) -> None:
    """Write UTF-8 text, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(content, encoding="utf-8")


def read_text(path: Path) -> str:
    """Text of another program: UTF-8 or 16 with a byte order mark, UTF-8, or else as Windows writes it in Western
    Europe. InputError if it is missing or no text.
    """
    try:
        _require_file(path)
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    marked = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    for encoding in ("utf-16",) if marked else ("utf-8-sig", "cp1252"):
        with suppress(UnicodeDecodeError):
            return content.decode(encoding)
    raise InputError(f"{path} is no text file")


def _require_file(path: Path) -> None:
    if not path.is_file():  # a pipe could be waited for, and a device has no end
        raise FileNotFoundError(errno.ENOENT, "No such file")


def whole_number(value: object) -> int | None:
    """The whole number that a value of another program means, which may write 640 as 640.0; None for any other."""
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def whole_number_of(text: object) -> int | None:
    """As `whole_number`, also of a text such as "640" or "640.0"."""
    if not isinstance(text, str):
        return whole_number(text)
    found = re.fullmatch(r"\s*([+-]?[0-9]{1,18})(?:\.0*)?\s*", text)
    return int(found[1]) if found else None


def write_json(path: Path, content: object) -> None:
    """Write JSON, indented, atomically."""
    write_text(path, json.dumps(content, indent=1) + "\n")


def read_json(path: Path, max_bytes: int | None = None) -> object:
    """Read JSON; InputError if missing, broken or larger than `max_bytes` (decoded, it takes up to 30 times
    as much).
    """
    try:
        _require_file(path)
        if max_bytes is not None and path.stat().st_size > max_bytes:
            raise InputError(f"{path} is larger than {max_bytes >> 20} MiB: that is no file of this kind")
        return json.loads(path.read_bytes())  # UTF-8, 16 or 32, with or without a byte order mark
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid JSON ({error})") from None
