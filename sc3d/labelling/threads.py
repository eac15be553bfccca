"""Kernels on several threads."""

from __future__ import annotations

import functools
import importlib

import numba


@functools.cache
def kernels_may_overlap() -> bool:
    """Whether two threads may run parallel kernels at the same time. Numba ends the process otherwise where all it has
    is its own pool, "workqueue": on Linux without libgomp, on macOS without OpenMP, or where it is told so.
    """
    # numba makes these attributes from the environment when it is imported
    chosen, order = (getattr(numba.config, f"THREADING_LAYER{name}") for name in ("", "_PRIORITY"))
    if chosen not in ("default", "omp") or (chosen == "default" and order[0] != "omp"):
        return False
    try:
        importlib.import_module("numba.np.ufunc.omppool")
    except ImportError:
        return False
    return True
