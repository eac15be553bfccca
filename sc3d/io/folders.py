"""What of a folder is its owner's, and what sc3d has written there: a scene may lie among the photos."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

SIDECAR_START = b'{\n "stage":'  # of what `sc3d.runner` writes beside every output
# in a scene, and what they are renamed to when they are replaced
OUTPUTS = ("masks", "confidence", "confidence_refined", "instances", "strokes", "truth", "depth", "export")
PICTURES = ("train.jpg",)


def resolved(path: Path) -> Path:
    """As `Path.resolve`, which fails before Python 3.13 for a link to itself."""
    return Path(os.path.realpath(path))


def link_or_copy(source: Path, link: Path) -> None:
    """Make `link` a link to a file or a folder, relative if `source` is (then seen from the link's folder); a copy
    where links are not possible (Windows asks for a privilege).
    """
    target = link.parent / source
    try:
        os.symlink(source, link, target_is_directory=target.is_dir())
    except FileExistsError:
        raise
    except (OSError, NotImplementedError):
        if target.is_dir():
            shutil.copytree(target, link)
        else:
            shutil.copyfile(target, link)


def files_below(folder: Path) -> tuple[list[Path], list[Path]]:
    """Files of a folder and its subfolders, ordered; and the folders and files in it that sc3d has written,
    scenes among them, which are not looked into. Links to folders are not followed.
    """
    found: list[Path] = []
    made: list[Path] = []
    for path, folders, files in os.walk(folder):
        here = Path(path)
        written = _written(here, [*folders, *files])
        written |= {name for name in folders if is_scene(here / name)}
        made += [here / name for name in written]
        folders[:] = [name for name in folders if name not in written]
        found += [here / name for name in files if name not in written and (here / name).is_file()]
    return sorted(found), sorted(made)


def is_scene(folder: Path) -> bool:
    """Whether a folder is a scene of sc3d: it holds an output with a sidecar, or a link to photos around it."""
    with suppress(OSError):
        sidecars = [*folder.glob("*.json"), *(folder / "sparse").glob("*.json")]
        images = folder / "images"
        around = images.is_symlink() and resolved(folder).is_relative_to(resolved(images))
        return around or any(map(_is_sidecar, sidecars))
    return False


def _written(folder: Path, names: list[str]) -> set[str]:
    """Names in a folder that are outputs of sc3d."""
    written = {name for name in names if f"{name}.json" in names and _is_sidecar(folder / f"{name}.json")}
    if written or is_scene(folder):
        written |= {name for name in names if name.partition(".")[0] in OUTPUTS or name in PICTURES}
    return written - {"images"}


def _is_sidecar(path: Path) -> bool:
    with suppress(OSError):
        if path.is_file():
            with path.open("rb") as file:
                return file.read(len(SIDECAR_START)) == SIDECAR_START
    return False
