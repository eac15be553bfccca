"""Pictures of Gaussians: what is where, in which color, and beside which photo."""

from __future__ import annotations

import numpy as np
import pytest

from sc3d.geometry.cameras import project
from sc3d.splatting.evaluation import compare, picture
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.rendering import render
from tests.splatting.scenes import RED_POINT, center_of_red, flat_ground, view_of

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    return flat_ground()


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


def test_colors_of_a_photo_are_applied_but_never_fitted(gaussians):
    """What was held out is judged with its brightness alone, whatever was fitted to the others."""
    view = view_of((1, -2, 9))
    change = np.diag([0.1, -0.1, -0.2])
    photo = np.round(picture(gaussians, view) @ (np.eye(3) + change)).astype(np.uint8)
    exposure = np.hstack([change, np.zeros((3, 1))]).ravel()
    assert compare(gaussians, view, photo, exposure=exposure).psnr > 45 > compare(gaussians, view, photo).psnr
