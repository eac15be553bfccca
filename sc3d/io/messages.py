"""Where messages go: to stderr, and to a file; nothing in them may command a terminal."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sc3d.errors import InputError
from sc3d.io.progress import HAS_BAR, bars_aside, show_bars

PACKAGES = ("sc3d", "tools")


class PlainText(logging.Formatter):
    """Names of photos and classes may hold what a terminal takes for commands."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


def printable(text: str) -> str:
    """Text without control characters, but for line feeds and tabs."""
    return re.sub(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", "?", text)


class ErrorStream(logging.StreamHandler):
    """stderr, without the lines that a bar there shows already."""

    def __init__(self) -> None:
        super().__init__(sys.stderr)
        self.setFormatter(PlainText("%(message)s"))
        self.addFilter(lambda record: not getattr(record, HAS_BAR, False))

    def emit(self, record: logging.LogRecord) -> None:
        with bars_aside():
            super().emit(record)


class LogFile(logging.FileHandler):
    """A file that is added to, with the time of every message."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, encoding="utf-8", errors="replace")
        self.setFormatter(PlainText("%(asctime)s %(message)s", "%Y-%m-%d %H:%M:%S"))


def start_logging(quiet: bool = False, verbose: bool = False, log: Path | None = None) -> None:
    """Log to stderr and to a file, of other packages warnings only.

    quiet: warnings and errors only on stderr, and no bars; verbose: also what is for the search for faults
    Raises InputError for a file that cannot be written.
    """
    logging.basicConfig(handlers=[ErrorStream()])
    root = logging.getLogger()
    for handler in list(root.handlers):
        if isinstance(handler, ErrorStream):
            handler.setLevel(logging.WARNING if quiet else logging.DEBUG)
        elif isinstance(handler, LogFile):  # of an earlier call
            root.removeHandler(handler)
            handler.close()
    if log is not None:
        root.addHandler(_opened(log))
    for package in PACKAGES:
        logging.getLogger(package).setLevel(logging.DEBUG if verbose else logging.INFO)
    logging.captureWarnings(True)
    show_bars(not quiet)


def _opened(path: Path) -> LogFile:
    try:
        return LogFile(path)
    except OSError as error:
        raise InputError(
            f"--log {path}: cannot write ({error.strerror}): name a file in a folder that exists"
        ) from None


@contextmanager
def messages_to(descriptor: int) -> Iterator[None]:
    """Write to `descriptor`, where stderr leads to outside, while the block has its number lead elsewhere."""
    stderr = 2
    found = []
    for handler in logging.getLogger().handlers:
        with suppress(OSError, ValueError):  # a stream without number, as in tests
            if isinstance(handler, ErrorStream) and handler.stream.fileno() == stderr:
                found.append((handler, handler.stream))
    with open(os.dup(descriptor), "w", encoding=sys.stderr.encoding, errors="backslashreplace") as stream:
        for handler, _ in found:
            handler.setStream(stream)
        try:
            yield
        finally:
            for handler, before in found:
                handler.setStream(before)


def write_to_log_file(text: str) -> None:
    """What stderr has been told in another way."""
    record = logging.LogRecord("sc3d", logging.ERROR, __file__, 0, "%s", (text,), None)
    for handler in logging.getLogger().handlers:
        if isinstance(handler, LogFile):
            handler.handle(record)
