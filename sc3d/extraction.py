"""Gaussians to a surface: depth of every view, checked against its neighbors, fused into a TSDF."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
from tqdm import tqdm

from sc3d.errors import Sc3dError, left_out
from sc3d.geometry.cameras import View
from sc3d.geometry.neighbors import orient_normals
from sc3d.geometry.raycast import FirstSurface, Surface, first_surface
from sc3d.geometry.tsdf import DepthFusion, Part, cloud_in_order, drop_small_parts, near_mesh, pixel_squares
from sc3d.io.atomic import require_room, temporary_name
from sc3d.settings.common import DepthMode
from sc3d.settings.reconstruction import Extract
from sc3d.splatting.consistency import blocking, consistent, pixel_rays
from sc3d.splatting.evaluation import facing_depth
from sc3d.splatting.gaussians import Gaussians

MAX_ANGLE = 80.0  # degrees between ray and normal
NUM_NEIGHBORS = 6
MIN_PART = 100  # triangles; smaller components are floaters
ROUNDS = 4  # of completion, each with every fourth view
MARGIN = 0.03  # share of the depth by which a surface must lie behind to be another one
CELLS, AROUND = 64, 6  # cells along the map, and how many of them on each side are around a point
NADIR_SPREAD = 20.0  # degrees
OBLIQUE_COVERAGE = 0.97
LOOSE = 4.0  # px; how far two views may disagree where nothing better is known

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Surfaces:
    """mesh, cloud: in the views' local world; voxel_size: world units.

    confirmed: share of all pixels whose depth was confirmed by neighbor views; coverage: share whose ray
        hits the mesh
    """

    mesh: o3d.t.geometry.TriangleMesh
    cloud: o3d.t.geometry.PointCloud
    voxel_size: float
    confirmed: float
    coverage: float


@dataclass(frozen=True)
class DepthViews:
    """The views whose depth is fused.

    views: pinhole; image: index to (H, W, 3) uint8 RGB of the view's size
    neighbors: per view, rows of views that see the same surface; depth_range: nearest and farthest depth,
        world units
    opaque: index to (H, W) bool pixels whose depth counts, None = all
    """

    views: list[View]
    image: Callable[[int], np.ndarray]
    neighbors: list[np.ndarray]
    depth_range: tuple[float, float]
    opaque: Callable[[int], np.ndarray | None] = lambda row: None


def extract_surface(gaussians: Gaussians, data: DepthViews, settings: Extract) -> Surfaces:
    """Fuse the rendered depth of all views; raises Sc3dError where the views show or share no surface."""
    # depth, and what is sure of it
    size = 8 * sum(view.width * view.height for view in data.views)
    require_room(Path(tempfile.gettempdir()) / "depth", size)
    with tempfile.TemporaryDirectory(prefix=temporary_name("sc3d-depth")) as folder:
        maps = _DepthMaps(Path(folder), data)
        footprint = maps.render(gaussians, settings.depth_mode)
        voxel_size = settings.voxel_size or _default_voxel_size(gaussians.means.detach().numpy(), footprint)
        fusion, confirmed = _fused(data, lambda row: maps.confirmed(row, settings.min_views), voxel_size)
        if not confirmed:
            raise Sc3dError("the views' depths do not agree anywhere: train longer, or lower --min-views")
        parts = [_part(fusion)]
        maps.trust(parts[0][0])
        wanted = wanted_coverage(data.views) if settings.coverage is None else settings.coverage
        for accept in (_agreed, _unopposed, _plausible):
            if _coverage(_joined(parts)[0], data.views) >= wanted:
                break
            for turn in range(min(ROUNDS, len(data.views))):
                parts.append(
                    _complete(
                        maps, _joined(parts)[0], voxel_size, range(turn, len(data.views), ROUNDS), accept
                    )
                )
    mesh, cloud = _joined(parts)
    return Surfaces(mesh, cloud, voxel_size, confirmed, _coverage(mesh, data.views))


def surface_from_depth(
    data: DepthViews, depth: Callable[[int], np.ndarray], points: np.ndarray, voxel_size: float
) -> Surfaces:
    """Fuse depth maps, without Gaussians; nothing is added that they do not hold.

    depth: index to (H, W) float32 depth that others confirm, 0 = none, of the view's size
    points: (N, 3) sparse points, for the size of the scene; voxel_size: world units, 0 = as for `extract_surface`
    """
    footprints = []
    for row, view in enumerate(data.views):
        found = depth(row)
        if (found > 0).any():
            footprints.append(float(np.median(found[found > 0])) / view.focal)
    if not footprints:
        raise Sc3dError("no depth is confirmed by other photos: more overlap is needed, or lower --min-views")
    voxel_size = voxel_size or _default_voxel_size(points, float(np.median(footprints)))
    fusion, confirmed = _fused(data, depth, voxel_size)
    mesh, cloud = _part(fusion)
    return Surfaces(mesh, cloud, voxel_size, confirmed, _coverage(mesh, data.views))


def _fused(
    data: DepthViews, depth: Callable[[int], np.ndarray], voxel_size: float
) -> tuple[DepthFusion, float]:
    """The field of all views' depth, and the share of all pixels that have one."""
    fusion, num_known = DepthFusion(voxel_size), 0
    for row, view in enumerate(tqdm(data.views, desc="fusing", unit="view", disable=None)):
        known = depth(row)
        fusion.integrate(view, known, data.image(row), data.depth_range[1])
        num_known += int((known > 0).sum())
    return fusion, num_known / sum(view.width * view.height for view in data.views)


