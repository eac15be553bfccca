"""Pictures of Gaussians: what is where, in which color, and beside which photo."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sc3d.cli import main
from sc3d.geometry.cameras import local_origin, look_at, pinhole_view, project, undistorted
from sc3d.io.images import read_image, write_image
from sc3d.io.splats import origin_comment, write_splat_ply
from sc3d.settings.train import TrainSettings
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.evaluation import compare, picture
from sc3d.splatting.gaussians import SH_C0, Gaussians
from sc3d.splatting.rendering import render
from sc3d.splatting.trainer import TrainResult
from sc3d.view.contact_sheet import (
    contact_sheet,
    depth_colors,
    depth_range,
    half_of,
    normal_colors,
    side_by_side,
)
from sc3d.view.flight_video import flight_path
from sc3d.view.training_sheet import chosen_views, training_rows, write_training_sheet
from tests.builders import ORIGIN, views, write_model

pytestmark = pytest.mark.usefixtures("one_thread")

RED_POINT = np.array([1.3, 0.8, 0.3])  # a lone red Gaussian above the ground; local frame
GREEN, RED, UP = (60, 140, 50), (230, 20, 20), (128, 128, 255)


def make_gaussians(half: float = 4.0) -> Gaussians:
    """A flat green ground, 2 `half` m wide, and one red Gaussian; both opaque."""
    x, y = np.meshgrid(*[np.arange(-half, half + 0.01, 0.2)] * 2)
    points = np.concatenate([np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1), RED_POINT[None]])
    colors = np.tile(np.float32(GREEN) / 255, (len(points), 1))
    colors[-1] = np.float32(RED) / 255
    scales = np.tile(np.float32([0.15, 0.15, 0.002]), (len(points), 1))
    scales[-1] = (0.08, 0.08, 0.002)
    quats = np.tile(np.float32([1, 0, 0, 0]), (len(points), 1))
    sh = ((colors - 0.5) / SH_C0).astype(np.float32)
    parts = [points.astype(np.float32), np.log(scales), quats, np.full(len(points), 6, np.float32), sh]
    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(part)) for part in parts))


def view_of(center: tuple[float, float, float], size: tuple[int, int] = (120, 90)):
    """A view whose principal point is not the middle, image top towards the north-east."""
    calibration = (110, 114, size[0] / 2 + 5, size[1] / 2 - 3)
    return pinhole_view(
        "some photo.jpg",
        size,
        calibration,
        look_at(np.array(center, float), np.array([0.3, 0.2, 0]), (0.4, 1, 0.3)),
    )


def center_of_red(image: np.ndarray) -> np.ndarray:
    """(2,) pixel coordinates of what is red in (H, W, 3) uint8 RGB."""
    weight = np.maximum(image[..., 0].astype(float) - 1.2 * image[..., 1] - 60, 0)
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    return make_gaussians()


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A scene at UTM coordinates with distorted photos of the Gaussians, and its gaussians.ply."""
    scene = tmp_path_factory.mktemp("splats") / "scene"
    write_model(scene / "sparse" / "0", views())
    origin, gaussians = local_origin(views()), make_gaussians(7.0)
    gaussians.means += torch.from_numpy((ORIGIN - origin).astype(np.float32))
    write_splat_ply(scene / "gaussians.ply", gaussians.arrays(), [origin_comment(origin)])
    for view in views():  # drawn by projection alone, not by the renderer under test
        photo = np.tile(np.uint8(GREEN), (view.height, view.width, 1))
        pixel = project(view, (ORIGIN + RED_POINT)[None])[0][0]
        photo = cv2.circle(
            photo, tuple(np.round(16 * (pixel - 0.5)).astype(int).tolist()), 3 * 16, RED, -1, cv2.LINE_AA, 4
        )
        write_image(scene / "images" / view.name, photo)
    return scene


