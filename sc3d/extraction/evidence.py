"""What is known of the depth of every view before it is fused, kept on disk: views are many, memory is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sc3d.geometry.cameras import View

Rows = Callable[[int], np.ndarray]


@dataclass(frozen=True)
class DepthViews:
    """The views whose depth is fused.

    views: pinhole; image: index to (H, W, 3) uint8 RGB of the view's size
    neighbors: per view, rows of views that see the same surface, best first
    depth_range: nearest and farthest depth, world units
    opaque: index to (H, W) bool pixels whose depth counts, None = all
    """

    views: list[View]
    image: Rows
    neighbors: list[np.ndarray]
    depth_range: tuple[float, float]
    opaque: Callable[[int], np.ndarray | None] = lambda row: None


@dataclass(frozen=True)
class ViewEvidence:
    """Of one view, all (H, W) if nothing else is said.

    confirmed: float32 depth that other views confirm, 0 = none
    continued: float32 depth that nobody confirms, but that continues confirmed surface, 0 = none
    normals: (H, W, 3) int8, 127 times the unit normals there, camera frame, towards the camera
    sky: bool, no surface at any depth
    """

    confirmed: np.ndarray
    continued: np.ndarray
    normals: np.ndarray
    sky: np.ndarray


class EvidenceStore:
    """`ViewEvidence` of all views in a folder, and what the confirmed surface looks like from each."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def write(self, row: int, evidence: ViewEvidence) -> None:
        for name, values in vars(evidence).items():
            self.save(row, name, values)

    def save(self, row: int, name: str, values: np.ndarray) -> None:
        np.save(self.folder / f"{row}-{name}.npy", values)

    def read(self, row: int, name: str) -> np.ndarray:
        return np.load(self.folder / f"{row}-{name}.npy")

    def has(self, row: int, name: str) -> bool:
        return (self.folder / f"{row}-{name}.npy").exists()
