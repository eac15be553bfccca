"""In which frame positions were written down: by the poses of two cameras, from which the way into the
present frame follows after the scene was moved, turned or scaled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sc3d.geometry.cameras import View

SAME = 1e-7  # rotation and scale that are none; 10 times as much for shifts, in distances of the two cameras

Reference = Mapping[str, np.ndarray]  # (3, 4) cam_from_world by the name of the photo; none = not known


def reference_of(views: Sequence[View]) -> dict[str, np.ndarray]:
    """The first camera by name, and the one that is farthest from it, with its pose; empty without views."""
    if not views:
        return {}
    first = min(views, key=lambda view: view.name)
    last = max(views, key=lambda view: (float(np.linalg.norm(view.center - first.center)), view.name))
    return {view.name: view.cam_from_world[:3] for view in (first, last)}


@dataclass(frozen=True)
class Move:
    """From the present frame into that of a reference: x -> scale * rotation @ (x - now) + then.

    rotation: (3, 3); now, then: (3,) center of the first camera in the present frame and in the reference's
    error: by how much the second camera misses its place then, as a share of the distance of the two
    """

    scale: float
    rotation: np.ndarray
    now: np.ndarray
    then: np.ndarray
    error: float = 0.0

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) float64 of the present frame in that of the reference."""
        return self.scale * (points - self.now) @ self.rotation.T + self.then


def move_into(reference: Reference, views: Sequence[View]) -> Move | None:
    """The way from the frame of the views into that of a reference; None where both are the same.

    Raises KeyError if none of the reference's photos has a camera now.
    """
    if not reference:
        return None
    poses = {view.name: view.cam_from_world[:3] for view in views}
    names = [name for name in reference if name in poses]
    first, last = names[0] if names else next(iter(reference)), names[-1] if names else ""
    then, now = reference[first], poses[first]
    centers = [[_center(part[name]) for name in (first, last)] for part in (reference, poses)]
    apart = [float(np.linalg.norm(pair[1] - pair[0])) for pair in centers]
    scale = apart[0] / apart[1] if min(apart) > 0 else 1.0
    move = Move(scale, then[:, :3].T @ now[:, :3], centers[1][0], centers[0][0])
    missed = np.linalg.norm(move(centers[1][1][None])[0] - centers[0][1]) / (apart[0] or 1.0)
    turned = np.abs(move.rotation - np.eye(3)).max()
    shifted = np.linalg.norm(move.now - move.then) / (apart[0] or 1.0)
    if max(turned, abs(scale - 1), missed / 10, shifted / 10) < SAME:
        return None
    return Move(scale, move.rotation, move.now, move.then, float(missed))


def _center(pose: np.ndarray) -> np.ndarray:
    return -pose[:, :3].T @ pose[:, 3]
