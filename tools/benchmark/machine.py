"""Clocks for a busy machine: CPU seconds per stage, thread counts, and the arithmetic ceiling to compare
with.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType

import numba
import numpy as np
import torch

from sc3d.splatting.cpu.simd import LANES, fma, splat, total

_CHAINS = 12  # independent accumulators: enough to hide the latency of two FMA units
_ROUNDS = 4_000_000


class Stopwatch:
    """Adds up seconds by stage.

    seconds: per stage a (3,) float64 array: CPU of the whole process, wall, CPU of the calling thread. At one
        thread the last one is what the work costs: the first also counts idle threads of OpenMP that still
        spin.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(3))

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the body."""
        before = _now()
        yield
        self.seconds[name] += _now() - before

    @contextmanager
    def watching(self, functions: dict[str, list[tuple[ModuleType, str]]]) -> Iterator[None]:
        """Time every call of module-level functions while the body runs. functions: per stage (module, name
        of the function) pairs.
        """
        with ExitStack() as stack:
            for stage, places in functions.items():
                for module, name in places:
                    stack.enter_context(replaced(module, name, self._timed(stage, getattr(module, name))))
            yield

    def _timed(self, stage: str, function: Callable) -> Callable:
        def timed(*arguments):
            with self.stage(stage):
                return function(*arguments)

        return timed


@contextmanager
def replaced(module: ModuleType, name: str, substitute: Callable) -> Iterator[None]:
    """Let `module.name` be something else while the body runs."""
    original = getattr(module, name)
    setattr(module, name, substitute)
    try:
        yield
    finally:
        setattr(module, name, original)


@contextmanager
def use_threads(count: int) -> Iterator[None]:
    """Let numba and torch use `count` threads while the body runs."""
    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(count)
    torch.set_num_threads(count)
    try:
        yield
    finally:
        numba.set_num_threads(before[0])
        torch.set_num_threads(before[1])


def num_threads() -> int:
    """Threads that the kernels may use on this machine."""
    return numba.config.NUMBA_NUM_THREADS


def fma_gflops(threads: int = 1) -> float:
    """Float32 multiply-adds in registers, billion operations (2 per multiply-add) a second: per CPU second at
    one thread, else per wall second.
    """
    sums = np.zeros(threads, np.float32)
    watch = Stopwatch()
    with use_threads(threads):
        _multiply_add(1, sums)  # compiled before it is timed
        with watch.stage("loop"):
            _multiply_add(_ROUNDS, sums)
    return 2e-9 * _CHAINS * LANES * _ROUNDS * threads / float(watch.seconds["loop"][2 if threads == 1 else 1])


def _now() -> np.ndarray:
    return np.array([time.process_time(), time.perf_counter(), time.thread_time()])


@numba.njit(cache=True, error_model="numpy", parallel=True)
def _multiply_add(rounds, sums):
    for thread in numba.prange(sums.shape[0]):
        factor, step = splat(np.float32(0.999)), splat(np.float32(0.001))
        a, b, c, d, e, f = splat(0.1), splat(0.2), splat(0.3), splat(0.4), splat(0.5), splat(0.6)
        g, h, i, j, k, m = splat(0.7), splat(0.8), splat(0.9), splat(1.1), splat(1.2), splat(1.3)
        for _ in range(rounds):
            a, b, c, d = (
                fma(a, factor, step),
                fma(b, factor, step),
                fma(c, factor, step),
                fma(d, factor, step),
            )
            e, f, g, h = (
                fma(e, factor, step),
                fma(f, factor, step),
                fma(g, factor, step),
                fma(h, factor, step),
            )
            i, j, k, m = (
                fma(i, factor, step),
                fma(j, factor, step),
                fma(k, factor, step),
                fma(m, factor, step),
            )
        sums[thread] = total(a + b + c + d + e + f + g + h + i + j + k + m)
