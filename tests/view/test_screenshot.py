"""Pictures must be exact: a point lies where `project` says, in the color it was given, with either
renderer.
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import open3d as o3d
import pycolmap
import pytest

from sc3d.errors import InputError, Sc3dError
from sc3d.geometry.cameras import View, in_image, look_at, pinhole_view, project, undistorted
from sc3d.scene.class_table import parse_classes
from sc3d.scene.labelled_cloud import LabelledSurface
from sc3d.view.colors import (
    COLORINGS,
    CONTESTED,
    STATES,
    color_points,
    color_scale,
    disagreement,
    disagreement_colors,
    shaded,
)
from sc3d.view.picking import Inspector
from sc3d.view.renderers import draws_colors, render, vulkan_works
from sc3d.view.screenshot import Style, draw_points, screenshot
from sc3d.view.viewpoints import frusta, overview
from sc3d.view.window import show

UTM = np.array([500_000.0, 4_500_000.0, 100.0])
CLASSES = parse_classes(
    [
        {"id": 1, "name": "grass", "color": [124, 179, 66]},
        {"id": 4, "name": "building", "color": [214, 60, 60]},
    ],
    "test",
)
# The two renderers cannot share a process, so the one that is not the default here runs in another one.
EXACTNESS = """
import sys; sys.path.insert(0, {folder!r})
from tests.view import test_screenshot as test_view
test_view.check_exactness({renderer!r})
"""


def make_cloud(points: np.ndarray, **attributes: np.ndarray) -> o3d.t.geometry.PointCloud:
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.ascontiguousarray(points)))
    for name, values in attributes.items():
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(values))
    return cloud


def full_cloud(num_points: int = 5) -> o3d.t.geometry.PointCloud:
    rng = np.random.default_rng(0)
    votes = {f"votes_{label}": rng.uniform(0, 3, (num_points, 1)).astype(np.float32) for label in range(5)}
    return make_cloud(
        rng.uniform(-5, 5, (num_points, 3)) + UTM,
        colors=rng.integers(0, 256, (num_points, 3)).astype(np.uint8),
        label=np.resize(np.uint8([0, 1, 4]), num_points)[:, None],
        confidence=np.linspace(0, 1, num_points, dtype=np.float32)[:, None],
        state=np.resize(np.arange(5, dtype=np.uint8), num_points)[:, None],
        **votes,
    )


def odd_view() -> View:
    """Off-center principal point, pixels that are not square, rolled."""
    cam_from_world = look_at(UTM + [3, -22, 18], UTM, up=(0.3, 0.1, 1.0))
    return pinhole_view("odd.jpg", (641, 403), (500, 520, 300, 222), cam_from_world)


def check_exactness(renderer: str) -> None:
    # apart, so that none hides another
    grid = np.stack(np.meshgrid(np.arange(-9, 10, 3.0), np.arange(-9, 10, 3.0), [0.0]), axis=-1).reshape(
        -1, 3
    )
    points = UTM + grid + np.random.default_rng(1).uniform(-0.4, 0.4, grid.shape)
    order = np.arange(len(points))
    colors = np.stack([order * 4 + 10, 250 - order * 5, order % 7 * 30 + 20], axis=1).astype(np.uint8)
    view = odd_view()
    pixels, _ = project(view, points)
    style = Style("photo", legend=False, background=(0, 0, 0), supersampling=1, renderer=renderer)
    image = screenshot(make_cloud(points, colors=colors), view, (641, 641), style).astype(int)
    assert image.shape == (403, 641, 3)
    found = 0
    for pixel, color in zip(pixels, colors, strict=True):
        if not ((pixel > 8) & (pixel < [view.width - 8, view.height - 8])).all():
            continue
        rows, columns = np.nonzero((image == color).all(axis=2))
        assert np.abs([columns.mean() + 0.5 - pixel[0], rows.mean() + 0.5 - pixel[1]]).max() < 1.5
        found += 1
    assert found >= 30


@pytest.mark.parametrize("renderer", ["vulkan", "egl"])
def test_points_appear_where_project_says(renderer):
    if renderer == "vulkan" and not vulkan_works():
        pytest.skip("no Vulkan here")
    script = EXACTNESS.format(folder=str(Path(__file__).parents[2]), renderer=renderer)
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False
    )
    if "cannot render pictures here" in done.stderr:
        pytest.skip(f"no {renderer} here")
    assert done.returncode == 0, done.stderr[-2000:]


def test_a_renderer_that_draws_all_in_the_first_color_is_found_out():
    """As Vulkan does with Mesa 25.0."""

    def first_color(renderable, view, background):
        colors = np.repeat(renderable.colors[:1], len(renderable.colors), axis=0)
        return render(dataclasses.replace(renderable, colors=colors), view, background)

    assert draws_colors(render)
    assert not draws_colors(first_color)


def test_undistorted_photo_view_is_drawn():
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=800, height=600, params=[700, 390, 310, 0.05])
    view = View("photo.jpg", camera, look_at(UTM + [0, -1, 40], UTM))
    pinhole = undistorted(view, 400)
    points = UTM + np.array([[-6.0, 3, 0], [8, -2, 0], [0, 0, 1], [5, 6, 2]])
    colors = np.uint8([[255, 0, 0], [0, 200, 0], [0, 0, 255], [200, 0, 200]])
    style = Style("photo", background=(0, 0, 0), supersampling=1)
    image = screenshot(make_cloud(points, colors=colors), view, (400, 300), style).astype(int)
    assert image.shape[:2] == (pinhole.height, pinhole.width)
    for pixel, color in zip(project(pinhole, points)[0], colors, strict=True):
        rows, columns = np.nonzero((image == color).all(axis=2))
        assert np.abs([columns.mean() + 0.5 - pixel[0], rows.mean() + 0.5 - pixel[1]]).max() < 1.5


def test_nearer_points_hide_farther_ones():
    grid = np.stack(np.meshgrid(np.linspace(-5, 5, 60), np.linspace(-5, 5, 60)), axis=-1).reshape(-1, 2)
    low, high = np.c_[grid, np.zeros(len(grid))], np.c_[grid * 0.5, np.full(len(grid), 3.0)]
    points = np.concatenate([low, high]) + UTM
    image = draw_points(points, None, (200, 200), Style(from_above=True))
    middle = image.rows[image.rows.shape[0] // 2, image.rows.shape[1] // 2]
    assert middle >= len(low)
    assert np.isclose(image.depth[image.rows >= 0].max() - image.depth.min(), 3.0, atol=0.01)


def test_picture_of_a_dense_cloud_is_closed_and_framed():
    grid = np.stack(np.meshgrid(np.linspace(-20, 20, 200), np.linspace(-10, 10, 100)), axis=-1).reshape(-1, 2)
    image = draw_points(np.c_[grid, np.zeros(len(grid))] + UTM, None, (600, 400), Style(supersampling=1))
    filled = image.rows >= 0
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    assert 5 < columns[0] < 40 and 5 < 600 - columns[-1] < 40  # nothing cut off, nothing wasted
    inner = filled[rows[0] + 8 : rows[-1] - 8, 300 - 100 : 300 + 100]
    assert inner.all()


@pytest.mark.parametrize("from_above", [False, True])
@pytest.mark.parametrize("size", [(800, 500), (300, 900)])
def test_aerial_view_holds_all_points(from_above, size):
    points = UTM + np.random.default_rng(2).uniform([-80, -10, 0], [20, 60, 35], (500, 3))
    view = overview(points, size, from_above)
    pixels, depth = project(view, points)
    assert in_image(view, pixels).all() and (depth > 0).all()
    north = project(view, points.mean(axis=0) + [[0, 0, 0], [0, 1, 0], [1, 0, 0]])[0]
    assert north[1, 1] < north[0, 1] and north[2, 0] > north[0, 0]  # north up, east right
    assert np.ptp(pixels, axis=0).max() > 0.7 * min(size)


def test_floaters_do_not_shrink_the_picture():
    points = np.random.default_rng(3).uniform(-10, 10, (5000, 3)) * [1, 1, 0.1]
    near = draw_points(points, None, (200, 200), Style())
    far = draw_points(np.concatenate([points, [[5000.0, 0, 0], [0, 0, 9000.0]]]), None, (200, 200), Style())
    assert (far.rows >= 0).mean() > 0.8 * (near.rows >= 0).mean()


def test_large_clouds_are_thinned_the_same_way_each_time():
    points = np.random.default_rng(4).uniform(-10, 10, (5000, 3))
    first, second = (draw_points(points, None, (200, 200), Style(max_points=300)).rows for _ in range(2))
    assert np.array_equal(first, second)
    assert len(np.unique(first[first >= 0])) <= 300


def test_mesh_is_drawn_in_its_colors():
    mesh = o3d.t.geometry.TriangleMesh(
        np.float64([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]]) + UTM, np.int32([[0, 1, 2], [0, 2, 3]])
    )
    mesh.vertex.colors = o3d.core.Tensor(np.tile(np.uint8([30, 160, 220]), (4, 1)))
    image = screenshot(mesh, None, (200, 200), Style(from_above=True))
    assert (image[60:140, 60:140] == [30, 160, 220]).all()


def test_frusta_start_at_the_camera_and_hold_the_image_corners():
    view = odd_view()
    lines = frusta([view], depth=2.0)
    assert lines.shape == (8, 2, 3)
    assert np.allclose(lines[:4, 0], view.center)
    pixels, depth = project(view, view.center + (lines[:4, 1] - view.center) * 0.999)
    assert np.allclose(depth, 2.0, rtol=2e-3)
    corners = np.array([[0, 0], [view.width, 0], [view.width, view.height], [0, view.height]], float)
    assert np.allclose(pixels, corners, atol=7)  # of a picture 100 px wide


def test_frusta_and_legend_change_the_picture():
    cloud, views = full_cloud(500), [odd_view()]
    plain = screenshot(cloud, None, (400, 300), Style(legend=False), CLASSES)
    legend = screenshot(cloud, None, (400, 300), Style(), CLASSES)
    cameras = draw_points(cloud.point.positions.numpy(), None, (400, 300), Style(cameras=views))
    assert plain.shape == (300, 400, 3)
    assert legend.shape[0] > 300 and np.array_equal(legend[:300], plain)
    assert (legend[300:] == CLASSES.palette[4]).all(axis=2).sum() > 30
    assert (cameras.rows == -2).any()


def test_colors():
    cloud = full_cloud()
    assert np.array_equal(color_points(cloud, "photo"), cloud.point.colors.numpy())
    assert np.array_equal(color_points(cloud, "label", CLASSES)[:3], CLASSES.palette[[0, 1, 4]])
    every = full_cloud(6)
    every.point["state"] = o3d.core.Tensor(np.arange(6, dtype=np.uint8)[:, None])
    assert np.array_equal(color_points(every, "state"), [state.color for state in STATES])
    confidence = color_points(cloud, "confidence").astype(int).sum(axis=1)
    assert (np.diff(confidence) > 0).all()  # brighter = surer
    for by in set(COLORINGS) - {"disagreement"}:  # which needs votes
        colors = color_points(cloud, by, CLASSES)
        assert colors.dtype == np.uint8 and colors.shape == (5, 3)


def test_disagreement_is_what_the_winner_did_not_get():
    # column 0 counts views and has no vote
    votes = np.float32([[3, 2, 0, 1, 0, 1], [1, 0, 0, 5, 0, 0], [0, 0, 0, 0, 0, 0], [9, 0, 0, 0, 0, 0]])
    assert np.allclose(disagreement(votes), [0.5, 0, np.nan, np.nan], equal_nan=True)
    assert np.isnan(disagreement(np.zeros((3, 1), np.float32))).all()
    rng = np.random.default_rng(5)
    many = rng.uniform(0, 4, (200, 6)).astype(np.float32)
    losers = [(np.sort(row[1:])[:-1]).sum() / row[1:].sum() for row in many]
    assert np.allclose(disagreement(many), losers, atol=1e-6)


def test_disagreement_colors_rise_and_stop_where_no_class_has_a_majority():
    colors = disagreement_colors(np.float32([0, 0.2, CONTESTED, 0.9, np.nan])).astype(int)
    assert np.abs(colors[2] - colors[3]).sum() == 0 and (colors[4] == STATES[0].color).all()
    assert colors[0, 1] > colors[1, 1] > colors[2, 1]  # green falls: light gray, orange, dark red
    assert len({tuple(color) for color in colors.tolist()}) == 4
    cloud = full_cloud(50)
    votes = np.concatenate([cloud.point[f"votes_{label}"].numpy() for label in range(5)], axis=1)
    assert np.array_equal(color_points(cloud, "disagreement"), disagreement_colors(disagreement(votes)))


@pytest.mark.parametrize("by", ["confidence", "disagreement"])
def test_scale_is_drawn_below_the_picture(by):
    picture, scale = screenshot(full_cloud(100), None, (500, 300), Style(by), CLASSES), color_scale(by)
    strip = picture[300:].reshape(-1, 3)
    assert len(strip) and all((strip == color).all(axis=1).any() for color in scale.colors[[0, -1]])


def test_relief_leaves_level_ground_and_darkens_what_faces_away():
    normals = np.float32([[0, 0, 1], [-1, 1, 0], [1, -1, 0], [0, 0, 0], [0, 0, 3]])
    colors = np.tile(np.uint8([[100, 150, 60]]), (5, 1))
    result = shaded(colors, normals).astype(int)
    assert (result[[0, 3, 4]] == colors[0]).all()
    assert (result[1] >= colors[0]).all() and (result[2] < 0.6 * colors[0]).all()


@pytest.mark.parametrize("by", COLORINGS)
def test_missing_attribute_names_the_stage(by):
    with pytest.raises(InputError, match="sc3d (extract|label)"):
        color_points(make_cloud(np.zeros((3, 3))), by, CLASSES)


def test_votes_without_those_of_some_class_are_none():
    cloud = make_cloud(np.zeros((3, 3)), votes_1=np.ones((3, 1), np.float32))
    with pytest.raises(InputError, match="no votes"):
        color_points(cloud, "disagreement", CLASSES)


def test_unknown_ids_and_broken_confidences_do_not_fail():
    odd = {
        "state": np.uint8([[9], [255], [1]]),
        "confidence": np.float32([[np.nan], [2], [-1]]),
        "label": np.uint8([[7], [0], [1]]),
    }
    cloud = make_cloud(np.zeros((3, 3)), **odd)
    assert (
        color_points(cloud, "state").shape
        == color_points(cloud, "confidence").shape
        == color_points(cloud, "label", CLASSES).shape
    )
    assert np.array_equal(color_points(cloud, "confidence")[0], color_points(cloud, "confidence")[2])


def test_empty_geometry_is_an_input_error():
    with pytest.raises(InputError, match="no points"):
        screenshot(
            make_cloud(np.full((2, 3), np.nan), colors=np.zeros((2, 3), np.uint8)), style=Style("photo")
        )


def test_without_display_the_window_names_the_screenshot(monkeypatch, tmp_path):
    inspector = Inspector(full_cloud(), [], CLASSES, [tmp_path / "no_mesh.ply"])
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(Sc3dError, match="--screenshot FILE"):
        show(inspector)
    monkeypatch.setenv("DISPLAY", ":4242")
    with pytest.raises(Sc3dError, match="--screenshot FILE"):
        show(inspector)


def test_where_nothing_can_render_the_error_names_the_two_packages():
    script = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parents[2])!r}); from tests.view import test_screenshot as test_view; from sc3d.errors import Sc3dError; from sc3d.view.screenshot import screenshot\n"
        "try: screenshot(test_view.full_cloud(), None, (64, 64), class_table=test_view.CLASSES)\n"
        "except Sc3dError as error: sys.exit(str(error))"
    )
    hidden = {
        "VK_ICD_FILENAMES": "/nonexistent.json",
        "VK_DRIVER_FILES": "/nonexistent.json",
        "__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent.json",
    }
    environment = {name: value for name, value in os.environ.items() if name != "DISPLAY"} | hidden
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    if done.returncode == 0:
        pytest.skip("another OpenGL driver than that of libglvnd renders here")
    assert (
        done.returncode == 1
        and "apt install libvulkan1 mesa-vulkan-drivers" in done.stderr
        and "Traceback" not in done.stderr
    ), done.stderr[-2000:]


def test_without_any_vulkan_driver_the_other_renderer_is_used():
    """The missing driver aborts Open3D, which must not reach this process."""
    script = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parents[2])!r}); from tests.view import test_screenshot as test_view; from sc3d.view.renderers import vulkan_works\n"
        "assert not vulkan_works(); test_view.check_exactness('auto')"
    )
    environment = os.environ | {
        "VK_ICD_FILENAMES": "/nonexistent.json",
        "VK_DRIVER_FILES": "/nonexistent.json",
    }
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    if "cannot render pictures here" in done.stderr:
        pytest.skip("no EGL here")
    assert done.returncode == 0, done.stderr[-2000:]


def test_labels_in_a_photo_match_what_the_camera_sees(tmp_path):
    grid = np.stack(np.meshgrid(np.linspace(-10, 10, 120), np.linspace(-10, 10, 120)), axis=-1).reshape(-1, 2)
    label = np.where(grid[:, 0] < 2, 1, 4).astype(np.uint8)
    cloud = make_cloud(np.c_[grid, np.zeros(len(grid))] + UTM, label=label[:, None])
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=640, height=480, params=[600, 320, 240, -0.05])
    view = View("a.jpg", camera, look_at(UTM + [0, 0, 12.0], UTM))
    image = LabelledSurface.build(cloud, [view], [tmp_path / "no_mesh.ply"]).see(view, (320, 240))[0]
    assert image.shape == (240, 320) and image.dtype == np.uint8
    border = project(view, UTM + [[2.0, 0, 0]])[0][0, 0] / 2
    row = image[120]
    assert (row[: int(border) - 3] == 1).all() and (row[int(border) + 4 :] == 4).all()
