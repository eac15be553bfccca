"""What takes its process with it becomes an error of the one that started it."""

import errno
import os
import signal
import sys

import pytest

from sc3d.errors import InputError, Sc3dError
from sc3d.io.child_process import ChildProcess
from sc3d.io.provenance import peak_memory_mb, reset_peak_memory

STATE = [0]


def add(number):
    STATE[0] += number
    return STATE[0]


def count(steps, step):
    for _ in range(steps):
        step()
    return os.getpid()


def refuse(text):
    raise InputError(text)


def fail():
    return [][1]


def say_and_abort(text):
    os.write(2, text.encode())
    os.abort()


def kill_self():
    os.kill(os.getpid(), signal.SIGKILL)


def fill(megabytes):
    return len(bytearray(megabytes << 20))


def test_it_keeps_its_state_tells_steps_and_is_another_process():
    steps = []
    with ChildProcess("library") as child:
        assert [child.call(add, 2), child.call(add, 3)] == [2, 5]
        assert child.call(count, 3, step=lambda: steps.append(1)) != os.getpid()
    assert len(steps) == 3 and STATE == [0]


def test_errors_for_the_user_arrive_as_they_are_and_it_goes_on():
    with ChildProcess("library") as child:
        with pytest.raises(InputError, match="^no such photo$"):
            child.call(refuse, "no such photo")
        with pytest.raises(RuntimeError, match="IndexError"):
            child.call(fail)
        assert child.call(add, 1) == 1


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize(
    ("text", "kind", "told"),
    [
        ("", Sc3dError, "library ended in the middle of its work (SIGABRT); finished work is kept"),
        ("  what():  lost a pose\n", Sc3dError, "(SIGABRT): lost a pose; finished"),
        ("F1130 10:00:00.000000 12 a.cc:5] Check failed\n*** trace\n", Sc3dError, "(SIGABRT): Check failed;"),
        ("  what():  std::bad_alloc\n", MemoryError, "library"),
        ("  what():  SQLite error: database or disk is full\n", OSError, os.strerror(errno.ENOSPC)),
    ],
)
def test_an_abort_is_one_error_that_says_why(text, kind, told, capfd):
    with pytest.raises(kind) as raised, ChildProcess("library") as child:
        child.call(say_and_abort, text)
    assert told in str(raised.value) and type(raised.value) is kind
    assert capfd.readouterr().err == ""  # its stack trace stays with it


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_one_that_the_system_killed_says_what_to_do():
    with pytest.raises(Sc3dError, match=r"SIGKILL.*want of memory.*--max-size"), ChildProcess("x") as child:
        child.call(kill_self)


def test_its_peak_memory_counts():
    reset_peak_memory()
    before = peak_memory_mb()
    with ChildProcess("library") as child:
        child.call(fill, before + 100)
    assert peak_memory_mb() >= before + 100
