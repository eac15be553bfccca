"""How far the work is: a bar on a terminal; in files and pipes a line every 30 seconds.

The lines come from a thread of their own, also in a long call without steps, if the library that is called
lets go of Python's lock. They are log messages, so processes without logging, such as workers, write none.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import AbstractContextManager, contextmanager
from typing import TypeVar

from tqdm import tqdm

logger = logging.getLogger(__name__)

INTERVAL = 30.0  # seconds between two lines
POLL = 0.5  # seconds between two looks at work that does not tell by itself
HAS_BAR = "has_bar"  # attribute of the log records of lines that a bar shows already

Item = TypeVar("Item")


class Board:
    """What is under way in this process, outermost first. clock: seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock, self.bars = clock, True
        self._tasks: list[Progress] = []
        self._lock = threading.Lock()
        self._last, self._ended = 0.0, threading.Event()

    def add(self, task: Progress) -> None:
        """Begin to tell of a task, inside of those that are there."""
        with self._lock:
            self._tasks.append(task)
            if len(self._tasks) > 1:
                return
            self._last, self._ended = self.clock(), threading.Event()
        if logger.isEnabledFor(logging.INFO):
            threading.Thread(target=self._watch, args=(self._ended,), daemon=True).start()

    def remove(self, task: Progress) -> None:
        """The task has ended."""
        with self._lock:
            self._tasks.remove(task)
            if not self._tasks:
                self._ended.set()

    def _watch(self, ended: threading.Event) -> None:
        while not ended.wait(max(self._last + INTERVAL - self.clock(), 0.1)):
            self.tell()

    def tell(self) -> None:
        """Log a line, if the last one is old enough and something is under way."""
        with self._lock:
            tasks, now = list(self._tasks), self.clock()
            if not tasks or now - self._last < INTERVAL:
                return
            self._last = now
        texts = [task.text(now) for task in tasks]
        logger.info(
            "%s; %s so far",
            ": ".join(text for text in texts if text),
            duration(now - tasks[0].started),
            extra={HAS_BAR: any(task.has_bar for task in tasks)},
        )


BOARD = Board()


class Progress:
    """Work of `total` steps (None = unknown), of which `initial` are done, as a context.

    unit: one step, in English; "%" = the steps are per cent. bar: False = without a bar on a terminal;
    leave: whether the bar stays when the work is done
    """

    def __init__(
        self,
        total: int | None,
        description: str,
        unit: str,
        *,
        initial: int = 0,
        bar: bool = True,
        leave: bool = True,
        board: Board = BOARD,
    ) -> None:
        self.total, self.done, self._unit = total, initial, unit
        self._description, self._initial, self._figures = description, initial, ""
        self._board, self._lock, self.started = board, threading.Lock(), board.clock()
        self._bar = tqdm(
            total=total,
            initial=initial,
            desc=description,
            unit=unit,
            leave=leave,
            disable=None if bar and board.bars else True,  # None: on a terminal only
        )
        self.has_bar = not self._bar.disable

    def __enter__(self) -> Progress:
        self._board.add(self)
        return self

    def __exit__(self, *error: object) -> None:
        self._board.remove(self)
        self._bar.close()

    def update(self, count: int = 1) -> None:
        """So many steps more are done."""
        with self._lock:
            self.done += count
            self._bar.update(count)

    def advance_to(self, done: int) -> None:
        """So many steps are done in total."""
        self.update(done - self.done)

    def show(self, figures: str) -> None:
        """Figures of the present state, behind the bar and in the lines."""
        self._figures = figures
        self._bar.set_postfix_str(figures, refresh=False)

    def text(self, now: float) -> str:
        """What a line says of it."""
        figures = f", {self._figures}" if self._figures else ""
        if not self.total:
            counted = f" {self.done} {self._unit}s" if self.done else ""
            return f"{self._description}{counted}{figures}"
        count = "" if self._unit == "%" else f" ({self.done} of {self.total} {self._unit}s)"
        return f"{self._description} {self.done / self.total:.0%}{count}{self._left(now)}{figures}"

    def _left(self, now: float) -> str:
        new = self.done - self._initial
        if new <= 0 or not self.total or self.done >= self.total:
            return ""
        return f", {duration((now - self.started) / new * (self.total - self.done))} left"


def progress(
    items: Iterable[Item],
    description: str,
    unit: str,
    *,
    total: int | None = None,
    bar: bool = True,
    leave: bool = True,
    board: Board = BOARD,
) -> Iterator[Item]:
    """The items, with a step for each that has been worked on; the rest as in `Progress`."""
    if total is None:
        total = len(items) if isinstance(items, Sized) else None
    with Progress(total, description, unit, bar=bar, leave=leave, board=board) as task:
        for item in items:
            yield item
            task.update()


def under_way(description: str, board: Board = BOARD) -> Progress:
    """A context for work without steps, or around what has some: the lines name it."""
    return Progress(None, description, "", bar=False, board=board)


@contextmanager
def polled(task: Progress, count: Callable[[], int | None]) -> Iterator[None]:
    """Ask while the block runs how many steps are done (None = not known now), and take it as done at its end
    if nothing fails."""
    ended = threading.Event()

    def poll() -> None:
        while not ended.wait(POLL if task.has_bar else 10 * POLL):
            done = count()
            if done is not None:
                task.advance_to(done)

    thread = threading.Thread(target=poll, daemon=True)
    with task:
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
        if task.total is not None:
            task.advance_to(task.total)


def show_bars(shown: bool) -> None:
    """Whether terminals get bars from now on."""
    BOARD.bars = shown


def bars_aside() -> AbstractContextManager[None]:
    """A context in which something else may be written to a terminal."""
    return tqdm.external_write_mode()


def duration(seconds: float) -> str:
    """Such as 40 s, 12 min or 3 h 20 min."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 100:
        return f"{minutes} min"
    hours, rest = divmod(minutes, 60)
    return f"{hours} h {rest} min"
