"""What a click, a lasso and balls choose, against their definition on analytic clouds."""

import numpy as np
import pytest

from sc3d.errors import InputError
from sc3d.scene import selection
from sc3d.scene.selection import balls_around, balls_within, region_around, seen_in_lasso

FAR = np.array([5e5, 4.2e6, 100.0])  # UTM


def sheet(height: float, half: float = 4.0, step: float = 0.1) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-half, half, step), np.arange(-half, half, step))
    return FAR + np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)


def test_a_region_ends_where_label_color_or_surface_end():
    points = np.concatenate([sheet(0), sheet(1)])
    east, local = points[:, 0] > FAR[0] + 1, points - FAR
    label = np.where(east, 2, 1)
    colors = np.where(local[:, 1:2] > 2, np.uint8([200, 40, 40]), np.uint8([40, 90, 40]))
    row = int(np.argmin(np.linalg.norm(local, axis=1)))
    expected = ~east & (local[:, 2] == 0)
    assert (region_around(points, label, None, row, 0.1) == np.flatnonzero(expected)).all()
    darker = expected & (local[:, 1] <= 2)
    assert (region_around(points, label, colors, row, 0.1) == np.flatnonzero(darker)).all()
    alone = np.concatenate([points, FAR + [[1e9, 0, 0]]])
    assert (region_around(alone, np.append(label, 1), None, row, 0.1) == np.flatnonzero(expected)).all()


@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_a_lasso_takes_what_is_seen_in_it_and_not_what_lies_behind(tilt):
    """From above: a lasso around a table, its border and the ground around."""
    table, ground = sheet(1.5, half=1.0), sheet(0.0)
    points = np.concatenate([table, ground])
    eye = FAR + np.array([8 * np.tan(tilt), 0.0, 8.0])
    square = FAR + np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0.0]])
    corners = (square - eye) / np.linalg.norm(square - eye, axis=1, keepdims=True)
    chosen = np.zeros(len(points), bool)
    chosen[seen_in_lasso(points, eye, corners, 0.1)] = True
    assert chosen[: len(table)].all()
    on_top = eye + (ground - eye) * ((eye[2] - FAR[2] - 1.5) / (eye[2] - ground[:, 2]))[:, None] - FAR
    behind = (np.abs(on_top[:, :2]) < 0.8).all(axis=1)
    clear = (np.abs(on_top[:, :2]) > 1.25).any(axis=1)
    inside = (np.abs(ground - FAR)[:, :2] < 2.95).all(axis=1)
    assert behind.sum() > 50 and not chosen[len(table) :][behind].any()
    assert (inside & clear).sum() > 50 and chosen[len(table) :][inside & clear].all()
    assert not chosen[len(table) :][(np.abs(ground - FAR)[:, :2] > 3.05).any(axis=1)].any()


def test_a_lasso_wider_than_a_picture_is_refused():
    corners = np.array([[1, 0, 0.1], [-1, 0, 0.1], [0, 1, 0.1]]) / np.sqrt(1.01)
    with pytest.raises(InputError, match="wider than a picture"):
        seen_in_lasso(sheet(0), FAR, corners, 0.1)


def test_balls_hold_what_is_chosen_and_others_only_within_a_spacing():
    ground = sheet(0) + np.random.default_rng(0).normal(0, 0.01, (6400, 3))
    points = np.concatenate([ground, sheet(-0.35)])  # a floor below, hidden
    local = points - FAR
    chosen = (np.linalg.norm(local[:, :2], axis=1) < 3) & (local[:, 2] > -0.2)
    found = balls_around(points, np.flatnonzero(chosen), 0.1)
    inside = found.contain(points)
    assert inside[chosen].all() and not inside[local[:, 2] < -0.2].any()
    assert np.linalg.norm(local[inside & ~chosen, :2], axis=1).max() < 3.25
    assert sum(len(centers) for centers, _ in found.groups) < chosen.sum() / 2 and len(found.groups) > 1
    dense = sheet(0, half=2.0, step=0.03)  # of another cloud
    assert found.contain(dense).all()


def test_what_is_too_ragged_for_balls_is_refused(monkeypatch):
    monkeypatch.setattr(selection, "MAX_CENTERS", 60)
    points = sheet(0)
    with pytest.raises(InputError, match="too ragged"):
        balls_around(points, np.arange(0, len(points), 2), 0.1)
    assert balls_around(points, np.arange(len(points)), 0.1).contain(points).all()


def test_balls_within_hold_no_other_point():
    points = np.random.default_rng(3).uniform(0, 10, (3000, 3))
    chosen = np.flatnonzero((points[:, 0] < 5) & (points[:, 1] < 7))
    held = np.flatnonzero(balls_within(points, chosen, 0.4).contain(points))
    assert set(chosen) <= set(held)
    near = np.linalg.norm(points[:, None] - points[chosen][None], axis=2).min(axis=1)
    assert (near[np.setdiff1d(held, chosen)] <= 0.4 / 16 * 1.01).all()
    nearby = points[chosen] + 0.4 / 40  # of another cloud
    assert balls_within(points, chosen, 0.4).contain(nearby).mean() > 0.95
