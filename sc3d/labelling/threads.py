"""Kernels on several threads."""

from __future__ import annotations

import functools
import importlib
from typing import Any

import numba


@functools.cache
def kernels_may_overlap() -> bool:
    """Whether two threads may run parallel kernels at the same time. Numba ends the process otherwise where all it has
    is its own pool, "workqueue": on Linux without libgomp, on macOS without OpenMP, or where it is told so.
    """
    settings: Any = numba.config  # filled when it loads
    layers = {"default": settings.THREADING_LAYER_PRIORITY[0]}
    if layers.get(settings.THREADING_LAYER, settings.THREADING_LAYER) != "omp":
        return False
    try:
        importlib.import_module("numba.np.ufunc.omppool")
    except ImportError:
        return False
    return True
