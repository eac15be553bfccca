"""A clicked point must be the one that is seen, and the photos named must be those that fusion would count."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pycolmap
import pytest

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, local_origin, look_at, pinhole_view, project
from sc3d.geometry.raycast import Surface, first_surface, see_points
from sc3d.scene.class_table import parse_classes
from sc3d.view import picking
from sc3d.view.display_cloud import DisplayCloud, class_ids, only_classes, progressive_order, with_votes
from sc3d.view.picking import Inspector, photos_that_see, point_on_ray, position_at

UTM = np.array([512_345.0, 5_187_654.0, 210.0])
CLASSES = parse_classes(
    [
        {"id": 1, "name": "road", "color": [150, 150, 160]},
        {"id": 3, "name": "a / b", "color": [170, 220, 110]},
    ],
    "test",
)


def make_cloud(points: np.ndarray, **attributes: np.ndarray) -> o3d.t.geometry.PointCloud:
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.ascontiguousarray(points)))
    for name, values in attributes.items():
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(values))
    return cloud


def box_on_ground() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) in UTM and triangles of a ground square with a box on it."""
    ground = o3d.t.geometry.TriangleMesh.create_box(20, 20, 1).translate([-10, -10, -1])
    box = o3d.t.geometry.TriangleMesh.create_box(4, 3, 5).translate([-2, -1, 0])
    vertices = np.concatenate([mesh.vertex.positions.numpy() for mesh in (ground, box)]).astype(np.float64)
    triangles = np.concatenate([ground.triangle.indices.numpy(), box.triangle.indices.numpy() + 8])
    return vertices + UTM, triangles


def views_around() -> list[View]:
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=240, height=180, params=[210.0, 124.0, 87.0, -0.08])
    centers = [[0, 0, 30], [18, 2, 14], [-16, 9, 12], [3, -19, 9], [0, 15, 20]]
    return [
        View(f"photo_{row}.jpg", camera, look_at(UTM + center, UTM)) for row, center in enumerate(centers)
    ]


