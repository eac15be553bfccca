"""From the ids, names and colors that other programs use to the classes of the scene."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.json_files import read_json, whole_number_of
from sc3d.scene.class_table import ClassTable
from sc3d.scene.mask_values import BLACK, UNKNOWN, Meanings, color_code, meanings_of

MAX_IDS = 1 << 16  # of PNGs with one id per pixel
UNLABELLED = ("ignore", "unlabelled", "unlabeled")


@dataclass(frozen=True)
class ClassMapping:
    """The class table of a scene, with what stands for its classes elsewhere.

    mapping: class id by id, name or color in the files, 0 = unlabelled; None without --mapping
    origin: the mapping's file, for messages
    """

    table: ClassTable
    mapping: dict[str, int] | None = None
    origin: Path | None = None

    @property
    def names(self) -> str:
        """The names in the table, for messages."""
        return ", ".join(entry.name for entry in self.table)

    def find(self, keys: tuple[str, ...]) -> int | None:
        """Class id for the first key that the mapping has, or else for a name in the table; of both also in
        another letter case, where that is clear. None if there is none.
        """
        mapping = self.mapping or {}
        for key in keys:
            if key in mapping:
                return mapping[key]
        if any(entry.name == keys[0].strip() for entry in self.table):
            return self.table.find(keys[0])
        for key in keys:
            alike = self._folded.get(key.strip().casefold(), set())
            if len(alike) == 1:
                return next(iter(alike))
        return self.table.find(keys[0])

    @cached_property
    def _folded(self) -> dict[str, set[int]]:
        """Class ids by the keys of the mapping in lower case."""
        found = defaultdict[str, set[int]](set)
        for key, class_id in (self.mapping or {}).items():
            found[key.casefold()].add(class_id)
        return found

    @cached_property
    def meanings(self) -> Meanings:
        """What the values and colors of PNGs may stand for. A mapping replaces the numbering and the colors of the
        table; InputError if one of its keys is neither an id nor a color, or a color stands for two classes.
        """
        if self.mapping is None:
            return meanings_of(self.table)
        ids, colors = dict[int, int](), {BLACK: 0}
        for key, class_id in self.mapping.items():
            if re.fullmatch(r"[0-9]{1,5}", key) and int(key) < MAX_IDS:
                ids[int(key)] = class_id
                continue
            code = color_code(self._color(key))
            if colors.get(code, class_id) not in (class_id, 0):
                raise InputError(
                    f"{self.origin}: {key!r} has the color of another class: colors cannot tell them apart"
                )
            colors[code] = class_id
        by_id = np.full(MAX_IDS, UNKNOWN, np.int16)
        if ids:
            by_id[[0, *ids]] = [ids.get(0, 0), *ids.values()]
        return Meanings(by_id, colors if len(ids) < len(self.mapping) else {})

    def _color(self, key: str) -> tuple[int, int, int]:
        code = re.fullmatch(r"#([0-9a-fA-F]{6})", key)
        if code:
            red, green, blue = bytes.fromhex(code[1])
            return red, green, blue
        values = re.fullmatch(r"[\[(]?\s*([0-9]{1,3})\s*,\s*([0-9]{1,3})\s*,\s*([0-9]{1,3})\s*[\])]?", key)
        if not values or max(map(int, values.groups())) > 255:
            raise InputError(
                f"{self.origin}: {key!r} is no id and no color: PNGs need whole numbers from 0 to {MAX_IDS - 1}, "
                'or colors such as "#d63c3c" or "[214, 60, 60]"'
            )
        red, green, blue = map(int, values.groups())
        return red, green, blue


def read_mapping(mapping: Path | None, table: ClassTable) -> ClassMapping:
    """The table with the mapping of a JSON file, if there is one.

    The file holds an object: keys are ids ("7"), names ("wall") or colors ("#d63c3c", "[214, 60, 60]") of
    the masks; values are names or ids of the table, or null or "ignore" for unlabelled. Raises InputError for
    anything else.
    """
    if mapping is None:
        return ClassMapping(table)
    content = read_json(mapping)
    if not isinstance(content, dict) or not content:
        raise InputError(
            f'{mapping} must hold an object such as {{"wall": "building", "7": "road", "#00ff00": "tree", "sky": null}}'
        )
    return ClassMapping(
        table, {key.strip(): _class_id(key, value, table, mapping) for key, value in content.items()}, mapping
    )


def _class_id(key: str, value: object, table: ClassTable, origin: Path) -> int:
    found = 0 if value is None else whole_number_of(value)
    if isinstance(value, str):
        found = named if (named := table.find(value)) is not None else found
        found = 0 if found is None and value.strip().casefold() in UNLABELLED else found
    if found is None or found not in {0, *(entry.id for entry in table)}:
        names = ", ".join(entry.name for entry in table)
        raise InputError(
            f"{origin}: {key!r} stands for {value!r}, which is no class: write one of {names}, or null for unlabelled"
        )
    return found
