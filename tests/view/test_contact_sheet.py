"""Pictures of Gaussians beside one another, and the sheet of a training."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sc3d.geometry.held_out import held_out_views
from sc3d.io.images import read_image
from sc3d.scene.held_out import HeldOutPhoto
from sc3d.settings.train import TrainSettings
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.evaluation import compare, picture
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.trainer import TrainResult
from sc3d.view.contact_sheet import (
    contact_sheet,
    depth_colors,
    depth_range,
    normal_colors,
    side_by_side,
)
from sc3d.view.training_sheet import chosen_views, training_rows, write_training_sheet
from tests.splatting.scenes import UP, flat_ground, view_of

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    return flat_ground()


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
    def split(count, every):
        return held_out_views([None] * count, [], np.zeros((0, 3)), every, 0.0)

    assert chosen_views(split(18, 0)) == [(index, False) for index in (0, 3, 7, 10, 14, 17)]
    assert chosen_views(split(3, 0)) == [(0, False), (1, False), (2, False)]
    with_test = chosen_views(split(40, 8))
    assert [index for index, held_out in with_test if held_out] == [7, 15, 31, 39] and [
        held_out for _, held_out in with_test
    ] == [True] * 4 + [False] * 2
    assert not {index for index, held_out in with_test if not held_out} & set(range(7, 40, 8))
    assert chosen_views(split(8, 8))[0] == (7, True) and len(chosen_views(split(8, 8))) == 6


@pytest.mark.parametrize("exposure", ["gain", "affine"])
def test_training_sheet_uses_the_exposures_found(gaussians, tmp_path, exposure):
    cameras = [view_of(center) for center in [(0, -3, 7), (2, 2, 8), (-2, 1, 8), (0, 2, 9)]]
    photos = [np.round(0.7 * picture(gaussians, view)).astype(np.uint8) for view in cameras]
    data = TrainingData(cameras, photos, np.zeros((10, 3)), np.zeros((10, 3), np.uint8))
    exposures = np.array([[np.log(0.7), 0], [0, 0], [np.log(0.7), 0], [0, 0]])
    if exposure == "affine":
        darker = np.hstack([-0.3 * np.eye(3), np.zeros((3, 1))]).ravel()
        exposures = np.stack([darker, 0 * darker, darker, 0 * darker])
    settings = TrainSettings(iterations=30, test_every=4, exposure=exposure)
    rows = training_rows(gaussians, data, settings, exposures)
    assert [row.held_out for row in rows] == [True, False, False, False]
    assert [row.psnr > 40 for row in rows] == [True, True, False, True]  # the held-out one is fitted
    log = [{"iteration": 30, "loss": 0.1, "psnr": 31.0, "num_gaussians": 5, "seconds": 1.0}]
    held_out = [HeldOutPhoto("a.jpg", "every 4", 25.0, 0.8, 1.0, 25.0, 0.8, None)]
    result = TrainResult(gaussians, exposures, log, held_out)
    write_training_sheet(tmp_path / "train.jpg", result, data, settings)
    assert read_image(tmp_path / "train.jpg").shape[1] == 1600 and [
        path.name for path in tmp_path.iterdir()
    ] == ["train.jpg"]


def test_side_by_side_keeps_the_pictures():
    left, right = (np.full((30, 200, 3), value, np.uint8) for value in (10, 200))
    picture = side_by_side((left, right), ("a" * 200, "b"))
    assert (
        np.array_equal(picture[:30, :200], left)
        and np.array_equal(picture[:30, -200:], right)
        and picture.shape[0] > 40
    )
