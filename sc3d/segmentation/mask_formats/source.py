"""Which format is it, and which photo does each mask belong to? Reads any of them to checked masks that are
drawn one at a time.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sc3d.errors import InputError
from sc3d.scene.class_table import ClassTable
from sc3d.scene.photo_names import NamePattern, PhotoNames, files_of_photos
from sc3d.scene.scene import tell_of_turned
from sc3d.segmentation.mask_formats.annotations import to_mask
from sc3d.segmentation.mask_formats.checks import CheckedMask, Checks
from sc3d.segmentation.mask_formats.coco import read_coco
from sc3d.segmentation.mask_formats.cvat import read_cvat
from sc3d.segmentation.mask_formats.labelme import read_labelme
from sc3d.segmentation.mask_formats.mapping import read_mapping
from sc3d.segmentation.mask_formats.pngs import check_png, is_colored

logger = logging.getLogger(__name__)

READERS = {"labelme": read_labelme, "coco": read_coco, "cvat": read_cvat}
SUFFIXES = {"labelme": ".json", "coco": ".json", "cvat": ".xml", "index": ".png", "color": ".png"}


@dataclass(frozen=True)
class MaskFiles:
    """Masks made elsewhere.

    path: a folder, or a JSON or XML file
    format: auto, index, color, labelme, coco or cvat
    mapping: JSON file of the ids, names or colors in them and the classes that they stand for
    name_pattern: how they are named, see `sc3d.scene.photo_names.NamePattern`
    """

    path: Path
    format: str = "auto"
    mapping: Path | None = None
    name_pattern: str | None = None


def read_masks(
    source: MaskFiles,
    photo_sizes: dict[str, tuple[int, int]],
    class_table: ClassTable,
    photos: Path | None = None,
) -> dict[str, CheckedMask]:
    """Masks by photo name, all checked and none drawn yet.

    photo_sizes: (width, height) px as stored by photo name; photos: their folder, for their EXIF orientation
    Raises InputError, in one line, for everything that does not fit.
    """
    pattern = None if source.name_pattern is None else NamePattern(source.name_pattern)
    names = PhotoNames(photo_sizes, pattern)
    kind = detect(source.path, names) if source.format == "auto" else source.format
    folder = source.path if source.path.is_dir() else source.path.parent
    checks = Checks(photo_sizes, read_mapping(source.mapping, class_table), names, folder, photos)
    automatic = source.format == "auto"
    masks: dict[str, CheckedMask] = {}
    files = _files(source.path, kind, names)
    if kind in ("index", "color"):
        _tell_of_other_folders(source.path, files)
    for file in files:
        try:
            for name, mask in _read(file, "auto" if automatic and kind not in READERS else kind, checks):
                if name in masks:
                    checks.add(
                        "double",
                        f"{name} has a mask in {masks[name].origin} and another in {mask.origin}; "
                        "--name-pattern says which are meant",
                    )
                masks.setdefault(name, mask)
        except InputError as error:
            checks.add("file", str(error))
    checks.finish(source.path)
    if not masks:
        raise InputError(
            f"no masks in {source.path}: no annotation with an area is there"
            + ("" if pattern is None else f", or no name fits --name-pattern {pattern.text!r}")
        )
    if checks.by_palette:
        logger.info(
            "%s: %d masks are read by the colors of their palette, which are those of the class table; --format index takes the ids",
            source.path,
            checks.by_palette,
        )
    if checks.turned and SUFFIXES[kind] == ".png":
        tell_of_turned(source.path, len(checks.turned), checks.turned[0])
    elif checks.turned:
        logger.info(
            "%s: %d photos (such as %s) are turned by EXIF: annotations are read as made on the photo as it is shown",
            source.path,
            len(checks.turned),
            checks.turned[0],
        )
    told = "PNG" if automatic and kind not in READERS else kind
    logger.info("%s: %s masks for %d of %d photos", source.path, told, len(masks), len(photo_sizes))
    return dict(sorted(masks.items()))


def _read(file: Path, kind: str, checks: Checks) -> Iterator[tuple[str, CheckedMask]]:
    if kind not in READERS:
        yield from check_png(file, kind, checks)
        return
    for photo in READERS[kind](file):
        found = to_mask(photo, checks)
        if found is not None:
            yield found


def detect(path: Path, names: PhotoNames = PhotoNames(())) -> str:
    """Format of a file or folder of the photos `names`, by what is in it; InputError if nothing is known."""
    annotated = next(filter(None, map(_kind, _find(path, (".json", ".xml"), names))), None)
    if annotated:
        return annotated
    pngs = _find(path, (".png",), names) if path.is_dir() else []
    if pngs:
        return "color" if all(is_colored(file) for file in pngs) else "index"
    if path.suffix.lower() in (".zip", ".gz", ".7z"):
        raise InputError(f"no masks in {path}: unpack the archive")
    raise InputError(
        f"no masks in {path}: PNG files named like the photos, LabelMe or COCO JSON or CVAT XML are expected"
    )


def _kind(file: Path) -> str | None:
    """Format of a JSON or XML file by the words in it, without decoding a file that may be large."""
    if file.suffix.lower() == ".xml":
        return "cvat"
    content = file.read_bytes()
    if b'"annotations"' in content and b'"categories"' in content:
        return "coco"
    return "labelme" if b'"shapes"' in content else None


def _files(path: Path, kind: str, names: PhotoNames) -> list[Path]:
    files = _find(path, (SUFFIXES[kind],), names)
    if not files or (kind in ("index", "color") and not path.is_dir()):
        what = (
            f"a folder of {SUFFIXES[kind]} files named like the photos is"
            if SUFFIXES[kind] == ".png"
            else f"a {SUFFIXES[kind]} file or a folder of them is"
        )
        raise InputError(f"no masks in {path}: {what} expected for --format {kind}")
    return files


def _find(path: Path, suffixes: tuple[str, ...], names: PhotoNames) -> list[Path]:
    """The file itself, or the files of a folder by name; annotations also in all folders below, PNGs only in
    those that are named like folders of the photos, because others may hold photos.
    """
    if not path.is_dir():
        return [path] if path.is_file() and path.suffix.lower() in suffixes else []
    if suffixes == (".png",):
        return files_of_photos(path, names, suffixes)
    return _all_files(path, suffixes)


def _all_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    return sorted(
        file
        for file in folder.rglob("*")
        if file.suffix.lower() in suffixes and not file.name.startswith(".") and file.is_file()
    )


def _tell_of_other_folders(path: Path, files: list[Path]) -> None:
    """Count the PNGs that were not looked at."""
    others = sorted(set(_all_files(path, (".png",))) - set(files))
    if others:
        logger.warning(
            "%s: %d PNG files in folders that are not named like those of the photos are left out, "
            "such as %s",
            path,
            len(others),
            others[0].relative_to(path),
        )
