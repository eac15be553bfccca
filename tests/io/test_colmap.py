"""COLMAP models put together, written, read and taken apart again."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from sc3d.io.colmap import (
    build_model,
    cam_from_world,
    copy_cameras,
    load_model,
    observed_rows,
    point_arrays,
    registered_images,
    write_model,
)
from tests.builders import views

POINTS = np.random.default_rng(0).normal(size=(6, 3)) + [5e5, 5e6, 100]
COLORS = np.arange(18, dtype=np.uint8).reshape(6, 3)


def observations() -> list[tuple[np.ndarray, np.ndarray]]:
    random = np.random.default_rng(1)
    return [
        (rows, random.uniform(0, 50, (len(rows), 2))) for rows in (random.permutation(6) for _ in views())
    ]


def test_a_model_comes_back_as_it_was(tmp_path):
    given = observations()
    write_model(tmp_path / "deep" / "model", build_model(views(), POINTS, COLORS, given))
    model = load_model(tmp_path / "deep" / "model")
    images, (point_ids, xyz, colors) = registered_images(model), point_arrays(model)
    np.testing.assert_array_equal(xyz, POINTS)
    np.testing.assert_array_equal(colors, COLORS)
    assert [image.name for image in images] == [view.name for view in views()] and len(model.cameras) == 1
    for image, view, (rows, pixels) in zip(images, views(), given, strict=True):
        np.testing.assert_allclose(cam_from_world(image), view.cam_from_world, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(observed_rows(image, point_ids), rows)
        np.testing.assert_array_equal([point.xy for point in image.get_observation_points2D()], pixels)


def test_cameras_outlive_the_model_and_are_shared_where_equal():
    wide = [replace(view.resized(320, 240), name=f"wide_{view.name}") for view in views()[:2]]
    model = build_model([*views(), *wide])
    cameras = copy_cameras(model)
    del model
    assert sorted(cameras) == [1, 2] and all(camera.has_prior_focal_length for camera in cameras.values())
    assert [cameras[number].width for number in (1, 2)] == [views()[0].width, 320]


def test_points_that_were_filtered_out_are_minus_one():
    model = build_model(views(), POINTS, COLORS, observations())
    point_ids, _, _ = point_arrays(model)
    image = registered_images(model)[0]
    rows = observed_rows(image, point_ids)
    np.testing.assert_array_equal(observed_rows(image, point_ids[:4]), np.where(rows < 4, rows, -1))
    np.testing.assert_array_equal(observed_rows(image, point_ids[2:]), np.where(rows < 2, -1, rows - 2))
    assert (observed_rows(image, point_ids[:0]) == -1).all()


def test_as_many_observations_as_views():
    with pytest.raises(ValueError):
        build_model(views(), POINTS, COLORS, observations()[:-1])
    assert isinstance(build_model(views()), pycolmap.Reconstruction)
