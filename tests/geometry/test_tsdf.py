"""TSDF fusion of exact depth maps: sphere, deep scene, off-center principal point."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from sc3d.geometry.cameras import look_at, pinhole_view
from sc3d.geometry.raycast import Surface, first_surface
from sc3d.geometry.tsdf import (
    DepthFusion,
    cloud_in_order,
    drop_small_parts,
    mesh_in_order,
    near_mesh,
    pixel_squares,
)

VOXEL = 0.05


@pytest.fixture(scope="module")
def sphere():
    """Fused from 40 exact depth maps; grazing pixels left out, as `extract` does."""
    mesh = o3d.t.geometry.TriangleMesh.create_sphere(2.0, 200)
    surface = Surface.from_mesh(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy(), np.zeros(3))
    fusion = DepthFusion(VOXEL, 2000)
    color = np.broadcast_to(np.uint8([200, 100, 0]), (300, 400, 3))
    for row in range(40):  # spread evenly, by the golden angle
        height, turn = 1 - (2 * row + 1) / 40, np.pi * (3 - np.sqrt(5)) * row
        center = np.array(
            [np.cos(turn) * np.sqrt(1 - height**2), np.sin(turn) * np.sqrt(1 - height**2), height]
        )
        view = pinhole_view("a", (400, 300), (600, 600, 190, 155), look_at(8 * center, np.zeros(3)))
        first = first_surface(surface, view)
        depth = np.where(
            np.isfinite(first.range) & (first.incidence > np.cos(np.deg2rad(75))),
            first.range * first.ray_z,
            0,
        )
        fusion.integrate(view, depth.astype(np.float32), color, 20.0)
    return fusion


def test_sphere_within_half_a_voxel_and_closed(sphere):
    mesh = sphere.mesh()
    radius = np.linalg.norm(mesh.vertex.positions.numpy(), axis=1)
    assert np.abs(radius - 2).max() < 0.5 * VOXEL
    assert abs(radius.mean() - 2) < 0.1 * VOXEL
    directions = np.random.default_rng(1).normal(size=(5000, 3))
    onto = 2 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    assert near_mesh(onto, mesh, VOXEL).mean() > 0.999


def test_near_a_part_of_a_mesh_is_what_distances_say(sphere):
    """Of the whole sphere's cloud, in its order, near one half of the mesh."""
    mesh, points = sphere.mesh(), sphere.cloud().point.positions.numpy()
    corners = mesh.vertex.positions.numpy()[mesh.triangle.indices.numpy()]
    half = mesh.select_faces_by_mask(o3d.core.Tensor(corners[..., 0].max(axis=1) < 0.3))
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(half)
    expected = scene.compute_distance(o3d.core.Tensor(points)).numpy() <= 0.5 * VOXEL
    assert 0.3 < expected.mean() < 0.8
    assert np.array_equal(near_mesh(points, half, 0.5 * VOXEL), expected)
    backwards = near_mesh(points[::-1], half, 0.5 * VOXEL)  # another order costs time, no more
    assert np.array_equal(backwards[::-1], expected)


