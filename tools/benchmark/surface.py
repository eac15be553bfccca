"""How good a reconstructed surface is, against the exact one of a synthetic scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import open3d as o3d

from sc3d.geometry.cameras import View, local_origin, undistorted
from sc3d.geometry.raycast import Surface, first_surface, see_points
from sc3d.io.clouds import read_cloud, read_mesh
from sc3d.io.mask_images import read_index_image
from sc3d.io.progress import progress
from sc3d.scene.depth_map import depth_file, read_depth_map
from sc3d.scene.scene import Scene
from sc3d.settings.common import DepthMode
from sc3d.splatting.dataset import load_gaussians
from sc3d.splatting.evaluation import depth_map

MIN_ALPHA = 0.9
NUM_SAMPLES = 500_000  # of the mesh
WITHIN, FAR = 2.0, 5.0  # voxels
MIN_VIEWS = 2  # that confirm a depth of `sc3d depth`

# of a view: (H, W) depth z, and where it counts
Depth = Callable[[View], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class SurfaceFigures:
    """depth: relative errors where it counts: rendered with alpha > 0.9, or, without Gaussians, what
    `sc3d depth` found and two views confirm; sky and trees apart; mesh: shares of surface within 2 voxels.

    depth_median, depth_p90: outside sky and trees; tree_median: of trees; shares of pixels: opaque (depth
        counts), hit (the ray meets the mesh), tree_hit, sky_hit (None = no sky in the photos)
    complete, completeness: share of the true surface that two or more photos see, all of it and per class
        name; accuracy: share of the mesh's area near the truth; spikes: farther than 5 voxels from it
    voxel_size: of the mesh, world units
    """

    depth_median: float
    depth_p90: float
    tree_median: float
    opaque: float
    hit: float
    tree_hit: float
    sky_hit: float | None
    complete: float
    completeness: dict[str, float]
    accuracy: float
    spikes: float
    voxel_size: float


def surface_figures(
    scene: Scene, truth: Scene, voxel_size: float, depth_mode: DepthMode = "blended"
) -> SurfaceFigures:
    """Compare gaussians.ply and mesh.ply of `scene` with truth_depth/, truth/, truth.ply and truth_mesh.ply of
    `truth`, whose cameras it must have.
    """
    origin = local_origin(scene.model.views)
    views = [view.shifted(origin) for view in scene.model.views]
    mesh, true_mesh = _surface(scene.mesh, origin), _surface(truth.path / "truth_mesh.ply", origin)
    ids = {entry.name: entry.id for entry in truth.class_table()}
    depth = _depth_errors(_depths_of(scene, depth_mode), mesh, views, truth, ids["tree"])
    completeness = _completeness(mesh, true_mesh, views, truth, WITHIN * voxel_size, origin)
    away = _distances(true_mesh, _samples(scene, origin)) / voxel_size
    return SurfaceFigures(
        **depth,
        complete=completeness.pop(""),
        completeness=completeness,
        accuracy=float((away <= WITHIN).mean()),
        spikes=float((away > FAR).mean()),
        voxel_size=voxel_size,
    )


def _depths_of(scene: Scene, depth_mode: DepthMode) -> Depth:
    """From the Gaussians if there are any, else from depth/."""
    if not scene.gaussians.exists():
        return lambda view: _stored_depth(scene, view)
    gaussians = load_gaussians(scene)[0]

    def rendered(view: View) -> tuple[np.ndarray, np.ndarray]:
        depth, alpha, _ = depth_map(gaussians, view, depth_mode)
        return depth, alpha > MIN_ALPHA

    return rendered


def _stored_depth(scene: Scene, view: View) -> tuple[np.ndarray, np.ndarray]:
    """As many pixels as the view has, each the nearest of the map."""
    depth = read_depth_map(depth_file(scene.depth, view.name)).confirmed(MIN_VIEWS)
    rows = ((np.arange(view.height) + 0.5) * depth.shape[0] / view.height).astype(int)
    columns = ((np.arange(view.width) + 0.5) * depth.shape[1] / view.width).astype(int)
    depth = depth[np.ix_(rows, columns)]
    return depth, depth > 0


def _depth_errors(
    depth_of: Depth, mesh: Surface, views: list[View], truth: Scene, tree: int
) -> dict[str, float | None]:
    errors, labels, shares = [], [], []
    num_sky, num_walled = 0, 0
    for view in progress(views, "depth", "view"):
        stem = view.name.rsplit(".", 1)[0]
        exact, label = (
            np.load(truth.path / "truth_depth" / f"{stem}.npy"),
            read_index_image(truth.truth / f"{stem}.png"),
        )
        small = undistorted(view, max(exact.shape))
        depth, counts = depth_of(small)
        known = np.isfinite(exact) & (exact > 0)
        used = known & counts & (depth > 0)
        errors.append(np.abs(depth[used] - exact[used]) / exact[used])
        labels.append(label[used])
        hit = np.isfinite(first_surface(mesh, small).range)
        num_sky, num_walled = num_sky + (~known).sum(), num_walled + hit[~known].sum()
        shares.append(
            [
                counts[known].mean(),
                hit[known].mean(),
                hit[label == tree].mean() if (label == tree).any() else np.nan,
            ]
        )
    errors, labels = np.concatenate(errors), np.concatenate(labels)
    opaque, hit, tree_hit = np.nanmean(shares, axis=0)
    other = errors[labels != tree]
    return {
        "depth_median": float(np.median(other)),
        "depth_p90": float(np.quantile(other, 0.9)),
        "tree_median": float(np.median(errors[labels == tree])),
        "opaque": float(opaque),
        "hit": float(hit),
        "tree_hit": float(tree_hit),
        "sky_hit": float(num_walled / num_sky) if num_sky else None,
    }


def _completeness(
    mesh: Surface, true_mesh: Surface, views: list[View], truth: Scene, distance: float, origin: np.ndarray
) -> dict[str, float]:
    """By class name; "" for all, those of no class included."""
    cloud = read_cloud(truth.path / "truth.ply")
    points, normals = cloud.point.positions.numpy() - origin, cloud.point.normals.numpy()
    seen = np.zeros(len(points), np.int32)
    for view in progress(views, "visible", "view"):
        seen[see_points(view, points, normals, first_surface(true_mesh, view), 0.05).points] += 1
    near, label = _distances(mesh, points) <= distance, cloud.point.label.numpy().ravel()
    return {"": float(near[seen >= 2].mean())} | {
        entry.name: float(near[(label == entry.id) & (seen >= 2)].mean())
        for entry in truth.class_table()
        if ((label == entry.id) & (seen >= 2)).any()
    }


def _samples(scene: Scene, origin: np.ndarray) -> np.ndarray:
    """(NUM_SAMPLES, 3) area-uniform points of the mesh, local frame."""
    mesh = read_mesh(scene.mesh)
    corners = (mesh.vertex.positions.numpy() - origin)[mesh.triangle.indices.numpy()]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(corners), NUM_SAMPLES, p=area / area.sum())
    s, t = np.sqrt(rng.random(NUM_SAMPLES)), rng.random(NUM_SAMPLES)
    return np.einsum("nc,ncd->nd", np.stack([1 - s, s * (1 - t), s * t], axis=1), corners[chosen])


def _surface(path, origin: np.ndarray) -> Surface:
    mesh = read_mesh(path)
    return Surface.from_mesh(
        mesh.vertex.positions.numpy() - origin, mesh.triangle.indices.numpy(), np.zeros(3)
    )


def _distances(surface: Surface, points: np.ndarray) -> np.ndarray:
    return surface.scene.compute_distance(o3d.core.Tensor(np.ascontiguousarray(points, np.float32))).numpy()
