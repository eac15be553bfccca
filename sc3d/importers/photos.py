"""Find the photos of a project: by path, by file name, or by name without suffix."""

from __future__ import annotations

import os
import unicodedata
from collections import Counter
from dataclasses import replace
from pathlib import Path, PurePosixPath, PureWindowsPath

from sc3d.errors import InputError
from sc3d.geometry.cameras import View
from sc3d.importers.project import Project
from sc3d.io.images import find_photos, image_size


class PhotoFinder:
    """The photos of a folder by the names that projects give them: with more or less of their path, with
    other separators, without suffix, in other case or Unicode form; what fits more exactly counts first.
    """

    def __init__(self, folder: Path) -> None:
        self._known: dict[str, Path] = {}
        files = [file.relative_to(folder) for file in find_photos(folder)]
        for plain in (_same_letters, str):
            for key in (lambda file: file.stem, lambda file: file.name, str):  # the exact path counts most
                self._known |= {plain(key(file)): file for file in files}

    def find(self, name: str) -> Path | None:
        """Path of a photo in the folder; None if it is not there."""
        path = PurePosixPath(plain_name(name))
        parts = [str(PurePosixPath(*path.parts[start:])) for start in range(len(path.parts))]
        keys = [*parts, path.stem, path.name]
        return next(
            (self._known[key] for key in [*keys, *map(_same_letters, keys)] if key in self._known), None
        )


def plain_name(name: str) -> str:
    """A photo's path with slashes, whatever system it was written on."""
    return PureWindowsPath(name).as_posix()


def photo_folder(project: Project, images: Path | None) -> Path | None:
    """Where the photos of a project are: `images` if given, else the common folder of those that the project
    names within its own folder (of all, if none is there), or the end of that path, if the project was moved.
    None if there is no such folder.
    """
    if images is not None:
        if not images.is_dir():
            raise InputError(f"{images} is not a folder: --images takes the folder of the photos")
        return images
    if project.photos is None or not project.views:
        return None
    folder = _common_folder(_inside(project) or _full_names(project))
    ends = [PurePosixPath(*folder.parts[start:]) for start in range(1, len(folder.parts))]
    places = [folder, *(Path(os.path.abspath(project.photos), end) for end in ends)]
    return next((place for place in places if place.is_dir()), None)


def locate_photos(project: Project, images: Path | None) -> tuple[Project, Path | None]:
    """The project with its views named by path in a folder of photos, and that folder.

    images: where to look; None = where the project says. Returns None for the folder, and names relative to
        the one that the project means, if there is none.
    Photos that are not there, that lie outside of the project, or that several cameras claim are left out.
    InputError if none is left, or if one has another shape than its camera.
    """
    folder = photo_folder(project, images)
    if images is None and project.photos is not None:
        inside = set(_inside(project))
        outside = [row for row, name in enumerate(_full_names(project)) if inside and name not in inside]
        project = project.without(outside, "with a path that leads out of the project")
    if folder is None:
        return _named_as_meant(project), None
    finder, count = PhotoFinder(folder), len(project.views)
    found = [finder.find(view.name) for view in project.views]
    missing = [row for row, file in enumerate(found) if file is None]
    if len(missing) == count:
        raise InputError(
            f"none of the {count} photos of the project is in {folder}, such as {project.views[0].name}: pass their folder with --images"
        )
    project = project.without(missing, f"not in {folder}")
    files = [str(file) for file in found if file is not None]
    doubtful = _sharing(project, folder, files)
    project = project.without(doubtful, "that share a photo with another camera")
    files = [file for row, file in enumerate(files) if row not in doubtful]
    views = [replace(view, name=file) for view, file in zip(project.views, files)]
    for view in views:
        _check_shape(view, image_size(folder / view.name), folder)
    return replace(project, views=views), folder


def _sharing(project: Project, folder: Path, files: list[str]) -> set[int]:
    """Rows of the views whose photo (of `files`) another view has too, and better or as well."""
    exact = [
        file if file == plain_name(view.name) or str(folder.absolute() / file) == full else None
        for view, file, full in zip(project.views, files, _full_names(project))
    ]
    claims, exact_claims = Counter(files), Counter(exact)
    return {
        row
        for row, file in enumerate(files)
        if claims[file] > 1 and not (exact[row] == file and exact_claims[file] == 1)
    }


def _named_as_meant(project: Project) -> Project:
    """Views named by path relative to the common folder of the photos, where the project says where that is;
    by file where it names them by an absolute path alone.
    """
    paths = [PurePosixPath(name) for name in _full_names(project)]
    if project.photos is not None:
        folder = _common_folder([str(path) for path in paths])
        paths = [path.relative_to(folder) for path in paths]
    elsewhere = [
        path.is_absolute() or ".." in path.parts or PureWindowsPath(path).is_absolute() for path in paths
    ]
    names = [path.name if away else str(path) for path, away in zip(paths, elsewhere)]
    return replace(project, views=[replace(view, name=name) for view, name in zip(project.views, names)])


def _full_names(project: Project) -> list[str]:
    """Paths of the photos as the project names them, absolute where it says in which folder they are."""
    names = [plain_name(view.name) for view in project.views]
    if project.photos is None:
        return names
    return [os.path.normpath(Path(os.path.abspath(project.photos), name)) for name in names]


def _inside(project: Project) -> list[str]:
    """Those of the paths that lie in the folder of the project."""
    root = f"{os.path.abspath(project.photos or '')}{os.sep}"
    return [name for name in _full_names(project) if name.startswith(root)]


def _common_folder(names: list[str]) -> Path:
    return Path(os.path.commonpath([os.path.dirname(name) for name in names]))


def _same_letters(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _check_shape(view: View, size: tuple[int, int], folder: Path) -> None:
    if abs(size[0] * view.height - size[1] * view.width) > max(size[0], view.width):
        raise InputError(
            f"{folder / view.name} is {size[0]}x{size[1]}, but its camera is {view.width}x{view.height}: these are other photos, or turned ones"
        )
