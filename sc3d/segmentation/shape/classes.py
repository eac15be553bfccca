"""Which classes of a scene the shapes stand for; a table to start from where a scene has none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sc3d.errors import InputError
from sc3d.scene.class_table import ClassTable, SemanticClass
from sc3d.segmentation.shape.points import BUILDING, GROUND, HIGH_VEGETATION, LOW_VEGETATION, NONE

DEFAULT = ClassTable(
    (
        SemanticClass(1, "ground", (190, 160, 110), ("ground", "road"), 2),
        SemanticClass(2, "low vegetation", (170, 220, 110), ("grass", "lawn"), 3),
        SemanticClass(3, "high vegetation", (40, 150, 60), ("tree", "bush"), 5),
        SemanticClass(4, "building", (214, 60, 60), ("building", "house", "roof"), 6),
    )
)
# by shape: names, the first that a table has counts; else ASPRS codes, likewise
NAMES = {
    GROUND: ("ground", "bare ground", "bare earth", "terrain"),
    LOW_VEGETATION: ("low vegetation", "grass", "lawn"),
    HIGH_VEGETATION: ("high vegetation", "tree", "trees"),
    BUILDING: ("building", "buildings", "house"),
}
CODES = {GROUND: (2, 11), LOW_VEGETATION: (3,), HIGH_VEGETATION: (5, 4), BUILDING: (6,)}


def class_ids(table: ClassTable) -> np.ndarray:
    """(5,) uint8 id of the class of each shape, 0 for `NONE`.

    A shape is the class with its name, else the only one with its ASPRS code. Low vegetation is the ground
    where no class is low vegetation, and the ground is low vegetation where no class is ground.
    Raises InputError that names what stands for nothing, or for several classes.
    """
    ids = np.zeros(5, np.uint8)
    for shape in NAMES:
        ids[shape] = _find(table, shape)
    if not ids[LOW_VEGETATION]:
        ids[LOW_VEGETATION] = ids[GROUND]
    if not ids[GROUND]:
        ids[GROUND] = ids[LOW_VEGETATION]
    missing = [shape for shape in NAMES if not ids[shape]]
    if missing:
        wanted = " and ".join(f"{NAMES[shape][0]} (ASPRS code {CODES[shape][0]})" for shape in missing)
        raise InputError(
            f'--backend geometry finds no class for {wanted} in classes.json: give one that "asprs" code, or '
            "take classes.json out of the scene to begin with ground, low and high vegetation and building"
        )
    ids[NONE] = 0
    return ids


def _find(table: ClassTable, shape: int) -> int:
    """Id of the class of a shape; 0 = none."""
    usable = [entry for entry in table if entry.surface]
    for name in NAMES[shape]:
        named = [entry for entry in usable if entry.name.casefold() == name]
        if len(named) == 1:
            return named[0].id
    for code in CODES[shape]:
        coded = [entry for entry in usable if entry.asprs == code]
        if len(coded) > 1:
            raise InputError(_several(coded, shape, code))
        if coded:
            return coded[0].id
    return 0


def _several(coded: Sequence[SemanticClass], shape: int, code: int) -> str:
    names = " and ".join(entry.name for entry in coded)
    return (
        f"--backend geometry: {names} of classes.json all have the ASPRS code {code}: name one of them "
        f"{NAMES[shape][0]!r}, or give it alone that code"
    )
