"""Gaussians to a surface: depth of every view, checked against its neighbours, fused into a TSDF (METHOD section 1, Surface)."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
import torch
from tqdm import tqdm

from sc3d.errors import Sc3dError
from sc3d.geometry.cameras import View
from sc3d.geometry.neighbors import orient_normals
from sc3d.geometry.surface import DepthFusion, drop_small_parts, near_mesh
from sc3d.settings import Extract
from sc3d.splatting.consistency import consistent, pixel_rays
from sc3d.splatting.evaluation import depth_map
from sc3d.splatting.gaussians import Gaussians

MAX_ANGLE = 80.0  # degrees between ray and normal
NUM_NEIGHBOURS = 6
MIN_PART = 200  # triangles; smaller components are floaters


@dataclass(frozen=True)
class Surfaces:
    """mesh, cloud: in the views' local world; coverage: share of all pixels whose depth entered the surface; voxel_size: world units."""

    mesh: o3d.t.geometry.TriangleMesh
    cloud: o3d.t.geometry.PointCloud
    coverage: float
    voxel_size: float


def extract_surface(
    gaussians: Gaussians, views: list[View], image: Callable[[int], np.ndarray], neighbours: list[np.ndarray], depth_limit: float, settings: Extract
) -> Surfaces:
    """Fuse the rendered depth of all views.

    views: pinhole; image: index to (H, W, 3) uint8 RGB of the view's size; neighbours: per view, rows of views that see the same surface
    depth_limit: farthest depth, world units
    """
    with tempfile.TemporaryDirectory(prefix="sc3d-depth-") as folder:
        files = [Path(folder) / f"{row}.npy" for row in range(len(views))]
        footprints = []
        for view, file in tqdm(zip(views, files, strict=True), total=len(views), desc="depth", unit="view", disable=None):
            depth = _reliable_depth(gaussians, view, depth_limit)
            np.save(file, depth)
            if (depth > 0).any():
                footprints.append(float(np.median(depth[depth > 0])) / view.focal)
        if not footprints:
            raise Sc3dError("no view shows a surface: train longer, or check the cameras")
        voxel_size = settings.voxel_size or _default_voxel_size(gaussians, float(np.median(footprints)))
        fusion, kept, total = DepthFusion(voxel_size), 0, 0
        for row, view in enumerate(tqdm(views, desc="fusing", unit="view", disable=None)):
            depth = torch.from_numpy(np.load(files[row]))
            others = [(torch.from_numpy(np.load(files[other])), views[other]) for other in neighbours[row][:NUM_NEIGHBOURS]]
            confirmed = consistent(depth, view, others).numpy() >= min(settings.min_views, len(others))
            depth = np.where(confirmed, depth.numpy(), 0).astype(np.float32)
            fusion.integrate(view, depth, image(row), depth_limit)
            kept, total = kept + int((depth > 0).sum()), total + depth.size
    mesh, cloud = fusion.mesh(), fusion.cloud()
    if not len(cloud.point.positions):
        raise Sc3dError("the views' depths do not agree anywhere: train longer, or lower --min-views")
    mesh = drop_small_parts(mesh, MIN_PART)
    cloud = cloud.select_by_mask(o3d.core.Tensor(near_mesh(cloud.point.positions.numpy(), mesh, 0.5 * voxel_size)))
    return Surfaces(mesh, cloud, kept / total, voxel_size)


def centre_cloud(gaussians: Gaussians, centres: np.ndarray, min_opacity: float) -> o3d.t.geometry.PointCloud:
    """The Gaussians' centres as a cloud: positions, colours, normals (smallest axis, towards the nearest of the (M, 3) camera centres)."""
    chosen = gaussians[gaussians.opacities >= min_opacity].detached()
    if not len(chosen):
        raise Sc3dError(f"no Gaussian has an opacity of {min_opacity} or more: lower --min-opacity")
    points = chosen.means.numpy()
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    colors = np.clip(0.5 + 0.28209479177387814 * chosen.sh[:, 0].numpy(), 0, 1)
    cloud.point.colors = o3d.core.Tensor(np.round(colors * 255).astype(np.uint8))
    cloud.point.normals = o3d.core.Tensor(orient_normals(points, chosen.normals.numpy(), centres).astype(np.float32))
    return cloud


def _reliable_depth(gaussians: Gaussians, view: View, depth_limit: float) -> np.ndarray:
    depth, _, normals_cam = depth_map(gaussians, view)
    rays_cam = torch.nn.functional.normalize(pixel_rays(view), dim=2).numpy()
    facing = -(normals_cam * rays_cam).sum(axis=2) > np.cos(np.deg2rad(MAX_ANGLE))
    return np.where(facing & (depth < depth_limit), depth, 0).astype(np.float32)


def _default_voxel_size(gaussians: Gaussians, footprint: float) -> float:
    low, high = np.quantile(gaussians.means.detach().numpy(), [0.01, 0.99], axis=0)
    return max(1.5 * footprint, float((high - low).max()) / 2048)
