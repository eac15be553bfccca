"""Which points of a scene a viewer shows."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest

from sc3d.errors import InputError
from sc3d.settings.common import Memory
from sc3d.view import display_cloud
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


def test_of_a_cloud_that_does_not_fit_an_even_part_is_shown_and_told(tmp_path, monkeypatch, caplog):
    points = np.random.default_rng(0).uniform(0, 9, (20_000, 3))
    scene = write_scene(tmp_path, labelled_cloud(points, np.ones(20_000)))
    monkeypatch.setattr(display_cloud, "fits", lambda needed, memory: memory.max_memory != "2G")
    monkeypatch.setattr(display_cloud, "max_points", lambda *_: 5000)
    assert len(load_cloud(scene).point.positions) == 20_000
    some = load_cloud(scene, memory=Memory("2G")).point
    assert abs(len(some.positions) - 5000) < 250
    assert "million points are shown, evenly" in caplog.text and "--max-memory 2G" in caplog.text
    assert {"label", "confidence", "state", "num_views"} <= set(some)
    assert some.positions.numpy().mean(axis=0) == pytest.approx([4.5] * 3, abs=0.2)
