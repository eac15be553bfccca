"""True points: the labelled truth cloud and the sparse points with their tracks."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from sc3d.geometry.cameras import View, in_image, project
from sc3d.synthetic.mesh import LEAF
from sc3d.synthetic.shading import display
from sc3d.synthetic.walk import EYE_HEIGHT, PAVEMENT
from sc3d.synthetic.world import World

LIFT = 0.002  # rays start this far off the surface, m


def truth_cloud(world: World, num_points: int, rng: np.random.Generator) -> o3d.t.geometry.PointCloud:
    """Area-uniform samples of every surface of the site that shows from some direction above the horizon.

    Of a street also what shows to somebody who walks along it.
    returns: `num_points` points: positions float64 (world, m), normals float32 (outward), colors uint8, label
        uint8 (`scene.class_table.OTHER` = cars, walls), instance int32 (`World.instances`)
    """
    points, triangles = sample_surface(world, num_points, rng)
    light = world.light(points.astype(np.float32), triangles, np.full(len(points), 0.1, np.float32))
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    cloud.point.normals = o3d.core.Tensor(world.normals(triangles).astype(np.float32))
    cloud.point.colors = o3d.core.Tensor(display(light))
    cloud.point.label = o3d.core.Tensor(world.truth(points.astype(np.float32), triangles)[:, None])
    cloud.point.instance = o3d.core.Tensor(world.instances(triangles)[:, None])
    return cloud


def sample_surface(world: World, num_points: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) float64 points uniform over the outer surfaces of the site, and their triangles (N,)."""
    corners = world.corners.astype(np.float64)
    areas = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    near = np.abs(corners[:, :, :2]).min(1).max(1) <= world.ground.extent / 2
    share = np.cumsum(np.where(near, areas, 0.0))
    found_points, found_triangles, missing = [], [], num_points
    while missing > 0:
        triangles = np.searchsorted(share, rng.random(int(1.5 * missing) + 100) * share[-1], side="right")
        s, t = np.sqrt(rng.random(len(triangles))), rng.random(len(triangles))
        weights = np.stack([1 - s, s * (1 - t), s * t], 1)
        points = np.einsum("nc,ncd->nd", weights, corners[triangles])
        inside = np.abs(points[:, :2]).max(1) <= world.ground.extent / 2
        kept = np.flatnonzero(inside)
        seen = _seen_from_above(world, points[kept], triangles[kept])
        if world.street:
            rest = np.flatnonzero(~seen)
            seen[rest] = _seen_on_foot(world, points[kept[rest]], triangles[kept[rest]])
        kept = kept[seen]
        found_points.append(points[kept])
        found_triangles.append(triangles[kept])
        missing -= len(kept)
    return np.concatenate(found_points)[:num_points], np.concatenate(found_triangles)[:num_points]


def find_tracks(
    world: World, views: list[View], num_points: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, list]:
    """True sparse points seen by at least three views.

    returns: (P, 3) points; (P,) triangles; per view the indices (K,) of the points it sees and their pixels
        (K, 2)
    """
    points, triangles = sample_surface(world, num_points, rng)
    seen, pixels = [], []
    for view in views:
        at, _ = project(view, points)
        inside = np.flatnonzero(in_image(view, at))
        clear = ~world.hidden(
            np.broadcast_to(view.center, (len(inside), 3)), points[inside] - view.center, far=0.9998
        )
        seen.append(inside[clear])
        pixels.append(at[inside[clear]])
    counts = np.bincount(np.concatenate(seen), minlength=len(points))
    rank = np.cumsum(counts >= 3) - 1
    observations = [
        (rank[index[counts[index] >= 3]], at[counts[index] >= 3]) for index, at in zip(seen, pixels)
    ]
    return points[counts >= 3], triangles[counts >= 3], observations


def _seen_from_above(world: World, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(N,) bool: something above can see the point: straight up, or one of 24 directions 60, 40 and 20
    degrees above the horizon.
    """
    normals = world.normals(triangles)
    leaf = world.ints[triangles, 0] == LEAF  # seen from both sides
    visible = np.zeros(len(points), bool)
    directions = [np.array([0.0, 0.0, 1.0])]
    for turn, elevation in enumerate(np.radians([60, 40, 20])):
        for azimuth in 2 * np.pi * (np.arange(8) + turn / 3) / 8:
            level, up = np.cos(elevation), np.sin(elevation)
            directions.append(np.array([np.cos(azimuth) * level, np.sin(azimuth) * level, up]))
    for direction in directions:
        facing = leaf | (normals @ direction > 0.02)
        rest = np.flatnonzero(~visible & facing)
        if len(rest):
            visible[rest] = ~world.hidden(
                points[rest] + LIFT * direction, np.broadcast_to(direction, (len(rest), 3))
            )
    return visible


def _seen_on_foot(world: World, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(N,) bool: somebody on a pavement, in front of the point or a few steps aside, can see it."""
    normals = world.normals(triangles)
    leaf = world.ints[triangles, 0] == LEAF
    visible = np.zeros(len(points), bool)
    for aside in (-6.0, 0.0, 6.0):
        for pavement in (-PAVEMENT, PAVEMENT):
            eyes = np.column_stack(
                [points[:, 0] + aside, np.full(len(points), pavement), np.zeros(len(points))]
            )
            eyes[:, 2] = world.ground.height(eyes[:, :2]) + EYE_HEIGHT
            ways = eyes - points
            facing = leaf | ((normals * ways).sum(1) > 0.02 * np.linalg.norm(ways, axis=1))
            rest = np.flatnonzero(~visible & facing)
            if len(rest):
                visible[rest] = ~world.hidden(points[rest] + LIFT * ways[rest], ways[rest], far=0.99)
    return visible
