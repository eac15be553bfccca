"""The class table: which uint8 id means what, and how it is shown, prompted and exported."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeGuard

import numpy as np

from sc3d.errors import InputError
from sc3d.io.json_files import read_json, whole_number
from sc3d.scene.channels import Channels

# in names: they would act on terminals, or cannot be written
CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
MAX_NAME, MAX_BYTES = 200, 1 << 20
EXAMPLE = '{"id": 1, "name": "building", "color": [214, 60, 60]}'
MAKE_CLASSES = (
    f"pass --classes FILE to `sc3d run`, or write there [{EXAMPLE}, ...], with a line for each class"
)
# in truth masks, unless a class has one of these ids: looked at and none of the classes; not to be judged
OTHER, UNJUDGED = 254, 255
# ASPRS codes of vegetation, of buildings, and of ground, low vegetation, water, rail, road
LOW, MEDIUM, HIGH, BUILDING = 3, 4, 5, 6
GROUND_CODES = (2, LOW, 9, 10, 11)
ON_GROUND, STANDING = 0, 1
VEHICLES = ("car", "cars", "vehicle", "vehicles")  # names of what LAS has no code for


@dataclass(frozen=True)
class SemanticClass:
    """One class. id: 1 to 255 (0 is reserved: unlabelled); color: RGB uint8; prompts: texts for segmenters;
    asprs: LAS class code; surface: False for what masks may show and no point can be, such as the sky;
    rest: mask pixels without a class are of this one; countable: whether its objects are told apart, None =
    as `ClassTable.is_countable` has it.
    """

    id: int
    name: str
    color: tuple[int, int, int]
    prompts: tuple[str, ...] = ()
    asprs: int = 1
    surface: bool = True
    rest: bool = False
    countable: bool | None = None


@dataclass(frozen=True)
class ClassTable:
    """The classes of a scene, ordered by id."""

    classes: tuple[SemanticClass, ...]

    def __iter__(self) -> Iterator[SemanticClass]:
        return iter(self.classes)

    def __len__(self) -> int:
        return len(self.classes)

    @property
    def num_ids(self) -> int:
        """Largest id + 1: the length of arrays indexed by id."""
        return self.classes[-1].id + 1

    @property
    def leaves_other(self) -> bool:
        """Whether truth masks may hold `OTHER` and `UNJUDGED`: no class has one of these ids."""
        return self.num_ids <= OTHER

    @property
    def channels(self) -> Channels:
        """Of votes for these classes, as far as a point can be of them."""
        return Channels.of_classes([entry.id for entry in self.classes if entry.surface])

    @property
    def without_surface(self) -> tuple[SemanticClass, ...]:
        """The classes that no point can be of."""
        return tuple(entry for entry in self.classes if not entry.surface)

    def shows_no_surface(self, labels: np.ndarray) -> np.ndarray:
        """Bool, of the shape of `labels` (uint8 ids): of a class without surface."""
        return np.isin(labels, [entry.id for entry in self.without_surface])

    def levels(self, channels: Channels) -> np.ndarray | None:
        """(C,) int of the labels 1..C of votes: ON_GROUND, STANDING, or -1 where the ASPRS code does not say; None
        unless there are classes of both.
        """
        standing = self.tree_codes | {BUILDING}
        levels = dict.fromkeys(GROUND_CODES, ON_GROUND) | dict.fromkeys(standing, STANDING)
        codes = {entry.id: entry.asprs for entry in self.classes}
        found = [levels.get(codes.get(label, 0), -1) for label in channels.ids[1:].tolist()]
        return np.array(found + [-1] * channels.none) if {ON_GROUND, STANDING} <= set(found) else None

    @property
    def tree_codes(self) -> set[int]:
        """ASPRS codes of trees: medium and high vegetation; low if no class has those."""
        return {MEDIUM, HIGH} if {MEDIUM, HIGH} & {entry.asprs for entry in self.classes} else {LOW}

    @property
    def ground_classes(self) -> list[int]:
        """Ids of the classes that lie on the ground, by their ASPRS codes."""
        wanted = set(GROUND_CODES) - self.tree_codes
        return [entry.id for entry in self.classes if entry.asprs in wanted]

    @property
    def rest(self) -> SemanticClass | None:
        """The class of mask pixels that have none."""
        return next((entry for entry in self.classes if entry.rest), None)

    @property
    def palette(self) -> np.ndarray:
        """(256, 3) uint8 RGB per id; unlabelled is dark gray, other of truth masks a lighter one."""
        palette = np.zeros((256, 3), np.uint8)
        palette[0], palette[OTHER] = 60, 105
        for entry in self.classes:
            palette[entry.id] = entry.color
        return palette

    def name(self, label: int) -> str:
        """Name of an id; "unlabelled" for 0, "other" for `OTHER` of truth."""
        rest = {0: "unlabelled"} | ({OTHER: "other"} if self.leaves_other else {})
        return next(
            (entry.name for entry in self.classes if entry.id == label), rest.get(label, f"class {label}")
        )

    def entry(self, label: int) -> SemanticClass:
        """The class of an id that the table has."""
        return next(entry for entry in self.classes if entry.id == label)

    def is_countable(self, entry: SemanticClass) -> bool:
        """Whether objects of a class are told apart: as the table says, else buildings, trees and
        vehicles.
        """
        if entry.countable is not None:
            return entry.countable
        coded = entry.asprs in {BUILDING, *self.tree_codes}
        return entry.surface and (coded or entry.name.casefold() in VEHICLES)

    def find(self, name: str) -> int | None:
        """Id of a class by its name: as it is written, else in any letter case if only one class fits; None if
        none does.
        """
        exact = [entry.id for entry in self.classes if entry.name == name.strip()]
        alike = [entry.id for entry in self.classes if entry.name.casefold() == name.strip().casefold()]
        return exact[0] if exact else alike[0] if len(alike) == 1 else None

    def unknown(self, labels: np.ndarray) -> list[int]:
        """Ids in `labels` (any shape, uint8) that are neither 0 nor in the table."""
        present = np.flatnonzero(np.bincount(np.asarray(labels, np.uint8).ravel(), minlength=256))
        return sorted({int(label) for label in present} - {0} - {entry.id for entry in self.classes})

    def as_json(self) -> list[dict]:
        """The list that `classes.json` holds; `surface` where it is not what the name says, `rest` where it
        is true, `countable` where it is said.
        """
        return [
            {
                key: value
                for key, value in asdict(entry).items()
                if {
                    "surface": value != _usual_surface(entry.name),
                    "rest": value,
                    "countable": value is not None,
                }.get(key, True)
            }
            for entry in self.classes
        ]


def read_classes(path: Path) -> ClassTable:
    """Read `classes.json`; raises InputError that names the faulty entry."""
    if not path.exists():
        raise InputError(f"{path} is missing: {MAKE_CLASSES}")
    entries = read_json(path, MAX_BYTES)
    return parse_classes(entries, path)


def parse_classes(entries: object, origin: Path | str) -> ClassTable:
    """Check a decoded class list; `origin` names its source in errors."""
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{origin} must hold a non-empty list of classes")
    classes = tuple(sorted((_parse_class(entry, origin) for entry in entries), key=lambda entry: entry.id))
    for key in ("id", "name"):
        values = [getattr(entry, key) for entry in classes]
        doubled = sorted({value for value in values if values.count(value) > 1})
        if doubled:
            raise InputError(f"{origin}: {key} {doubled[0]!r} is used twice")
    if not any(entry.surface for entry in classes):
        raise InputError(
            f"{origin}: no class has a surface, so that no point can get a label: add one that has"
        )
    rest = [entry for entry in classes if entry.rest]
    if len(rest) > 1 or any(not entry.surface for entry in rest):
        raise InputError(f"{origin}: one class at most can be the rest, and it needs a surface")
    return ClassTable(classes)


def _parse_class(entry: object, origin: Path | str) -> SemanticClass:
    if not isinstance(entry, dict):
        raise InputError(f"{origin}: every class must be an object like {EXAMPLE}")
    label, name, color = _whole(entry.get("id")), entry.get("name"), _whole_all(entry.get("color"))
    if not _is_int(label, 1, 255):
        raise InputError(
            f"{origin}: class id {label!r} must be a whole number from 1 to 255 (0 means unlabelled)"
        )
    if not isinstance(name, str) or not name.strip():
        raise InputError(f"{origin}: class {label} needs a name")
    if (
        not isinstance(color, list | tuple)
        or len(color) != 3
        or not all(_is_int(value, 0, 255) for value in color)
    ):
        raise InputError(f"{origin}: class {label} needs a color of three numbers from 0 to 255")
    prompts, asprs = entry.get("prompts", [name]), _whole(entry.get("asprs", 1))
    if not isinstance(prompts, list | tuple) or not all(isinstance(prompt, str) for prompt in prompts):
        raise InputError(f"{origin}: prompts of class {label} must be a list of texts")
    if any(CONTROL.search(text) for text in (name, *prompts)) or len(name) > MAX_NAME:
        raise InputError(
            f"{origin}: name or prompts of class {label} hold control characters, or more than {MAX_NAME} letters"
        )
    if not _is_int(asprs, 0, 255):
        raise InputError(f"{origin}: asprs code of class {label} must be a whole number from 0 to 255")
    surface, rest = entry.get("surface", _usual_surface(name)), entry.get("rest", False)
    for key, value in (("surface", surface), ("rest", rest)):
        if not isinstance(value, bool):
            raise InputError(f"{origin}: {key} of class {label} must be true or false")
    countable = entry.get("countable")
    if countable is not None and not (isinstance(countable, bool) and surface >= countable):
        raise InputError(
            f"{origin}: countable of class {label} must be true or false, and false without a surface"
        )
    return SemanticClass(label, name.strip(), tuple(color), tuple(prompts), asprs, surface, rest, countable)


def _usual_surface(name: str) -> bool:
    """Whether a class has a surface where the table does not say so."""
    return name.strip().casefold() != "sky"


def _whole(value: object) -> object:
    """A float without fraction, as tables and statistics programs write ids, as the int that it means."""
    return whole_number(value) if isinstance(value, float) and whole_number(value) is not None else value


def _whole_all(values: object) -> object:
    return [_whole(value) for value in values] if isinstance(values, list | tuple) else values


def _is_int(value: object, low: int, high: int) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high
