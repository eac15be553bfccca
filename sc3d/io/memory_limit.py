"""Memory that a command stays below: watched while it works, as what is planned need not be what is used."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sc3d.errors import InputError, Sc3dError

BASE = 900 << 20  # bytes of a process without points: libraries, a photo's masks, a few range maps
UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
INTERVAL = 0.1  # s between two looks
# of the limit, and bytes beyond: by so much more may a call into a library pass it, until it comes back
GRACE, MORE = 1.2, 256 << 20


class _Passed(KeyboardInterrupt):
    """No code that goes on after errors goes on after this one."""


def amount(text: str) -> int:
    """Bytes of an amount of memory such as 6G; InputError if it is none."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)i?B?", text.strip(), re.IGNORECASE)
    if not found:
        raise InputError(f"--max-memory {text}: an amount such as 6G or 800M is expected")
    if not found[2] and float(found[1]) < UNITS["M"]:
        raise InputError(f"--max-memory {text}: the unit is missing, such as {found[1]}M or {found[1]}G")
    return int(float(found[1]) * UNITS[found[2].upper()])


def in_use() -> int | None:
    """Bytes of memory that this process holds, without pages of files, which the system takes back when others
    need them; None where the system does not tell (other than Linux).
    """
    with suppress(OSError, ValueError):
        lines = Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines()
        found = dict(line.split(":", 1) for line in lines if ":" in line)
        return sum(int(found[name].split()[0]) << 10 for name in ("RssAnon", "RssShmem") if name in found)
    return None


@contextmanager
def memory_limit(text: str, name: str) -> Iterator[None]:
    """End the block by a Sc3dError with the figures if it passes what a --max-memory of `text` allows; "" =
    nothing is watched. What earlier work in this process still holds does not count.

    A call into a library that goes far beyond before it comes back ends the process, with the same line. The
    watch is a process of its own: such calls let no thread of this one look.
    """
    start = in_use()
    if not text or start is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    limit = amount(text) + max(0, start - BASE)
    line = f"{name} needs more than --max-memory {text} ({{}} MiB in use): allow more; finished work is kept"

    def passed(*_: object) -> None:
        raise _Passed

    before = signal.signal(signal.SIGUSR1, passed)
    asked = [
        str(value) for value in (os.getpid(), limit, int(GRACE * limit) + MORE, INTERVAL, f"sc3d: {line}")
    ]
    with subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", WATCH, *asked], stdout=subprocess.PIPE, stdin=subprocess.DEVNULL
    ) as watch:
        try:
            yield
        except _Passed:
            found = watch.stdout.readline() if watch.stdout is not None else b"0"
            raise Sc3dError(line.format(int(found) >> 20)) from None
        finally:
            signal.signal(signal.SIGUSR1, signal.SIG_IGN)  # the watch may just be sending it
            watch.kill()
            watch.wait()
            signal.signal(signal.SIGUSR1, before or signal.SIG_DFL)


# process, bytes at which it is interrupted once, at which it is ended, seconds between two looks, last line
WATCH = """
import os, signal, sys, time
process, limit, most, interval, line = sys.argv[1:]
told = False
while os.getppid() == int(process):
    used = 0
    try:
        with open(f"/proc/{process}/status") as file:
            for each in file:
                if each.startswith(("RssAnon:", "RssShmem:")):
                    used += int(each.split()[1]) << 10
    except OSError:
        break
    if used > int(limit) and not told:
        told = True
        print(used, flush=True)
        os.kill(int(process), signal.SIGUSR1)
    elif used > int(most):
        print(line.format(used >> 20), file=sys.stderr, flush=True)
        os.kill(int(process), signal.SIGKILL)
    time.sleep(float(interval))
"""
