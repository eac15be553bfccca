"""Depth of all views, with what is known of it, to mesh and cloud."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d

from sc3d.errors import Sc3dError
from sc3d.extraction.crop import cropped
from sc3d.extraction.evidence import DepthViews, EvidenceStore
from sc3d.extraction.first_hits import FirstHits, surface_of
from sc3d.extraction.free_space import MARGIN, count_opposed, farthest_free
from sc3d.extraction.photo_support import find_supported
from sc3d.geometry.cameras import View
from sc3d.geometry.raycast import Surface, first_surface
from sc3d.geometry.tsdf import DepthFusion, Part, cloud_in_order, drop_small_parts, near_mesh, pixel_squares
from sc3d.io.progress import Progress, progress
from sc3d.scene.depth_map import hardly_confirmed
from sc3d.settings.reconstruction import Fill
from sc3d.stereo.completion import nearest_by_color

MIN_PART = 100  # triangles; smaller components are floaters
ROUNDS = 4  # of completion, each with every fourth view
NUM_OTHERS = 12  # views asked whether they look through a point
NEAREST = 0.1  # of the nearest usual depth: occluders are nearer
BEYOND = 20.0  # times the farthest usual depth: where nobody looks through there, nothing tells how far it is
UNLIKE = 0.98  # quantile of the color differences on confirmed surface; more is something else
BESIDE = 0.1  # of the longest side
OCCLUDER = 2e-3  # of the pixels, smallest region that is taken for one

FILLS: tuple[Fill, ...] = ("nothing", "continued", "occluders")
Filled = tuple[np.ndarray, np.ndarray | None]  # (H, W) float32 depth, 0 = none; (H, W, 3) normals or None
Step = Callable[[DepthViews, EvidenceStore, int, np.ndarray], Filled]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Surfaces:
    """In the views' local world; voxel_size: world units.

    mesh: what several views confirm, with normals and colors
    unconfirmed: what one view only shows, positions and triangles
    cloud: of both, with uint8 `unconfirmed` (0 or 1)

    Shares of all pixels. confirmed: depth confirmed by other views; continued: added as it continues
    confirmed surface; occluders: added before it at the farthest depth that no other view looks through; sky;
    coverage: ray hits the mesh; covered: ray hits any of it

    cropped: share of the area that too few views see and that is left out
    """

    mesh: o3d.t.geometry.TriangleMesh
    unconfirmed: o3d.t.geometry.TriangleMesh
    cloud: o3d.t.geometry.PointCloud
    voxel_size: float
    confirmed: float
    continued: float
    occluders: float
    sky: float
    coverage: float
    covered: float
    cropped: float = 0.0


def fuse_views(
    data: DepthViews, store: EvidenceStore, voxel_size: float, fill: Fill, crop: int = 0
) -> Surfaces:
    """Fuse what is confirmed, then add what only one view shows, as far as `fill` allows, then leave out what
    fewer than `crop` views see.

    voxel_size: world units. Raises Sc3dError where nothing is confirmed.
    """
    part, confirmed = _fused(data, store, voxel_size)
    sure, unsure = [part], list[Part]()
    _see(data, store, part)
    hits = FirstHits(data, store)
    shares = {"continued": 0.0, "occluders": 0.0}
    steps = {"continued": _continued, "occluders": _occluding}
    for name in list(steps)[: FILLS.index(fill)]:
        with Progress(len(data.views), name, "view") as bar:
            for turn in range(min(ROUNDS, len(data.views))):
                before = len(sure), len(unsure)
                for row in range(turn, len(data.views), ROUNDS):
                    added = _added(data, store, hits.depth(row), row, steps[name], voxel_size)
                    sure.append(added[0])
                    unsure.append(added[1])
                    shares[name] += added[2] / len(data.views)
                    bar.update()
                hits.add([*sure[before[0] :], *unsure[before[1] :]])
    shares["sky"] = float(np.mean([store.read(row, "sky").mean() for row in range(len(data.views))]))
    shares["covered"] = float(
        np.mean([np.isfinite(hits.depth(row)).mean() for row in range(len(data.views))])
    )
    return _surfaces(
        data, store, (_joined(sure), _joined(unsure)), voxel_size, crop, {"confirmed": confirmed} | shares
    )


def _surfaces(
    data: DepthViews,
    store: EvidenceStore,
    parts: tuple[Part, Part],
    voxel_size: float,
    crop: int,
    shares: dict[str, float],
) -> Surfaces:
    """Of what is sure, as far as the photos support it, and what is not."""
    left_out = 0.0
    parts = _split(*parts, find_supported(parts[0], data, store, voxel_size))
    if crop:
        parts, left_out = cropped(parts, surface_of(parts), data, store, voxel_size, crop)
        shares["covered"] = _coverage(surface_of(parts), data.views)
    (mesh, cloud), (other, other_cloud) = parts
    for points, flag in ((cloud, 0), (other_cloud, 1)):
        points.point.unconfirmed = o3d.core.Tensor(np.full((len(points.point.positions), 1), flag, np.uint8))
    coverage = _coverage(surface_of(parts[:1]), data.views)
    return Surfaces(
        mesh,
        other,
        _joined_clouds([cloud, other_cloud]),
        voxel_size,
        **shares,
        coverage=coverage,
        cropped=left_out,
    )


def _split(sure: Part, unsure: Part, supported: tuple[np.ndarray, np.ndarray]) -> tuple[Part, Part]:
    """What is not supported goes to what is not sure. supported: (T,) triangles and (N,) points of `sure`"""
    (mesh, cloud), (triangles, points) = sure, supported
    if triangles.all() and points.all():
        return sure, unsure
    if not (triangles.any() and points.any()):
        logger.warning(
            "the photos correlate nowhere on the surface of the Gaussians: none of it is sure, and all is kept"
        )
        return sure, unsure
    kept, others = (
        (mesh.select_faces_by_mask(o3d.core.Tensor(rows)), cloud.select_by_mask(o3d.core.Tensor(chosen)))
        for rows, chosen in (supported, (~triangles, ~points))
    )
    return kept, _joined([(_bare(others[0]), others[1]), unsure])


def _bare(mesh: o3d.t.geometry.TriangleMesh) -> o3d.t.geometry.TriangleMesh:
    """Positions and triangles only."""
    return o3d.t.geometry.TriangleMesh(mesh.vertex.positions, mesh.triangle.indices)


def _fused(data: DepthViews, store: EvidenceStore, voxel_size: float) -> tuple[Part, float]:
    """The surface of all confirmed depth in range, and its share of all pixels."""
    fusion, shares = DepthFusion(voxel_size), list[float]()
    for row, view in enumerate(progress(data.views, "fusing", "view")):
        known = store.read(row, "confirmed")
        known[known >= data.depth_range[1]] = 0
        added = fusion.integrate(view, known, data.image(row), data.depth_range[1])
        shares.append(float((known > 0).mean()) if added else 0.0)
    if not any(shares):
        raise Sc3dError(
            "no depth is confirmed by other photos: more overlap is needed, or longer training, or --min-views 1"
        )
    if few := hardly_confirmed([view.name for view in data.views], shares):
        logger.warning(few)
    sizes = [view.width * view.height for view in data.views]
    part = _part(fusion)
    if not len(part[0].vertex.positions):
        raise Sc3dError(
            f"all confirmed surface is in loose parts of fewer than {MIN_PART} triangles: "
            "more overlap is needed, or longer training, or a smaller --voxel-size"
        )
    return part, float(np.average(shares, weights=sizes))


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


def _see(data: DepthViews, store: EvidenceStore, part: Part) -> None:
    """Keep how far every view sees, inf = no surface; what it knows behind a point: the mesh, or sky (inf),
    0 = nothing; and the mesh's colors.
    """
    surface = surface_of([part])
    for row, view in enumerate(progress(data.views, "looking", "view")):
        triangles, uv, hit = surface.triangles(view)
        known = np.where(np.isfinite(hit) | store.read(row, "sky"), hit, 0)
        store.save(row, "hit", hit)
        store.save(row, "known", known.astype(np.float32))
        store.save(row, "colors", _shown_colors(part[0], triangles, uv))


def _shown_colors(mesh: o3d.t.geometry.TriangleMesh, triangles: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 colors of the mesh at (H, W) triangles and their barycentric (H, W, 2); 0 at -1."""
    corners = mesh.triangle.indices.numpy()[triangles]
    weights = np.concatenate([1 - uv.sum(axis=2, keepdims=True), uv], axis=2)[..., None]
    colors = (mesh.vertex.colors.numpy()[corners] * weights).sum(axis=2)
    return np.where(triangles[..., None] >= 0, np.clip(colors * 255, 0, 255), 0).astype(np.uint8)


