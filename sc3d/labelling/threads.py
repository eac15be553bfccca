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
    chosen = numba.config.THREADING_LAYER
    if chosen not in ("default", "omp") or (
        chosen == "default" and numba.config.THREADING_LAYER_PRIORITY[0] != "omp"
    ):
        return False
    try:
        importlib.import_module("numba.np.ufunc.omppool")
    except ImportError:
        return False
    return True
