"""Masks that the user already has: any folder of index PNGs, checked and copied into the scene."""

from __future__ import annotations

import shutil
from pathlib import Path

from sc3d.classes import ClassTable
from sc3d.errors import InputError
from sc3d.io import atomic_path, image_size, read_index_image, write_image
from sc3d.scene import match_masks


def import_masks(
    source: Path,
    scene_masks: Path,
    photo_sizes: dict[str, tuple[int, int]],
    class_table: ClassTable,
    confidence: Path | None = None,
    scene_confidence: Path | None = None,
) -> list[str]:
    """Copy a folder of masks, and one of confidence maps if given, into the scene as 8-bit grey PNGs whose values are the ids.

    source, confidence: folders of `<photo stem>.png`
    scene_masks, scene_confidence: folders to write; each is replaced as a whole
    photo_sizes: (width, height) px by photo name
    returns: names of the photos that have a mask, in order

    Raises InputError before anything is written if a file does not fit. With `scene_confidence` but no `confidence`, confidence maps that
    the scene already has are removed, because they describe the masks that are replaced.
    """
    if confidence is not None and scene_confidence is None:
        raise InputError("confidence maps are given, but not where in the scene they belong")
    masks = match_masks(source, photo_sizes, class_table)
    maps = {} if confidence is None else _match_confidence(confidence, photo_sizes, masks)
    _check_target(source, scene_masks)
    if scene_confidence is not None:
        _check_target(confidence, scene_confidence)
    if maps:
        _copy(maps, confidence, scene_confidence)
    elif scene_confidence is not None and scene_confidence.is_dir() and source.resolve() != scene_masks.resolve():
        shutil.rmtree(scene_confidence)
    _copy(masks, source, scene_masks)
    return sorted(masks)


def _match_confidence(folder: Path, photo_sizes: dict[str, tuple[int, int]], masks: dict[str, Path]) -> dict[str, Path]:
    """Confidence maps by photo name, each readable and as large as the mask it belongs to."""
    maps = match_masks(folder, photo_sizes, None)
    for name, file in maps.items():
        if name not in masks:
            raise InputError(f"{file} is the confidence of a mask that does not exist: remove it, or add a mask for {name}")
        height, width = read_index_image(file).shape
        if (width, height) != image_size(masks[name]):
            raise InputError(f"{file} is {width}x{height}, but its mask is {'x'.join(map(str, image_size(masks[name])))}: they must be equal")
    return maps


def _check_target(source: Path | None, target: Path) -> None:
    """Refuse to replace a folder that is not the scene's own."""
    if target.is_symlink():
        raise InputError(f"{target} is a link: remove the link, so that the folder it leads to is not overwritten")
    if source is not None and target.resolve() in source.resolve().parents:
        raise InputError(f"{source} lies inside {target}, which would be replaced: move it elsewhere")


def _copy(files: dict[str, Path], source: Path, target: Path) -> None:
    if source.resolve() == target.resolve():
        return  # already in place, and checked
    with atomic_path(target) as temporary:
        temporary.mkdir()
        for file in files.values():
            write_image(temporary / file.name, read_index_image(file))
