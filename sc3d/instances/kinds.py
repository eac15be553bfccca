"""What is counted, by the class table: buildings by their roofs, trees by their crowns, all else by its
parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sc3d.scene.class_table import BUILDING, ClassTable

NOISE = (7, 18)  # ASPRS codes


@dataclass(frozen=True)
class Kind:
    """Classes whose points make up objects of one kind. ids: of the classes; how: what tells its objects
    apart
    """

    ids: tuple[int, ...]
    how: Literal["roofs", "crowns", "parts"]


def countable_kinds(table: ClassTable) -> list[Kind]:
    """The kinds of the countable classes that points can be of: buildings, trees, then every other class by
    itself.
    """
    counted = [entry for entry in table if entry.surface and table.is_countable(entry)]
    trees = table.tree_codes
    roofs = tuple(entry.id for entry in counted if entry.asprs == BUILDING)
    crowns = tuple(entry.id for entry in counted if entry.asprs in trees)
    found = [Kind(roofs, "roofs"), Kind(crowns, "crowns")]
    found += [Kind((entry.id,), "parts") for entry in counted if entry.id not in roofs + crowns]
    return [kind for kind in found if kind.ids]


def ground_ids(table: ClassTable, counts: np.ndarray) -> list[int]:
    """Ids of the classes that the ground shows: by their ASPRS codes or, where no point is of these, whatever
    is neither building, tree nor noise. counts: (256,) points of each id; empty if there are none.
    """
    present = [label for label in table.ground_classes if counts[label]]
    stands = {BUILDING, *table.tree_codes, *NOISE}
    rest = [entry.id for entry in table if entry.asprs not in stands and counts[entry.id]]
    return present or [label for label in rest if not table.is_countable(table.entry(label))]
