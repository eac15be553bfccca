"""Measurements: `python -m tools.benchmark
{speed,gpu,surface,tables,fusion-speed,questions,few-labels,city} --help`.
"""

from __future__ import annotations

import importlib
import sys

import tyro

from sc3d.cli import reporting_errors, start_logging
from tools.benchmark import settings

RUNS: dict[type, tuple[str, str]] = {
    settings.BenchmarkSpeed: ("speed", "run_speed"),
    settings.BenchmarkGpu: ("gpu", "run_gpu"),
    settings.BenchmarkTables: ("tables", "run_tables"),
    settings.BenchmarkFusionSpeed: ("fusion_speed", "run_fusion_speed"),
    settings.BenchmarkSurface: ("surface_page", "run_surface"),
    settings.BenchmarkQuestions: ("questions", "run_questions"),
    settings.BenchmarkFewLabels: ("few_labels", "run_few_labels"),
    settings.SynthesizeCity: ("city", "run_city"),
}


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark whose record the arguments make; only its own imports count in its memory."""
    description = "Measure sc3d on this machine."
    command = tyro.cli(
        settings.Benchmark, args=arguments, prog="python -m tools.benchmark", description=description
    )
    module, function = RUNS[type(command)]
    start_logging()
    with reporting_errors():
        getattr(importlib.import_module(f"tools.benchmark.{module}"), function)(command)


if __name__ == "__main__":
    main(sys.argv[1:])
