"""Which points of a scene a viewer shows."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest

from sc3d.errors import InputError
from sc3d.view.display_cloud import DisplayCloud, load_cloud
from tests.builders import labelled_cloud, write_scene


def test_points_that_no_second_photo_confirms_are_shown_on_demand(tmp_path):
    flags = (np.arange(300) % 4 == 0).astype(np.uint8)
    points = np.random.default_rng(0).uniform(0, 9, (300, 3))
    cloud = labelled_cloud(points, np.ones(300))
    cloud.point.unconfirmed = o3d.core.Tensor(flags[:, None])
    scene = write_scene(tmp_path, cloud)
    shown = load_cloud(scene, unconfirmed=False)
    np.testing.assert_array_equal(shown.point.positions.numpy(), points[flags == 0])
    assert len(load_cloud(scene).point.positions) == 300
    assert len(load_cloud(scene, scene.labelled, unconfirmed=False).point.positions) == 300  # all of a file
    display = DisplayCloud.from_cloud(shown, np.zeros(3), scene.class_table())
    cloud.point.label = o3d.core.Tensor(np.full((300, 1), 2, np.uint8))
    display.relabel(cloud)  # all points, as `propagate` writes them
    assert (display.label == 2).all()
    with pytest.raises(InputError, match="other points"):
        display.relabel(labelled_cloud(points + 1, np.ones(300)))
