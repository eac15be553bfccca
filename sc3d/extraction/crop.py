"""Surface that few photos see is left out: the border of a flight, where each photo looks farther than the next."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from sc3d.errors import Sc3dError
from sc3d.extraction.evidence import DepthViews, EvidenceStore
from sc3d.geometry.raycast import Surface, first_surface, see_points
from sc3d.geometry.tsdf import Part
from sc3d.io.progress import progress

POINTS = 1 << 20  # looked at a time: bounds memory, not results


def cropped(
    part: Part, surface: Surface, data: DepthViews, store: EvidenceStore, voxel_size: float, min_photos: int
) -> tuple[Part, float]:
    """The triangles and points that at least `min_photos` views see (`count_views`), a triangle by its middle;
    share of the mesh's area that is left out.

    part: mesh and cloud in the views' world; surface: the mesh, which hides what lies behind it
    Raises Sc3dError where nothing is left.
    """
    mesh, cloud = part
    corners = mesh.vertex.positions.numpy()[mesh.triangle.indices.numpy()].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(across, axis=1)
    points = np.concatenate([corners.mean(axis=1), cloud.point.positions.numpy()])
    normals = np.concatenate([across / np.maximum(areas, 1e-30)[:, None], cloud.point.normals.numpy()])
    kept = count_views(data, store, surface, points, normals, voxel_size) >= min_photos
    triangles, rows = np.split(kept, [len(areas)])
    if not (triangles.any() and rows.any()):
        raise Sc3dError(f"no surface is seen by {min_photos} photos at once: lower --crop")
    smaller = (
        mesh.select_faces_by_mask(o3d.core.Tensor(triangles)),
        cloud.select_by_mask(o3d.core.Tensor(rows)),
    )
    return smaller, float(areas[~triangles].sum() / areas.sum())


def count_views(
    data: DepthViews,
    store: EvidenceStore,
    surface: Surface,
    points: np.ndarray,
    normals: np.ndarray,
    voxel_size: float,
) -> np.ndarray:
    """(N,) int32 views that see each point: as `see_points` has it, at a pixel that is opaque and no sky.

    points, normals: (N, 3) in the views' world; surface: what hides points
    """
    counts = np.zeros(len(points), np.int32)
    for row, view in enumerate(progress(data.views, "cropping", "view")):
        first, shows, opaque = first_surface(surface, view), ~store.read(row, "sky"), data.opaque(row)
        if opaque is not None:
            shows &= opaque
        for start in range(0, len(points), POINTS):
            part = slice(start, start + POINTS)
            seen = see_points(view, points[part], normals[part], first, voxel_size)
            counts[part][seen.points[shows[seen.rows, seen.columns]]] += 1
    return counts
