"""The photos of a folder and its subfolders, and what in it is none."""

from __future__ import annotations

from pathlib import Path

from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path
from sc3d.io.folders import files_below, link_or_copy, resolved

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}

OTHER_SUFFIXES = {
    ".heic",
    ".heif",
    ".avif",
    ".webp",
    ".bmp",
    ".gif",
    ".jp2",
    ".jxl",
    ".dng",
    ".raw",
    ".cr2",
    ".nef",
    ".arw",
}

NO_PHOTOS = {"__macosx", "@eadir", "thumbnails", "thumbs"}  # folders of archives, file servers and viewers


def broken_link(link: Path) -> str:
    """What to say of a link to nothing."""
    return (
        f"{link} is a link to {link.readlink()}, which is not there: has it been moved? "
        "Put it back, or make the link anew"
    )


def list_photos(folder: Path) -> list[Path]:
    """Photos of a folder and its subfolders, by path. No photos are what sc3d has written there, hidden files
    and folders, and thumbnails.
    """
    return _survey(folder)[0]


def unused_files(folder: Path) -> str:
    """What in a folder of photos is not used, by reason, with numbers and examples; "" if nothing is."""
    parts = []
    for reason, files in _survey(folder)[1].items():
        shown = [str(file.relative_to(folder)) for file in files[:3]] + ["..."] * (len(files) > 3)
        parts += [f"{len(files)} {reason} ({', '.join(shown)})"] if files else []
    return "; ".join(parts)


def _survey(folder: Path) -> tuple[list[Path], dict[str, list[Path]]]:
    """Photos, and the files and folders that are left out, by reason."""
    files, made = files_below(folder)
    hidden, thumbnails, others, photos = list[Path](), list[Path](), list[Path](), list[Path]()
    for file in files:
        suffix, parts = file.suffix.lower(), file.relative_to(folder).parts
        if suffix not in IMAGE_SUFFIXES | OTHER_SUFFIXES:
            continue
        if any(part.startswith(".") for part in parts):
            hidden.append(file)
        elif any(part.lower() in NO_PHOTOS for part in parts[:-1]):
            thumbnails.append(file)
        else:
            (photos if suffix in IMAGE_SUFFIXES else others).append(file)
    reasons = {
        "of a format that is not read, convert them to JPEG": others,
        "written by sc3d": made,
        "hidden": hidden,
        "thumbnails or leftovers of an archive": thumbnails,
    }
    return photos, reasons


def find_photos(folder: Path) -> list[Path]:
    """As `list_photos`; InputError if there are none, or one is a link that leads elsewhere."""
    if folder.is_symlink() and not folder.exists():
        raise InputError(broken_link(folder))
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: give the folder that holds the photos")
    photos = list_photos(folder)
    if not photos:
        others = unused_files(folder)
        raise InputError(
            f"no photos in {folder}: JPEG, PNG or TIFF files are expected"
            + (f"; left out: {others}" if others else "")
        )
    for photo in photos:
        require_within(photo, folder)
    return photos


def require_place(photos: Path, images: Path) -> None:
    """InputError if `images` already holds other photos than those of the folder `photos`."""
    if images.exists() and not images.is_symlink() and resolved(images) != resolved(photos):
        raise InputError(f"{images} already holds other photos: choose another scene folder")


def link_photos(photos: Path, images: Path) -> None:
    """Make `images` a link to a folder of photos, a copy where links are not possible; nothing if it is that
    folder. InputError if it already holds others.
    """
    require_place(photos, images)
    if images.exists() and resolved(images) == resolved(photos):
        return
    with atomic_path(images) as temporary:
        link_or_copy(resolved(photos), temporary)


def require_within(file: Path, folder: Path) -> None:
    """InputError if a file of a folder is a link to a file outside of it; the folder itself may be a link."""
    if not resolved(file).is_relative_to(resolved(folder)):
        raise InputError(
            f"{file} is a link that leads out of {folder}: copy the file there, or make the whole folder a link"
        )
