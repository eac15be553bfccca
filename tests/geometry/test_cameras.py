"""Projection, rays and undistortion against analytic cameras and round trips."""

import cv2
import numpy as np
import pycolmap
import pytest

from sc3d.geometry import cameras

POSE = cameras.look_at(np.array([3.0, -4.0, 50.0]), np.array([5.0, 1.0, 0.0]))
MODELS = {
    "SIMPLE_PINHOLE": [900.0, 640.0, 355.0],
    "PINHOLE": [900.0, 905.0, 650.0, 355.0],
    "SIMPLE_RADIAL": [900.0, 640.0, 355.0, -0.08],
    "RADIAL": [900.0, 640.0, 355.0, -0.08, 0.02],
    "OPENCV": [900.0, 905.0, 650.0, 355.0, -0.1, 0.03, 0.001, -0.002],
    "FULL_OPENCV": [900.0, 905.0, 650.0, 355.0, -0.1, 0.03, 0.001, -0.002, 0.001, 0.0, 0.0, 0.0],
    "OPENCV_FISHEYE": [500.0, 505.0, 650.0, 355.0, 0.02, -0.004, 0.001, 0.0],
    "SIMPLE_RADIAL_FISHEYE": [500.0, 640.0, 355.0, 0.02],
    "THIN_PRISM_FISHEYE": [500.0, 505.0, 650.0, 355.0, 0.02, -0.004, 0.001, 0.0, 0.0, 0.0, 0.0, 0.0],
}


def make_view(model: str) -> cameras.View:
    return cameras.View(
        "photo.jpg", pycolmap.Camera(model=model, width=1280, height=720, params=MODELS[model]), POSE
    )


@pytest.mark.parametrize("model", MODELS)
def test_pixel_ray_point_pixel_round_trip(model):
    view = make_view(model)
    pixels = np.random.default_rng(0).uniform([0, 0], [1280, 720], (2000, 2))
    directions, ray_z = cameras.rays(view, pixels)
    ranges = np.random.default_rng(1).uniform(5, 200, 2000)
    found, depth = cameras.project(view, view.center + directions * ranges[:, None])
    assert np.abs(found - pixels).max() < 1e-6
    np.testing.assert_allclose(depth, ranges * ray_z, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)


def test_rays_without_pixels_are_the_pixel_centers():
    view = cameras.pinhole_view("a", (4, 3), (10, 10, 2, 1.5), np.eye(4))
    directions, ray_z = cameras.rays(view)
    first = np.array([0.5 - 2, 0.5 - 1.5, 10])
    np.testing.assert_allclose(directions[0], first / np.linalg.norm(first))
    assert ray_z[0] == pytest.approx(10 / np.linalg.norm(first))
    assert len(directions) == 12


def test_projection_is_the_textbook_formula_with_the_real_principal_point():
    view = cameras.pinhole_view("a", (800, 600), (700, 710, 390, 310), POSE)
    points = np.random.default_rng(0).normal([5, 1, 0], 3, (50, 3))
    in_camera = points @ POSE[:3, :3].T + POSE[:3, 3]
    expected = in_camera[:, :2] / in_camera[:, 2:] * [700, 710] + [390, 310]
    found, depth = cameras.project(view, points)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(depth, in_camera[:, 2])


def test_points_behind_or_far_outside_the_field_of_view_are_not_seen():
    view = make_view("OPENCV")  # its polynomial folds far points back into the image
    away = view.center - 10 * view.cam_from_world[2, :3]
    sideways = view.center + view.cam_from_world[2, :3] + 5 * view.cam_from_world[0, :3]
    pixels, _ = cameras.project(view, np.stack([away, sideways, view.center]))
    assert np.isnan(pixels).all()
    assert not cameras.in_image(view, pixels).any()


def test_look_at_from_above_has_north_up_and_east_right():
    view = cameras.pinhole_view(
        "a", (100, 100), (100, 100, 50, 50), cameras.look_at(np.array([0.0, 0.0, 10.0]), np.zeros(3))
    )
    pixels, _ = cameras.project(view, np.array([[1.0, 0, 0], [0, 1.0, 0]]))
    assert pixels[0, 0] > 50 and pixels[0, 1] == pytest.approx(50)
    assert pixels[1, 1] < 50 and pixels[1, 0] == pytest.approx(50)
    assert np.linalg.det(view.cam_from_world[:3, :3]) == pytest.approx(1)