def _part(fusion: DepthFusion) -> Part:
    """Mesh and cloud of a field, without floaters."""
    whole, cloud = fusion.mesh(), fusion.cloud()
    mesh = drop_small_parts(whole, MIN_PART)
    total = len(whole.triangle.indices)
    if dropped := total - len(mesh.triangle.indices):
        logger.info(
            "%d of %d triangles are left out: in loose parts of fewer than %d", dropped, total, MIN_PART
        )
    if not len(mesh.triangle.indices):
        return mesh, cloud.select_by_index(o3d.core.Tensor(np.empty(0, np.int64)))
    return mesh, cloud.select_by_mask(
        o3d.core.Tensor(near_mesh(cloud.point.positions.numpy(), mesh, 0.5 * fusion.voxel_size))
    )


def wanted_coverage(views: list[View]) -> float:
    """1 where all views look the same way: a wrong depth then moves a point along everybody's line of sight.
    Else OBLIQUE_COVERAGE.
    """
    forward = np.stack([view.cam_from_world[2, :3] for view in views])
    middle = forward.mean(axis=0)
    same = (
        forward @ (middle / np.maximum(np.linalg.norm(middle), 1e-12)) > np.cos(np.deg2rad(NADIR_SPREAD))
    ).all()
    return 1.0 if same else OBLIQUE_COVERAGE


def _coverage(mesh: o3d.t.geometry.TriangleMesh, views: list[View]) -> float:
    """Share of the views' pixels whose ray hits the mesh."""
    surface = _surface(mesh)
    return float(np.mean([np.isfinite(first_surface(surface, view).range).mean() for view in views]))


def _complete(
    maps: _DepthMaps,
    mesh: o3d.t.geometry.TriangleMesh,
    voxel_size: float,
    rows: range,
    accept: Callable[..., np.ndarray],
) -> Part:
    """Surface from the accepted depth of pixels that look through the holes of `mesh`, of some views.

    Each view's own: where views disagree, as in tree crowns, their average would be no surface at all.
    """
    surface, data, parts = _surface(mesh), maps.data, []
    for row in tqdm(rows, desc="completing", unit="view", disable=None):
        view = data.views[row]
        first, depth = first_surface(surface, view), maps.read(row)
        # where nothing is hit, or only something far behind
        before = depth < (1 - MARGIN) * first.range * first.ray_z
        squares, centers = pixel_squares(view, depth, data.image(row), before & accept(maps, row, first))
        parts.append(
            (
                squares,
                cloud_in_order(centers.voxel_down_sample(voxel_size))
                if len(centers.point.positions)
                else centers,
            )
        )
    return _joined(parts)


