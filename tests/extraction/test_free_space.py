"""Who looks through what: cameras before a wall, where that is known by construction."""

from __future__ import annotations

import numpy as np

from sc3d.extraction.free_space import count_opposed, farthest_free
from sc3d.geometry.cameras import View, look_at, pinhole_view

WIDTH, HEIGHT = 80, 60
WALL = 10.0
FACING = np.tile(np.int8([0, 0, -127]), (HEIGHT, WIDTH, 1))


def view(x: float) -> View:
    """Towards the wall z = 10 from (x, 0, 0)."""
    center = np.array([x, 0.0, 0.0])
    pose = look_at(center, center + [0, 0, 1.0], (0.0, -1.0, 0.0))
    return pinhole_view("a", (WIDTH, HEIGHT), (80.0, 80.0, 40.0, 30.0), pose)


def flat(depth: float) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), depth, np.float32)


OTHERS = [view(-1.0), view(1.0)]


def test_a_floater_is_opposed_by_all_that_see_the_wall_behind_it_and_the_wall_by_nobody():
    walls = [flat(WALL)] * 2
    inner = np.s_[5:-5, 30:-30]
    assert (count_opposed(flat(5.0), FACING, view(0.0), walls, OTHERS)[inner] == 2).all()
    assert not count_opposed(flat(WALL), FACING, view(0.0), walls, OTHERS).any()
    assert not count_opposed(flat(20.0), FACING, view(0.0), walls, OTHERS).any()  # behind it: hidden
    assert not count_opposed(flat(0.0), FACING, view(0.0), walls, OTHERS).any()
    assert not count_opposed(flat(5.0), FACING, view(0.0), [], []).any()
    # at depth 5 a pixel in column 2 lies 2.4 left, 3.4 left of the camera at 1, which sees 2.5
    assert (count_opposed(flat(5.0), FACING, view(0.0), walls, OTHERS)[:, 2] == 1).all()


def test_who_knows_nothing_opposes_nothing_and_sky_opposes_everything():
    assert not count_opposed(flat(5.0), FACING, view(0.0), [flat(0.0)] * 2, OTHERS).any()
    sky = [np.full((HEIGHT, WIDTH), np.inf, np.float32), flat(0.0)]
    assert (count_opposed(flat(500.0), FACING, view(0.0), sky, OTHERS)[5:-5, 10:-10] == 1).all()


def test_at_grazing_angles_depth_is_less_sure():
    walls, middle = [flat(WALL)] * 2, (HEIGHT // 2, WIDTH // 2)
    grazing = np.tile(np.int8([126, 0, -12]), (HEIGHT, WIDTH, 1))  # 5 degrees; a margin of 32 % instead of 3
    for depth, steep, shallow in ((0.98, 0, 0), (0.8, 2, 0), (0.6, 2, 2)):
        for normals, opposed in ((FACING, steep), (grazing, shallow)):
            counts = count_opposed(flat(depth * WALL), normals, view(0.0), walls, OTHERS)
            assert counts[middle] == opposed


def test_the_farthest_depth_that_nobody_looks_through():
    """From above, the view at x = 1 knows a wall at 10 in its left half only, and a screen at 4 in its right one."""
    other = np.where(np.arange(WIDTH) < WIDTH // 2, 4.0, WALL) * np.ones((HEIGHT, 1))
    far = flat(9.5)
    found = farthest_free(far, 0.1, view(0.0), [other.astype(np.float32)], [view(1.0)])
    # a point of the middle pixel at depth z is in column 40 - 80 / z of the other: always before its screen at 4
    middle = found[HEIGHT // 2, WIDTH // 2]
    assert middle == 0  # hidden by the screen at all depths down from 9.5: nothing bounds it
    # column 60 at depth z: 60 - 80 / z: the wall's half for z > 4, before the screen's edge for less
    edge = found[HEIGHT // 2, 60]
    assert 3.5 < edge < 4.2
    bounded = farthest_free(far, 0.1, view(0.0), [other.astype(np.float32)], [view(1.0)], bounded=True)
    assert bounded[HEIGHT // 2, WIDTH // 2] == np.float32(9.5)
    nowhere = farthest_free(flat(0.0), 0.1, view(0.0), [flat(WALL)], [view(1.0)])
    assert not nowhere.any()
    assert not farthest_free(far, 0.1, view(0.0), [], []).any()


def test_what_is_looked_through_down_to_the_camera_gets_no_depth():
    same = [np.full((HEIGHT, WIDTH), np.inf, np.float32)]
    assert not farthest_free(flat(50.0), 1.0, view(0.0), same, [view(0.0)]).any()
    assert not farthest_free(flat(50.0), 1.0, view(0.0), same, [view(0.0)], bounded=True).any()