def test_resized_view_scales_coordinates():
    view = make_view("SIMPLE_RADIAL")
    points = np.random.default_rng(0).normal([5, 1, 0], 5, (100, 3))
    large, _ = cameras.project(view, points)
    small, _ = cameras.project(view.resized(640, 360), points)
    np.testing.assert_allclose(small, large / 2, atol=1e-9)


def test_shifted_view_sees_shifted_points_in_the_same_place_at_utm_size():
    origin = np.array([512345.0, 5187654.0, 210.0])
    view = make_view("OPENCV")
    far = view.shifted(-origin)  # the same camera in a world whose coordinates are UTM
    points = np.random.default_rng(0).normal([5, 1, 0], 5, (100, 3))
    here, _ = cameras.project(view, points)
    there, _ = cameras.project(far, points + origin)
    assert np.nanmax(np.abs(here - there)) < 1e-4
    np.testing.assert_allclose(far.shifted(origin).cam_from_world, view.cam_from_world, atol=1e-8)


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"])
def test_undistorted_photo_shows_what_the_pinhole_view_projects(model):
    view = make_view(model)
    pinhole = cameras.undistorted(view, 640)
    assert pinhole.camera.is_undistorted() and max(pinhole.width, pinhole.height) == 640
    columns, rows = np.meshgrid(np.arange(1280), np.arange(720))
    # color = position in the distorted photo
    photo = np.stack([columns / 5, rows / 3, np.zeros_like(rows)], axis=2)
    warped = cameras.resample(photo.astype(np.float32), view, pinhole)
    pixels = (
        np.random.default_rng(0)
        .uniform([20, 20], [pinhole.width - 20, pinhole.height - 20], (200, 2))
        .astype(int)
    )
    inside = cameras.in_photo(view, pinhole)
    if inside is not None:
        pixels = pixels[cv2.erode(inside.astype(np.uint8), np.ones((7, 7)))[pixels[:, 1], pixels[:, 0]] > 0]
    assert len(pixels) > 150
    directions, _ = cameras.rays(pinhole, pixels + 0.5)
    expected, _ = cameras.project(view, view.center + 10 * directions)
    found = warped[pixels[:, 1], pixels[:, 0], :2] * [5, 3] + 0.5
    assert np.abs(found - expected).max() < 0.1


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"])
def test_undistorted_view_holds_the_whole_photo_and_knows_what_is_beside_it(model):
    view = make_view(model)
    pinhole = cameras.undistorted(view, 640)
    inside = cameras.in_photo(view, pinhole)
    columns, rows = cameras.pixel_centers(pinhole.width, pinhole.height).T
    directions, _ = cameras.rays(pinhole)
    pixels, _ = cameras.project(view, view.center + 10 * directions)
    gap = np.minimum(pixels, [1280, 720] - pixels).min(axis=1)  # px from the photo's border, negative outside
    found = np.ones(len(columns), bool) if inside is None else inside.ravel()
    sure = np.abs(gap) > 3
    np.testing.assert_array_equal(found[sure], gap[sure] > 0)
    assert found.mean() < 1
    if model == "OPENCV_FISHEYE":  # sees too much
        return
    corners = np.array([[1, 1], [1279, 1], [1, 719], [1279, 719.0]])
    seen = pinhole.camera.img_from_cam(np.c_[view.camera.cam_from_img(corners), np.ones(4)])
    assert cameras.in_image(pinhole, seen).all()


def test_strong_distortion_grows_the_view_by_a_tenth_of_a_side_only():
    camera = pycolmap.Camera(
        model="OPENCV_FISHEYE", width=1000, height=800, params=[330, 330, 500, 400, 0.01, 0, 0, 0]
    )
    view = cameras.View("a.jpg", camera, np.eye(4))
    pinhole = cameras.undistorted(view)
    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = 0.0
    least = pycolmap.undistort_camera(options, camera)
    assert pinhole.width <= 1.2 * least.width + 2 and pinhole.height <= 1.2 * least.height + 2
    assert pinhole.focal == pytest.approx(least.mean_focal_length())


def test_resampled_labels_are_never_mixed():
    view = make_view("OPENCV")
    labels = np.zeros((720, 1280), np.uint8)
    labels[:, 640:] = 4
    warped = cameras.resample(labels, view, cameras.undistorted(view, 500), labels=True)
    assert set(np.unique(warped)) == {0, 4}
