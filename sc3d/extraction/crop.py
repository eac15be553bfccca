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
    parts: tuple[Part, Part],
    surface: Surface,
    data: DepthViews,
    store: EvidenceStore,
    voxel_size: float,
    min_photos: int,
) -> tuple[tuple[Part, Part], float]:
    """The triangles and points that at least `min_photos` views see (`count_views`), a triangle by its middle;
    share of the area that is left out.

    parts: mesh and cloud of what is confirmed, and of what is not, in the views' world; surface: of both
        meshes, which hide what lies behind them
    Raises Sc3dError where nothing confirmed is left.
    """
    kept, area, left_out = list[Part](), 0.0, 0.0
    for mesh, cloud in parts:
        corners = mesh.vertex.positions.numpy()[mesh.triangle.indices.numpy()].astype(np.float64)
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(across, axis=1)
        if len(areas):
            points = np.concatenate([corners.mean(axis=1), cloud.point.positions.numpy()])
            normals = np.concatenate(
                [across / np.maximum(areas, 1e-30)[:, None], cloud.point.normals.numpy()]
            )
            enough = count_views(data, store, surface, points, normals, voxel_size) >= min_photos
            triangles, rows = np.split(enough, [len(areas)])
            area, left_out = area + areas.sum(), left_out + areas[~triangles].sum()
            mesh = mesh.select_faces_by_mask(o3d.core.Tensor(triangles))
            cloud = cloud.select_by_mask(o3d.core.Tensor(rows))
        kept.append((mesh, cloud))
    if not (len(kept[0][0].triangle.indices) and len(kept[0][1].point.positions)):
        raise Sc3dError(f"no surface is seen by {min_photos} photos at once: lower --crop")
    return (kept[0], kept[1]), float(left_out / area)


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
