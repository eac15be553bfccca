"""Find the photos of a project: by path, by file name, or by name without suffix."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from sc3d.errors import InputError
from sc3d.geometry.cameras import View
from sc3d.importers.project import Project
from sc3d.io.images import find_photos, image_size


def locate_photos(project: Project, folder: Path | None) -> tuple[Project, Path | None]:
    """The project with its views named by path in a folder of photos, and that folder.

    folder: where to look; None = where the project says. Returns None for it, and names by file, if there is
        none.
    InputError for a photo that is missing in the folder or has another shape than its camera.
    """
    names = [view.name for view in project.views]
    if folder is None and project.photos is not None:
        folder = project.photos / (
            os.path.commonpath([str(Path(name).parent) for name in names]) if names else ""
        )
    if folder is None or not folder.is_dir():
        return replace(
            project, views=[replace(view, name=Path(view.name).name) for view in project.views]
        ), None
    files = [file.relative_to(folder) for file in find_photos(folder)]
    known: dict[str, Path] = {}
    for key in (lambda file: file.stem, lambda file: file.name, str):  # the exact path counts most
        known |= {key(file): file for file in files}
    found = [next((known[key] for key in _keys(name) if key in known), None) for name in names]
    missing = [name for name, file in zip(names, found) if file is None]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(names)} photos of the project are not in {folder}, such as {missing[0]}: pass their folder with --images"
        )
    views = [replace(view, name=str(file)) for view, file in zip(project.views, found)]
    for view in views:
        _check_shape(view, image_size(folder / view.name), folder)
    return replace(project, views=views), folder


def _keys(name: str) -> list[str]:
    path = Path(name)
    parts = [str(Path(*path.parts[start:])) for start in range(len(path.parts))]
    return [*parts, path.stem, path.name]


def _check_shape(view: View, size: tuple[int, int], folder: Path) -> None:
    if abs(size[0] * view.height - size[1] * view.width) > max(size[0], view.width):
        raise InputError(
            f"{folder / view.name} is {size[0]}x{size[1]}, but its camera is {view.width}x{view.height}: these are other photos, or turned ones"
        )
