"""The folder in which a stage's finished parts wait."""

from __future__ import annotations

import glob
import hashlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from sc3d.io.atomic import claim, reject, remove, require_room
from sc3d.io.json_files import write_text
from sc3d.io.provenance import Input, PhotoFrames, digest
from sc3d.settings.common import Resources

MADE = "made-here"  # file that says where its folder was made


class WorkFolder:
    """A folder for what a stage has finished, beside its output: hidden, named after all that decides its
    content, and removed with the last output.
    """

    def __init__(self, output: Path, stage: str, inputs: Sequence[Input], settings: Any) -> None:
        ignored = {field.name for field in fields(Resources)}
        decisive = [
            sorted(
                (name, str(value))
                for name, value in asdict(settings).items()
                if name not in ignored | {"output"} and not isinstance(value, Path)  # which are inputs
            )
        ]
        state = hashlib.sha256(
            repr((stage, decisive, [_identity(item) for item in inputs])).encode()
        ).hexdigest()[:12]
        self.folder = output.absolute().parent / f".{output.name}.{state}.parts"
        for other in self.folder.parent.glob(f".{glob.escape(output.name)}.*.parts"):
            if other != self.folder:
                remove(other)
        if claim(self.folder).is_dir() and not self._is_made_here():
            reject(self.folder, "it was copied or unpacked")

    def subfolder(self, name: str) -> Path:
        folder = self.folder / name
        if not self.folder.is_dir():
            self.folder.mkdir(parents=True)
            write_text(self.folder / MADE, self._place())
        folder.mkdir(exist_ok=True)
        require_room(folder / "any")
        return folder

    def _place(self) -> str:
        """Where the folder lies on its disk, which nobody knows who made an archive of it."""
        return str(self.folder.stat().st_ino)

    def _is_made_here(self) -> bool:
        """The arrays in it are believed as they are, so nobody else may have written them."""
        with suppress(OSError, ValueError):
            return (self.folder / MADE).read_text(encoding="utf-8") == self._place()
        return False

    def remove(self) -> None:
        remove(self.folder)


def _identity(item: Input) -> tuple[str, str]:
    """Name and content, wherever it lies."""
    return item.folder.name if isinstance(item, PhotoFrames) else item.name, digest(item)
