"""What a point's color means: the photos, its class, its confidence, the way its label came about, or how
much the photos disagree about it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import cv2
import numpy as np

from sc3d.errors import InputError
from sc3d.scene.class_table import OTHER, ClassTable
from sc3d.scene.labelled_cloud import read_votes

if TYPE_CHECKING:
    import open3d as o3d

Coloring = Literal["photo", "label", "confidence", "state", "disagreement"]
COLORINGS: tuple[Coloring, ...] = get_args(Coloring)


class State(NamedTuple):
    """One value of the `state` attribute. color: RGB uint8."""

    name: str
    color: tuple[int, int, int]


STATES = (  # by value of `state`; colors apart for the color-blind too (Okabe and Ito)
    State("unseen", (138, 138, 138)),
    State("seed", (0, 158, 115)),
    State("locked", (213, 94, 0)),
    State("propagated", (86, 180, 233)),
    State("unlocked by reprojection", (204, 121, 167)),
    State("corrected by hand", (240, 228, 66)),
)

CONTESTED = 0.5  # disagreement from which on the color stays the same: no class has a majority there
_AGREED_TO_CONTESTED = ((222, 226, 230), (244, 165, 60), (165, 15, 60))
_LIGHT, _AMBIENT = (-0.5, 0.5, 0.7071), 0.45
_ATTRIBUTES = {
    "photo": "colors",
    "label": "label",
    "confidence": "confidence",
    "state": "state",
    "disagreement": "votes_1",
}
_MAKERS = {
    "photo": "the cloud has no photo colors: `sc3d extract SCENE` makes them",
    "label": "the cloud has no labels: run `sc3d label SCENE` and `sc3d propagate SCENE`, or look at it with --by photo",
    "confidence": "the cloud has no confidence: run `sc3d label SCENE` and `sc3d propagate SCENE`",
    "state": "the cloud has no label states: run `sc3d label SCENE` and `sc3d propagate SCENE`",
    "disagreement": "the cloud has no votes: run `sc3d label SCENE`, which leaves them in seeds.ply, and pass no other --file",
}


def color_points(
    cloud: o3d.t.geometry.PointCloud, by: Coloring, class_table: ClassTable | None = None
) -> np.ndarray:
    """Colors that show one attribute of a cloud, or of the vertices of a mesh.

    by: "photo" (colors), "label" (class colors), "confidence" (viridis, 0 dark to 1 bright), "state" (see
        STATES) or "disagreement" (of the votes)
    class_table: needed for "label"
    returns: (N, 3) uint8 RGB
    Raises InputError that names the stage if the attribute is missing.
    """
    if by not in COLORINGS:
        raise InputError(f"unknown coloring {by!r}: choose one of {', '.join(COLORINGS)}")
    if not can_color(cloud, by):
        raise InputError(_MAKERS[by])
    if by == "disagreement":
        votes = read_votes(cloud)
        if votes is None:  # those of some class are missing
            raise InputError(_MAKERS[by])
        return disagreement_colors(disagreement(votes.values))
    values = _attributes(cloud)[_ATTRIBUTES[by]].cpu().numpy()
    if by == "photo":
        return as_uint8(values)
    if by == "confidence":
        return confidence_colors(values)
    if by == "state":
        palette = np.array(
            [STATES[value if value < len(STATES) else 0].color for value in range(256)], np.uint8
        )
    elif class_table is None:
        raise InputError("class colors need the class table (classes.json)")
    else:
        palette = class_table.palette
    return palette[values.reshape(-1).astype(np.uint8)]


def can_color(cloud: o3d.t.geometry.PointCloud, by: Coloring) -> bool:
    """Whether a cloud, or a mesh, has the attribute that a coloring shows."""
    return _ATTRIBUTES[by] in _attributes(cloud)


def _attributes(
    geometry: o3d.t.geometry.PointCloud | o3d.t.geometry.TriangleMesh,
) -> o3d.t.geometry.TensorMap:
    return geometry.point if hasattr(geometry, "point") else geometry.vertex


def disagreement(votes: np.ndarray) -> np.ndarray:
    """Share of the votes that the winning class did not get.

    votes: (N, C + 1) values as `labelled_cloud.read_votes` gives them; column 0 counts views and does not vote
    returns: (N,) float32, 0 = all agree, at most 1 - 1 / classes; NaN where nothing voted
    """
    cast = votes[:, 1:]
    total = cast.sum(axis=1, dtype=np.float64)
    best = cast.max(axis=1, initial=0.0)
    return np.where(total > 0, 1 - best / np.where(total > 0, total, 1), np.nan).astype(np.float32)


def disagreement_colors(values: np.ndarray) -> np.ndarray:
    """(N, 3) uint8 RGB of (N,) disagreements: light gray where all agree, over orange to dark red from
    CONTESTED on; gray like unseen points where NaN.
    """
    stops = np.linspace(0, CONTESTED, len(_AGREED_TO_CONTESTED))
    known = np.nan_to_num(np.asarray(values, np.float64))
    colors = np.stack(
        [np.interp(known, stops, channel) for channel in np.transpose(_AGREED_TO_CONTESTED)], axis=-1
    )
    return np.where(np.isnan(values)[..., None], STATES[0].color, np.round(colors)).astype(np.uint8)


def confidence_colors(confidence: np.ndarray) -> np.ndarray:
    """(N, 3) uint8 RGB, viridis, of (N,) or (N, 1) confidences from 0 to 1; not finite counts as 0."""
    values = np.nan_to_num(np.asarray(confidence, np.float64).reshape(-1), nan=0.0, posinf=0.0, neginf=0.0)
    levels = np.round(np.clip(values, 0.0, 1.0) * 255).astype(np.uint8)
    viridis = cv2.applyColorMap(np.arange(256, dtype=np.uint8).reshape(-1, 1), cv2.COLORMAP_VIRIDIS).reshape(
        256, 3
    )[:, ::-1]
    return viridis[levels]


def legend_entries(
    by: Coloring, class_table: ClassTable | None, present: set[int] | None = None
) -> list[tuple[str, tuple[int, int, int]]]:
    """Names and RGB colors that explain a coloring; empty for photo colors and for confidence and
    disagreement, which have a scale.

    present: ids that occur; None = list all classes or states
    """
    if by == "state":
        return [
            (state.name, state.color)
            for value, state in enumerate(STATES)
            if present is None or value in present
        ]
    if by != "label" or class_table is None:
        return []
    entries = [(entry.name, entry.color) for entry in class_table if present is None or entry.id in present]
    if present is None or 0 in present:
        red, green, blue = class_table.palette[0].tolist()
        entries.append(("unlabelled", (red, green, blue)))
    if present is not None and OTHER in present and class_table.leaves_other:
        red, green, blue = class_table.palette[OTHER].tolist()
        entries.append((class_table.name(OTHER), (red, green, blue)))
    return entries


class ColorScale(NamedTuple):
    """A coloring by a number. low, high: what its ends mean; colors: (256, 3) uint8 RGB from low to high."""

    low: str
    high: str
    colors: np.ndarray


def color_scale(by: Coloring) -> ColorScale | None:
    """The scale of a coloring by a number; None for the others."""
    steps = np.linspace(0, 1, 256)
    if by == "confidence":
        return ColorScale("confidence 0", "1", confidence_colors(steps))
    if by == "disagreement":
        return ColorScale("all photos agree", "half or more disagree", disagreement_colors(CONTESTED * steps))
    return None


def shaded(colors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Colors in light from the north-west and above, as maps shade hills, so that shapes show where a whole
    class has one color.

    colors: (N, 3) uint8 RGB; normals: (N, 3) towards the outside; returns: (N, 3) uint8 RGB, the given
        colors on level ground
    """
    lengths = np.linalg.norm(normals, axis=1)
    cosine = normals @ np.array(_LIGHT, np.float32) / np.where(lengths > 0, lengths, 1)
    light = np.where(lengths > 0, _AMBIENT + (1 - _AMBIENT) * np.clip(cosine, 0, 1) / _LIGHT[2], 1)
    return np.round(np.clip(colors * light[:, None], 0, 255)).astype(np.uint8)


def as_uint8(colors: np.ndarray) -> np.ndarray:
    """(N, 3) uint8 of colors that may be floats from 0 to 1."""
    if colors.dtype == np.uint8:
        return colors
    return np.round(np.clip(np.nan_to_num(colors), 0.0, 1.0) * 255).astype(np.uint8)
