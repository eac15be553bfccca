"""The stages: each reads files of a scene folder, has the packages below compute, and writes files.

A stage module `sc3d/stages/<name>.py` offers three functions of (scene, settings):
    inputs   -> paths whose content decides whether the stage must run again
    outputs  -> paths that it writes
    run      -> does the work; returns the figures for the summary and the sidecar
and, where that is not all, one more:
    besides  -> folders that it writes into without being known by them
Stages never import one another; `execute` below is what they share: skip finished work, time it, write the
sidecars.
"""

from __future__ import annotations

import errno
import importlib
import logging
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from sc3d.errors import InputError, Sc3dError
from sc3d.io.atomic import remove_leftovers, require_inside, temporary_name
from sc3d.io.json_files import read_json, write_json
from sc3d.io.provenance import digest, peak_memory_mb, reset_peak_memory, versions
from sc3d.scene.scene import Scene
from sc3d.settings.common import Resources, Workers

logger = logging.getLogger(__name__)

MAX_SIDECAR = 64 << 20  # bytes: names of all photos may be in it


def execute(name: str, scene: Scene, settings: object, overwrite: bool = False) -> dict[str, object]:
    """Run one stage unless its outputs are up to date; returns its summary.

    Up to date: every output and its sidecar exist, made by the same settings from inputs of the same content.
    """
    stage = importlib.import_module(f"sc3d.stages.{name}")
    record: dict[str, Any] = {
        "stage": name,
        "settings": _decisive(settings),
        "inputs": {str(path): digest(path) for path in stage.inputs(scene, settings)},
    }
    outputs = stage.outputs(scene, settings)
    previous = _finished(record, outputs)
    if previous is not None and not overwrite:
        logger.info("%s: up to date (--overwrite runs it again)", name)
        return previous["summary"]
    besides = stage.besides(scene, settings) if hasattr(stage, "besides") else []
    _prepare(scene, outputs, besides)
    started = time.perf_counter()
    reset_peak_memory()
    with _replacing(outputs), _room(scene):
        summary = _plain(stage.run(scene, settings))
    record |= {
        "versions": versions(),
        "seconds": round(time.perf_counter() - started, 2),
        "peak_memory_mb": peak_memory_mb(),
        "summary": summary,
    }
    with _room(scene):
        for output in outputs:
            write_json(sidecar(output), record)
    _report(name, record, outputs)
    return summary


def _prepare(scene: Scene, outputs: list[Path], besides: list[Path]) -> None:
    """Refuse outputs that would be written through a link to elsewhere; remove what killed runs left behind."""
    for path in [*outputs, *besides]:
        require_inside(scene.path, path)
    for folder in {scene.path, Path(tempfile.gettempdir()), *outputs, *(output.parent for output in outputs)}:
        remove_leftovers(folder)


@contextmanager
def _replacing(outputs: list[Path]) -> Iterator[None]:
    """Hide the sidecars: an output that is being replaced must not pass for finished. They come back if the
    block fails and no output has changed.
    """
    before = [_identity(output) for output in outputs]
    hidden = {
        path: path.with_name(f"{temporary_name(path.name)}.before")
        for path in map(sidecar, outputs)
        if path.is_file()
    }
    for path, aside in hidden.items():
        path.rename(aside)
    try:
        yield
    except BaseException:  # Ctrl-C too
        if [_identity(output) for output in outputs] == before:
            for path, aside in hidden.items():
                aside.rename(path)
        raise
    finally:
        for aside in hidden.values():
            aside.unlink(missing_ok=True)


def _identity(path: Path) -> tuple[int, ...] | None:
    """Changes whenever a file is replaced, or anything in a folder."""
    with suppress(OSError):
        found = path.lstat()
        return found.st_ino, found.st_mtime_ns, found.st_size
    return None


@contextmanager
def _room(scene: Scene) -> Iterator[None]:
    """Say that the disk is full where it is, in whatever words a library puts it."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        if getattr(error, "errno", None) not in (errno.ENOSPC, errno.EDQUOT) and "disk is full" not in str(
            error
        ):
            raise
        name = getattr(error, "filename", None)
        raise Sc3dError(
            f"no space left in {Path(name).parent if name else scene.path}: make room and run the same command again; finished work is kept"
        ) from error


def _decisive(settings: Any) -> dict[str, object]:
    """The settings without those that no result depends on."""
    ignored = {field.name for field in fields(Resources)} if isinstance(settings, Workers) else set()
    return {name: value for name, value in _plain(asdict(settings)).items() if name not in ignored}


def sidecar(output: Path) -> Path:
    """`<output>.json`: settings, versions and input hashes of an output."""
    return output.with_name(output.name + ".json")


def _finished(record: dict, outputs: list[Path]) -> dict | None:
    found: dict | None = None
    for output in outputs:
        try:
            read = read_json(sidecar(output), MAX_SIDECAR)
        except InputError:
            return None
        if not isinstance(read, dict) or not isinstance(read.get("summary"), dict):
            return None
        found = read
        if not output.exists() or any(found.get(key) != value for key, value in record.items()):
            return None
    return found


def _report(name: str, record: dict, outputs: list[Path]) -> None:
    lines = [f"{name}: {record['seconds']:.1f} s, peak memory {record['peak_memory_mb']} MB"]
    lines += [f"  {key}: {value}" for key, value in record["summary"].items() if not isinstance(value, dict)]
    lines += [f"  wrote {output}" for output in outputs]
    logger.info("\n".join(lines))


def _plain(value: Any) -> Any:
    """JSON-ready copy: paths as text, tuples as lists, numpy scalars as numbers."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return value.item() if hasattr(value, "item") else value
