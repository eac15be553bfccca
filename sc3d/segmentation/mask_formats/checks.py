"""Does every annotation have its photo, its size and its class? All that does not fit is gathered and
reported in one line.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from sc3d.errors import InputError
from sc3d.io.images import IMAGE_SUFFIXES, read_orientation
from sc3d.io.limits import MAX_MASK_PIXELS
from sc3d.io.orientation import inverse, mask_turn, turned_size
from sc3d.scene.scene import check_mask_aspect
from sc3d.segmentation.mask_formats.mapping import ClassMapping

logger = logging.getLogger(__name__)

MAX_TEXT = 400  # characters of a message about one mismatch


@dataclass(frozen=True)
class CheckedMask:
    """A checked mask that has not been read yet.

    origin: where it comes from, for messages
    size: (width, height) px
    read: makes it, (H, W) uint8 class ids of the scene, in the frame of the photo as stored
    """

    origin: str
    size: tuple[int, int]
    read: Callable[[], np.ndarray]


class Checks:
    """Looks photos, sizes and classes up, and keeps what does not fit: for every kind of mismatch the first
    example and their number.
    """

    def __init__(
        self, photo_sizes: dict[str, tuple[int, int]], classes: ClassMapping, photos: Path | None = None
    ) -> None:
        """photo_sizes: (width, height) px as stored by photo name, no two of one stem; photos: their folder, for
        their EXIF orientation
        """
        self.classes = classes
        self.turned: list[str] = []  # photos that EXIF turns, whose annotations lie as shown by a rule alone
        self.by_palette = 0  # masks of which the palette's colors count, not the ids
        self._photos = photos
        self._photo_sizes = photo_sizes
        self._names = {Path(name).stem: name for name in photo_sizes}
        self._mismatches: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        self._skipped: Counter[str] = Counter()
        self._unknown: dict[str, str] = {}

    def add(self, kind: str, example: str) -> None:
        """Keep a mismatch; `example` is shown for the first one of its kind."""
        self._mismatches.setdefault(kind, _printable(example))
        self._counts[kind] += 1

    def skip(self, kinds: Iterable[str]) -> None:
        """Count annotations that have no area."""
        self._skipped.update(kinds)

    def photo(self, candidates: tuple[str, ...], origin: str) -> str | None:
        """Name of the photo that has the stem of one of the file names."""
        found = {
            name
            for name in (self._names.get(stem(candidate)) for candidate in candidates)
            if name is not None
        }
        if not found:
            example = next(iter(self._photo_sizes), "none")
            self.add(
                "photo",
                f"{_where(candidates[0], origin)} belongs to no photo: {len(self._names)} photos are known, such as {example}",
            )
        elif len(found) > 1:
            self.add(
                "ambiguous",
                f"{origin} is named after a photo, but says that it belongs to another: {' or '.join(sorted(found))}",
            )
        return found.pop() if len(found) == 1 else None

    def size(
        self, name: str, stated: tuple[Any, Any] | None, origin: str, own: int = 1
    ) -> tuple[tuple[int, int], int] | None:
        """(width, height) px of the mask of a photo: as stated if that fits the photo, that of the photo as shown
        if nothing is stated; and the orientation by which it is turned into the frame of the photo as stored.

        own: EXIF orientation of the mask
        """
        photo = self._photo_sizes[name]
        orientation = 1 if self._photos is None else read_orientation(self._photos / name)
        if stated is None:
            return turned_size(photo, orientation), inverse(orientation)
        try:
            width, height = (int(value) for value in stated)
            if width < 1 or height < 1 or (width, height) != tuple(float(value) for value in stated):
                raise ValueError
        except (ValueError, TypeError, OverflowError):
            self.add(
                "no size",
                f"{_where(name, origin)} has a size that is none: {str(stated[0])[:20]} x {str(stated[1])[:20]}",
            )
            return None
        if width * height > max(MAX_MASK_PIXELS, photo[0] * photo[1]):
            self.add(
                "too large",
                f"{_where(name, origin)} is {width}x{height}, but its photo is {photo[0]}x{photo[1]}: more than {MAX_MASK_PIXELS} px are refused",
            )
            return None
        turn, assumed = mask_turn(own, (width, height), orientation, photo)
        try:
            check_mask_aspect(_where(name, origin), turned_size((width, height), turn), photo)
        except InputError as error:
            self.add("size", str(error))
            return None
        if assumed:
            self.turned.append(name)
        return (width, height), turn

    def class_id(self, keys: tuple[str, ...], origin: str) -> int | None:
        """Class of the scene for a name, or else a number, in the file."""
        class_id = self.classes.find(keys)
        if class_id is None:
            self._unknown.setdefault(keys[0], origin)
            self._counts["class"] += 1
        return class_id

    def finish(self, source: Path) -> None:
        """Raise InputError if anything did not fit; tell what was skipped."""
        if self._unknown:
            shown = ", ".join(repr(name[:40]) for name in list(self._unknown)[:5])
            shown += f" and {len(self._unknown) - 5} more" if len(self._unknown) > 5 else ""
            self._mismatches["class"] = _printable(
                f"{next(iter(self._unknown.values()))} has unknown classes: {shown}; known are {self.classes.names}, "
                'others need a --mapping such as {"wall": "building", "sky": null}'
            )
        if self._mismatches:
            texts = [
                text + (f" ({self._counts[kind]} times)" if self._counts[kind] > 1 else "")
                for kind, text in self._mismatches.items()
            ]
            raise InputError(f"cannot import {source}: " + "; ".join(texts))
        if self._skipped:
            skipped = ", ".join(f"{kind} ({count})" for kind, count in sorted(self._skipped.items()))
            logger.warning("%s: annotations without an area were skipped: %s", source, skipped)


def _printable(text: str) -> str:
    """One short line, whatever names a file holds."""
    return "".join(letter if letter.isprintable() else "?" for letter in text[:MAX_TEXT]) + (
        "..." if len(text) > MAX_TEXT else ""
    )


def _where(name: str, origin: str) -> str:
    """The photo in a file of many, or the file of one."""
    return origin if stem(origin) == stem(name) else f"{name[-80:]} in {origin}"


def stem(name: str) -> str:
    """File name without folders (of any system) and without the suffix of an image; other dots belong to the
    name.
    """
    path = PureWindowsPath(name)
    return path.stem if path.suffix.lower() in IMAGE_SUFFIXES | {".json", ".webp", ".bmp"} else path.name
