"""Python in a process of its own."""

from __future__ import annotations

import subprocess
import sys


def run_python(code: str, timeout: float) -> subprocess.CompletedProcess[str]:
    """Run a program and catch what it says; it may take `timeout` seconds.

    Not in the folder in which the command was called: `python -c` takes modules from there first, and it may be
    a scene of somebody else, with a file `numpy.py`.
    """
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
        cwd=sys.prefix,
    )
