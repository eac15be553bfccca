"""`sc3d benchmark speed`: training, and OpenSplat beside it."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from sc3d.errors import InputError, Sc3dError
from sc3d.io.provenance import versions
from sc3d.scene.scene import Scene
from tools.benchmark.opensplat import cpu_seconds_per_iteration, find_binary, write_project
from tools.benchmark.publish import check_output, publish
from tools.benchmark.settings import BenchmarkSpeed
from tools.benchmark.speed_table import markdown
from tools.benchmark.training import measure_steps, measure_training
from tools.benchmark.workload import TrainingGround, build_workload, ground_of, synthetic_ground

logger = logging.getLogger(__name__)


def run_speed(command: BenchmarkSpeed) -> None:
    """Measure, show the table, write it if wanted."""
    _check(command)
    binary = None if command.opensplat is None else find_binary(command.opensplat)
    load = os.getloadavg()[0]
    ground = synthetic_ground() if command.scene is None else ground_of(Scene(command.scene).model)
    configurations = [
        _configuration(ground, (count, size), command, binary)
        for size in command.sizes
        for count in command.gaussians
    ]
    settings = {
        name: str(value) if isinstance(value, Path) else value for name, value in asdict(command).items()
    }
    record = {
        "benchmark": "speed",
        "scene": "synthetic ground" if command.scene is None else command.scene.absolute().name,
        "settings": settings,
        "versions": versions(),
        "load": load,
        "configurations": configurations,
    }
    publish(record, markdown(record), command.output)


def _configuration(
    ground: TrainingGround, size: tuple[int, int], command: BenchmarkSpeed, binary: Path | None
) -> dict:
    """size: number of Gaussians, longest side of the view, px"""
    workload = build_workload(ground, *size)
    logger.info("%s ...", workload.name)
    with tempfile.TemporaryDirectory() as folder:
        rival = None
        if binary is not None:
            write_project(workload, Path(folder))
            rival = _lenient(lambda: cpu_seconds_per_iteration(binary, Path(folder)))
        record = measure_training(workload, command.repeats, rival)
    return record | (measure_steps(workload, command.repeats) if command.surface else {})


def _lenient(rival: Callable[[], float]) -> Callable[[], float | None]:
    """The rival's time, or None once it failed, which is reported once: our own figures count without it."""
    failed = []

    def run() -> float | None:
        if failed:
            return None
        try:
            return rival()
        except Sc3dError as error:
            failed.append(error)
            logger.warning("%s", error)
            return None

    return run


def _check(command: BenchmarkSpeed) -> None:
    if min(command.gaussians, default=0) < 100 or min(command.sizes, default=0) < 16 or command.repeats < 1:
        raise InputError("the benchmark needs at least 100 Gaussians, 16 px and 1 repeat")
    check_output(command.output)
