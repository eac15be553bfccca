"""First surfaces and visibility with Open3D's `RaycastingScene`, from a mesh or from the surfels of a bare
cloud.

Distances along rays are ranges (from the camera center); depth = range * z component of the unit ray.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numba
import numpy as np
import open3d as o3d

from sc3d.geometry.cameras import View, camera_rays, in_image, project, rays
from sc3d.geometry.neighbors import NeighborIndex, estimate_normals, point_spacing

RAYS = 1 << 19  # cast at a time: bounds memory, not results
SURFEL_NEIGHBORS = 8
FLAT, SCATTERED = 0.8, 0.38  # half width of a surfel, in distances to the farthest neighbor
# depth tolerance: share of the range, and the cosine of incidence below which it grows no more
RANGE_TOLERANCE, MIN_COSINE = 0.005, 0.2
MAX_ROUGHNESS = 0.12  # mean distance of flat neighbors from the tangent plane, in the same unit
MIN_SUPPORT = 4  # points around a surfel, itself not counted; fewer: a floater, which blocks nothing


class RayTarget(Protocol):
    """What rays can hit: `Surface` here, `voxel_traversal.VoxelSurface`."""

    def cast(self, view: View, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rays from the center of `view` along (K, 3) float32 unit directions in its camera frame, NaN = no
        ray.

        returns: (K,) float32 range, world units, inf = nothing hit; (K,) float32 |cosine| between ray and
            surface normal
        """


