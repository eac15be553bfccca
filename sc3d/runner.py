"""The stages: each reads files of a scene folder, has the packages below compute, and writes files.

A stage module `sc3d/stages/<name>.py` offers three functions of (scene, settings):
    inputs   -> what decides whether the stage must run again: the content of paths, or `PhotoFrames`
    outputs  -> paths that it writes
    run      -> does the work; returns the figures for the summary and the sidecar
and, where that is not all, two more:
    begin    -> writes what of its inputs is missing and can be made up, such as a class table to start from
    besides  -> files, and folders, that it writes without being known by them
Stages never import one another; `execute` below is what they share: skip finished work, time it, write the
sidecars.
"""

from __future__ import annotations

import importlib
import logging
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, fields
from itertools import zip_longest
from pathlib import Path, PurePath
from typing import Any

from sc3d.errors import InputError, Sc3dError
from sc3d.io.atomic import (
    file_state,
    full_folder,
    remove_leftovers,
    require_inside,
    require_replaceable,
    require_writable,
    temporary_name,
)
from sc3d.io.json_files import read_json, write_json
from sc3d.io.memory_limit import memory_limit
from sc3d.io.progress import under_way
from sc3d.io.provenance import Input, PhotoFrames, digest, peak_memory_mb, reset_peak_memory, versions
from sc3d.scene.scene import Scene
from sc3d.settings.common import Memory, Resources

logger = logging.getLogger(__name__)

MAX_SIDECAR = 64 << 20  # bytes: names of all photos may be in it


def execute(name: str, scene: Scene, settings: object, overwrite: bool = False) -> dict[str, object]:
    """Run one stage unless its outputs are up to date; returns its summary.

    Up to date: every output and its sidecar exist, made by the same settings from inputs of the same content,
    wherever the scene and they lie and however they are spelled.
    """
    with under_way(name):
        return _execute(name, scene, settings, overwrite)


def up_to_date(name: str, scene: Scene, settings: object) -> bool:
    """Whether `execute` would find the outputs of a stage finished, as the scene is now."""
    stage = importlib.import_module(f"sc3d.stages.{name}")
    outputs = stage.outputs(scene, settings)
    if not all(output.exists() and sidecar(output).exists() for output in outputs):
        return False  # without reading the inputs, which may not be there
    return _finished(_record(name, scene, settings), outputs, scene, settings) is not None


def files(name: str, scene: Scene, settings: object) -> tuple[list[Path], list[Path]]:
    """Files and folders that a stage reads and writes."""
    stage = importlib.import_module(f"sc3d.stages.{name}")
    read = [item for item in stage.inputs(scene, settings) if isinstance(item, Path)]
    return read, stage.outputs(scene, settings)


def _record(name: str, scene: Scene, settings: object) -> dict[str, Any]:
    """What decides whether the outputs of a stage are up to date."""
    stage = importlib.import_module(f"sc3d.stages.{name}")
    return {
        "stage": name,
        "settings": _decisive(settings, scene),
        "inputs": {_named(item, scene): digest(item) for item in stage.inputs(scene, settings)},
    }


def _execute(name: str, scene: Scene, settings: object, overwrite: bool) -> dict[str, object]:
    stage = importlib.import_module(f"sc3d.stages.{name}")
    if hasattr(stage, "begin"):
        stage.begin(scene, settings)
    record = _record(name, scene, settings)
    outputs = stage.outputs(scene, settings)
    previous = _finished(record, outputs, scene, settings)
    if previous is not None and not overwrite:
        logger.info("%s: up to date (--overwrite runs it again)", name)
        return previous["summary"]
    besides = stage.besides(scene, settings) if hasattr(stage, "besides") else []
    logger.debug("%s: settings %s, inputs %s", name, record["settings"], record["inputs"])
    _prepare(scene, outputs, besides, getattr(settings, "output", None))
    started = time.perf_counter()
    reset_peak_memory()
    asked = settings.max_memory if isinstance(settings, Memory) else ""
    with _replacing(outputs), _room(scene, outputs), memory_limit(asked, name):
        summary = _plain(stage.run(scene, settings))
    record |= {
        "versions": versions(),
        "seconds": round(time.perf_counter() - started, 2),
        "peak_memory_mb": peak_memory_mb(),
        "summary": summary,
    }
    with _room(scene, outputs):
        for output in outputs:
            write_json(sidecar(output), record)
    _report(name, record, outputs)
    return summary


def _prepare(scene: Scene, outputs: list[Path], besides: list[Path], named: Path | None) -> None:
    """Refuse outputs that cannot be written, or only through a link to elsewhere; remove what killed runs left
    behind. named: the output that the user has named, a file; of the others, folders have no suffix.
    """
    for output in outputs:
        require_writable(output.parent)
        require_replaceable(sidecar(output), is_folder=False)
    for path in [*outputs, *besides]:
        require_inside(scene.path, path)
        require_replaceable(path, is_folder=not path.suffix and path != named)
    for folder in {scene.path, Path(tempfile.gettempdir()), *outputs, *(output.parent for output in outputs)}:
        remove_leftovers(folder)


@contextmanager
def _replacing(outputs: list[Path]) -> Iterator[None]:
    """Hide the sidecars: an output that is being replaced must not pass for finished. They come back if the
    block fails and no output has changed.
    """
    before = [file_state(output) for output in outputs]
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
        if [file_state(output) for output in outputs] == before:
            for path, aside in hidden.items():
                aside.rename(path)
        raise
    finally:
        for aside in hidden.values():
            aside.unlink(missing_ok=True)