def test_cloud_has_colors_and_outward_normals(sphere):
    cloud = sphere.cloud()
    points, normals = cloud.point.positions.numpy(), cloud.point.normals.numpy()
    assert np.abs(np.linalg.norm(points, axis=1) - 2).max() < 0.5 * VOXEL
    assert (np.einsum("ij,ij->i", points, normals) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert np.abs(cloud.point.colors.numpy().astype(int) - [200, 100, 0]).max() <= 1


def test_triangles_face_outwards(sphere):
    mesh = sphere.mesh()
    corners = mesh.vertex.positions.numpy()[mesh.triangle.indices.numpy()]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ij,ij->i", facing, corners[:, 0]) >= 0).all()


def test_a_deep_scene_keeps_its_depth():
    """A plane 120 m away: nothing wraps, as 16-bit millimeters would at 65.5 m."""
    fusion = DepthFusion(0.5, 2000)
    for x in (0.0, 10.0):
        view = pinhole_view(
            "a", (120, 90), (150, 150, 57, 47), look_at(np.array([x, 0, 120.0]), np.array([x, 0, 0.0]))
        )
        fusion.integrate(view, np.full((90, 120), 120, np.float32), np.zeros((90, 120, 3), np.uint8), 150.0)
    height = fusion.mesh().vertex.positions.numpy()[:, 2]
    assert len(height) > 1000 and np.abs(height).max() < 0.05


def test_empty_depth_adds_nothing_and_distorted_views_are_refused():
    import pycolmap

    from sc3d.geometry.cameras import View

    fusion = DepthFusion(0.5, 10)
    view = pinhole_view("a", (20, 10), (15, 15, 10, 5), np.eye(4))
    fusion.integrate(view, np.zeros((10, 20), np.float32), np.zeros((10, 20, 3), np.uint8), 150.0)
    assert len(fusion.cloud().point.positions) == 0 and len(fusion.mesh().triangle.indices) == 0
    radial = View(
        "b", pycolmap.Camera(model="RADIAL", width=20, height=10, params=[15, 10, 5, 0.1, 0]), np.eye(4)
    )
    with pytest.raises(ValueError, match="pinhole"):
        fusion.integrate(radial, np.ones((10, 20), np.float32), np.zeros((10, 20, 3), np.uint8), 150.0)


def test_a_view_without_depth_in_range_or_with_a_few_pixels_adds_nothing():
    """Open3D raises "No block is touched" for these."""
    fusion, color = DepthFusion(0.5, 10), np.zeros((30, 40, 3), np.uint8)
    view = pinhole_view("a", (40, 30), (40, 40, 20, 15), np.eye(4))
    assert not fusion.integrate(view, np.full((30, 40), 200, np.float32), color, 150.0)
    dot = np.zeros((30, 40), np.float32)
    dot[5, 5] = 3.0
    assert not fusion.integrate(view, dot, color, 150.0)
    assert len(fusion.mesh().triangle.indices) == 0
    assert fusion.integrate(view, np.full((30, 40), 3, np.float32), color, 150.0)


def test_pixel_squares_with_normals_tile_a_grazing_plane_without_gaps():
    """Ground seen at 6 to 17 degrees: squares that lie in it are seen from above as one surface, those that face
    the camera are not.
    """
    center = np.array([0.0, -10.0, 1.5])
    view = pinhole_view("a", (80, 60), (200, 200, 40, 30), look_at(center, np.array([0.0, 0, 0.0])))
    rays_cam = np.stack(
        [*np.meshgrid((np.arange(80) - 39.5) / 200, (np.arange(60) - 29.5) / 200), np.ones((60, 80))], axis=2
    )
    down = rays_cam @ view.cam_from_world[:3, 2]
    depth = np.where(down < -0.1, -1.5 / np.minimum(down, -0.1), 0).astype(np.float32)
    depth[depth > 15] = 0
    normals = np.tile(view.cam_from_world[:3, 2].astype(np.float32), (60, 80, 1))
    above = pinhole_view(
        "b", (60, 120), (100, 100, 30, 60), look_at(np.array([0.0, -4.0, 9.0]), np.array([0.0, -4.0, 0]))
    )
    hits = {}
    for name, given in (("in it", normals), ("longer", 90 * normals), ("facing", None)):
        mesh, cloud = pixel_squares(view, depth, np.zeros((60, 80, 3), np.uint8), depth > 0, given)
        surface = Surface.from_mesh(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy(), np.zeros(3))
        first = first_surface(surface, above)
        hits[name] = np.isfinite(first.range)
        if given is not None:
            assert np.abs(mesh.vertex.positions.numpy()[:, 2]).max() < 1e-3
            assert np.abs(cloud.point.positions.numpy()[:, 2]).max() < 1e-3
            assert (cloud.point.normals.numpy()[:, 2] > 0.999).all()
    columns, rows = np.meshgrid(np.arange(60), np.arange(120))
    x, y = above_ground(above, columns + 0.5, rows + 0.5)
    ahead = y + 10
    inside = (ahead > 6) & (ahead < 10) & (np.abs(x) < 0.15 * ahead)
    assert inside.sum() > 300
    assert hits["in it"][inside].all() and (hits["longer"] == hits["in it"]).all()
    assert hits["facing"][inside].mean() < 0.9


def above_ground(view, columns, rows) -> tuple[np.ndarray, np.ndarray]:
    """x and y where the rays of pixels meet z = 0."""
    pixels = np.stack([columns, rows, np.ones_like(columns)], axis=-1)
    directions = pixels @ np.linalg.inv(view.matrix).T @ view.cam_from_world[:3, :3]
    points = view.center - directions * (view.center[2] / directions[..., 2:])
    return points[..., 0], points[..., 1]


def test_small_parts_are_dropped():
    large = o3d.t.geometry.TriangleMesh.create_sphere(2.0, 20)
    small = o3d.t.geometry.TriangleMesh.create_box().translate([10, 0, 0])
    both = o3d.t.geometry.TriangleMesh.from_legacy(large.to_legacy() + small.to_legacy())
    assert len(drop_small_parts(both, 50).triangle.indices) == len(large.triangle.indices)


def test_pixel_squares_cover_exactly_the_wanted_pixels_at_their_depth():
    view = pinhole_view(
        "a", (80, 60), (90, 90, 37, 32), look_at(np.array([3.0, 1, 20]), np.array([0.0, 0, 0]))
    )
    rng = np.random.default_rng(0)
    depth = rng.uniform(15, 16, (60, 80)).astype(np.float32)
    wanted = np.zeros((60, 80), bool)
    wanted[10:40, 20:60] = True
    depth[12, 30] = 0
    mesh, cloud = pixel_squares(view, depth, np.full((60, 80, 3), 77, np.uint8), wanted)
    assert len(mesh.triangle.indices) == 2 * len(cloud.point.positions) == 2 * (30 * 40 - 1)
    first = first_surface(
        Surface.from_mesh(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy(), np.zeros(3)), view
    )
    seen = first.range * first.ray_z
    inner = wanted.copy()
    inner[12, 30] = False
    assert np.isfinite(seen[inner]).all()
    assert (seen[inner] <= depth[inner] + 1e-3).all() and np.median(np.abs(seen - depth)[inner]) < 0.5
    outside = np.ones_like(wanted)
    outside[9:41, 19:61] = False  # squares reach half a pixel further
    assert not np.isfinite(seen[outside]).any()
    corners = mesh.vertex.positions.numpy()[mesh.triangle.indices.numpy()]
    facing = np.einsum(
        "ij,ij->i",
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
        view.center - corners[:, 0],
    )
    assert (facing > 0).all()
    empty, none = pixel_squares(view, depth, np.zeros((60, 80, 3), np.uint8), np.zeros((60, 80), bool))
    assert len(empty.triangle.indices) == 0 and len(none.point.positions) == 0


def test_order_is_that_of_positions_and_says_the_same():
    """A mesh whose vertices and triangles are shuffled comes out as the same bytes, with the same corners,
    sense and colors.
    """
    rng = np.random.default_rng(3)
    mesh = o3d.t.geometry.TriangleMesh.create_sphere(1.0, 12)
    vertices, triangles = mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()
    colors = rng.random(vertices.shape).astype(np.float32)
    found = []
    for _ in range(2):
        order = rng.permutation(len(vertices))
        turned = np.stack(
            [np.roll(row, rng.integers(3)) for row in np.argsort(order)[rng.permutation(triangles)]]
        )
        shuffled = o3d.t.geometry.TriangleMesh(o3d.core.Tensor(vertices[order]), o3d.core.Tensor(turned))
        shuffled.vertex.colors = o3d.core.Tensor(colors[order])
        found.append(mesh_in_order(shuffled))
    one, other = found
    assert all(
        (one.vertex[name].numpy() == other.vertex[name].numpy()).all() for name in ("positions", "colors")
    )
    assert (one.triangle.indices.numpy() == other.triangle.indices.numpy()).all()
    keys = one.vertex.positions.numpy()[:, ::-1].tolist()
    assert keys == sorted(keys)
    described = np.concatenate([one.vertex.positions.numpy(), one.vertex.colors.numpy()], axis=1)[
        one.triangle.indices.numpy()
    ]
    before = np.concatenate([vertices, colors], axis=1)[triangles]
    assert _corner_set(described) == _corner_set(before)


def _corner_set(corners: np.ndarray) -> list:
    """Triangles without regard to their order or first corner, but to their sense."""
    return sorted(
        min(tuple(map(tuple, np.roll(triangle, turn, axis=0))) for turn in range(3)) for triangle in corners
    )


def test_cloud_order_keeps_every_point_with_its_values():
    rng = np.random.default_rng(4)
    points, order = (
        rng.integers(0, 4, (60, 3)).astype(np.float32) + rng.random((60, 3)).astype(np.float32),
        rng.permutation(60),
    )
    clouds = []
    for rows in (np.arange(60), order):
        cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points[rows]))
        cloud.point.colors = o3d.core.Tensor(np.arange(60, dtype=np.uint8)[rows, None])
        clouds.append(cloud_in_order(cloud))
    for name in ("positions", "colors"):
        np.testing.assert_array_equal(clouds[0].point[name].numpy(), clouds[1].point[name].numpy())
    np.testing.assert_array_equal(
        clouds[0].point.positions.numpy(), points[clouds[0].point.colors.numpy()[:, 0]]
    )


