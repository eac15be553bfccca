"""What was learned on one site for others: a `.npz` of plain arrays, with `model.json` in it, which says what
they mean. Its parts (`appearance`, `strokes`) are made and understood by those who learn.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.arrays import read_arrays
from sc3d.io.atomic import atomic_path
from sc3d.io.limits import DamagedFileError
from sc3d.scene.class_table import ClassTable

KIND, VERSION = "sc3d site model", 1
HEAD = "model.json"
MAX_HEAD, MAX_ARRAYS = 1 << 20, 1000  # bytes; arrays of all parts
TIME = (1980, 1, 1, 0, 0, 0)  # of all entries: the same model is the same file


@dataclass(frozen=True)
class ModelPart:
    """facts: JSON; arrays: of numbers, one or two axes each."""

    facts: dict
    arrays: Mapping[str, np.ndarray]


def require_model_or_nothing(path: Path) -> None:
    """InputError if there is anything but a model that a new one would replace."""
    if path.exists():
        try:
            _read_head(path)
        except InputError:
            raise InputError(
                f"{path} exists and is no model of this sc3d, so that --save-model does not replace it: choose another name"
            ) from None


def write_model(path: Path, table: ClassTable, parts: Mapping[str, ModelPart]) -> None:
    """Write a model of the classes of a table."""
    head = {
        "kind": KIND,
        "version": VERSION,
        "classes": [{"id": entry.id, "name": entry.name} for entry in table],
        "parts": {name: part.facts | {"arrays": sorted(part.arrays)} for name, part in parts.items()},
    }
    with (
        atomic_path(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        _add(archive, HEAD, json.dumps(head, indent=1).encode())
        for name, part in parts.items():
            for key in sorted(part.arrays):
                content = io.BytesIO()
                np.lib.format.write_array(content, np.ascontiguousarray(part.arrays[key]), allow_pickle=False)
                _add(archive, f"{name}.{key}.npy", content.getvalue())


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    entry = zipfile.ZipInfo(name, TIME)
    entry.compress_type = zipfile.ZIP_DEFLATED
    archive.writestr(entry, content)


def read_model(path: Path, table: ClassTable, part: str) -> ModelPart:
    """A part of a model, for a scene with the classes of `table`.

    Raises InputError for what is no model, of a later version, of other classes, or without that part.
    """
    head = _read_head(path)
    require_same_classes(head["classes"], table, path)
    facts = head["parts"].get(part)
    if not isinstance(facts, dict):
        known = ", ".join(map(str, head["parts"])) or "nothing"
        raise InputError(f"{path} holds no {part}, but {known}: save it on a site that has what it takes")
    names = facts.get("arrays")
    if (
        not isinstance(names, list)
        or len(names) > MAX_ARRAYS
        or not all(isinstance(one, str) for one in names)
    ):
        raise InputError(f"{path} is damaged: model.json names no arrays of {part}")
    try:
        arrays = read_arrays(path, [f"{part}.{name}" for name in names])
    except DamagedFileError as error:
        raise InputError(f"{path} is damaged: {error}") from None
    return ModelPart(facts, dict(zip(names, arrays, strict=True)))


def _read_head(path: Path) -> dict:
    if not path.is_file():
        raise InputError(f"{path} is missing: `sc3d propagate SCENE --save-model FILE` writes such a model")
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.getinfo(HEAD).file_size > MAX_HEAD:
                raise ValueError("model.json is too large")
            with archive.open(HEAD) as stream:
                head = json.loads(stream.read(MAX_HEAD + 1))
    # zipfile raises RuntimeError for encryption and NotImplementedError for methods that it does not know
    except (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path} is no model of `sc3d propagate --save-model`: {error}") from None
    if not isinstance(head, dict) or head.get("kind") != KIND:
        raise InputError(f"{path} is no model of `sc3d propagate --save-model`")
    if head.get("version") != VERSION:
        raise InputError(
            f"{path} is a model of version {head.get('version')!r}, not {VERSION}: save it again with this sc3d"
        )
    if not isinstance(head.get("classes"), list) or not isinstance(head.get("parts"), dict):
        raise InputError(f"{path} is damaged: model.json has no classes or parts")
    return head


def require_same_classes(classes: list, table: ClassTable, path: Path) -> None:
    """InputError that names the first class that a model and a table do not have in common, id and name."""
    theirs = {(entry.get("id"), entry.get("name")) for entry in classes if isinstance(entry, dict)}
    ours = {(entry.id, entry.name) for entry in table}
    other = sorted(theirs ^ ours, key=str)
    if other:
        label, name = other[0]
        owner = "the model" if other[0] in theirs else "the scene"
        raise InputError(
            f"{path} was learned with another class table: only {owner} has class {label} {name!r};"
            " use a model of the same ids and names"
        )
