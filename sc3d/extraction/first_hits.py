"""How far each view looks until it meets surface, while surface is added: what is new is cast apart, and
the nearer of both stays, so that nothing is built or met twice.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sc3d.extraction.evidence import DepthViews, EvidenceStore
from sc3d.geometry.raycast import Surface, first_surface
from sc3d.geometry.tsdf import Part


class FirstHits:
    """Depth of the first surface of all views; the store holds "hit" of what was there before."""

    def __init__(self, data: DepthViews, store: EvidenceStore) -> None:
        self._data, self._store = data, store
        self._added, self._met = list[Surface](), [0] * len(data.views)

    def add(self, parts: Sequence[Part]) -> None:
        """More surface, in the views' world."""
        if any(len(mesh.triangle.indices) for mesh, _ in parts):
            self._added.append(surface_of(parts))

    def depth(self, row: int) -> np.ndarray:
        """(H, W) float32 z of what a view meets first, world units; inf = nothing."""
        depth = self._store.read(row, "hit")
        for surface in self._added[self._met[row] :]:
            np.minimum(depth, first_surface(surface, self._data.views[row]).depth, depth)
        if self._met[row] < len(self._added):
            self._store.save(row, "hit", depth)
            self._met[row] = len(self._added)
        return depth


def surface_of(parts: Sequence[Part]) -> Surface:
    """The meshes of some parts together."""
    meshes = [(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()) for mesh, _ in parts]
    return Surface.from_meshes([mesh for mesh in meshes if len(mesh[1])], np.zeros(3))
