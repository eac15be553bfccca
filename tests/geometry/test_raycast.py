"""First surface and visibility: analytic occluders, meshes against surfels, both directions on a sphere."""

import numpy as np
import open3d as o3d
import pytest

from sc3d.geometry.cameras import look_at, pinhole_view
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.geometry.raycast import Surface, first_surface, nearest_points, see_points, surface_points

UP = np.float32([0, 0, 1])


def grid(low: float, high: float, step: float, height: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(low, high, step), np.arange(low, high, step))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)


def overhead(height: float = 20.0, size: int = 200) -> object:
    return pinhole_view(
        "top",
        (size, size),
        (size, size, size / 2, size / 2),
        look_at(np.array([0.0, 0, height]), np.zeros(3)),
    )


def sphere_mesh(resolution: int = 100):
    mesh = o3d.t.geometry.TriangleMesh.create_sphere(2.0, resolution)
    return mesh.vertex.positions.numpy().astype(np.float64), mesh.triangle.indices.numpy()


@pytest.mark.parametrize("offset", [np.zeros(3), np.array([5e5, 5e6, 200.0])])
def test_range_and_depth_of_a_sphere_are_analytic(offset):
    vertices, triangles = sphere_mesh(300)
    view = pinhole_view(
        "a", (300, 200), (400, 400, 140, 105), look_at(np.array([7.0, 2, 3]), np.zeros(3))
    ).shifted(-offset)
    first = first_surface(Surface.from_mesh(vertices + offset, triangles, np.round(offset)), view)
    hit = np.isfinite(first.range)
    rows, columns = np.nonzero(hit)
    points = surface_points(first, view, rows, columns) - offset
    assert hit.sum() > 5000
    assert np.abs(np.linalg.norm(points, axis=1) - 2).max() < 1e-3
    towards = (view.center - offset - points) / np.linalg.norm(
        view.center - offset - points, axis=1, keepdims=True
    )
    cosine = np.einsum("ij,ij->i", towards, points / 2)
    assert np.quantile(np.abs(first.incidence[hit] - cosine), 0.99) < 0.03


@pytest.mark.parametrize("kind", ["mesh", "surfels"])
def test_a_wall_hides_what_is_behind_it(kind):
    ground, roof = grid(-6, 6, 0.1, 0.0), grid(-2, 2, 0.1, 5.0)
    points = np.concatenate([ground, roof])
    normals = np.tile(UP, (len(points), 1))
    view = overhead()
    if kind == "mesh":
        corners = np.array(
            [[-2, -2, 5], [2, -2, 5], [2, 2, 5], [-2, 2, 5], [-6, -6, 0], [6, -6, 0], [6, 6, 0], [-6, 6, 0]],
            float,
        )
        surface = Surface.from_mesh(
            corners, np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]), np.zeros(3)
        )
    else:
        surface = Surface.from_cloud(points, normals, np.zeros(3))
    seen = see_points(view, points, normals, first_surface(surface, view), 0.1).points
    visible = np.zeros(len(points), bool)
    visible[seen] = True
    shadow = np.abs(ground[:, :2]).max(axis=1) < 2 * 20 / 15 - 0.2  # what the roof covers, seen from 20 m
    assert not visible[: len(ground)][shadow].any()
    open_ground = (np.abs(ground[:, :2]).max(axis=1) > 2 * 20 / 15 + 0.4) & (
        np.abs(ground[:, :2]).max(axis=1) < 6
    )
    assert visible[: len(ground)][open_ground].mean() > 0.999
    assert visible[len(ground) :].all()


def test_without_the_filter_everything_in_the_image_is_seen():
    points = np.concatenate([grid(-2, 2, 0.2, 0.0), grid(-2, 2, 0.2, 5.0)])
    assert len(see_points(overhead(), points, None, None, 0.1).points) == len(points)


def test_back_faces_are_not_seen():
    wall = grid(-2, 2, 0.1, 5.0)
    points = np.concatenate([wall, wall - [0, 0, 0.05]])  # a slab thinner than the tolerance
    normals = np.concatenate([np.tile(UP, (len(wall), 1)), np.tile(-UP, (len(wall), 1))])
    seen = see_points(
        overhead(),
        points,
        normals,
        first_surface(Surface.from_cloud(points, normals, np.zeros(3)), overhead()),
        0.1,
    ).points
    assert len(seen) == len(wall) and seen.max() < len(wall)


def test_pixel_to_surface_and_point_to_pixel_agree_on_a_sphere():
    vertices, triangles = sphere_mesh()
    surface = Surface.from_mesh(vertices, triangles, np.zeros(3))
    points = np.random.default_rng(0).normal(size=(4000, 3))
    points = 2 * points / np.linalg.norm(points, axis=1, keepdims=True)
    normals = (points / 2).astype(np.float32)
    index, agree, total = NeighborIndex(points), 0, 0
    for seed in range(6):
        center = np.random.default_rng(seed).normal(size=3)
        view = pinhole_view(
            "a", (900, 900), (1000, 1000, 450, 450), look_at(9 * center / np.linalg.norm(center), np.zeros(3))
        )
        first = first_surface(surface, view)
        forward = np.zeros(len(points), bool)
        forward[see_points(view, points, normals, first, 0.02).points] = True
        backward = np.zeros(len(points), bool)
        rows = nearest_points(first, view, index, 0.3)
        backward[np.unique(rows[rows >= 0])] = True
        agree += (forward == backward).sum()
        total += len(points)
    assert agree / total > 0.99


def test_half_of_a_foreground_still_blocks_and_a_floater_does_not():
    ground, roof = grid(-6, 6, 0.1, 0.0), grid(-3, 3, 0.1, 5.0)
    roof = roof[np.random.default_rng(0).permutation(len(roof))[: len(roof) // 2]]
    floater = np.array([[3.3, 3.3, 8.0]])
    points = np.concatenate([ground, roof, floater])
    normals = np.tile(UP, (len(points), 1))
    view = overhead(20, 400)
    first = first_surface(Surface.from_cloud(points, normals, np.zeros(3)), view)
    visible = np.zeros(len(points), bool)
    visible[see_points(view, points, normals, first, 0.1).points] = True
    behind = np.abs(ground[:, :2]).max(axis=1) < 3
    assert visible[: len(ground)][behind].mean() < 0.002
    under = np.linalg.norm(ground[:, :2] - floater[0, :2] * 20 / 12, axis=1) < 0.4
    assert under.sum() > 20 and visible[: len(ground)][under].all()
    rows = nearest_points(first, view, NeighborIndex(points), 0.3)
    assert not (rows == len(points) - 1).any()