def _others(data: DepthViews, store: EvidenceStore, row: int) -> tuple[list[np.ndarray], list[View]]:
    rows = data.neighbors[row][:NUM_OTHERS]
    return [store.read(other, "known") for other in rows], [data.views[other] for other in rows]


def _added(
    data: DepthViews, store: EvidenceStore, hit: np.ndarray, row: int, step: Step, voxel_size: float
) -> tuple[Part, Part, float]:
    """Squares where a view has a depth by `step` and sees nothing of the surface, `hit` (H, W), there: of
    confirmed depth, and of other; their share of its pixels.

    Each view's own: where views disagree, as in tree crowns, their average would be no surface at all.
    """
    view = data.views[row]
    depth, normals = step(data, store, row, hit)
    wanted = (depth > 0) & (depth < (1 - MARGIN) * hit) & ~store.read(row, "sky")
    confirmed = depth == store.read(row, "confirmed")
    image, parts = data.image(row), list[Part]()
    for chosen in (wanted & confirmed, wanted & ~confirmed):
        squares, centers = pixel_squares(view, depth, image, chosen, normals)
        if len(centers.point.positions):
            centers = cloud_in_order(centers.voxel_down_sample(voxel_size))
        parts.append((squares, centers))
    (sure, unsure) = parts
    return sure, (_bare(unsure[0]), unsure[1]), float(wanted.mean())