def test_panels_are_what_the_camera_sees(gaussians):
    view = view_of((1, -2, 9))
    photo = picture(gaussians, view)
    found = compare(gaussians, view, photo, exposure=(0.0, 0.0))
    expected = (render(gaussians, view).color.clamp(0, 1) * 255).round().byte().numpy()
    assert np.array_equal(found.rendered, expected) and np.array_equal(found.photo, photo) and found.psnr > 50
    assert np.abs(center_of_red(found.rendered) - project(view, RED_POINT[None])[0][0]).max() < 0.1
    row, column = view.height // 2, view.width // 2
    ray = np.array(
        [
            (column + 0.5 - view.matrix[0, 2]) / view.matrix[0, 0],
            (row + 0.5 - view.matrix[1, 2]) / view.matrix[1, 1],
            1,
        ]
    )
    height_per_depth = ray @ view.cam_from_world[:3, :3][:, 2]
    # where the ray meets z = 0
    assert np.isclose(found.depth[row, column], -view.center[2] / height_per_depth, rtol=1e-3)
    # world frame, towards the camera, although it is tilted
    assert np.abs(found.normals[found.depth > 0] - [0, 0, 1]).max() < 0.02


def test_exposure_of_the_photo_is_fitted_or_applied(gaussians):
    view = view_of((1, -2, 9))
    photo = np.round(0.8 * picture(gaussians, view) + 10).astype(np.uint8)
    assert (
        compare(gaussians, view, photo).psnr
        > 45
        > 30
        > compare(gaussians, view, photo, exposure=(0.0, 0.0)).psnr
    )
    assert compare(gaussians, view, photo, exposure=(np.log(0.8), 10 / 255)).psnr > 45


