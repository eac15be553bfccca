"""Classes that will be weak: masks held against one another where several photos see one sparse point."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sc3d.geometry.cameras import in_image, project
from sc3d.scene.class_table import ClassTable, SemanticClass
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Label

FEW_PHOTOS = 3  # that show a class; with less, errors of a mask are not found
FEW_POINTS = 20  # points of a class: less say nothing of its masks


@dataclass(frozen=True)
class ClassCheck:
    """What masks say of one class.

    photos: how many show it; points: sparse points that most masks give it
    views: median number of masks that say something at such a point; agreement: mean share of them that say
        this class; confused: name of the class that the others say most; None where there are too few points
    """

    name: str
    photos: int
    points: int = 0
    views: float | None = None
    agreement: float | None = None
    confused: str | None = None

    @property
    def weakness(self) -> str:
        """Why the class will be weak; "" if it will not."""
        if not self.photos:
            return "in no mask"
        if self.photos < FEW_PHOTOS:
            return f"in the masks of {self.photos} photos only"
        if self.views is not None and self.views < FEW_PHOTOS:
            return f"seen by {self.views:g} masks at a place, on the median"
        if self.agreement is not None and self.agreement < Label.consensus:
            rest = f", many say {self.confused}" if self.confused else ""
            return f"{self.agreement:.0%} of the masks agree where most say so{rest}"
        return ""


def check_classes(scene: Scene) -> list[ClassCheck]:
    """Each class of a scene with cameras and masks, in the order of the table."""
    table, model = scene.class_table(), scene.model
    files = scene.mask_files(scene.masks, table)
    counts = np.zeros((len(model.points), table.num_ids), np.int32)
    photos = np.zeros(table.num_ids, int)
    for view, track in zip(model.views, model.tracks, strict=True):
        if view.name not in files:
            continue
        mask = scene.read_mask(files[view.name], view.name)
        photos[np.unique(mask)] += 1
        pixels = project(view, model.points[track])[0]
        inside = in_image(view, pixels)
        scale = np.array(mask.shape[::-1]) / (view.width, view.height)
        column, row = (pixels[inside] * scale).astype(int).T
        counts[track[inside], mask[row, column]] += 1
    counts[:, 0] = 0
    return [_check(entry, table, counts, int(photos[entry.id])) for entry in table]


def _check(entry: SemanticClass, table: ClassTable, counts: np.ndarray, photos: int) -> ClassCheck:
    total = counts.sum(axis=1)
    rows = np.flatnonzero((counts.argmax(axis=1) == entry.id) & (total > 0))
    if len(rows) < FEW_POINTS:
        return ClassCheck(entry.name, photos, len(rows))
    several = rows[total[rows] > 1]
    others = counts[several].sum(axis=0)
    others[entry.id] = 0
    return ClassCheck(
        entry.name,
        photos,
        len(rows),
        float(np.median(total[rows])),
        float(np.mean(counts[several, entry.id] / total[several])) if len(several) else None,
        table.name(int(others.argmax())) if others.any() else None,
    )


def masks_to_check(scene: Scene) -> bool:
    """Whether a scene has what `check_classes` needs."""
    needed: tuple[Path, ...] = (scene.sparse, scene.masks, scene.classes)
    return all(path.exists() for path in needed)
