"""The labels of a cloud, seen through a photo's camera: the way `evaluate` sees them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, local_origin

if TYPE_CHECKING:
    import open3d as o3d

    from sc3d.geometry.neighbors import NeighborIndex
    from sc3d.geometry.raycast import Surface

_REACH = 4.0  # a pixel takes the label of a point at most this many point spacings from the surface


@dataclass(frozen=True)
class LabelledSurface:
    """A labelled cloud and the surface it lies on; built once, looked at through many views.

    labels: (N,) uint8 ids; reach: largest distance between surface and point, world units
    """

    surface: Surface
    index: NeighborIndex
    labels: np.ndarray
    reach: float

    @classmethod
    def build(cls, cloud: o3d.t.geometry.PointCloud, views: list[View], mesh: Path | None = None) -> LabelledSurface:
        """cloud: with `label`; views: of the scene, for the side that normals face; mesh: file of the surface, None or missing = surfels."""
        from sc3d.geometry.neighbors import NeighborIndex
        from sc3d.geometry.raycast import Surface
        from sc3d.labelled import point_arrays, read_surface, spacing_of

        if "label" not in cloud.point:
            raise InputError("the cloud has no labels: run `sc3d label SCENE` and `sc3d propagate SCENE`")
        points, normals = point_arrays(cloud, np.array([view.centre for view in views]))
        origin = local_origin(views)
        surface = read_surface(mesh, points, normals, origin) if mesh else Surface.from_cloud(points, normals, origin)
        labels = cloud.point["label"].numpy().reshape(-1).astype(np.uint8)
        return cls(surface, NeighborIndex(points), labels, _REACH * spacing_of(points))


def render_labels(labelled: LabelledSurface, view: View, max_size: int = 1000) -> np.ndarray:
    """The class that the cloud shows at each pixel of a photo, distortion included.

    max_size: longest side of the result, px
    returns: (H, W) uint8 ids, 0 = unlabelled or nothing hit
    """
    from sc3d.geometry.raycast import first_surface, nearest_points

    scale = min(1.0, max_size / max(view.width, view.height))
    sized = view.resized(max(1, round(view.width * scale)), max(1, round(view.height * scale)))
    rows = nearest_points(first_surface(labelled.surface, sized), sized, labelled.index, labelled.reach)
    return np.where(rows >= 0, labelled.labels[rows], 0).astype(np.uint8)
