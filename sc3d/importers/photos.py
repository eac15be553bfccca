"""Find the photos of a project: by path, by file name, or by name without suffix."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path, PurePosixPath, PureWindowsPath

from sc3d.errors import InputError
from sc3d.geometry.cameras import View
from sc3d.importers.project import Project
from sc3d.io.images import image_size
from sc3d.io.photo_folder import find_photos
from sc3d.scene.photo_names import PhotoNames, photo_name, shared_folders


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
    names = names_in(folder)
    found = [names.match(plain_name(view.name), changed=False) for view in project.views]
    _require_clear(project, folder, found)
    project, found = _without(project, found, [not photos for photos in found], f"not in {folder}")
    unclear = [len(photos) > 1 for photos in found]
    project, found = _without(project, found, unclear, "that may be any of several photos of their name")
    doubtful = _sharing(project, folder, [photos[0] for photos in found])
    shared = [row in doubtful for row in range(len(found))]
    project, found = _without(project, found, shared, "that share a photo with another camera")
    if not project.views:
        raise InputError(
            f"no photo is left: {'; '.join(f'{len(gone)} {reason}' for reason, gone in project.left_out.items())};"
            f" pass the folder that holds the photos of all cameras with --images, not {folder}"
        )
    views = [replace(view, name=photos[0]) for view, photos in zip(project.views, found)]
    for view in views:
        _check_shape(view, image_size(folder / view.name), folder)
    return replace(project, views=views), folder


def names_in(folder: Path) -> PhotoNames:
    """The photos of a folder and its subfolders."""
    return PhotoNames(photo_name(photo, folder) for photo in find_photos(folder))


def _require_clear(project: Project, folder: Path, found: list[tuple[str, ...]]) -> None:
    """InputError if no view means one photo alone; found: the photos that each view may mean."""
    if any(len(photos) == 1 for photos in found):
        return
    names = [view.name for view in project.views]
    unclear = [(name, photos) for name, photos in zip(names, found) if photos]
    if not unclear:
        raise InputError(
            f"none of the {len(names)} photos of the project is in {folder}, such as {names[0]}: "
            "pass their folder with --images"
        )
    name, photos = unclear[0]
    raise InputError(
        f"{len(unclear)} of {len(names)} photos of the project may be any of several in {folder}, "
        f"such as {name!r}: {' or '.join(photos)}; give them names with the folder in the program that wrote "
        "the project, or pass the folder of its photos alone with --images"
    )


def _without(
    project: Project, found: list[tuple[str, ...]], out: list[bool], reason: str
) -> tuple[Project, list[tuple[str, ...]]]:
    """The project and the photos of its views without those that are out."""
    rows = {row for row, is_out in enumerate(out) if is_out}
    return project.without(rows, reason), [photos for row, photos in enumerate(found) if row not in rows]


def _sharing(project: Project, folder: Path, files: list[str]) -> set[int]:
    """Rows of the views whose photo (of `files`) another view has too, and better or as well: the whole path
    counts most, then the folders in common, the name of the photos' own folder included.
    """
    ranks = [
        (
            file == plain_name(view.name) or str(folder.absolute() / file) == full,
            shared_folders(plain_name(view.name), (folder.absolute() / file).as_posix()),
        )
        for view, file, full in zip(project.views, files, _full_names(project))
    ]
    claims: dict[str, list[tuple[bool, int]]] = defaultdict(list)
    for file, rank in zip(files, ranks):
        claims[file].append(rank)
    return {
        row
        for row, (file, rank) in enumerate(zip(files, ranks))
        if rank != max(claims[file]) or claims[file].count(rank) > 1
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
    counts = Counter(names)
    shared = [row for row, name in enumerate(names) if counts[name] > 1]
    if len(shared) == len(names):
        raise InputError(
            f"all {len(names)} photos of the project share their names with others, such as {names[0]!r}, "
            "and nothing tells them apart: give them names with the folder (100MEDIA/DJI_0001.JPG) in the program that wrote the project"
        )
    views = [replace(view, name=name) for view, name in zip(project.views, names)]
    return replace(project, views=views).without(shared, "that share their names with others")


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


def _check_shape(view: View, size: tuple[int, int], folder: Path) -> None:
    if abs(size[0] * view.height - size[1] * view.width) > max(size[0], view.width):
        raise InputError(
            f"{folder / view.name} is {size[0]}x{size[1]}, but its camera is {view.width}x{view.height}: "
            "these are other photos, or turned ones"
        )
