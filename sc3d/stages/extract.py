"""gaussians.ply or depth/ + cameras + photos -> mesh.ply, unconfirmed.ply and cloud.ply, in the world of the cameras."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path

import numpy as np
import open3d as o3d

from sc3d.errors import InputError, left_out
from sc3d.extraction.centers import center_cloud
from sc3d.extraction.evidence import DepthViews, EvidenceStore, ViewEvidence
from sc3d.extraction.fusion import NUM_OTHERS, Surfaces, default_voxel_size, fuse_views
from sc3d.extraction.rendered import write_rendered
from sc3d.geometry.cameras import View, in_image, local_origin, project, resample, undistorted
from sc3d.geometry.view_selection import neighbor_views
from sc3d.io.atomic import require_room, temporary_name
from sc3d.io.clouds import write_geometry
from sc3d.io.progress import progress
from sc3d.scene.depth_map import DepthMap, depth_file, depth_map_size, read_depth_map
from sc3d.scene.scene import Scene, SparseModel, check_photos, require_views
from sc3d.settings.reconstruction import Extract
from sc3d.splatting.dataset import load_gaussians

logger = logging.getLogger(__name__)


def inputs(scene: Scene, settings: Extract) -> list[Path]:
    if settings.method == "depth":
        return [scene.depth, scene.sparse, scene.images]
    stereo = [scene.depth] if settings.method == "tsdf" and scene.depth.exists() else []
    return [scene.gaussians, scene.sparse, scene.images, *stereo]


def outputs(scene: Scene, settings: Extract) -> list[Path]:
    return [scene.cloud] if settings.method == "centers" else [scene.cloud, *scene.surface]


def run(scene: Scene, settings: Extract) -> dict[str, object]:
    if settings.method == "centers":
        gaussians, origin = load_gaussians(scene)
        centers = np.array([view.center for view in scene.model.views])
        cloud = center_cloud(gaussians, centers - origin, settings.min_opacity)
        write_geometry(scene.cloud, _placed(cloud, origin))
        return {"points": len(cloud.point.positions)}
    require_views(scene)
    if settings.crop > len(scene.model.views):
        raise InputError(
            f"--crop {settings.crop}: only {len(scene.model.views)} photos have a camera; take a smaller number"
        )
    with tempfile.TemporaryDirectory(prefix=temporary_name("sc3d-depth")) as folder:
        store = EvidenceStore(Path(folder))
        surfaces, origin = (_from_depth if settings.method == "depth" else _from_gaussians)(
            scene, settings, store
        )
    write_geometry(scene.mesh, _placed(surfaces.mesh, origin))
    write_geometry(scene.unconfirmed, _placed(surfaces.unconfirmed, origin))
    write_geometry(scene.cloud, _placed(surfaces.cloud, origin))
    return _figures(surfaces, settings.crop)


def _from_gaussians(scene: Scene, settings: Extract, store: EvidenceStore) -> tuple[Surfaces, np.ndarray]:
    """Surface of the Gaussians, after what the maps of `sc3d depth` confirm, and the world position of its
    origin.
    """
    gaussians, origin = load_gaussians(scene)
    check_photos(scene, [view.name for view in scene.model.views])
    points = gaussians.means.detach().numpy()
    data = _views(
        scene, scene.model.views, origin, [settings.max_size] * len(scene.model.views), points + origin
    )
    _require_room(data)
    if scene.depth.exists():
        maps = _Maps(scene, data.views)
        for row in progress(range(len(data.views)), "reading depth", "view"):
            store.write(row, maps.evidence(row, settings.min_views))
    footprint = write_rendered(gaussians, data, store, settings.min_views, settings.depth_mode)
    voxel_size = settings.voxel_size or default_voxel_size(points, footprint)
    return fuse_views(data, store, voxel_size, settings.fill, settings.crop), origin


def _from_depth(scene: Scene, settings: Extract, store: EvidenceStore) -> tuple[Surfaces, np.ndarray]:
    """Surface of the maps of `sc3d depth`, and the world position of its origin."""
    scene.require(scene.depth, hint="run `sc3d depth` first")
    model, origin = scene.model, local_origin(scene.model.views)
    photo_views = [view for view in model.views if depth_file(scene.depth, view.name).exists()]
    if not photo_views:
        raise InputError(f"{scene.depth} has no depth of a photo of {scene.sparse}: run `sc3d depth` again")
    if len(photo_views) < len(model.views):
        missing = sorted({view.name for view in model.views} - {view.name for view in photo_views})
        logger.warning(left_out(missing, len(model.views), "photos have no depth map"))
    check_photos(scene, [view.name for view in photo_views])
    sizes = [depth_map_size(depth_file(scene.depth, view.name)) for view in photo_views]
    data = _views(scene, photo_views, origin, sizes, model.points)
    _require_room(data)
    maps, footprints = _Maps(scene, data.views), []
    for row, view in enumerate(progress(data.views, "reading depth", "view")):
        store.write(row, maps.evidence(row, settings.min_views))
        found = store.read(row, "confirmed")
        if (found > 0).any():
            footprints.append(float(np.median(found[found > 0])) / view.focal)
    voxel_size = settings.voxel_size or default_voxel_size(
        model.points, float(np.median(footprints)) if footprints else 1.0
    )
    return fuse_views(data, store, voxel_size, settings.fill, settings.crop), origin


def _views(
    scene: Scene, photo_views: list[View], origin: np.ndarray, sizes: list[int], means: np.ndarray
) -> DepthViews:
    """The views around a local origin, undistorted, each with its longest side; means: as in `_depth_range`."""
    model, local = scene.model, [view.shifted(origin) for view in photo_views]
    views = [undistorted(view, size) for view, size in zip(local, sizes, strict=True)]
    tracks = {view.name: track for view, track in zip(model.views, model.tracks, strict=True)}
    neighbors = neighbor_views(
        [tracks[view.name] for view in photo_views],
        model.points,
        np.array([view.center for view in photo_views]),
        NUM_OTHERS,
    )

    def image(row: int) -> np.ndarray:
        return resample(scene.read_photo(photo_views[row].name), local[row], views[row])

    def opaque(row: int) -> np.ndarray | None:
        return scene.opaque_pixels(local[row], views[row])

    return DepthViews(views, image, neighbors, _depth_range(model, means), opaque)


class _Maps:
    """The depth maps of a scene at the size of views; of a photo without one, nothing is known."""

    def __init__(self, scene: Scene, views: list[View]) -> None:
        self.scene, self.views = scene, views

    def evidence(self, row: int, min_views: int) -> ViewEvidence:
        view, file = self.views[row], depth_file(self.scene.depth, self.views[row].name)
        shape = view.height, view.width
        found = read_depth_map(file).resized(shape) if file.exists() else DepthMap.nothing(shape)
        return ViewEvidence(found.confirmed(min_views), found.continued, found.normals, found.sky)


def _require_room(data: DepthViews) -> None:
    """Four maps of 4 bytes and 4 bytes of colors and sky per pixel."""
    size = 20 * sum(view.width * view.height for view in data.views)
    require_room(Path(tempfile.gettempdir()) / "depth", size)


def _figures(surfaces: Surfaces, crop: int) -> dict[str, object]:
    """What is said of a surface; crop: photos that see each of it, 0 = no matter how many."""
    told = f"{surfaces.cropped:.1%} of the area, seen by fewer than {crop} photos, is left out"
    shares = {
        name: getattr(surfaces, name)
        for name in ("confirmed", "continued", "occluders", "sky", "coverage", "covered")
    }
    return {
        "points": len(surfaces.cloud.point.positions),
        "unconfirmed_points": int(surfaces.cloud.point.unconfirmed.numpy().sum()),
        "triangles": len(surfaces.mesh.triangle.indices),
        "voxel_size": round(surfaces.voxel_size, 5),
        **{name: f"{share:.1%} of the pixels" for name, share in shares.items()},
        **({"cropped": told} if crop else {}),
    }


def _depth_range(model: SparseModel, means: np.ndarray) -> tuple[float, float]:
    """0.7 times the 1st and 1.2 times the 99th percentile of the sparse points' depths, in the photos that
    see them; of all that lie in a photo, if the model does not tell; of the Gaussians' means (N, 3), world,
    if there are no sparse points.
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
