"""What a point's colour means: the photos, its class, its confidence or the way its label came about."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import cv2
import numpy as np

from sc3d.classes import ClassTable
from sc3d.errors import InputError

if TYPE_CHECKING:
    import open3d as o3d

Colouring = Literal["photo", "label", "confidence", "state"]
COLOURINGS: tuple[str, ...] = get_args(Colouring)


class State(NamedTuple):
    """One value of the `state` attribute. color: RGB uint8."""

    name: str
    color: tuple[int, int, int]


STATES = (  # by value of `state`; colours apart for the colour-blind too (Okabe and Ito)
    State("unseen", (138, 138, 138)),
    State("seed", (0, 158, 115)),
    State("locked", (213, 94, 0)),
    State("propagated", (86, 180, 233)),
    State("unlocked by reprojection", (204, 121, 167)),
)

_ATTRIBUTES = {"photo": "colors", "label": "label", "confidence": "confidence", "state": "state"}
_MAKERS = {
    "photo": "the cloud has no photo colours: `sc3d extract SCENE` makes them",
    "label": "the cloud has no labels: run `sc3d label SCENE` and `sc3d propagate SCENE`",
    "confidence": "the cloud has no confidence: run `sc3d label SCENE` and `sc3d propagate SCENE`",
    "state": "the cloud has no label states: run `sc3d label SCENE` and `sc3d propagate SCENE`",
}


def color_points(cloud: o3d.t.geometry.PointCloud, by: Colouring, class_table: ClassTable | None = None) -> np.ndarray:
    """Colours that show one attribute of a cloud, or of the vertices of a mesh.

    by: "photo" (colors), "label" (class colours), "confidence" (viridis, 0 dark to 1 bright) or "state" (see STATES)
    class_table: needed for "label"
    returns: (N, 3) uint8 RGB
    Raises InputError that names the stage if the attribute is missing.
    """
    if by not in COLOURINGS:
        raise InputError(f"unknown colouring {by!r}: choose one of {', '.join(COLOURINGS)}")
    attributes = cloud.point if hasattr(cloud, "point") else cloud.vertex
    if _ATTRIBUTES[by] not in attributes:
        raise InputError(_MAKERS[by])
    values = attributes[_ATTRIBUTES[by]].cpu().numpy()
    if by == "photo":
        return as_uint8(values)
    if by == "confidence":
        return confidence_colors(values)
    if by == "state":
        palette = np.array([STATES[value if value < len(STATES) else 0].color for value in range(256)], np.uint8)
    elif class_table is None:
        raise InputError("class colours need the class table (classes.json)")
    else:
        palette = class_table.palette
    return palette[values.reshape(-1).astype(np.uint8)]


def confidence_colors(confidence: np.ndarray) -> np.ndarray:
    """(N, 3) uint8 RGB, viridis, of (N,) or (N, 1) confidences from 0 to 1; not finite counts as 0."""
    values = np.nan_to_num(np.asarray(confidence, np.float64).reshape(-1), nan=0.0, posinf=0.0, neginf=0.0)
    levels = np.round(np.clip(values, 0.0, 1.0) * 255).astype(np.uint8)
    viridis = cv2.applyColorMap(np.arange(256, dtype=np.uint8).reshape(-1, 1), cv2.COLORMAP_VIRIDIS).reshape(256, 3)[:, ::-1]
    return viridis[levels]


def legend_entries(by: Colouring, class_table: ClassTable | None, present: set[int] | None = None) -> list[tuple[str, tuple[int, int, int]]]:
    """Names and RGB colours that explain a colouring; empty for photo colours and confidence (a colour bar).

    present: ids that occur; None = list all classes or states
    """
    if by == "state":
        return [(state.name, state.color) for value, state in enumerate(STATES) if present is None or value in present]
    if by != "label" or class_table is None:
        return []
    entries = [(entry.name, entry.color) for entry in class_table if present is None or entry.id in present]
    unlabelled = [("unlabelled", tuple(int(value) for value in class_table.palette[0]))]
    return entries + (unlabelled if present is None or 0 in present else [])


def as_uint8(colors: np.ndarray) -> np.ndarray:
    """(N, 3) uint8 of colours that may be floats from 0 to 1."""
    if colors.dtype == np.uint8:
        return colors
    return np.round(np.clip(np.nan_to_num(colors), 0.0, 1.0) * 255).astype(np.uint8)
