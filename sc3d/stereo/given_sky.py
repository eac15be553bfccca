"""Sky that masks show: those of the scene, or masks made for it, binary or of classes, in any format of masks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.mask_images import turned_onto
from sc3d.scene.class_table import ClassTable, SemanticClass
from sc3d.scene.mask_values import read_confidence
from sc3d.scene.photo_names import PhotoNames
from sc3d.scene.scene import Scene, match_masks
from sc3d.segmentation.mask_formats.source import READERS, MaskFiles, detect, read_masks

UNTOLD, SURFACE, SKY = 0, 1, 2  # what a mask says of a pixel
ADVICE = "`sc3d segment --masks` has --mapping and --format; depth then takes the sky of the scene's masks"
ONLY_SKY = ClassTable((SemanticClass(1, "sky", (255, 255, 255), surface=False),))

GivenSky = dict[str, Callable[[], np.ndarray]]  # per photo: (H, W) uint8 UNTOLD, SURFACE or SKY, as stored


def shows_sky(scene: Scene) -> bool:
    """Whether the scene has masks in which a class has no surface."""
    return scene.masks.is_dir() and scene.classes.exists() and bool(scene.class_table().without_surface)


def sky_of_scene(scene: Scene) -> GivenSky:
    """What the masks of the scene say, of photos with a camera; InputError as in `Scene.mask_files`."""
    table = scene.class_table()

    def read(name: str, file: Path) -> np.ndarray:
        return _told(scene.read_mask(file, name), table)

    return {name: partial(read, name, file) for name, file in scene.mask_files(scene.masks, table).items()}


def read_given_sky(
    path: Path, photo_sizes: dict[str, tuple[int, int]], table: ClassTable | None, photos: Path
) -> GivenSky:
    """What masks made for the sky say.

    path: as `MaskFiles` has it; PNGs may also be binary: 0, and 1 or 255 for sky, where 0 is no sky. Of
        classes, those without surface are sky; where the table has none, one that is called sky
    photo_sizes: (width, height) px as stored by photo name; photos: their folder

    InputError for what does not fit, for masks without any sky, and where it is not clear which values are.
    """
    if not path.exists():
        raise InputError(f"--sky-masks {path} is missing: pass a folder of masks, or a file of annotations")
    annotated = detect(path, PhotoNames(photo_sizes)) in READERS
    value, binary = (0, GivenSky()) if annotated else _binary(path, photo_sizes, photos)
    unclear = InputError(
        f"--sky-masks: {path} holds 0 and one other value, which is a class with a surface: save binary masks in gray of 8 "
        "bits with 255 for sky, or 1 where 255 is a class; masks of classes need a pixel of one without surface"
    )
    if table is None or not table.without_surface:
        if table is not None and value in {entry.id for entry in table}:
            raise unclear
        if not annotated and not binary:
            raise InputError(
                f"--sky-masks: the masks in {path} are not binary (0, and 1 or 255 for sky), or show no sky; for masks of "
                'classes, call one of classes.json sky, or mark it "surface": false'
            )
        return binary or _of_classes(path, photo_sizes, ONLY_SKY, photos)
    try:
        classes = _of_classes(path, photo_sizes, table, photos)
    except InputError:
        if not binary:
            raise
        return binary
    if any((read() == SKY).any() for read in classes.values()):
        return classes
    if binary:
        raise unclear
    raise InputError(f"--sky-masks: no mask in {path} has a pixel of a class without surface")


def _of_classes(
    path: Path, photo_sizes: dict[str, tuple[int, int]], table: ClassTable, photos: Path
) -> GivenSky:
    """Masks of classes in any format."""
    try:
        masks = read_masks(MaskFiles(path), photo_sizes, table, photos)
    except InputError as error:
        raise InputError(f"--sky-masks: {error}; {ADVICE}") from None

    def read(name: str) -> np.ndarray:
        return _told(masks[name].read(), table)

    return {name: partial(read, name) for name in masks}


def _binary(path: Path, photo_sizes: dict[str, tuple[int, int]], photos: Path) -> tuple[int, GivenSky]:
    """The value of sky in binary PNGs, and these; 0 and none if they hold more than 0 and 1, or 0 and 255, or show
    no sky.
    """

    def read(name: str, file: Path) -> np.ndarray:
        found = turned_onto(read_confidence(file), file, photos / name)
        return np.where(found > 0, np.uint8(SKY), np.uint8(SURFACE))

    files, values = match_masks(path, photo_sizes, None, photos=photos), set[int]()
    for file in files.values():
        values |= _values(file) - {0}
        if len(values) > 1:
            break
    if values not in ({1}, {255}):
        return 0, {}
    return values.pop(), {name: partial(read, name, file) for name, file in files.items()}


def _values(file: Path) -> set[int]:
    """Gray values of a PNG; -1 for one that has colors, or more than 8 bits."""
    try:
        return set(np.flatnonzero(np.bincount(read_confidence(file).ravel())).tolist())
    except InputError:
        return {-1}


def _told(labels: np.ndarray, table: ClassTable) -> np.ndarray:
    """(H, W) uint8 of ids."""
    told = np.where(table.shows_no_surface(labels), SKY, SURFACE)
    return np.where(labels == 0, UNTOLD, told).astype(np.uint8)
