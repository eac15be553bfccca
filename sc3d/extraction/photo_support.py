"""Which of the surface the photos bear out. Renderings of Gaussians agree with one another wherever the
Gaussians are, so where stereo confirms nothing, photos that do not correlate speak against them.
"""

from __future__ import annotations

import numpy as np

from sc3d.extraction.evidence import DepthViews, EvidenceStore
from sc3d.geometry.raycast import Surface
from sc3d.geometry.tsdf import Part
from sc3d.geometry.voxels import voxel_keys, voxel_origin
from sc3d.io.progress import progress

CELL = 4.0  # voxels: triangles are smaller than pixels, so those of a cell are judged together
ENOUGH = 0.1  # of the pixels that see a cell
NEAR = 0.01  # of the depth


def find_supported(
    part: Part, data: DepthViews, store: EvidenceStore, voxel_size: float
) -> tuple[np.ndarray, np.ndarray]:
    """(T,) bool triangles and (N,) bool points that lie in supported cells: such as have, of all pixels that
    see them, a share of ENOUGH whose depth there is `supported` by the photos. Everything, where the store
    does not tell.

    part: mesh of T triangles and cloud of N points in the views' world
    """
    vertices, triangles = part[0].vertex.positions.numpy(), part[0].triangle.indices.numpy()
    points = part[1].point.positions.numpy()
    if not store.has(0, "supported"):
        return np.ones(len(triangles), bool), np.ones(len(points), bool)
    size = CELL * voxel_size
    origin = voxel_origin(vertices.min(axis=0), size)
    of_triangle = voxel_keys(vertices[triangles].mean(axis=1), origin, size)
    cells, row = np.unique(of_triangle, return_inverse=True)
    seen, supported = _count(Surface.from_mesh(vertices, triangles, np.zeros(3)), len(triangles), data, store)
    seen, supported = np.bincount(row, seen), np.bincount(row, supported)
    good = (seen > 0) & (supported >= ENOUGH * seen)
    of_point = voxel_keys(points, origin, size)
    place = np.minimum(np.searchsorted(cells, of_point), len(cells) - 1)
    return good[row], good[place] & (cells[place] == of_point)


def _count(
    surface: Surface, num_triangles: int, data: DepthViews, store: EvidenceStore
) -> tuple[np.ndarray, np.ndarray]:
    """(T,) pixels of all views that see each triangle first, and those of them whose supported depth it is."""
    seen, supported = np.zeros(num_triangles), np.zeros(num_triangles)
    for row, view in enumerate(progress(data.views, "comparing with the photos", "view")):
        triangles, _, first = surface.triangles(view)
        hit = triangles >= 0
        depth, known = first[hit], store.read(row, "supported")[hit]
        near = np.abs(known - depth) < NEAR * depth
        seen += np.bincount(triangles[hit], minlength=num_triangles)
        supported += np.bincount(triangles[hit][near], minlength=num_triangles)
    return seen, supported