def _agreed(maps: _DepthMaps, row: int, first: FirstSurface) -> np.ndarray:
    """(H, W) bool: as high as the surroundings, and more neighbors agree than look through it."""
    return maps.usual(row) & (maps.counts(row, LOOSE) > maps.blocks(row))


def _unopposed(maps: _DepthMaps, row: int, first: FirstSurface) -> np.ndarray:
    """(H, W) bool: as high as the surroundings, nothing known behind it, and no neighbor looks through it:
    what only one view sees.
    """
    return maps.usual(row) & (maps.blocks(row) == 0) & ~np.isfinite(first.range)


def _plausible(maps: _DepthMaps, row: int, first: FirstSurface) -> np.ndarray:
    """(H, W) bool: some neighbor agrees, or at most one looks through it; crowns in the wind, but also
    floaters.
    """
    return (maps.counts(row, LOOSE) >= 1) | (maps.blocks(row) <= 1)


def _joined(parts: list[Part]) -> Part:
    meshes, clouds = zip(*parts, strict=True)
    mesh = o3d.t.geometry.TriangleMesh()
    starts = np.cumsum([0, *(len(each.vertex.positions) for each in meshes[:-1])])
    for name in ("positions", "normals", "colors"):
        mesh.vertex[name] = o3d.core.Tensor(np.concatenate([each.vertex[name].numpy() for each in meshes]))
    mesh.triangle.indices = o3d.core.Tensor(
        np.concatenate(
            [each.triangle.indices.numpy() + start for each, start in zip(meshes, starts, strict=True)]
        )
    )
    cloud = o3d.t.geometry.PointCloud()
    for name in ("positions", "normals", "colors"):
        cloud.point[name] = o3d.core.Tensor(np.concatenate([each.point[name].numpy() for each in clouds]))
    return mesh, cloud