def _continued(data: DepthViews, store: EvidenceStore, row: int, hit: np.ndarray) -> Filled:
    """Depth that continues confirmed surface and that no other view looks through; and confirmed depth whose
    surface is too thin for the field: ground at grazing angles.
    """
    confirmed = store.read(row, "confirmed")
    depth = np.where(confirmed > 0, confirmed, store.read(row, "continued"))
    normals = store.read(row, "normals")
    free = count_opposed(depth, normals, data.views[row], *_others(data, store, row)) == 0
    return np.where(free, depth, 0), normals


def _occluding(data: DepthViews, store: EvidenceStore, row: int, hit: np.ndarray) -> Filled:
    """Depth of what stands before the surface, or where no surface and no sky is: as far as no other view
    looks through it; where nothing bounds it, that of the most alike pixel nearby.
    """
    view, empty = data.views[row], ~np.isfinite(hit) & ~store.read(row, "sky")
    opaque = data.opaque(row)
    if opaque is not None:
        empty &= opaque
    known = store.read(row, "known")
    as_known = np.abs(known / np.where(np.isfinite(hit), hit, 1) - 1) < MARGIN
    covered = _unlike_surface(data, store, row, (known > 0) & np.isfinite(hit) & as_known, np.isfinite(hit))
    empty = _large(empty | covered) & empty  # a few pixels at a border say nothing
    others, nearest = _others(data, store, row), NEAREST * data.depth_range[0]
    beyond = np.where(empty & ~covered, np.float32(BEYOND * data.depth_range[1]), np.float32(0))
    toward = np.broadcast_to(np.array([0, 0, -1], np.float32), (*hit.shape, 3))
    inside = count_opposed(beyond, toward, view, *others) > 0
    far = np.where(covered, (1 - MARGIN) * hit, np.where(inside, data.depth_range[1], 0)).astype(np.float32)
    depth = farthest_free(far, nearest, view, *others)
    depth = cv2.medianBlur(depth, 5)
    before_sky = np.where(inside, depth, 0)  # as leaves do that go on where nothing is known
    depth = np.where(empty & (depth == 0), _spread(before_sky, data.image(row)), depth)
    return farthest_free(depth, nearest, view, *others, bounded=True), None


