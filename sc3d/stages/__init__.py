"""The stages: each reads files of a scene folder, calls one function of the package and writes files.

A stage module `sc3d/stages/<name>.py` offers three functions of (scene, settings):
    inputs   -> paths whose content decides whether the stage must run again
    outputs  -> paths that it writes
    run      -> does the work; returns the figures for the summary and the sidecar
Stages never import one another; `execute` below is what they share: skip finished work, time it, write the sidecars.
"""

from __future__ import annotations

import importlib
import json
import logging
import os
import platform
import resource
import time
from contextlib import suppress
from dataclasses import asdict
from importlib import metadata
from pathlib import Path

import sc3d
from sc3d.errors import InputError
from sc3d.io import digest, write_json
from sc3d.scene import Scene

logger = logging.getLogger(__name__)

PACKAGES = ("open3d", "numpy", "scipy", "torch", "numba", "pycolmap", "opencv-python-headless")


def execute(name: str, scene: Scene, settings: object, overwrite: bool = False) -> dict[str, object]:
    """Run one stage unless its outputs are up to date; returns its summary.

    Up to date: every output and its sidecar exist, made by the same settings from inputs of the same content.
    """
    stage = importlib.import_module(f"sc3d.stages.{name}")
    record = {"stage": name, "settings": _plain(asdict(settings)), "inputs": {str(path): digest(path) for path in stage.inputs(scene, settings)}}
    outputs = stage.outputs(scene, settings)
    previous = _finished(record, outputs)
    if previous is not None and not overwrite:
        logger.info("%s: up to date (--overwrite runs it again)", name)
        return previous["summary"]
    started = time.perf_counter()
    reset_peak_memory()
    kept = {sidecar(output): sidecar(output).read_bytes() for output in outputs if sidecar(output).exists()}
    for path in kept:  # an output that is being replaced must not pass for finished
        path.unlink()
    try:
        summary = _plain(stage.run(scene, settings))
    except InputError:  # raised before anything is written
        for path, content in kept.items():
            path.write_bytes(content)
        raise
    record |= {"versions": versions(), "seconds": round(time.perf_counter() - started, 2), "peak_memory_mb": peak_memory_mb(), "summary": summary}
    for output in outputs:
        write_json(sidecar(output), record)
    _report(name, record, outputs)
    return summary


def sidecar(output: Path) -> Path:
    """`<output>.json`: settings, versions and input hashes of an output."""
    return output.with_name(output.name + ".json")


def versions() -> dict[str, str]:
    """Versions of sc3d, Python and the packages that decide results."""
    found = {"sc3d": sc3d.__version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def reset_peak_memory() -> None:
    """Start measuring the peak anew (Linux; elsewhere it stays that of the whole process)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory_mb() -> int:
    """Largest resident memory since `reset_peak_memory`, MB."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) // 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def require_writable(folder: Path) -> None:
    """Raise InputError, before any work, if a scene folder cannot be written."""
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK, effective_ids=True):
        raise InputError(f"cannot write to {existing}: check its permissions or choose another folder")


def _finished(record: dict, outputs: list[Path]) -> dict | None:
    found = None
    for output in outputs:
        try:
            found = json.loads(sidecar(output).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        if not output.exists() or any(found.get(key) != value for key, value in record.items()):
            return None
    return found


def _report(name: str, record: dict, outputs: list[Path]) -> None:
    lines = [f"{name}: {record['seconds']:.1f} s, peak memory {record['peak_memory_mb']} MB"]
    lines += [f"  {key}: {value}" for key, value in record["summary"].items() if not isinstance(value, dict)]
    lines += [f"  wrote {output}" for output in outputs]
    logger.info("\n".join(lines))


def _plain(value: object) -> object:
    """JSON-ready copy: paths as text, tuples as lists, numpy scalars as numbers."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return value.item() if hasattr(value, "item") else value