def test_near_is_bright_up_is_blue_and_nothing_is_gray(gaussians):
    near_far = depth_range([np.float32([[5, 10, 20, 0]])])
    colors = depth_colors(np.float32([[5, 10, 20, 0]]), (5.0, 20.0)).astype(int)
    brightness = colors.sum(axis=2)[0]
    assert (
        brightness[0] > brightness[1] > brightness[2]
        and np.ptp(colors[0, 3]) < 10
        and near_far[0] >= 5
        and near_far[1] <= 20
    )
    assert depth_range([np.zeros((2, 2), np.float32)]) == (1.0, 1.0)
    # towards the north: its top is farther away
    found = compare(gaussians, view_of((0, -6, 5)), np.zeros((90, 120, 3), np.uint8))
    normals = normal_colors(found.normals)
    present = found.depth > 0
    assert 0.2 < present.mean() < 1
    assert np.abs(normals[present].astype(int) - UP).max() <= 3
    assert np.ptp(normals[~present].astype(int), axis=1).max() < 10
    depth = depth_colors(found.depth, depth_range([found.depth])).astype(int).sum(axis=2)
    column = np.flatnonzero(present[:, 60])
    assert depth[column[-1], 60] > depth[column[len(column) // 2], 60] > depth[column[0], 60]


def test_sheet_holds_the_four_panels(gaussians):
    centers = [(0, -3, 7), (2, 2, 8)]
    rows = [compare(gaussians, view, picture(gaussians, view)) for view in map(view_of, centers)]
    sheet = contact_sheet(rows, "a title " + "that is too long " * 20, width=560)
    assert sheet.shape[1] == 560 and sheet.dtype == np.uint8
    cell = (560 - 2 * 16 - 3 * 8) // 4
    near_far = depth_range([row.depth for row in rows])
    top, height = sheet.shape[0] - 16 - 8 - round(cell * 90 / 120), round(cell * 90 / 120)
    expected = [
        rows[1].photo,
        rows[1].rendered,
        depth_colors(rows[1].depth, near_far),
        normal_colors(rows[1].normals),
    ]
    for column, panel in enumerate(expected):
        left = 16 + column * (cell + 8)
        shown = sheet[top : top + height, left : left + cell].astype(float)
        assert np.abs(shown - cv2.resize(panel, (cell, height), interpolation=cv2.INTER_NEAREST)).mean() < 6
    portrait = compare(gaussians, view_of((0, 0, 8), (40, 90)), np.zeros((90, 40, 3), np.uint8))
    assert contact_sheet([rows[0], portrait], "", width=560).shape[1] == 560


def test_chosen_photos_are_spread_and_held_out_ones_come_first():
    assert chosen_views(18, TrainSettings()) == [(index, False) for index in (0, 3, 7, 10, 14, 17)]
    assert chosen_views(3, TrainSettings()) == [(0, False), (1, False), (2, False)]
    with_test = chosen_views(40, TrainSettings(test_every=8))
    assert [index for index, held_out in with_test if held_out] == [7, 15, 31, 39] and [
        held_out for _, held_out in with_test
    ] == [True] * 4 + [False] * 2
    assert not {index for index, held_out in with_test if not held_out} & set(range(7, 40, 8))
    assert (
        chosen_views(8, TrainSettings(test_every=8))[0] == (7, True)
        and len(chosen_views(8, TrainSettings(test_every=8))) == 6
    )


def test_training_sheet_uses_the_exposures_found(gaussians, tmp_path):
    cameras = [view_of(center) for center in [(0, -3, 7), (2, 2, 8), (-2, 1, 8), (0, 2, 9)]]
    photos = [np.round(0.7 * picture(gaussians, view)).astype(np.uint8) for view in cameras]
    data = TrainingData(cameras, photos, np.zeros((10, 3)), np.zeros((10, 3), np.uint8))
    exposures = np.array([[np.log(0.7), 0], [0, 0], [np.log(0.7), 0], [0, 0]])
    settings = TrainSettings(iterations=30, test_every=4)
    rows = training_rows(gaussians, data, settings, exposures)
    assert [row.held_out for row in rows] == [True, False, False, False]
    assert [row.psnr > 40 for row in rows] == [True, True, False, True]  # the held-out one is fitted
    log = [{"iteration": 30, "loss": 0.1, "psnr": 31.0, "num_gaussians": 5, "seconds": 1.0}]
    result = TrainResult(gaussians, exposures, log, {"psnr": 25.0, "ssim": 0.8})
    write_training_sheet(tmp_path / "train.jpg", result, data, settings)
    assert read_image(tmp_path / "train.jpg").shape[1] == 1600 and [
        path.name for path in tmp_path.iterdir()
    ] == ["train.jpg"]


@pytest.mark.parametrize("size", [(500, 300), (300, 500)])
def test_splats_lie_where_the_photo_has_them(trained, tmp_path, size):
    target = tmp_path / "pair.png"
    main(
        [
            "view",
            str(trained),
            "--screenshot",
            str(target),
            "--photo",
            "photo_1.jpg",
            "--splats",
            "--size",
            *map(str, size),
        ]
    )
    picture = read_image(target)
    pinhole = undistorted(views()[1])
    scale = min(1.0, half_of(size)[0] / pinhole.width)
    width, height = int(pinhole.width * scale + 1e-6), int(pinhole.height * scale + 1e-6)
    assert abs(picture.shape[1] - (2 * width + 8)) <= 2 and picture.shape[0] > height
    photo, splats = picture[:height, :width], picture[:height, -width:]
    expected = project(pinhole.resized(width, height), (ORIGIN + RED_POINT)[None])[0][0]
    assert np.abs(center_of_red(photo) - expected).max() < 0.3
    assert np.abs(center_of_red(splats) - expected).max() < 0.3
    assert np.abs(np.median(splats.reshape(-1, 3), axis=0) - GREEN).max() < 12


def test_splats_from_the_air_have_north_up(trained, tmp_path):
    target = tmp_path / "air.png"
    for extra in ([], ["--from-above"]):
        main(["view", str(trained), "--screenshot", str(target), "--splats", "--size", "320", "240", *extra])
        picture = read_image(target)
        assert picture.shape == (240, 320, 3) and (picture[0, 0] == 255).all()  # white where nothing is
        ground = np.argwhere((np.abs(picture.astype(int) - GREEN) < 40).all(axis=2))
        assert len(ground) > 5000
        offset = (
            center_of_red(np.where((picture == 255).all(axis=2, keepdims=True), 0, picture))
            - ground.mean(axis=0)[::-1]
        )
        assert offset[0] > 5 and offset[1] < -5  # in the north-east


def test_flight_passes_through_the_cameras(trained, tmp_path):
    path = flight_path(views(), (100, 100))
    assert (
        20 < len(path) <= 600
        and path[0].width % 2 == 0
        and path[0].height % 2 == 0
        and max(path[0].width, path[0].height) <= 100
    )
    centers = np.array([view.center for view in path])
    for view in views():
        assert np.linalg.norm(centers - view.center, axis=1).min() < 0.15
    assert np.linalg.norm(np.diff(centers, axis=0), axis=1).max() < 0.3  # no jumps
    assert np.allclose(path[-1].cam_from_world, views()[-1].cam_from_world, atol=1e-6)
    assert len(flight_path(views()[:1], (100, 100))) == 1
    target = tmp_path / "flight.mp4"
    main(["view", str(trained), "--flight", str(target), "--size", "160", "160"])
    video = cv2.VideoCapture(str(target))
    read, frame = video.read()
    assert read and frame.shape[1] == 160 and int(video.get(cv2.CAP_PROP_FRAME_COUNT)) > 20
    first = flight_path(views(), (160, 160))[0]
    assert (
        np.abs(center_of_red(frame[..., ::-1]) - project(first, (ORIGIN + RED_POINT)[None])[0][0]).max() < 1.5
    )


def test_side_by_side_keeps_the_pictures():
    left, right = (np.full((30, 200, 3), value, np.uint8) for value in (10, 200))
    picture = side_by_side((left, right), ("a" * 200, "b"))
    assert (
        np.array_equal(picture[:30, :200], left)
        and np.array_equal(picture[:30, -200:], right)
        and picture.shape[0] > 40
    )


class TestBadInput:
    def check(self, capsys, words: list[str], *arguments: object) -> None:
        with pytest.raises(SystemExit) as stopped:
            main(["view", *map(str, arguments)])
        lines = capsys.readouterr().err.strip().splitlines()
        assert stopped.value.code == 2 and len(lines) == 1 and all(word in lines[0] for word in words), lines

    def test_not_trained_yet(self, capsys, tmp_path):
        write_model(tmp_path / "sparse" / "0", views())
        for option in (["--splats", "--screenshot", tmp_path / "a.png"], ["--flight", tmp_path / "a.mp4"]):
            self.check(capsys, ["gaussians.ply is missing", "sc3d train"], tmp_path, *option)

    def test_trained_with_other_cameras(self, capsys, tmp_path, trained):
        write_model(tmp_path / "sparse" / "0", [view.shifted(np.array([500.0, 0, 0])) for view in views()])
        (tmp_path / "gaussians.ply").write_bytes((trained / "gaussians.ply").read_bytes())
        self.check(
            capsys, ["other cameras", "--overwrite"], tmp_path, "--splats", "--screenshot", tmp_path / "a.png"
        )

    def test_options_that_do_not_fit(self, capsys, trained, tmp_path):
        self.check(capsys, ["--screenshot FILE"], trained, "--splats")
        self.check(capsys, [".mp4"], trained, "--flight", tmp_path / "a.avi")
        self.check(capsys, [".png"], trained, "--splats", "--screenshot", tmp_path / "a.gif")
        self.check(
            capsys,
            ["no photo 'other.jpg'", "photo_0.jpg"],
            trained,
            "--splats",
            "--photo",
            "other.jpg",
            "--screenshot",
            tmp_path / "a.png",
        )
        self.check(
            capsys, ["too small"], trained, "--splats", "--size", "0", "9", "--screenshot", tmp_path / "a.png"
        )
        self.check(
            capsys, ["--file"], trained, "--splats", "--file", "x.ply", "--screenshot", tmp_path / "a.png"
        )
        assert not list(tmp_path.iterdir())
