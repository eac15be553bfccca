"""Where a browser's camera stands to look at a place, and how it gets there."""

import numpy as np
import pytest

from sc3d.geometry.cameras import look_at, pinhole_view, project
from sc3d.view.web.orbit_camera import OrbitCamera

LEAST = 0.5


def window_of(pose: OrbitCamera, aspect: float, scale: float = 1.0):
    """What a browser shows of a pose, as a view of 600 px height; scale: of the window's sides around its middle"""
    height, width = 600, round(600 * aspect)
    focal = height / 2 / np.tan(pose.fov / 2) / scale
    return pinhole_view(
        "window",
        (width, height),
        (focal, focal, width / 2, height / 2),
        look_at(pose.position, pose.look_at, tuple(pose.up)),
    )


def inside(pose: OrbitCamera, aspect: float, points: np.ndarray, scale: float = 1.0) -> np.ndarray:
    view = window_of(pose, aspect, scale)
    pixels, _ = project(view, points)
    return ((pixels >= -1e-6) & (pixels <= np.array([view.width, view.height]) + 1e-6)).all(axis=1)


@pytest.mark.parametrize("seed", range(20))
def test_all_of_a_place_is_in_the_window_and_the_eye_stays_on_the_free_line(seed):
    random = np.random.default_rng(seed)
    points = random.normal(size=(200, 3)) * random.uniform(0.05, 20, 3)
    target, aspect = points[0], random.uniform(0.4, 2.5)
    towards = random.normal(size=3) if seed % 4 else np.array([0, 0, 1.0])
    towards /= np.linalg.norm(towards)
    ahead = np.array([0, -1.0, 0])
    free = OrbitCamera.of_place(points, target, towards, np.inf, LEAST, aspect, ahead)
    assert inside(free, aspect, points).all()
    assert not inside(free, aspect, points, 0.2).all()  # and not from far away
    size = np.abs(points - target).max()
    for reach in (free.distance, 0.8 * free.distance, 1.5 * size, 0.1 * size):
        pose = OrbitCamera.of_place(points, target, towards, reach, LEAST, aspect, ahead)
        assert pose.distance <= reach * (1 + 1e-9) and np.allclose(
            np.cross(pose.position - target, towards), 0, atol=1e-9 * (1 + reach)
        )
        in_front = (pose.position - points) @ towards
        slope = np.abs(points - target).max() / max(in_front.min(), 1e-9)
        if in_front.min() > 0 and slope * max(1, 1 / aspect) < 1.5:  # a window can hold it
            assert inside(pose, aspect, points).all()


def test_small_places_are_shown_with_what_is_around_them():
    pose = OrbitCamera.of_place(
        np.zeros((1, 3)), np.zeros(3), np.array([0, -0.6, 0.8]), 9.0, LEAST, 1.0, np.array([0, 1.0, 0])
    )
    assert np.isclose(2 * pose.distance * np.tan(pose.fov / 2), LEAST) and pose.up[2] == 1


def test_straight_down_the_top_is_where_one_looked():
    pose = OrbitCamera(np.array([0, -5.0, 5.0]), np.zeros(3), np.array([0, 0, 1.0]), 0.7)
    assert np.allclose(pose.ahead, [0, 1, 0])
    down = OrbitCamera.of_place(
        np.eye(3), np.zeros(3), np.array([0, 0, 1.0]), 9.0, LEAST, 1.0, np.array([1.0, 0, 0])
    )
    assert np.allclose(down.up, [1, 0, 0]) and np.allclose(down.ahead, [1, 0, 0])
    up = OrbitCamera(np.zeros(3), np.array([0, 0, 1.0]), np.zeros(3), 0.7)
    assert np.allclose(up.ahead, [0, 1, 0])  # which is as good as any


@pytest.mark.parametrize("end", [[3.0, 4, 0], [-3.0, 0, 0], [3.0, 0, 0], [0, 0.1, 30]])
def test_a_flight_goes_around_and_not_through(end):
    start = OrbitCamera(np.array([3.0, 0, 0]), np.zeros(3), np.array([0, 0, 1.0]), 0.4)
    goal = OrbitCamera(np.array(end) + 1, np.ones(3), np.array([0, 1.0, 0]), 1.0)
    poses = [start.between(goal, share) for share in np.linspace(0, 1, 50)]
    assert np.allclose(poses[0].position, start.position) and poses[-1] is goal
    closest = min(start.distance, goal.distance)
    assert all(closest * (1 - 1e-9) <= pose.distance <= 30.1 for pose in poses)
    steps = np.linalg.norm(np.diff([pose.position for pose in poses], axis=0), axis=1)
    assert steps.max() < 3 * max(np.linalg.norm(goal.position - start.position), np.pi * 3) / 49
    assert all(np.linalg.norm(pose.up) > 0.1 for pose in poses)