@contextmanager
def _room(scene: Scene, outputs: list[Path]) -> Iterator[None]:
    """Say that a disk is full and which, in whatever words a library puts it: that of the file that was written,
    or of the scene, the outputs or the temporary files.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        folders = [scene.path, *(output.parent for output in outputs), Path(tempfile.gettempdir())]
        full = full_folder(error, folders)
        if full is None:
            raise
        hint = (
            ", or let TMPDIR name a folder with more room for temporary files" if full == folders[-1] else ""
        )
        raise Sc3dError(
            f"no space left in {full}: make room{hint}, and run the same command again; finished work is kept"
        ) from error


def _decisive(settings: Any, scene: Scene) -> dict[str, object]:
    """The settings without those that no result depends on; paths as `_portable` has them."""
    ignored = {field.name for field in fields(Resources)}
    return {name: _plain(value, scene) for name, value in asdict(settings).items() if name not in ignored}


def _path_fields(settings: Any) -> set[str]:
    return {field.name for field in fields(settings) if "Path" in str(field.type)}


def _named(item: Input, scene: Scene) -> str:
    if isinstance(item, PhotoFrames):
        return f"{_portable(item.folder, scene)} (frames)"
    return _portable(item, scene)


def _portable(path: Path, scene: Scene) -> str:
    """Relative to the scene folder for what lies in it, by name or by links, so that it may be moved and called
    by any path; else absolute.
    """
    for convert in (os.path.abspath, os.path.realpath):
        inside = PurePath(convert(path))
        if inside.is_relative_to(convert(scene.path)):
            return inside.relative_to(convert(scene.path)).as_posix()
    return os.path.abspath(path)


def sidecar(output: Path) -> Path:
    """`<output>.json`: settings, versions and input hashes of an output."""
    return output.with_name(output.name + ".json")


def _off(settings: Any) -> set[str]:
    """Settings that are off, as they are by default."""
    return {
        field.name
        for field in fields(settings)
        if not getattr(settings, field.name) and getattr(settings, field.name) == field.default
    }


def _finished(record: dict, outputs: list[Path], scene: Scene, settings: object) -> dict | None:
    found: dict | None = None
    for output in outputs:
        try:
            read = read_json(sidecar(output), MAX_SIDECAR)
        except InputError:
            return None
        if not isinstance(read, dict) or not isinstance(read.get("summary"), dict):
            return None
        found = read
        if not output.exists() or not _is_same_work(found, record, scene, settings):
            return None
    return found


def _is_same_work(found: dict, record: dict, scene: Scene, asked: object) -> bool:
    """Whether a sidecar tells of what `record` asks for, with the settings `asked`. Inputs count by their
    content, and settings that are paths by the inputs that they name: sidecars of earlier versions hold them as
    they were typed, and do not know later ones, which count as off.
    """
    inputs, settings, paths = found.get("inputs"), found.get("settings"), _path_fields(asked)
    if (
        found.get("stage") != record["stage"]
        or not isinstance(inputs, dict)
        or not isinstance(settings, dict)
    ):
        return False
    later = record["settings"].keys() - settings.keys()
    settings = settings | {name: record["settings"][name] for name in later & _off(asked)}
    if (
        list(inputs.values()) != list(record["inputs"].values())
        or settings.keys() != record["settings"].keys()
    ):
        return False
    if not all(
        PurePath(before).name == PurePath(now).name or _is_same_file(before, now, scene)
        for before, now in zip(inputs, record["inputs"], strict=True)
    ):
        return False
    return all(
        settings[name] == value
        or name == "output"  # which the sidecar lies beside
        or (name in paths and _names_same(settings[name], value, (inputs, record["inputs"]), scene))
        for name, value in record["settings"].items()
    )


def _names_same(before: object, now: object, inputs: tuple[dict, dict], scene: Scene) -> bool:
    """Whether two values of a setting name the same: inputs, whose content is the same, or one file."""
    listed = [list(value) if isinstance(value, list) else [value] for value in (before, now)]
    return all(
        (_names_input(first, inputs[0]) and _names_input(second, inputs[1]))
        or (isinstance(first, str) and isinstance(second, str) and _is_same_file(first, second, scene))
        for first, second in zip_longest(*listed)
    )


def _names_input(value: object, inputs: dict[str, str]) -> bool:
    """Whether a path is an input or a folder of inputs; None stands for the scene's own."""
    return value is None or any(
        key == value or PurePath(str(value)) in PurePath(key).parents for key in inputs
    )


def _is_same_file(before: str, now: str, scene: Scene) -> bool:
    """before: as a sidecar has it; now: as `_portable` has it."""
    with suppress(OSError, ValueError):
        return os.path.samefile(before, scene.path / now)
    return False


def _report(name: str, record: dict, outputs: list[Path]) -> None:
    lines = [f"{name}: {record['seconds']:.1f} s, peak memory {record['peak_memory_mb']} MB"]
    lines += [f"  {key}: {value}" for key, value in record["summary"].items() if not isinstance(value, dict)]
    lines += [f"  wrote {output}" for output in outputs]
    logger.info("\n".join(lines))


def _plain(value: Any, scene: Scene | None = None) -> Any:
    """JSON-ready copy: paths as text (with a scene, as `_portable` has them), tuples as lists, numpy scalars as
    numbers.
    """
    if isinstance(value, dict):
        return {str(key): _plain(item, scene) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, scene) for item in value]
    if isinstance(value, Path):
        return str(value) if scene is None else _portable(value, scene)
    return value.item() if hasattr(value, "item") else value
