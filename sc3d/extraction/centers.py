"""The Gaussians' centers as a cloud, without a surface."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from sc3d.errors import Sc3dError
from sc3d.geometry.neighbors import orient_normals
from sc3d.splatting.gaussians import Gaussians


def center_cloud(gaussians: Gaussians, centers: np.ndarray, min_opacity: float) -> o3d.t.geometry.PointCloud:
    """The Gaussians' centers as a cloud: positions, colors, normals (smallest axis, towards the nearest of
    the (M, 3) camera centers).
    """
    chosen = gaussians[gaussians.opacities >= min_opacity].detached()
    if not len(chosen):
        raise Sc3dError(f"no Gaussian has an opacity of {min_opacity} or more: lower --min-opacity")
    points = chosen.means.numpy()
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    cloud.point.colors = o3d.core.Tensor(chosen.base_colors)
    cloud.point.normals = o3d.core.Tensor(
        orient_normals(points, chosen.normals.numpy(), centers).astype(np.float32)
    )
    return cloud
