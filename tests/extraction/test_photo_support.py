"""Renderings that agree are sure only where the photos correlate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sc3d.geometry.cameras import View
from sc3d.stereo.multi_view import plane_normals, planes_of
from tests.extraction.builders import data, flat_square, surface_of, views


def photo(view: View, textured: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 of the ground z = 0: waves where `textured` says so of x, else gray.

    textured: (2,) low and high
    """
    columns, rows = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    rays = np.stack([columns, rows, np.ones((120, 160))], axis=2) @ np.linalg.inv(view.matrix).T
    rays = rays @ view.cam_from_world[:3, :3]
    x, y, _ = np.moveaxis(view.center - rays * (view.center[2] / rays[..., 2:]), 2, 0)
    waves = np.sin(5 * x + 2 * np.sin(3 * y)) + np.sin(7 * y + np.sin(4 * x))
    gray = np.where((x > textured[0]) & (x < textured[1]), 128 + 50 * waves, 128)
    return np.repeat(gray[..., None], 3, axis=2).astype(np.uint8)


def clear_of_borders(points: np.ndarray) -> np.ndarray:
    """(N,) bool: a patch and a cell from the end of the texture, and well inside the photos."""
    return (np.abs(points[:, 0]) > 0.9) & (np.abs(points[:, :2]).max(axis=1) < 3)


def test_surface_is_split_where_the_photos_show_nothing():
    seen = replace(data(), image=lambda row: photo(views()[row], np.array([-9.0, 0.0])))
    found = surface_of(flat_square(8.0, 0.0), seen, "nothing")
    for mesh, side in ((found.mesh, -1), (found.unconfirmed, 1)):
        middles = mesh.vertex.positions.numpy()[mesh.triangle.indices.numpy()].mean(axis=1)
        clear = clear_of_borders(middles)
        assert len(middles) > 1000 and (middles[clear, 0] * side > 0).all()
    points, flags = found.cloud.point.positions.numpy(), found.cloud.point.unconfirmed.numpy().ravel()
    clear = clear_of_borders(points)
    np.testing.assert_array_equal(flags[clear] == 1, points[clear, 0] > 0)
    assert found.coverage < 0.7 * found.covered


def test_photos_that_correlate_everywhere_leave_all_of_it_sure():
    seen = replace(data(), image=lambda row: photo(views()[row], np.array([-99.0, 99.0])))
    found = surface_of(flat_square(8.0, 0.0), seen, "nothing")
    points, flags = found.cloud.point.positions.numpy(), found.cloud.point.unconfirmed.numpy().ravel()
    assert not flags[np.abs(points[:, :2]).max(axis=1) < 3].any() and flags.mean() < 0.1


def test_planes_of_depth_and_normals_are_those_that_gave_them():
    view = views()[0]
    columns, rows = np.meshgrid(np.arange(160) - 80.0, np.arange(120) - 60.0)
    planes = np.stack([0.1 + 2e-4 * columns - 1e-4 * rows, *np.full((2, 120, 160), 0.0)], axis=2)
    planes[..., 1:] = 2e-4, -1e-4
    depth = 1 / planes[..., 0]
    depth[:5] = 0
    again = planes_of(view, depth, plane_normals(view, planes))
    assert not again[:5].any()
    np.testing.assert_allclose(again[5:, :, 0], planes[5:, :, 0], rtol=1e-6)
    np.testing.assert_allclose(again[5:, :, 1:], planes[5:, :, 1:], atol=3e-6)  # normals have 8 bits
