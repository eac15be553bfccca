"""Gaussians on known planes come out as mesh and cloud where they are."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sc3d.errors import Sc3dError
from sc3d.extraction import DepthViews, center_cloud, extract_surface, wanted_coverage
from sc3d.geometry.cameras import look_at, pinhole_view
from sc3d.settings.reconstruction import Extract
from sc3d.splatting.gaussians import Gaussians

STEP = 0.1


def flat_square(half: float, height: float) -> Gaussians:
    """Opaque discs with normals along z."""
    x, y = np.meshgrid(np.arange(-half, half, STEP), np.arange(-half, half, STEP))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    gaussians = Gaussians.from_points(
        points, np.tile(np.uint8([200, 120, 40]), (len(points), 1)), 0, opacity=0.95
    )
    scales = torch.full_like(gaussians.log_scales, float(np.log(STEP)))
    scales[:, 2] = -8
    quats = torch.zeros_like(gaussians.quats)
    quats[:, 0] = 1
    return replace(gaussians, log_scales=scales, quats=quats)


def views() -> list:
    centers = [[-2, -2, 12], [2, -2, 12], [2, 2, 12], [-2, 2, 12], [0, 0, 13]]
    return [
        pinhole_view(
            f"{row}.jpg", (160, 120), (150, 150, 78, 62), look_at(np.array(center, float), np.zeros(3))
        )
        for row, center in enumerate(centers)
    ]


def data() -> DepthViews:
    neighbors = [np.array([other for other in range(5) if other != row]) for row in range(5)]
    return DepthViews(views(), lambda row: np.full((120, 160, 3), 90, np.uint8), neighbors, (1.0, 30.0))


def test_plane_comes_out_flat_closed_and_upwards():
    surfaces = extract_surface(flat_square(4.0, 0.5), data(), Extract(voxel_size=0.15))
    points = surfaces.cloud.point.positions.numpy()
    inner = np.abs(points[:, :2]).max(axis=1) < 3.5
    assert inner.sum() > 1000 and np.abs(points[inner, 2] - 0.5).max() < 0.05
    assert surfaces.cloud.point.normals.numpy()[inner, 2].min() > 0.95
    assert np.abs(surfaces.cloud.point.colors.numpy().astype(int) - 90).max() <= 1
    cells = np.floor(points[inner, :2] / 0.3).astype(int)
    assert len(np.unique(cells, axis=0)) >= 23**2
    assert 0 < surfaces.confirmed <= 1 and surfaces.coverage >= surfaces.confirmed - 0.02


def test_completion_covers_what_only_one_view_sees():
    lonely = replace(
        data(), neighbors=[np.array([4]), np.array([4]), np.array([4]), np.array([4]), np.array([0])]
    )
    without = extract_surface(flat_square(8.0, 0.0), lonely, Extract(voxel_size=0.15, coverage=0.0))
    completed = extract_surface(flat_square(8.0, 0.0), lonely, Extract(voxel_size=0.15, coverage=1.0))
    assert completed.coverage > without.coverage + 0.02
    assert np.abs(completed.cloud.point.positions.numpy()[:, 2]).max() < 0.1


def test_median_depth_sees_through_a_veil():
    """Faint discs 2 m above the middle of the ground: blended depth mixes the two, and no two views agree."""
    ground, veil = flat_square(4.0, 0.5), flat_square(1.0, 2.5)
    veil.opacity_logits[:] = -3.0
    joined = {
        name: torch.cat([values, veil.parameters()[name]]) for name, values in ground.parameters().items()
    }
    errors = {}
    for mode in ("blended", "median"):
        settings = Extract(voxel_size=0.15, coverage=0.0, depth_mode=mode)
        points = extract_surface(Gaussians(**joined), data(), settings).cloud.point.positions.numpy()
        errors[mode] = np.abs(points[np.abs(points[:, :2]).max(axis=1) < 3.5, 2] - 0.5)
    assert errors["median"].max() < 0.05 and len(errors["median"]) > 1000
    assert errors["blended"].max() > 0.2


def test_nothing_to_see_is_said():
    with pytest.raises(Sc3dError, match="no view shows a surface"):
        extract_surface(flat_square(1.0, 50.0), data(), Extract())


def test_centers_with_colors_and_normals_towards_the_cameras():
    gaussians = flat_square(2.0, 0.0)
    cloud = center_cloud(gaussians, np.array([view.center for view in views()]), 0.3)
    assert len(cloud.point.positions) == len(gaussians)
    assert (cloud.point.normals.numpy()[:, 2] > 0.99).all()
    assert np.abs(cloud.point.colors.numpy().astype(int) - [200, 120, 40]).max() <= 1
    with pytest.raises(Sc3dError, match="min-opacity"):
        center_cloud(gaussians, np.zeros((1, 3)), 0.99)


def test_only_flights_that_look_one_way_are_filled_without_limit():
    ahead, aside = np.array([0.0, 0.0, 12.0]), np.array([9.0, 0.0, 12.0])
    down = [
        pinhole_view(f"{row}.jpg", (160, 120), (150, 150, 80, 60), look_at(center, center * [1, 1, 0]))
        for row, center in enumerate((ahead, aside))
    ]
    oblique = pinhole_view("o.jpg", (160, 120), (150, 150, 80, 60), look_at(aside, np.zeros(3)))
    assert wanted_coverage(down) == 1 and wanted_coverage([*down, oblique]) < 1