@dataclass(frozen=True)
class Surface:
    """What rays can hit, in a frame shifted by `origin` (3,) so that float32 keeps its precision."""

    scene: o3d.t.geometry.RaycastingScene
    origin: np.ndarray

    @classmethod
    def from_mesh(cls, vertices: np.ndarray, triangles: np.ndarray, origin: np.ndarray) -> Surface:
        """vertices: (V, 3) world; triangles: (T, 3) rows of vertices."""
        return cls.from_meshes([(vertices, triangles)], origin)

    @classmethod
    def from_meshes(cls, parts: list[tuple[np.ndarray, np.ndarray]], origin: np.ndarray) -> Surface:
        """Several meshes, each vertices and triangles as in `from_mesh`."""
        scene = o3d.t.geometry.RaycastingScene()
        for vertices, triangles in parts:
            scene.add_triangles(
                o3d.core.Tensor(np.ascontiguousarray(vertices - origin, np.float32)),
                o3d.core.Tensor(np.ascontiguousarray(triangles, np.uint32)),
            )
        return cls(scene, np.asarray(origin, np.float64))

    @classmethod
    def from_cloud(cls, points: np.ndarray, normals: np.ndarray | None, origin: np.ndarray) -> Surface:
        """Squares in the tangent planes of the points, large enough to touch their neighbors (a surfel
        cloud).

        points: (N, 3) world; normals: (N, 3) or None = estimated. Lone points (floaters) get no surfel.
        """
        vertices, triangles = surfels(points - origin, normals)
        return cls(cls.from_mesh(vertices, triangles, np.zeros(3)).scene, np.asarray(origin, np.float64))

    def triangles(self, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(H, W) int64 triangle that each pixel hits first, -1 = none, (H, W, 2) float32 barycentric u, v,
        and (H, W) float32 depth z, world units, inf = nothing hit.
        """
        directions = camera_rays(view.camera)
        bundle = np.empty((len(directions), 6), np.float32)
        _aim(directions, view.cam_from_world, (view.center - self.origin).astype(np.float32), bundle)
        hit = self.scene.cast_rays(o3d.core.Tensor.from_numpy(bundle))
        numbers = hit["primitive_ids"].numpy()
        rows = np.where(numbers == self.scene.INVALID_ID, -1, numbers.astype(np.int64))
        shape, ranges = (view.height, view.width), hit["t_hit"].numpy()
        depth = np.where(np.isfinite(ranges), ranges * directions[:, 2], np.float32(np.inf))
        return rows.reshape(shape), hit["primitive_uvs"].numpy().reshape(*shape, 2), depth.reshape(shape)

    def cast(self, view: View, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `RayTarget.cast`."""
        count = len(directions)
        distance, incidence = np.empty(count, np.float32), np.empty(count, np.float32)
        start = (view.center - self.origin).astype(np.float32)
        bundle = np.empty((min(count, RAYS), 6), np.float32)
        for first in range(0, count, RAYS):
            part = slice(first, min(first + RAYS, count))
            _aim(directions[part], view.cam_from_world, start, bundle)
            hit = self.scene.cast_rays(o3d.core.Tensor.from_numpy(bundle[: part.stop - first]))
            _measure(
                directions[part],
                bundle,
                hit["t_hit"].numpy(),
                hit["primitive_normals"].numpy(),
                distance[part],
                incidence[part],
            )
        return distance, incidence


@dataclass(frozen=True)
class FirstSurface:
    """The first surface of a view, one value per pixel.

    range: (H, W) float32 from the camera center, world units; inf = nothing hit
    incidence: (H, W) float32 |cosine| between ray and surface normal
    ray_z: (H, W) float32, depth = range * ray_z
    """

    range: np.ndarray
    incidence: np.ndarray
    ray_z: np.ndarray

    @property
    def depth(self) -> np.ndarray:
        """(H, W) float32 z, world units; inf = nothing hit."""
        return np.where(np.isfinite(self.range), self.range * self.ray_z, np.float32(np.inf))


def first_surface(surface: RayTarget, view: View) -> FirstSurface:
    """Cast the rays of all pixel centers of `view`, by the camera's own model."""
    directions, shape = camera_rays(view.camera), (view.height, view.width)
    distance, incidence = surface.cast(view, directions)
    return FirstSurface(distance.reshape(shape), incidence.reshape(shape), directions[:, 2].reshape(shape))


@numba.njit(parallel=True, cache=True)
def _aim(directions, cam_from_world, origin, bundle):
    """Rays (K, 6) from `origin` (3,) along directions (K, 3) turned from the camera into the world; those
    without direction point nowhere.
    """
    for k in numba.prange(len(directions)):
        x, y, z = np.float64(directions[k, 0]), np.float64(directions[k, 1]), np.float64(directions[k, 2])
        lost = not np.isfinite(x + y + z)
        for axis in range(3):
            bundle[k, axis] = origin[axis]
            bundle[k, 3 + axis] = (
                0.0
                if lost
                else x * cam_from_world[0, axis] + y * cam_from_world[1, axis] + z * cam_from_world[2, axis]
            )


@numba.njit(parallel=True, cache=True)
def _measure(directions, bundle, t_hit, normals, distance, incidence):
    """Range (K,), infinite without a ray or a hit, and |cosine| (K,) between ray and surface normal."""
    for k in numba.prange(len(directions)):
        distance[k] = t_hit[k] if np.isfinite(directions[k, 2]) else np.float32(np.inf)
        incidence[k] = abs(
            normals[k, 0] * bundle[k, 3] + normals[k, 1] * bundle[k, 4] + normals[k, 2] * bundle[k, 5]
        )


def surface_points(first: FirstSurface, view: View, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """(K, 3) float64 world positions of the first surface at K pixels that hit something."""
    directions, _ = rays(view, np.stack([columns + 0.5, rows + 0.5], axis=1))
    return view.center + directions * first.range[rows, columns, None]


def nearest_points(
    first: FirstSurface,
    view: View,
    index: NeighborIndex,
    max_distance: float,
    wanted: np.ndarray | None = None,
) -> np.ndarray:
    """(H, W) int32 row of the cloud point nearest to the first surface at each pixel; -1 = nothing hit, or no
    point within `max_distance`.

    index: over the cloud, world; wanted: (H, W) bool pixels to look at, None = all
    """
    hit = np.isfinite(first.range) if wanted is None else np.isfinite(first.range) & wanted
    rows, columns = np.nonzero(hit)
    result = np.full(first.range.shape, -1, np.int32)
    if len(rows):
        nearest, distance = index.nearest(surface_points(first, view, rows, columns), 1)
        result[rows, columns] = np.where(distance[:, 0] <= max_distance, nearest[:, 0], -1)
    return result


@dataclass(frozen=True)
class Sighting:
    """The points that a view sees, K of N.

    points: (K,) int64 rows of the cloud
    rows, columns: (K,) int32 pixel
    excess: (K,) float32 how far behind the first surface, in tolerances; <= 1
    incidence: (K,) float32 cosine between the ray and the point's normal (1 without normals)
    depth: (K,) float32 z, world units
    """

    points: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    excess: np.ndarray
    incidence: np.ndarray
    depth: np.ndarray


def see_points(
    view: View, points: np.ndarray, normals: np.ndarray | None, first: FirstSurface | None, voxel_size: float
) -> Sighting:
    """Which points a view sees: inside the image, facing the camera, and not behind the first surface.

    A point is visible iff its range <= first range + tol, tol = max(voxel_size, 0.5 % of the range) /
    max(|cos incidence|, 0.2).
    points: (N, 3) world; normals: (N, 3) or None (then every point faces the camera)
    first: first surface of the view; None = no occlusion test
    """
    pixels, depth = project(view, points)
    inside = np.flatnonzero(in_image(view, pixels))
    columns, rows = pixels[inside, 0].astype(np.int32), pixels[inside, 1].astype(np.int32)
    towards = view.center - points[inside]
    distance = np.linalg.norm(towards, axis=1)
    cosine = (
        np.ones(len(inside))
        if normals is None
        else np.einsum("ij,ij->i", normals[inside], towards) / distance
    )
    excess = np.zeros(len(inside))
    keep = np.ones(len(inside), bool)
    if first is not None:
        tolerance = np.maximum(voxel_size, RANGE_TOLERANCE * distance) / np.maximum(
            np.abs(cosine), MIN_COSINE
        )
        excess = np.maximum(distance - first.range[rows, columns], 0) / tolerance
        keep = (excess <= 1) & (cosine > 0)
    seen = inside[keep]
    return Sighting(
        seen,
        rows[keep],
        columns[keep],
        excess[keep].astype(np.float32),
        np.abs(cosine[keep]).astype(np.float32),
        depth[seen].astype(np.float32),
    )


def surfels(
    points: np.ndarray,
    normals: np.ndarray | None,
    spacing: float | None = None,
    wanted: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Two triangles per point in its tangent plane.

    points: (N, 3) local frame; normals: (N, 3) or None; spacing: of the whole cloud that they are part of,
        None = their own; wanted: (N,) bool, None = all
    returns: (4 K, 3) vertices and (2 K, 3) triangles of the K <= N points that have support

    Half width: FLAT times the distance to the 8th neighbor, which leaves a hole at about 1 of 700 places of a
    randomly sampled surface; SCATTERED times it where the neighbors do not lie in a plane (leaves), so that
    crowns do not swell and their gaps stay open.
    """
    neighbors, distances = NeighborIndex(points, np.zeros(3)).nearest(points, SURFEL_NEIGHBORS + 1)
    if normals is None:
        normals = (
            estimate_normals(points, neighbors)
            if neighbors.shape[1] > 3
            else np.tile(np.array([0, 0, 1], np.float32), (len(points), 1))
        )
    spacing = spacing or point_spacing(distances) or 1.0
    supported = (distances[:, 1:] < 4 * spacing).sum(axis=1) >= min(MIN_SUPPORT, len(points) - 1)
    supported &= True if wanted is None else wanted
    away = np.abs(np.einsum("nki,ni->nk", points[neighbors[:, 1:]] - points[:, None], normals)).mean(axis=1)
    share = np.where(away > MAX_ROUGHNESS * distances[:, -1], SCATTERED, FLAT)
    half = (share * np.clip(distances[:, -1], spacing, 4 * spacing))[supported, None]
    center, normal = points[supported], normals[supported]
    helper = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first_axis = np.cross(normal, helper)
    first_axis /= np.linalg.norm(first_axis, axis=1, keepdims=True)
    second_axis = np.cross(normal, first_axis)
    corners = [
        center + half * (u * first_axis + v * second_axis) for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    vertices = np.stack(corners, axis=1).reshape(-1, 3)
    base = 4 * np.arange(len(center))[:, None]
    return vertices, np.concatenate([base + [[0, 1, 2]], base + [[0, 2, 3]]], axis=1).reshape(-1, 3)
