"""The folder in which a stage's finished parts wait."""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from sc3d.io.atomic import require_room
from sc3d.settings.common import Resources


class WorkFolder:
    """A folder for what a stage has finished, beside its output: hidden, named after all that decides its
    content, and removed with the last output.
    """

    def __init__(self, output: Path, stage: str, inputs: list[Path], settings: Any) -> None:
        ignored = {field.name for field in fields(Resources)}
        decisive = [
            sorted(
                (name, str(value))
                for name, value in asdict(settings).items()
                if name not in ignored | {"output"} and not isinstance(value, Path)  # which are inputs
            )
        ]
        state = hashlib.sha256(
            repr((stage, decisive, [_identity(path) for path in inputs])).encode()
        ).hexdigest()[:12]
        self.folder = output.absolute().parent / f".{output.name}.{state}.parts"
        for other in self.folder.parent.glob(f".{output.name}.*.parts"):
            if other != self.folder:
                shutil.rmtree(other, ignore_errors=True)

    def subfolder(self, name: str) -> Path:
        folder = self.folder / name
        folder.mkdir(parents=True, exist_ok=True)
        require_room(folder / "any")
        return folder

    def remove(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)


def _identity(path: Path) -> tuple:
    """Of a file, or of all files of a folder: names from there on, sizes and times; wherever it lies."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    return path.name, tuple(
        (file.relative_to(path).as_posix(), file.stat().st_size, file.stat().st_mtime_ns)
        for file in files
        if file.is_file()
    )
