"""Measurements: `sc3d benchmark speed`, `tables`, `fusion-speed`, `surface` and `city`."""

from __future__ import annotations

import importlib

from sc3d import settings

RUNS = {
    settings.BenchmarkSpeed: ("speed", "run_speed"),
    settings.BenchmarkTables: ("tables", "run_tables"),
    settings.BenchmarkFusionSpeed: ("fusion_speed", "run_fusion_speed"),
    settings.BenchmarkSurface: ("surface_page", "run_surface"),
    settings.BenchmarkCity: ("city", "run_city"),
}


def main(command: settings.Benchmark) -> None:
    """Run the benchmark that the record stands for; only its own imports count in its memory."""
    module, function = RUNS[type(command)]
    getattr(importlib.import_module(f"tools.benchmark.{module}"), function)(command)
