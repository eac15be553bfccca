"""`sc3d view` of splats: from the air, beside a photo, as a flight."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sc3d.cli import main
from sc3d.geometry.cameras import local_origin, project, undistorted
from sc3d.io.images import read_image, write_image
from sc3d.io.splats import origin_comment, write_splat_ply
from sc3d.view.contact_sheet import (
    half_of,
)
from sc3d.view.flight_video import flight_path
from tests.builders import ORIGIN, views, write_model
from tests.splatting.scenes import GREEN, RED, RED_POINT, center_of_red, flat_ground

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A scene at UTM coordinates with distorted photos of the Gaussians, and its gaussians.ply."""
    scene = tmp_path_factory.mktemp("splats") / "scene"
    write_model(scene / "sparse" / "0", views())
    origin, gaussians = local_origin(views()), flat_ground(7.0)
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