@dataclass(frozen=True)
class _Relief:
    """Lowest and highest height of a surface around each cell of a coarse map.

    axes: (3, 3) rows: two horizontal axes and up, which is against the mean viewing direction; start: (2,)
        corner; size: cell, world units
    low, high: (CELLS, CELLS) float32
    """

    axes: np.ndarray
    start: np.ndarray
    size: float
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def from_vertices(cls, vertices: np.ndarray, views: list[View]) -> _Relief:
        up = -np.sum([view.cam_from_world[2, :3] for view in views], axis=0)
        axes = np.linalg.svd(up[None])[2][[1, 2, 0]]
        axes[2] *= np.sign(axes[2] @ up)
        placed = vertices @ axes.T
        start = placed[:, :2].min(axis=0)
        relief = cls(
            axes, start, float(np.ptp(placed[:, :2], axis=0).max()) / CELLS * 1.001, np.empty(0), np.empty(0)
        )
        cells, height = relief.place(vertices)
        low, high = np.full(CELLS**2, np.inf, np.float32), np.full(CELLS**2, -np.inf, np.float32)
        np.minimum.at(low, cells, height)
        np.maximum.at(high, cells, height)
        window = np.ones((2 * AROUND + 1,) * 2, np.uint8)
        low, high = (
            cv2.erode(low.reshape(CELLS, CELLS), window),
            cv2.dilate(high.reshape(CELLS, CELLS), window),
        )
        overall = np.quantile(height, [0.01, 0.99])  # where nothing sure is around
        return replace(
            relief,
            low=np.where(np.isfinite(low), low, overall[0]),
            high=np.where(np.isfinite(high), high, overall[1]),
        )

    def place(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N,) cell of each (N, 3) point (the nearest one for points off the map) and (N,) height."""
        placed = points @ self.axes.T
        column, row = np.clip(((placed[:, :2] - self.start) / self.size).astype(np.int64), 0, CELLS - 1).T
        return row * CELLS + column, placed[:, 2]


class _DepthMaps:
    """Depth of every view, kept on disk, and what the neighbors say of it."""

    def __init__(self, folder: Path, data: DepthViews) -> None:
        self.folder, self.data = folder, data

    def render(self, gaussians: Gaussians, mode: DepthMode) -> float:
        """Write all maps; returns the median size of a pixel on the surface, world units."""
        footprints, empty = [], list[str]()
        for row, view in enumerate(tqdm(self.data.views, desc="depth", unit="view", disable=None)):
            depth = facing_depth(gaussians, view, MAX_ANGLE, mode)
            nearest, farthest = self.data.depth_range
            depth[(depth <= nearest) | (depth >= farthest)] = 0
            opaque = self.data.opaque(row)
            if opaque is not None:
                depth[~opaque] = 0
            np.save(self.folder / f"{row}.npy", depth)
            if not (depth > 0).any():
                empty.append(view.name)
            else:
                footprints.append(float(np.median(depth[depth > 0])) / view.focal)
        if empty and footprints:
            logger.warning(left_out(empty, len(self.data.views), "photos show no surface and are not fused"))
        if not footprints:
            raise Sc3dError("no view shows a surface: train longer, or check the cameras")
        return float(np.median(footprints))

    def read(self, row: int, kind: str = "") -> np.ndarray:
        return np.load(self.folder / f"{row}{kind}.npy")

    def counts(self, row: int, tolerance: float) -> np.ndarray:
        """(H, W) number of neighbors that see a pixel's surface within `tolerance` px of where this view has
        it.
        """
        others = [
            (self.read(other), self.data.views[other]) for other in self.data.neighbors[row][:NUM_NEIGHBORS]
        ]
        return consistent(self.read(row), self.data.views[row], others, tolerance)

    def confirmed(self, row: int, min_views: int) -> np.ndarray:
        """(H, W) float32 depth that enough neighbors confirm, else 0."""
        enough = self.counts(row, 1.0) >= min(min_views, len(self.data.neighbors[row]))
        return np.where(enough, self.read(row), 0).astype(np.float32)

    def trust(self, mesh: o3d.t.geometry.TriangleMesh) -> None:
        """Take what the views see of a mesh for sure."""
        surface = _surface(mesh)
        self.relief = _Relief.from_vertices(mesh.vertex.positions.numpy(), self.data.views)
        for row, view in enumerate(self.data.views):
            first = first_surface(surface, view)
            np.save(
                self.folder / f"{row}-sure.npy",
                np.where(np.isfinite(first.range), first.range * first.ray_z, 0).astype(np.float32),
            )

    def usual(self, row: int) -> np.ndarray:
        """(H, W) whether a pixel's point is as high as something sure around it on the map; a floater is
        higher. After `trust`.
        """
        view, depth = self.data.views[row], self.read(row)
        points_cam = pixel_rays(view).numpy() * depth[..., None]
        points = (points_cam - view.cam_from_world[:3, 3]) @ view.cam_from_world[:3, :3]
        cells, height = self.relief.place(points.reshape(-1, 3))
        margin = MARGIN * depth.ravel()
        return (
            (height > self.relief.low.ravel()[cells] - margin)
            & (height < self.relief.high.ravel()[cells] + margin)
        ).reshape(depth.shape)

    def blocks(self, row: int) -> np.ndarray:
        """(H, W) number of neighbors that are sure of a surface behind a pixel's point, so that it would be
        in their way; after `trust`.
        """
        sure = [
            (self.read(other, "-sure"), self.data.views[other])
            for other in self.data.neighbors[row][:NUM_NEIGHBORS]
        ]
        return blocking(self.read(row), self.data.views[row], sure, MARGIN)


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


def _default_voxel_size(points: np.ndarray, footprint: float) -> float:
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    return max(1.5 * footprint, float((high - low).max()) / 2048)


def _surface(mesh: o3d.t.geometry.TriangleMesh) -> Surface:
    return Surface.from_mesh(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy(), np.zeros(3))
