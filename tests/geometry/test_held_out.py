"""Which photos are held out: flights, orbits and streets of known layout, in any order of the photos; and
which pixels the others can know, against exact visibility.
"""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from sc3d.errors import InputError
from sc3d.geometry.cameras import in_image, look_at, pinhole_view, project, rays
from sc3d.geometry.held_out import held_out_views, sector_views, times_seen
from sc3d.geometry.shown import Witnesses

SIZE, CALIBRATION = (96, 64), (80.0, 80.0, 48.0, 32.0)
RANDOM = np.random.default_rng(0)


def views_at(centers, targets, up=(0, 0, 1)):
    return [
        pinhole_view(
            f"{row}.jpg", SIZE, CALIBRATION, look_at(np.array(center, float), np.array(target, float), up)
        )
        for row, (center, target) in enumerate(zip(centers, targets, strict=True))
    ]


def tracks_of(views, points, hidden=lambda view, points: np.zeros(len(points), bool)):
    found = []
    for view in views:
        pixels, depths = project(view, points)
        found.append(np.flatnonzero(in_image(view, pixels) & (depths > 0) & ~hidden(view, points)))
    return found


def flight():
    """8 strips of 10 photos straight down at 30 m, 8 m apart, over flat ground."""
    x, y = np.meshgrid(np.arange(10) * 8.0, np.arange(8) * 8.0)
    centers = np.stack([x.ravel(), y.ravel(), np.full(80, 30.0)], 1)
    points = np.column_stack([RANDOM.uniform(-20, 95, 6000), RANDOM.uniform(-20, 80, 6000), np.zeros(6000)])
    views = views_at(centers, centers * [1, 1, 0], (0, 1, 0))
    return views, points, tracks_of(views, points)


def orbit():
    """40 photos around a pillar of 3 m radius, from 12 m away; points on the side towards them are seen."""
    angles = np.arange(40) * np.pi / 20
    centers = np.stack([12 * np.cos(angles), 12 * np.sin(angles), np.full(40, 3.0)], 1)
    turn, height = RANDOM.uniform(0, 2 * np.pi, 3000), RANDOM.uniform(0, 6, 3000)
    points = np.stack([3 * np.cos(turn), 3 * np.sin(turn), height], 1)
    views = views_at(centers, [[0, 0, 3]] * 40)
    behind = lambda view, points: ((view.center - points) * points)[:, :2].sum(1) <= 0
    return views, points, tracks_of(views, points, behind)


def street():
    """A walk of 100 m between two facades, at each of 25 spots one photo to the left and one to the right."""
    along = np.repeat(np.arange(25) * 4.0, 2)
    side = np.tile([-8.0, 8.0], 25)
    centers = np.stack([along, np.zeros(50), np.full(50, 1.7)], 1)
    targets = np.stack([along + 2, side, np.full(50, 2.5)], 1)
    points = np.stack(
        [RANDOM.uniform(-12, 112, 4000), RANDOM.choice([-8.0, 8.0], 4000), RANDOM.uniform(0, 7, 4000)], 1
    )
    views = views_at(centers, targets)
    return views, points, tracks_of(views, points)


def contiguous(places, chosen, step):
    """Whether the chosen rows hang together by steps of at most `step`."""
    near, reached = cdist(places[chosen], places[chosen]) <= step, np.zeros(len(chosen), bool)
    reached[0] = True
    for _ in chosen:
        reached |= near[reached].any(axis=0)
    return reached.all()


@pytest.mark.parametrize("capture", [flight, orbit, street])
def test_sector_does_not_depend_on_the_order_of_the_photos(capture):
    views, points, tracks = capture()
    names = {views[index].name for index in sector_views(views, tracks, points, 0.2)}
    assert len(names) == round(0.2 * len(views))
    for _ in range(5):
        order = RANDOM.permutation(len(views))
        shuffled, seen = [views[row] for row in order], [tracks[row] for row in order]
        assert {shuffled[index].name for index in sector_views(shuffled, seen, points, 0.2)} == names


def test_sector_of_a_flight_is_one_corner():
    views, points, tracks = flight()
    centers = np.stack([view.center for view in views])
    chosen = sector_views(views, tracks, points, 0.2)
    assert contiguous(centers, chosen, 8.1)
    corner = min(
        ([x, y, 30] for x in (0, 72) for y in (0, 56)), key=lambda at: cdist([at], centers[chosen]).sum()
    )
    inside = cdist([corner], centers)[0]
    assert inside[chosen].max() <= np.delete(inside, chosen).min() + 1e-6
    counts = times_seen([tracks[row] for row in range(80) if row not in chosen], len(points)) >= 2
    kept = np.concatenate([counts[tracks[row]] for row in chosen])
    assert 0.4 < kept.mean() < 0.95  # the others see most of it, and not all


def test_sector_of_an_orbit_is_an_arc():
    views, points, tracks = orbit()
    chosen = np.array(sector_views(views, tracks, points, 0.25))
    gaps = np.diff(np.concatenate([chosen, chosen[:1] + 40]))
    assert len(chosen) == 10 and (gaps > 1).sum() == 1