FUSE = """
import hashlib, os, sys
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(sys.argv[1])])
import numpy as np
from sc3d.geometry.cameras import look_at, pinhole_view
from sc3d.geometry.tsdf import DepthFusion
fusion, rng = DepthFusion(0.1, 4000), np.random.default_rng(0)
for x in range(4):
    view = pinhole_view("a", (160, 120), (150, 150, 80, 60), look_at(np.array([x, 0.0, 9.0]), np.array([0.0, 0, 0])))
    fusion.integrate(view, (9 + rng.random((120, 160)) * 0.3).astype(np.float32), rng.integers(0, 255, (120, 160, 3), np.uint8), 20.0)
mesh, cloud, state = fusion.mesh(), fusion.cloud(), hashlib.md5()
for values in (mesh.vertex.positions, mesh.vertex.colors, mesh.triangle.indices, cloud.point.positions, cloud.point.colors, cloud.point.normals):
    assert len(values) > 5000
    state.update(np.ascontiguousarray(values.numpy()).tobytes())
print(state.hexdigest())
"""


def test_one_core_and_all_cores_give_the_same_bytes():
    def digest(cores: int) -> str:
        environment = os.environ | {
            "OMP_NUM_THREADS": str(cores),
            "PYTHONPATH": str(Path(__file__).parents[2]),
        }
        return subprocess.run(
            [sys.executable, "-c", FUSE, str(cores)],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stdout

    assert digest(1) == digest(2) == digest(2)
