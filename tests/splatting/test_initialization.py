"""Starting points from the plane sweep: where sparse points leave the photos empty, and at the right depth."""

from dataclasses import replace

import numpy as np
import pytest

from sc3d.geometry.view_selection import neighbor_views
from sc3d.splatting.initialization import plane_sweep_points
from tests.splatting.scenes import SIZE, color, photographed, ring, valley

pytestmark = pytest.mark.usefixtures("one_thread")


def test_empty_parts_are_filled_at_the_right_depth():
    data, *_ = photographed(ring(), valley(), wave=2.0, noise=0.05)
    sparse = data.points[:, 0] < -1  # the right half has no sparse points
    data = replace(data, points=data.points[sparse], colors=data.colors[sparse])
    neighbors = neighbor_views(None, data.points, np.stack([view.center for view in data.views]))
    points, colors = plane_sweep_points(data, neighbors, 3000)
    right = points[points[:, 0] > 0.5]
    assert len(right) > 150
    height = right[:, 2] - 0.3 * np.abs(right[:, 0])
    assert np.median(np.abs(height)) < 0.15 and np.abs(np.median(height)) < 0.1  # at 9 units distance
    expected = color(points, 2.0) * 255
    assert np.median(np.abs(colors - expected)) < 15
    masked = replace(data, masks=lambda index: np.zeros((SIZE[1], SIZE[0]), bool))
    assert len(plane_sweep_points(masked, neighbors, 3000)[0]) == 0