def _spread(depth: np.ndarray, image: np.ndarray) -> np.ndarray:
    """(H, W) depth of the pixel with a depth that is reached with the least change of color, up to BESIDE
    away.
    """
    source, _ = nearest_by_color(image, depth > 0)
    rows, columns = np.divmod(source, depth.shape[1])
    gap = np.hypot(np.arange(depth.shape[0])[:, None] - rows, np.arange(depth.shape[1]) - columns)
    return np.where((source >= 0) & (gap < BESIDE * max(depth.shape)), depth.ravel()[source], 0)


def _unlike_surface(
    data: DepthViews, store: EvidenceStore, row: int, known: np.ndarray, hit: np.ndarray
) -> np.ndarray:
    """(H, W) bool: regions in which the photo does not look like the surface behind: something is before it.

    The measure is how the two differ where this view confirms the surface. What continues it has no look of its
    own and goes with the more alike of what is confirmed and what is not. known, hit: (H, W) bool, the
    confirmed surface, any surface
    """
    confirmed = (store.read(row, "confirmed") > 0) & known
    if not confirmed.any():
        return np.zeros_like(hit)
    photo, shown = data.image(row).astype(np.float32), store.read(row, "colors").astype(np.float32)
    gap = np.abs(cv2.blur(photo, (9, 9)) - cv2.blur(shown, (9, 9))).max(axis=2)
    unlike = known & ~confirmed & (gap > np.quantile(gap[confirmed], UNLIKE))
    seeds = _large(unlike)
    source, _ = nearest_by_color(data.image(row), seeds | confirmed | ~hit)
    return seeds.ravel()[source] & hit & ~confirmed


def _large(region: np.ndarray) -> np.ndarray:
    """(H, W) bool: connected parts of at least OCCLUDER of the pixels."""
    _, labels, sizes, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8))
    large = sizes[:, cv2.CC_STAT_AREA] >= OCCLUDER * region.size
    large[0] = False
    return large[labels]


def _joined(parts: list[Part]) -> Part:
    """One mesh and one cloud of several; empty without any."""
    meshes = [mesh for mesh, _ in parts if len(mesh.triangle.indices)]
    joined = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor.zeros((0, 3)), o3d.core.Tensor.zeros((0, 3), o3d.core.int32)
    )
    if meshes:
        starts = np.cumsum([0, *(len(mesh.vertex.positions) for mesh in meshes[:-1])])
        for name in meshes[0].vertex:
            joined.vertex[name] = o3d.core.Tensor(
                np.concatenate([mesh.vertex[name].numpy() for mesh in meshes])
            )
        corners = [mesh.triangle.indices.numpy() + start for mesh, start in zip(meshes, starts, strict=True)]
        joined.triangle.indices = o3d.core.Tensor(np.concatenate(corners))
    return joined, _joined_clouds([cloud for _, cloud in parts])


def _joined_clouds(clouds: list[o3d.t.geometry.PointCloud]) -> o3d.t.geometry.PointCloud:
    clouds = [cloud for cloud in clouds if len(cloud.point.positions)]
    joined = o3d.t.geometry.PointCloud(o3d.core.Tensor.zeros((0, 3)))
    for name in clouds[0].point if clouds else ():
        joined.point[name] = o3d.core.Tensor(np.concatenate([cloud.point[name].numpy() for cloud in clouds]))
    return joined


def _coverage(surface: Surface, views: list[View]) -> float:
    """Share of the views' pixels whose ray hits a surface."""
    return float(np.mean([np.isfinite(first_surface(surface, view).range).mean() for view in views]))


def default_voxel_size(points: np.ndarray, footprint: float) -> float:
    """1.5 times the size of a pixel on the surface, but at most 2048 voxels along the box of the (N, 3)
    points.
    """
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    return max(1.5 * footprint, float((high - low).max()) / 2048)