def points_on_faces(count: int) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) points in UTM and their outward normals, on the ground and on all faces of the box but its
    floor.
    """
    rng = np.random.default_rng(1)
    u, v = rng.uniform(0, 1, (2, count))
    faces = [
        (np.c_[20 * u - 10, 20 * v - 10, 0 * u], [0, 0, 1]),
        (np.c_[4 * u - 2, 3 * v - 1, 0 * u + 5], [0, 0, 1]),
        (np.c_[0 * u - 2, 3 * v - 1, 5 * u], [-1, 0, 0]),
        (np.c_[0 * u + 2, 3 * v - 1, 5 * u], [1, 0, 0]),
        (np.c_[4 * u - 2, 0 * v - 1, 5 * u], [0, -1, 0]),
        (np.c_[4 * u - 2, 0 * v + 2, 5 * u], [0, 1, 0]),
    ]
    points = np.concatenate([face for face, _ in faces]) + UTM
    return points, np.repeat(np.float32([normal for _, normal in faces]), count, axis=0)


def test_photos_that_see_are_those_that_fusion_counts():
    views, (points, normals) = views_around(), points_on_faces(60)
    surface = Surface.from_mesh(*box_on_ground(), local_origin(views))
    # the slow twin
    seen = {
        view.name: set(see_points(view, points, normals, first_surface(surface, view), 0.1).points.tolist())
        for view in views
    }
    found = [
        photos_that_see(point, normal, views, surface, 0.1)
        for point, normal in zip(points, normals, strict=True)
    ]
    assert found == [[name for name, rows in seen.items() if row in rows] for row in range(len(points))]
    counts = np.array([len(names) for names in found])
    assert counts.min() == 0 and counts.max() >= 4  # points that nobody sees and points that nearly all see


def inspector(tmp_path, **attributes: np.ndarray) -> Inspector:
    points, normals = points_on_faces(300)
    labels = np.resize(np.uint8([1, 3, 0]), len(points))[:, None]
    mesh = o3d.t.geometry.TriangleMesh(
        *(o3d.core.Tensor(values) for values in (box_on_ground()[0], box_on_ground()[1].astype(np.int32)))
    )
    o3d.t.io.write_triangle_mesh(str(tmp_path / "mesh.ply"), mesh)
    return Inspector(
        make_cloud(points, label=labels, **attributes), views_around(), CLASSES, [tmp_path / "mesh.ply"], 0.1
    )


def test_everything_known_of_a_point_is_told(tmp_path):
    points, normals = points_on_faces(300)
    votes = {
        f"votes_{label}": np.full((len(points), 1), count, np.float32)
        for label, count in enumerate((5, 1.25, 0, 3.5))
    }
    state, confidence = (
        np.full((len(points), 1), 2, np.uint8),
        np.linspace(0, 1, len(points), dtype=np.float32)[:, None],
    )
    looked_up = inspector(tmp_path, normals=normals, state=state, confidence=confidence, **votes).look_up(301)
    surface = Surface.from_mesh(*box_on_ground(), UTM)
    assert (looked_up.label, looked_up.state) == ("a / b", "locked") and np.isclose(
        looked_up.confidence, confidence[301, 0]
    )
    assert list(looked_up.votes.items()) == [("a / b", 3.5), ("road", 1.25)]
    assert np.array_equal(looked_up.position, points[301])
    assert looked_up.photos == tuple(photos_that_see(points[301], normals[301], views_around(), surface, 0.1))
    assert all(
        word in str(looked_up) for word in ("point 301", "a / b 3.5, road 1.2", "locked", "photo_0.jpg")
    )


def test_a_surface_that_does_not_fit_is_told_and_not_read(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(picking, "fits", lambda *_: False)
    found = inspector(tmp_path)
    assert found.look_up(0).photos == () and found.look_up(1).photos == ()
    assert caplog.text.count("which photos see a point is not told") == 1


def test_nearest_is_the_nearest_at_utm_size(tmp_path):
    found, (points, _) = inspector(tmp_path), points_on_faces(300)
    queries = UTM + np.random.default_rng(3).uniform(-11, 11, (100, 3))
    assert [found.nearest(query) for query in queries] == [
        int(np.argmin(((points - query) ** 2).sum(axis=1))) for query in queries
    ]


def test_missing_attributes_views_and_mesh_do_no_harm(tmp_path):
    points, _ = points_on_faces(300)
    bare = Inspector(make_cloud(points), [], None, [tmp_path / "no_mesh.ply"]).look_up(7)
    assert (bare.label, bare.confidence, bare.state, bare.votes, bare.photos) == (None, None, None, {}, ())
    ground = points[:300]  # no normals, no mesh: both are made from the points
    seen = Inspector(make_cloud(ground), views_around(), None, [tmp_path / "no_mesh.ply"]).look_up(
        int(np.argmin(((ground - UTM - [5, 0, 0]) ** 2).sum(axis=1)))
    )
    assert set(seen.photos) == {view.name for view in views_around()}
    from_below = View("below.jpg", views_around()[0].camera, look_at(UTM + [1, 1, -20], UTM))
    assert (
        Inspector(make_cloud(ground), [*views_around(), from_below], None, [tmp_path / "no_mesh.ply"])
        .look_up(0)
        .photos.count("below.jpg")
        == 0
    )


def test_ray_takes_the_first_surface_and_there_the_nearest_point():
    grid = np.stack(
        np.meshgrid(np.arange(-5, 5.0, 0.5), np.arange(-5, 5.0, 0.5), indexing="ij"), axis=-1
    ).reshape(-1, 2)
    points = np.concatenate([np.c_[grid, np.zeros(len(grid))], np.c_[grid, np.full(len(grid), 4.0)]])
    row = point_on_ray(points, np.array([0.0, 0, 10]), np.array([0.09, 0.0, -1.0]) * 7, 0.5)
    assert np.array_equal(points[row], [0.5, 0, 4])
    assert np.array_equal(
        points[point_on_ray(points, np.array([0.0, 0, 2]), np.array([0.0, 0, -1]), 0.5)], [0, 0, 0]
    )
    assert point_on_ray(points, np.array([20.0, 0, 10]), np.array([0, 0, -1.0]), 0.5) is None
    assert point_on_ray(points[:0], np.zeros(3), np.array([0, 0, 1.0]), 0.5) is None


@pytest.mark.parametrize("buffer", [False, True])
def test_pixel_of_a_picture_goes_back_to_its_point(buffer):
    size, near, far = (320, 240), 1.0, 200.0
    view = pinhole_view("window", size, (260, 260, 160, 120), look_at(np.array([3.0, -30, 22]), np.zeros(3)))
    flip = np.diag([1.0, -1, -1, 1])  # OpenGL: y up, camera looks along -z
    last = [(near + far) / (near - far), 2 * near * far / (near - far)]
    projection = np.array([[2 * 260 / 320, 0, 0, 0], [0, 2 * 260 / 240, 0, 0], [0, 0, *last], [0, 0, -1, 0]])
    for point in np.random.default_rng(2).uniform(-6, 6, (20, 3)):
        pixel, z = project(view, point[None])
        column, row = np.floor(pixel[0]).astype(int)
        depth = np.full(size[::-1], 1.0 if buffer else np.inf)
        depth[row, column] = (
            (projection[2, 2] * -z[0] + projection[2, 3]) / z[0] / 2 + 0.5 if buffer else z[0]
        )
        found = position_at(depth, (column, row), flip @ view.cam_from_world, projection)
        assert np.linalg.norm(found - point) < 0.75 * z[0] / 260  # half a pixel
        assert position_at(depth, (column - 1, row), flip @ view.cam_from_world, projection) is None


def test_every_beginning_of_the_order_is_spread_evenly():
    side = 32
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), axis=-1).reshape(-1, 2)
    points = np.random.default_rng(4).permutation(np.c_[grid, np.zeros(len(grid))]) + UTM
    order = progressive_order(points)
    assert np.array_equal(np.sort(order), np.arange(len(points)))
    for blocks in (1, 2, 4, 8, 16):  # as many points as square blocks: one in each
        first = (points[order[: blocks**2], :2] - UTM[:2]).astype(int) // (side // blocks)
        assert len(np.unique(first, axis=0)) == blocks**2
    shuffle = np.random.default_rng(5).permutation(len(points))
    assert np.array_equal(points[shuffle][progressive_order(points[shuffle])], points[order])
    assert len(progressive_order(points[:0])) == 0 and progressive_order(points[:1]).tolist() == [0]


def test_shown_cloud_keeps_millimeters_and_rows():
    points = UTM + np.random.default_rng(6).uniform(-60, 60, (5000, 3))
    label = np.random.default_rng(7).choice(np.uint8([0, 1, 3]), (5000, 1))
    display = DisplayCloud.from_cloud(
        make_cloud(points, label=label, confidence=np.ones((5000, 1), np.float32)), np.round(UTM), CLASSES
    )
    assert (
        display.points.dtype == np.float32
        and np.abs(display.points + display.origin - points[display.rows]).max() < 1e-3
    )
    assert np.array_equal(display.colors("label"), CLASSES.palette[label.ravel()[display.rows]])
    assert display.class_counts == {value: int((label == value).sum()) for value in (0, 1, 3)}
    assert display.colorings == ("label", "confidence") and np.isclose(
        display.spacing_at(1250), 2 * display.spacing_at(5000)
    )


def test_classes_are_chosen_by_name():
    cloud = make_cloud(np.zeros((4, 3)), label=np.uint8([[0], [1], [3], [1]]))
    assert class_ids(CLASSES, ()) is None and class_ids(CLASSES, ("road", "unlabelled")) == {0, 1}
    assert (
        only_classes(cloud, {1}).point["label"].numpy().ravel().tolist() == [1, 1]
        and only_classes(cloud, None) is cloud
    )
    with pytest.raises(InputError, match="no class 'house': choose from road, a / b, unlabelled"):
        class_ids(CLASSES, ("house",))
    with pytest.raises(InputError, match="nothing to show"):
        only_classes(cloud, {9})


def test_votes_come_from_seeds_of_the_same_points_only():
    points = UTM + np.random.default_rng(8).uniform(-1, 1, (6, 3))
    seeds = make_cloud(points, votes_0=np.ones((6, 1), np.float32), votes_1=np.full((6, 1), 2, np.float32))
    merged = with_votes(make_cloud(points, label=np.ones((6, 1), np.uint8)), seeds)
    assert merged.point["votes_1"].numpy().tolist() == [[2.0]] * 6 and "label" in merged.point
    with pytest.raises(InputError, match="different points"):
        with_votes(make_cloud(points[::-1]), seeds)
