"""Does every annotation have its photo, its size and its class? All that does not fit is gathered and
reported in one line.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sc3d.errors import InputError
from sc3d.io.images import read_orientation
from sc3d.io.json_files import whole_number_of
from sc3d.io.limits import MAX_MASK_PIXELS
from sc3d.io.orientation import inverse, mask_turn, turned_size
from sc3d.scene.photo_names import PhotoNames, photo_name, stem
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
        self,
        photo_sizes: dict[str, tuple[int, int]],
        classes: ClassMapping,
        names: PhotoNames | None = None,
        folder: Path = Path(),
        photos: Path | None = None,
    ) -> None:
        """photo_sizes: (width, height) px as stored by photo name; names: those photos, None = with the rules
        that programs follow; folder: the files' own; photos: that of the photos, for their EXIF orientation
        """
        self.classes = classes
        self.names = PhotoNames(photo_sizes) if names is None else names
        self.folder = folder
        self.turned: list[str] = []  # photos that EXIF turns, whose annotations lie as shown by a rule alone
        self.by_palette = 0  # masks of which the palette's colors count, not the ids
        self._photos = photos
        self._photo_sizes = photo_sizes
        self._mismatches: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        self._advice: dict[str, str] = {}
        self._skipped: Counter[str] = Counter()
        self._left_out: list[Path] = []
        self._unknown: dict[str, str] = {}

    def add(self, kind: str, example: str) -> None:
        """Keep a mismatch; `example` is shown for the first one of its kind."""
        self._mismatches.setdefault(kind, _printable(example))
        self._counts[kind] += 1

    def skip(self, kinds: Iterable[str]) -> None:
        """Count annotations that have no area."""
        self._skipped.update(kinds)

    def fits(self, file: Path) -> bool:
        """Whether a file is named as --name-pattern says, if there is one; others are counted."""
        pattern = self.names.pattern
        if pattern is None or pattern.photos(photo_name(file, self.folder)):
            return True
        self._left_out.append(file)
        return False

    def photo(self, candidates: tuple[str, ...], origin: str) -> str | None:
        """Name of the photo that the file names mean, or the file itself, where it is among them."""
        matches = self._matches(candidates, origin, False) or self._matches(candidates, origin, True)
        if not matches:
            example = next(iter(self._photo_sizes), "none")
            self.add(
                "photo",
                f"{_where(candidates[0], origin)} belongs to no photo: {len(self._photo_sizes)} photos are known, such as {example}",
            )
            self._advice.setdefault("photo", _printable(self.names.advice(candidates[0][-MAX_TEXT:])))
            return None
        common = set.intersection(*map(set, matches))
        if len(common) == 1:
            return common.pop()
        if common:
            self.add(
                "several",
                f"{_where(candidates[0], origin)} may belong to {self.names.choices(sorted(common), '')}",
            )
        else:
            told = " or ".join(sorted({name for found in matches for name in found}))
            self.add(
                "ambiguous",
                f"{origin} is named after a photo, but says that it belongs to another: {told}",
            )
        return None

    def _matches(self, candidates: tuple[str, ...], origin: str, changed: bool) -> list[tuple[str, ...]]:
        """What `_match` finds for the names that mean any photo."""
        found = [self._match(candidate, origin, changed) for candidate in candidates]
        return [photos for photos in found if photos]

    def _match(self, candidate: str, origin: str, changed: bool) -> tuple[str, ...]:
        """Photos that a name may mean; the folder of the file that it stands in may decide."""
        place = photo_name(Path(origin), self.folder)
        if candidate == origin:
            return self.names.match_file(place, self.folder, changed)
        found = self.names.match(candidate, changed)
        folder = place.rpartition("/")[0]
        return self.names.match(f"{folder}/{candidate}", changed) if len(found) > 1 and folder else found

    def size(
        self, name: str, stated: tuple[Any, Any] | None, origin: str, own: int = 1
    ) -> tuple[tuple[int, int], int] | None:
        """(width, height) px of the mask of a photo: as stated if that fits the photo, that of the photo as
        shown if nothing is stated; and the orientation by which it is turned into the frame of the photo as
        stored.

        own: EXIF orientation of the mask
        """
        photo = self._photo_sizes[name]
        orientation = 1 if self._photos is None else read_orientation(self._photos / name)
        if stated is None:
            return turned_size(photo, orientation), inverse(orientation)
        width, height = whole_number_of(stated[0]), whole_number_of(stated[1])
        if width is None or height is None or min(width, height) < 1:
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
                text
                + (f" ({self._counts[kind]} times)" if self._counts[kind] > 1 else "")
                + self._advice.get(kind, "")
                for kind, text in self._mismatches.items()
            ]
            raise InputError(f"cannot import {source}: " + "; ".join(texts))
        if self._left_out and self.names.pattern is not None:
            logger.warning(
                "%s: %d files do not fit --name-pattern %r and are left out, such as %s",
                source,
                len(self._left_out),
                self.names.pattern.text,
                self._left_out[0].name,
            )
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
