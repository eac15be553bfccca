"""--max-memory: planned with, watched, and never without a word."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from sc3d.errors import InputError, Sc3dError
from sc3d.io.memory_limit import amount, in_use, memory_limit

linux = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="no /proc")
TAKE = """
import sys, time
from sc3d.io import memory_limit as limits
limits.GRACE, limits.MORE, limits.BASE = 1.0, {more} << 20, 1 << 40
try:
    with limits.memory_limit("60M", "train"):
        {take}
        time.sleep(20)
except Exception as error:
    print(type(error).__name__, error)
"""


def run(take, more):
    code = TAKE.format(take=take, more=more)
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)


@linux
def test_work_that_passes_it_ends_with_the_figures():
    found = run("kept = bytearray(200 << 20)", 10_000)
    assert found.stdout.startswith("Sc3dError train needs more than --max-memory 60M (")
    assert "MiB in use): allow more; finished work is kept" in found.stdout and found.returncode == 0


@linux
def test_a_call_that_never_comes_back_ends_with_the_line():
    # one call, that takes the memory and then holds Python's lock, whatever signal comes
    take = "from itertools import chain, repeat; max(chain(map(bytearray, [200 << 20]), repeat(b'')))"
    found = run(take, 0)
    assert found.returncode == -9 and found.stderr.count("\n") == 1
    assert found.stderr.startswith("sc3d: train needs more than --max-memory 60M (")


@linux
def test_less_passes_and_earlier_work_does_not_count():
    held = bytearray(50 << 20)
    assert (in_use() or 0) > len(held)
    with memory_limit("2G", "label"):
        time.sleep(0.3)
    with memory_limit("", "label"):
        pass


@pytest.mark.parametrize("text", ["", "many", "6", "-1G"])
def test_what_is_no_amount_is_refused(text):
    with pytest.raises(InputError, match="max-memory"):
        amount(text)
    assert amount("1.5G") == 3 << 29 and amount("800 MiB") == 800 << 20
    assert issubclass(InputError, Sc3dError)
