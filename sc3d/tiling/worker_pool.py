"""Processes of this machine that run tasks. Each hangs on a pipe of its own, which nobody else can open: with
a port, every user of the machine could have code run.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from multiprocessing.connection import Connection, wait
from typing import Any, cast

from sc3d.errors import Sc3dError
from sc3d.io.child_process import environment, live_with_parent, told
from sc3d.io.progress import Progress

RETRIES = 3  # of a task whose worker is lost; more, and the task itself is what kills it
Message = tuple[str, int, str]  # name of the logger, level, text
SECONDS = 5.0  # that an ending worker may take


class LostTaskError(Sc3dError):
    """A task has taken several workers with it."""

    def __init__(self, name: str) -> None:
        super().__init__(
            f"{name}: a task has ended {RETRIES + 1} workers, maybe for want of memory; start fewer workers, or lower --max-memory"
        )


def _environment(threads: int) -> AbstractContextManager[None]:
    """Of a process that is started in the block: so many threads, and no modules from a scene."""
    given = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), str(threads))
    return environment(given | {"PYTHONSAFEPATH": "1"})


class _Worker:
    """One process; `index`: of the item that it works on, None = idle."""

    def __init__(self, threads: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs,), daemon=True)
        with _environment(threads):
            self._process.start()
        theirs.close()  # so that the pipe ends with the process
        self._function: Callable | None = None
        self.index: int | None = None

    def give(self, function: Callable, index: int, item: object) -> None:
        """A worker keeps the function: only a new one is sent."""
        self.index = index
        with suppress(OSError):  # it is gone, which its pipe tells
            self.connection.send((function if function is not self._function else None, item))
        self._function = function

    def end(self) -> None:
        self.connection.close()
        if self.index is not None:
            self._process.kill()  # a native library could answer a gentler signal with a trace of its own
        self._process.join(SECONDS)
        if self._process.exitcode is None:
            self._process.kill()
            self._process.join()


class WorkerPool:
    """Up to `size` processes, started when there is work; a lost one is replaced, and what it was at is done
    again.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._workers: list[_Worker] = []

    def run(self, name: str, function: Callable, items: Sequence) -> list:
        """Results in the order of the items; what a task raises is raised. LostTaskError if no worker
        survives a task.
        """
        todo, lost, results = deque(range(len(items))), Counter[int](), dict[int, Any]()
        try:
            with Progress(len(items), name, "part") as bar:
                while len(results) < len(items):
                    self._hand_out(function, items, todo)
                    for worker in self._answering():
                        index, worker.index = worker.index, None
                        assert index is not None
                        answer = self._answer(worker)
                        if answer is not None:
                            done, value, messages = answer
                            _log(messages)
                            results[index] = _value(name, done, value)
                            bar.update()
                            continue
                        lost[index] += 1
                        if lost[index] > RETRIES:
                            raise LostTaskError(name)
                        todo.appendleft(index)
        except BaseException:
            self.close()
            raise
        return [results[index] for index in range(len(items))]

    def close(self) -> None:
        while self._workers:
            self._workers.pop().end()

    def _hand_out(self, function: Callable, items: Sequence, todo: deque[int]) -> None:
        idle = [worker for worker in self._workers if worker.index is None]
        new = min(self._size - len(self._workers), len(todo) - len(idle))
        started = [
            _Worker(max(1, (os.cpu_count() or 1) // self._size)) for _ in range(new)
        ]  # all of them, before the first is waited for
        self._workers += started
        for worker in idle + started:
            if todo:
                index = todo.popleft()
                worker.give(function, index, items[index])

    def _answering(self) -> list[_Worker]:
        busy = {worker.connection: worker for worker in self._workers if worker.index is not None}
        return [busy[cast(Connection, connection)] for connection in wait(list(busy))]

    def _answer(self, worker: _Worker) -> tuple[bool, Any, list[Message]] | None:
        """Whether the task was done, its result or error, and what was logged; None if the process is gone."""
        try:
            return worker.connection.recv()
        except (EOFError, OSError):
            self._workers.remove(worker)
            worker.end()
            return None


class _Messages(logging.Handler):
    """What a worker logs: the process that started it says it, in its way and to its files."""

    def __init__(self) -> None:
        super().__init__()
        self._found: list[Message] = []

    def emit(self, record: logging.LogRecord) -> None:
        self._found.append((record.name, record.levelno, record.getMessage()))

    def take(self) -> list[Message]:
        found, self._found = self._found, []
        return found


def _log(messages: list[Message]) -> None:
    for name, level, text in messages:
        logging.getLogger(name).log(level, "%s", text)


def _value(name: str, done: bool, value: Any) -> Any:
    if done:
        return value
    raise value if isinstance(value, Exception) else RuntimeError(f"{name}: in a worker:\n{value}")


def _work(connection: Connection) -> None:
    """A worker's life: until the pipe ends, or the process that started it."""
    live_with_parent()
    messages = _Messages()
    logging.getLogger().addHandler(messages)
    logging.captureWarnings(True)
    function: Callable | None = None
    while True:
        try:
            given, item = connection.recv()
            function = given or function
            assert function is not None
            answer = True, function(item)
        except EOFError:
            return
        except Exception as error:
            answer = False, told(error)
        try:
            connection.send((*answer, messages.take()))
        except OSError:
            return
