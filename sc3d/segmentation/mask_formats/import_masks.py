"""Masks that the user already has, in any of the formats of sc3d.segmentation.mask_formats: checked, and
drawn into the scene.
"""

from __future__ import annotations

import logging
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path, discard
from sc3d.io.folders import resolved
from sc3d.io.images import read_orientation, write_image
from sc3d.io.mask_images import index_image_size, is_indexed, turned_onto
from sc3d.io.progress import progress
from sc3d.scene.class_table import ClassTable
from sc3d.scene.mask_values import read_confidence
from sc3d.scene.photo_names import PhotoNames
from sc3d.scene.scene import Scene, match_masks, photo_sizes
from sc3d.segmentation.mask_formats.checks import CheckedMask
from sc3d.segmentation.mask_formats.source import MaskFiles, read_masks
from sc3d.settings.labels import Segment

logger = logging.getLogger(__name__)


def import_scene_masks(scene: Scene, settings: Segment, class_table: ClassTable) -> dict[str, object]:
    """Masks of `--masks` into the scene, or a look at those that are there; returns figures for the summary."""
    if settings.masks is None:
        told = settings.mapping, settings.name_pattern
        if told != (None, None) or settings.format not in ("auto", "index"):
            raise InputError(
                "--mapping, --format and --name-pattern say how to read --masks, which is missing"
            )
        if not scene.masks.is_dir():
            raise InputError(
                "--masks FOLDER is needed (or --backend geometry, strokes, grounded-sam or sam3, which make masks)"
            )
        found = scene.mask_files(scene.masks, class_table)
        scene.warn_of_unplaced(scene.masks, scene.confidence)
        return {"masks": len(found), "source": "already in the scene"}
    source, sizes = mask_source(settings, settings.masks), photo_sizes(scene.images)
    names = import_masks(
        source, scene.masks, sizes, class_table, settings.confidence, scene.confidence, scene.images
    )
    scene.warn_of_unplaced(scene.masks, scene.confidence)
    return {"masks": len(names), "confidence": settings.confidence is not None}


def mask_source(settings: Segment, path: Path) -> MaskFiles:
    """The masks in `path`, to be read as the settings say."""
    return MaskFiles(path, settings.format, settings.mapping, settings.name_pattern)


def import_masks(
    source: MaskFiles | Path,
    scene_masks: Path,
    photo_sizes: dict[str, tuple[int, int]],
    class_table: ClassTable,
    confidence: Path | None = None,
    scene_confidence: Path | None = None,
    photos: Path | None = None,
) -> list[str]:
    """Write masks, and confidence maps if given, into the scene as 8-bit gray PNGs whose values are the ids
    of the class table, in the frame of the photos as stored.

    source: masks in any format; a bare path is looked at
    scene_masks, scene_confidence: folders to write; each is replaced as a whole
    photo_sizes: (width, height) px by photo name
    confidence: folder of PNGs named like the photos; photos: that of the photos, for their EXIF orientation
    returns: names of the photos that have a mask, in order

    Raises InputError before anything is written if a file does not fit. With `scene_confidence` but no
    `confidence`, confidence maps that the scene already has are removed, because they describe the masks that
    are replaced.
    """
    if confidence is not None and scene_confidence is None:
        raise InputError("confidence maps are given, but not where in the scene they belong")
    source = source if isinstance(source, MaskFiles) else MaskFiles(source)
    in_place = resolved(source.path) == resolved(scene_masks)
    if in_place and (
        source.mapping is not None
        or source.name_pattern is not None
        or source.format not in ("auto", "index")
    ):
        raise InputError(
            f"{source.path} is the scene's own folder, which holds ids of the class table: masks to convert belong elsewhere"
        )
    masks, maps = check_masks(
        replace(source, format="index") if in_place else source, photo_sizes, class_table, confidence, photos
    )
    wide = next(
        (mask.origin for mask in masks.values() if in_place and not is_indexed(Path(mask.origin))), None
    )
    if wide is not None:
        raise InputError(
            f"{wide} has colors, or 16 bits: the scene's own masks are 8-bit PNGs with one id per pixel"
        )
    _check_target(source.path, scene_masks)
    if scene_confidence is not None:
        _check_target(confidence, scene_confidence)
    with ExitStack() as folders:  # all is written before anything replaces what is there
        if maps and confidence and scene_confidence and resolved(confidence) != resolved(scene_confidence):
            _copy(maps, folders.enter_context(atomic_path(scene_confidence)), PhotoNames(photo_sizes), photos)
        if not in_place:  # in place, they are already there and checked
            _draw(masks, folders.enter_context(atomic_path(scene_masks)), PhotoNames(photo_sizes), photos)
            if not maps and scene_confidence is not None:
                discard(scene_confidence)
    return sorted(masks)


def check_masks(
    source: MaskFiles,
    photo_sizes: dict[str, tuple[int, int]],
    class_table: ClassTable,
    confidence: Path | None = None,
    photos: Path | None = None,
) -> tuple[dict[str, CheckedMask], dict[str, Path]]:
    """Masks that are not drawn yet, and confidence maps, by photo name; InputError, in one line, for all that
    does not fit.
    """
    masks = read_masks(source, photo_sizes, class_table, photos)
    return masks, {} if confidence is None else _match_confidence(confidence, photo_sizes, masks, photos)


def _match_confidence(
    folder: Path,
    photo_sizes: dict[str, tuple[int, int]],
    masks: dict[str, CheckedMask],
    photos: Path | None,
) -> dict[str, Path]:
    """Confidence maps by photo name, each readable and as large as the mask it belongs to."""
    maps = match_masks(folder, photo_sizes, None, photos=photos)
    for name, file in maps.items():
        if name not in masks:
            raise InputError(
                f"{file} is the confidence of a mask that does not exist: remove it, or add a mask for {name}"
            )
        size = index_image_size(file, _photo(photos, name))
        if size != masks[name].size:
            sizes = "x".join(map(str, size)), "x".join(map(str, masks[name].size))
            raise InputError(f"{file} is {sizes[0]}, but its mask is {sizes[1]}: they must be equal")
        read_confidence(file)
    return maps


def _photo(photos: Path | None, name: str) -> Path | None:
    return None if photos is None else photos / name


def _orientation(photos: Path | None, name: str) -> int:
    return 1 if photos is None else read_orientation(photos / name)


def _check_target(source: Path | None, target: Path) -> None:
    """Refuse to replace a folder that is not the scene's own."""
    if target.is_symlink():
        raise InputError(
            f"{target} is a link: remove the link, so that the folder it leads to is not overwritten"
        )
    if source is not None and resolved(target) in resolved(source).parents:
        raise InputError(f"{source} lies inside {target}, which would be replaced: move it elsewhere")


def _copy(files: dict[str, Path], folder: Path, names: PhotoNames, photos: Path | None) -> None:
    folder.mkdir()
    for name, file in files.items():
        confidence = turned_onto(read_confidence(file), file, _photo(photos, name))
        write_image(names.path(folder, name), confidence, _orientation(photos, name))


def _draw(masks: dict[str, CheckedMask], folder: Path, names: PhotoNames, photos: Path | None) -> None:
    folder.mkdir()
    for name, mask in progress(masks.items(), "import", "photo"):
        write_image(names.path(folder, name), mask.read(), _orientation(photos, name))
