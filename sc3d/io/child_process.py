"""A process of its own for a library that may take the process it runs in with it: there a full disk, want of
memory or a fault in native code ends that process only, and becomes an error here.
"""

from __future__ import annotations

import errno
import logging
import multiprocessing
import os
import re
import signal
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any

from sc3d.errors import Sc3dError
from sc3d.io.atomic import FULL
from sc3d.io.progress import show_bars
from sc3d.io.provenance import note_peak_of_child, process_peak_mb

logger = logging.getLogger(__name__)

SECONDS = 5.0  # that an ending process may take
LINES = 200  # of its last words that are kept
# what glog and the C++ library say in front of the reason
REASON = re.compile(r"what\(\):\s*(?P<what>.+)|^[EF]\d{4,8} [^\]]*\]\s*(?P<logged>.+)")
NO_MEMORY = re.compile(r"bad_alloc|out of memory|cannot allocate", re.IGNORECASE)

Run = Callable[..., Any]
"""Calls a function with arguments, here or in a `ChildProcess`; `step`, if given, is handed on by that name"""


def run_here(function: Callable, *arguments: object, **options: object) -> Any:
    """In this process."""
    return function(*arguments, **options)


class ChildProcess:
    """Calls functions one after another in one other process, as a context. name: of the library, for errors."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __enter__(self) -> ChildProcess:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        words, spoken = context.Pipe(duplex=False)
        level = logging.getLogger("sc3d").getEffectiveLevel()
        self._process = context.Process(target=_serve, args=(theirs, spoken, level), daemon=True)
        with environment(
            {"PYTHONSAFEPATH": "1"}
        ):  # no modules from the folder in which the command was called
            self._process.start()
        theirs.close()  # so that the pipes end with the process
        spoken.close()
        self._last_words: deque[str] = deque(maxlen=LINES)
        self._listener = threading.Thread(target=self._listen, args=(words,), daemon=True)
        self._listener.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        self._connection.close()  # which ends it, unless it is at work
        if kind is not None:
            self._process.kill()
        self._process.join(SECONDS)
        if self._process.exitcode is None:
            self._process.kill()
            self._process.join()
        self._listener.join(SECONDS)

    def call(self, function: Callable, *arguments: object, step: Callable[[], object] | None = None) -> Any:
        """The result of a function of a module, or what it raises. step: called here whenever the function calls
        its argument of that name.

        Raises OSError (ENOSPC), MemoryError or Sc3dError, by its last words, if the process ends.
        """
        try:
            self._connection.send((function, arguments, step is not None))
            while True:
                kind, *found = self._connection.recv()
                if kind == "step" and step is not None:
                    step()
                elif kind == "message":
                    logging.getLogger(found[0]).log(found[1], "%s", found[2])
                elif kind == "done":
                    note_peak_of_child(found[1])
                    return found[0]
                elif kind == "error":
                    raise (
                        found[0]
                        if isinstance(found[0], Exception)
                        else RuntimeError(f"{self._name}: in a process of its own:\n{found[0]}")
                    )
        except (EOFError, BrokenPipeError, ConnectionResetError):
            self._process.join(SECONDS)
            self._listener.join(SECONDS)
            raise self._reason() from None

    def _listen(self, words: Connection) -> None:
        """Keep what the library writes to its standard error; shown with --verbose."""
        with os.fdopen(os.dup(words.fileno()), encoding="utf-8", errors="replace") as stream:
            words.close()
            for line in stream:
                self._last_words.append(line.rstrip())
                logger.debug("%s: %s", self._name, line.rstrip())

    def _reason(self) -> Exception:
        said, status = "\n".join(self._last_words), self._process.exitcode
        if FULL.search(said):
            return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if NO_MEMORY.search(said):
            return MemoryError(self._name)
        found = [
            match["what"] or match["logged"] for line in self._last_words if (match := REASON.search(line))
        ]
        reason = f": {found[0].strip()}" if found else ""
        how = f"exit status {status}"
        if status is not None and status < 0:
            how = signal.Signals(-status).name
            if how == "SIGKILL":
                reason = ", as the system does for want of memory: use a smaller --max-size"
        return Sc3dError(
            f"{self._name} ended in the middle of its work ({how}){reason}; finished work is kept, run the same"
            " command again, with --verbose to see what it says"
        )


@contextmanager
def environment(given: dict[str, str]) -> Iterator[None]:
    """Environment variables for processes that are started in the block; not longer than that: libraries here
    look at it too.
    """
    before = {name: os.environ.get(name) for name in given}
    os.environ.update(given)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def live_with_parent() -> None:
    """In a process that another one has started: leave Ctrl + C to that one, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    show_bars(False)  # the parent has them


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


def told(error: Exception) -> Exception | str:
    """What is for the user as it is, anything else with its place in the code."""
    known = isinstance(error, Sc3dError | OSError | MemoryError)
    return error if known else "".join(traceback.format_exception(error))


class _Answers(logging.Handler):
    """The way to the parent, from any thread; what is logged goes there too, to be said in its way."""

    def __init__(self, connection: Connection) -> None:
        super().__init__()
        self._connection, self._sending = connection, threading.Lock()

    def send(self, *answer: object) -> None:
        with self._sending, suppress(OSError):
            self._connection.send(answer)

    def emit(self, record: logging.LogRecord) -> None:
        self.send("message", record.name, record.levelno, record.getMessage())


def _serve(connection: Connection, spoken: Connection, level: int) -> None:
    """The life of a `ChildProcess`: until the pipe ends, or the parent."""
    live_with_parent()
    sys.stderr.flush()
    os.dup2(spoken.fileno(), 2)
    answers = _Answers(connection)
    logging.getLogger().addHandler(answers)
    logging.getLogger("sc3d").setLevel(level)
    logging.captureWarnings(True)
    while True:
        try:
            function, arguments, steps = connection.recv()
        except (EOFError, OSError):
            return
        options = {"step": lambda *_: answers.send("step")} if steps else {}
        try:
            result = function(*arguments, **options)
        except Exception as error:
            answers.send("error", told(error))
        else:
            answers.send("done", result, process_peak_mb())
