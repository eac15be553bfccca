"""Which views see the same surface from elsewhere."""

import numpy as np

from sc3d.geometry.view_selection import nearest_views, neighbor_views


def test_neighbors_share_points_at_a_good_angle():
    points = np.random.default_rng(0).uniform(-5, 5, (200, 3)) * [1, 1, 0]
    centers = np.array([[0, 0, 20], [0.2, 0, 20], [4, 0, 20], [-4, 0, 20], [0, 30, 5], [6, 0, 20]], float)
    everything = np.arange(200)
    tracks = [everything, everything, everything[:150], everything[:100], everything[:120], np.zeros(0, int)]
    found = neighbor_views(tracks, points, centers, count=2)
    assert found[0].tolist() == [2, 3]  # 1 is too close, 4 too oblique, 5 shares nothing
    assert found[5].tolist()[0] == 2  # without tracks: the nearest
    assert [len(others) for others in neighbor_views(None, points, centers, count=3)] == [3] * 6


def test_nearest_views_do_not_depend_on_units():
    centers = np.random.default_rng(1).uniform(0, 10, (20, 3))
    for one, other in zip(nearest_views(centers), nearest_views(centers * 1000 + 5e5), strict=True):
        assert one.tolist() == other.tolist()
    assert nearest_views(np.zeros((1, 3)))[0].size == 0
    assert nearest_views(np.eye(3)[:2])[0].tolist() == [1]
