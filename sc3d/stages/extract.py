"""gaussians.ply or depth/ + cameras + photos -> mesh.ply and cloud.ply, in the world of the cameras."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import open3d as o3d

from sc3d.errors import InputError, left_out
from sc3d.extraction import DepthViews, Surfaces, center_cloud, extract_surface, surface_from_depth
from sc3d.geometry.cameras import in_image, local_origin, project, resample, undistorted
from sc3d.geometry.view_selection import neighbor_views
from sc3d.io.clouds import write_geometry
from sc3d.scene.depth_map import depth_file, depth_map_size, read_depth_map
from sc3d.scene.scene import Scene, SparseModel, check_photos, require_views
from sc3d.settings.reconstruction import Extract
from sc3d.splatting.dataset import load_gaussians

logger = logging.getLogger(__name__)


def inputs(scene: Scene, settings: Extract) -> list[Path]:
    return [scene.depth if settings.method == "depth" else scene.gaussians, scene.sparse, scene.images]


def outputs(scene: Scene, settings: Extract) -> list[Path]:
    return [scene.cloud] if settings.method == "centers" else [scene.cloud, scene.mesh]


def run(scene: Scene, settings: Extract) -> dict[str, object]:
    if settings.method == "depth":
        return _from_depth(scene, settings)
    gaussians, origin = load_gaussians(scene)
    model = scene.model
    centers = np.array([view.center for view in model.views])
    if settings.method == "centers":
        cloud = center_cloud(gaussians, centers - origin, settings.min_opacity)
        write_geometry(scene.cloud, _placed(cloud, origin))
        return {"points": len(cloud.point.positions)}
    require_views(scene)
    check_photos(scene, [view.name for view in model.views])
    views = [undistorted(view.shifted(origin), settings.max_size) for view in model.views]

    def image(row: int) -> np.ndarray:
        return resample(scene.read_photo(model.views[row].name), model.views[row].shifted(origin), views[row])

    def opaque(row: int) -> np.ndarray | None:
        return scene.opaque_pixels(model.views[row].shifted(origin), views[row])

    means = gaussians.means.detach().numpy() + origin
    neighbors = neighbor_views(model.tracks, model.points, centers)
    data = DepthViews(views, image, neighbors, _depth_range(model, means), opaque)
    return _written(scene, extract_surface(gaussians, data, settings), origin)


def _from_depth(scene: Scene, settings: Extract) -> dict[str, object]:
    """Mesh and cloud of the maps of `sc3d depth`."""
    scene.require(scene.depth, hint="run `sc3d depth` first")
    model, origin = scene.model, local_origin(scene.model.views)
    photo_views = [view for view in model.views if depth_file(scene.depth, view.name).exists()]
    if not photo_views:
        raise InputError(f"{scene.depth} has no depth of a photo of {scene.sparse}: run `sc3d depth` again")
    if len(photo_views) < len(model.views):
        missing = sorted({view.name for view in model.views} - {view.name for view in photo_views})
        logger.warning(left_out(missing, len(model.views), "photos have no depth map"))
    check_photos(scene, [view.name for view in photo_views])
    views = [
        undistorted(view.shifted(origin), depth_map_size(depth_file(scene.depth, view.name)))
        for view in photo_views
    ]

    def image(row: int) -> np.ndarray:
        view = photo_views[row]
        return resample(scene.read_photo(view.name), view.shifted(origin), views[row])

    def depth(row: int) -> np.ndarray:
        return read_depth_map(depth_file(scene.depth, views[row].name)).confirmed(settings.min_views)

    data = DepthViews(views, image, [], _depth_range(model, model.points), lambda row: None)
    surfaces = surface_from_depth(data, depth, model.points - origin, settings.voxel_size)
    return _written(scene, surfaces, origin)


def _written(scene: Scene, surfaces: Surfaces, origin: np.ndarray) -> dict[str, object]:
    """Write mesh and cloud; returns the figures."""
    write_geometry(scene.mesh, _placed(surfaces.mesh, origin))
    write_geometry(scene.cloud, _placed(surfaces.cloud, origin))
    return {
        "points": len(surfaces.cloud.point.positions),
        "triangles": len(surfaces.mesh.triangle.indices),
        "voxel_size": round(surfaces.voxel_size, 5),
        "confirmed": f"{surfaces.confirmed:.1%} of the pixels",
        "coverage": f"{surfaces.coverage:.1%} of the pixels",
    }


def _depth_range(model: SparseModel, means: np.ndarray) -> tuple[float, float]:
    """0.7 times the 1st and 1.2 times the 99th percentile of the sparse points' depths, in the photos that see
    them; of all that lie in a photo, if the model does not tell; of the Gaussians' means (N, 3), world, if there
    are no sparse points.
    """
    tracked = any(len(track) for track in model.tracks)
    points = model.points if len(model.points) else means
    depths = []
    for view, track in zip(model.views, model.tracks, strict=True):
        pixels, depth = project(view, points[track] if tracked else points)
        depths.append(depth if tracked else depth[in_image(view, pixels) & (depth > 0)])
    found = np.concatenate(depths)
    if not len(found):
        raise InputError(
            "no photo sees a sparse point or a Gaussian: cameras and Gaussians do not belong together"
        )
    near, far = np.quantile(found, [0.01, 0.99])
    return 0.7 * float(near), 1.2 * float(far)


def _placed(geometry, origin: np.ndarray):
    """The geometry moved from the local frame to the world, with float64 positions."""
    attributes = geometry.vertex if isinstance(geometry, o3d.t.geometry.TriangleMesh) else geometry.point
    attributes.positions = o3d.core.Tensor(attributes.positions.numpy().astype(np.float64) + origin)
    return geometry