def test_sector_of_a_street_looks_one_way_and_begins_at_an_end():
    views, points, tracks = street()
    chosen = np.array(sector_views(views, tracks, points, 0.2))
    assert len(set(chosen % 2)) == 1
    spots = np.sort(chosen // 2)
    assert np.array_equal(spots, np.arange(10)) or np.array_equal(spots, np.arange(15, 25))


def test_photos_from_one_spot_are_held_out_by_direction():
    """A panorama whose spots differ by centimeters: the sector is what looks nearly the same way."""
    angles = np.arange(24) * np.pi / 12
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(24)], 1)
    centers = RANDOM.normal(0, 0.02, (24, 3))
    points = 10 * directions[RANDOM.integers(0, 24, 500)] + RANDOM.normal(0, 1, (500, 3))
    views = views_at(centers, centers + directions)
    chosen = np.array(sector_views(views, tracks_of(views, points), points, 0.25))
    assert (np.diff(np.concatenate([chosen, chosen[:1] + 24])) > 1).sum() == 1


def test_of_two_ends_the_one_that_others_see_more_of():
    """Photos along a line; at the one end a second line sees the same ground."""
    line = np.stack([np.arange(20) * 10.0, np.zeros(20), np.full(20, 20.0)], 1)
    centers = np.concatenate([line, line[15:] + [0, 3, 0], line[15:] - [0, 3, 0]])
    points = np.column_stack([RANDOM.uniform(-10, 200, 3000), RANDOM.uniform(-5, 5, 3000), np.zeros(3000)])
    views = views_at(centers, centers * [1, 1, 0], (0, 1, 0))
    chosen = sector_views(views, tracks_of(views, points), points, 0.1)
    assert all(views[row].center[0] > 150 for row in chosen)


def test_a_camera_far_off_does_not_scatter_the_sector():
    views, points, tracks = flight()
    lost = views_at([[5000, 5000, 900]], [[5000, 5000, 0]], (0, 1, 0))
    chosen = sector_views(views + lost, [*tracks, np.zeros(0, int)], points, 0.2)
    centers = np.stack([view.center for view in views + lost])
    assert contiguous(centers, [row for row in chosen if row != 80], 8.1)


def test_both_hold_outs_are_apart_and_the_rest_is_trained_on():
    views, points, tracks = flight()
    split = held_out_views(views, tracks, points, 8, 0.2)
    assert split.sector == sector_views(views, tracks, points, 0.2) and len(split.sector) == 16
    rest = [row for row in range(80) if row not in split.sector]
    assert split.every_nth == rest[7::8] and len(split.all) == 24
    assert sorted(split.all + split.trained) == list(range(80))
    assert held_out_views(views, [], points, 8, 0.0).every_nth == list(range(7, 80, 8))
    assert held_out_views(views, [], points, 0, 0.0).trained == list(range(80))
    for every, share in ((1, 0.0), (0, 0.99), (2, 0.97)):
        with pytest.raises(InputError, match="at least 2 are needed"):
            held_out_views(views, tracks, points, every, share)


def test_no_points_and_cameras_at_one_place_still_give_a_sector():
    views = views_at([[0, 0, 5]] * 5, [[0, 0, 0]] * 5, (0, 1, 0))
    assert sector_views(views, [np.zeros(0, int)] * 5, np.zeros((0, 3)), 0.3) == [0, 1]


def test_pixels_that_others_know_are_those_that_two_of_them_see():
    views, points, tracks = flight()
    split = held_out_views(views, tracks, points, 0, 0.2)
    others = [views[row] for row in split.trained]
    witnesses = Witnesses(others, [tracks[row] for row in split.trained], points)
    right, shares = [], []
    for row in split.sector:
        directions, along = rays(views[row])
        ground = views[row].center - directions * (views[row].center[2] / directions[:, 2])[:, None]
        truth = sum(in_image(other, project(other, ground)[0]) for other in others) >= 2
        found = witnesses.pixels(views[row], tracks[row]).ravel()
        right.append((found == truth).mean())
        shares.append(truth.mean())
        depth = witnesses.depth(views[row], tracks[row])
        assert np.allclose(depth[depth > 0], 30, rtol=1e-5) and (depth > 0).sum() <= len(tracks[row])
    assert min(right) > 0.93 and np.mean(right) > 0.97
    assert min(shares) < 0.6 and max(shares) > 0.8  # there was something to tell apart


def test_what_stands_before_it_is_not_known():
    """Photos of a pillar from its other side have its back in their image, and do not see it."""
    views, points, tracks = orbit()
    front, others = 0, list(range(17, 24))
    witnesses = Witnesses([views[row] for row in others], [tracks[row] for row in others], points)
    assert not witnesses.pixels(views[front], tracks[front]).any()
    assert not witnesses.depth(views[front], tracks[front]).any()
