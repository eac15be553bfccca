"""Voting, conflicts and locks on small analytic scenes."""

from dataclasses import replace

import numpy as np
import pytest

from sc3d.geometry.cameras import look_at, pinhole_view
from sc3d.geometry.raycast import Surface
from sc3d.labelling.cloud import Cloud
from sc3d.labelling.fusion import fuse
from sc3d.labelling.observation import edge_distance, observe
from sc3d.scene.labels import LOCKED, SEED, UNLOCKED, UNSEEN
from sc3d.settings.labels import Label, PaperMechanisms

PLAIN = Label(
    voxel_size=0.2,
    edge_width=0,
    use_confidence=False,
    verify="no",
    mechanisms=PaperMechanisms(depth_excess=False, incidence=False, range=False),
)
SECOND_VOTE = replace(PLAIN.mechanisms, reproject=True)


def plane(height: float = 0.0, half: float = 3.0, step: float = 0.1) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-half, half, step), np.arange(-half, half, step))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)


def cloud_of(points: np.ndarray, up: float = 1.0) -> Cloud:
    return Cloud(points, np.tile(np.float32([0, 0, up]), (len(points), 1)))


def cameras_above(count: int, size: int = 120) -> list:
    rng = np.random.default_rng(7)
    return [
        pinhole_view(
            f"view_{row:02d}.jpg",
            (size, size),
            (size, size, size / 2, size / 2),
            look_at(np.array([*rng.uniform(-2, 2, 2), 12.0]), np.zeros(3)),
        )
        for row in range(count)
    ]


def constant(labels: dict[str, int], size: int = 120):
    return lambda view: (np.full((size, size), labels[view.name], np.uint8), None)


def test_agreement_is_a_seed_everywhere():
    cloud, views = cloud_of(plane()), cameras_above(5)
    labels = fuse(
        cloud,
        views,
        constant({view.name: 3 for view in views}),
        Surface.from_cloud(cloud.points, cloud.normals, np.zeros(3)),
        5,
        PLAIN,
    ).labels
    assert (labels.label == 3).all() and (labels.state == SEED).all()
    assert (labels.confidence == 1).all() and (labels.num_views == 5).all()


@pytest.mark.parametrize(
    ("votes", "consensus", "state"),
    [
        ([1, 1, 1, 2], 0.8, LOCKED),
        ([1, 1, 1, 1, 2], 0.8, SEED),
        ([1, 1, 1, 1, 2], 1.0, LOCKED),
        ([2], 1.0, SEED),
    ],
)
def test_consensus_threshold_decides_between_seed_and_lock(votes, consensus, state):
    cloud, views = cloud_of(plane()), cameras_above(len(votes))
    read = constant({view.name: vote for view, vote in zip(views, votes, strict=True)})
    labels = fuse(cloud, views, read, None, 5, replace(PLAIN, consensus=consensus)).labels
    assert (labels.state == state).all()
    assert (labels.label == (0 if state == LOCKED else votes[0])).all()


def test_paper_locks_on_any_disagreement():
    cloud, views = cloud_of(plane()), cameras_above(10)
    read = constant({view.name: 2 if row == 9 else 1 for row, view in enumerate(views)})
    assert (fuse(cloud, views, read, None, 5, replace(PLAIN, method="paper")).labels.state == LOCKED).all()


def test_label_zero_never_votes():
    cloud, views = cloud_of(plane()), cameras_above(4)
    read = constant({view.name: 0 if row else 2 for row, view in enumerate(views)})
    labels = fuse(cloud, views, read, None, 5, PLAIN).labels
    assert (labels.label == 2).all() and (labels.num_views == 1).all()
    nothing = fuse(cloud, views, constant({view.name: 0 for view in views}), None, 5, PLAIN).labels
    assert (nothing.state == UNSEEN).all() and (nothing.label == 0).all() and (nothing.confidence == 0).all()


def test_direct_overlay_lets_the_last_photo_win():
    cloud, views = cloud_of(plane()), cameras_above(3)
    read = constant({view.name: row + 1 for row, view in enumerate(views)})
    assert (fuse(cloud, views[::-1], read, None, 5, replace(PLAIN, method="direct")).labels.label == 3).all()


@pytest.mark.parametrize("method", ["direct", "majority", "conflict-lock"])
def test_no_label_leaks_behind_a_wall(method):
    ground, roof = plane(0.0, 6.0), plane(4.0, 2.0)
    points = np.concatenate([ground, roof])
    cloud = cloud_of(points)
    view = pinhole_view(
        "a.jpg", (300, 300), (300, 300, 150, 150), look_at(np.array([0.0, 0, 12.0]), np.zeros(3))
    )
    mask = np.full((300, 300), 4, np.uint8)
    edge = int(300 * 2 / 8) + 1
    mask[150 - edge : 150 + edge, 150 - edge : 150 + edge] = 1  # the roof as this camera sees it
    surface = Surface.from_cloud(points, cloud.normals, np.zeros(3))
    labels = fuse(cloud, [view], lambda _: (mask, None), surface, 5, replace(PLAIN, method=method)).labels
    hidden = np.abs(ground[:, :2]).max(axis=1) < 2.5  # the roof's shadow reaches 3.0
    assert (labels.label[: len(ground)][hidden] == 0).all()
    assert (labels.label[len(ground) :] == 1).all()
    assert not (labels.label[: len(ground)] == 1).any()
    leaking = fuse(cloud, [view], lambda _: (mask, None), None, 5, replace(PLAIN, method=method)).labels
    assert (leaking.label[: len(ground)][hidden] == 1).all()


def test_thin_wall_keeps_a_label_on_each_side():
    """Two faces 4 cm apart in voxels of 20 cm, seen from above and from below."""
    top, bottom = plane(0.02, 2.0), plane(-0.02, 2.0)
    points = np.concatenate([top, bottom])
    cloud = Cloud(points, np.concatenate([cloud_of(top).normals, cloud_of(bottom, -1.0).normals]))
    above = cameras_above(3)
    below = [
        pinhole_view(
            f"below_{row}.jpg",
            (120, 120),
            (120, 120, 60, 60),
            look_at(np.array([0.3 * row, 0, -12.0]), np.zeros(3)),
        )
        for row in range(3)
    ]
    read = constant({view.name: 1 for view in above} | {view.name: 2 for view in below})
    labels = fuse(
        cloud, above + below, read, Surface.from_cloud(points, cloud.normals, np.zeros(3)), 5, PLAIN
    ).labels
    assert (labels.label[: len(top)] == 1).all() and (labels.label[len(top) :] == 2).all()
    assert (labels.state == SEED).all()


def test_votes_do_not_depend_on_the_order_of_views_or_points():
    rng = np.random.default_rng(0)
    points = plane() + rng.normal(0, 0.02, plane().shape)
    cloud, views = cloud_of(points), cameras_above(8)
    masks = {
        view.name: (
            rng.integers(0, 5, (120, 120)).astype(np.uint8),
            rng.integers(0, 256, (120, 120)).astype(np.uint8),
        )
        for view in views
    }
    settings = Label(voxel_size=0.2)
    surface = Surface.from_cloud(points, cloud.normals, np.zeros(3))
    first = fuse(cloud, views, lambda view: masks[view.name], surface, 5, settings)
    order, point_order = rng.permutation(8), rng.permutation(len(points))
    second = fuse(
        Cloud(points[point_order], cloud.normals[point_order]),
        [views[row] for row in order],
        lambda view: masks[view.name],
        surface,
        5,
        settings,
    )
    np.testing.assert_array_equal(first.grid.votes[first.rows][point_order], second.grid.votes[second.rows])
    for name in ("label", "confidence", "state", "num_views"):
        np.testing.assert_array_equal(getattr(first.labels, name)[point_order], getattr(second.labels, name))


def test_reprojection_unlocks_what_only_mask_edges_disputed():
    """Masks whose boundary wobbles by a few pixels: with edges taken out, the views agree."""
    cloud = cloud_of(plane(half=2.0))

    def read(_):
        mask = np.full((120, 120), 1, np.uint8)
        mask[:, 60 + rng.integers(-1, 2) :] = 2
        return mask, None

    straight = [
        pinhole_view(
            f"s{row:02d}.jpg", (120, 120), (120, 120, 60, 60), look_at(np.array([0.0, 0, 12.0]), np.zeros(3))
        )
        for row in range(12)
    ]
    rng = np.random.default_rng(0)
    locked = fuse(cloud, straight, read, None, 5, replace(PLAIN, consensus=0.95)).labels
    rng = np.random.default_rng(0)
    again = fuse(
        cloud, straight, read, None, 5, replace(PLAIN, consensus=0.95, edge_width=0.9, mechanisms=SECOND_VOTE)
    ).labels
    assert (locked.state == LOCKED).sum() > 0
    assert (again.state == UNLOCKED).sum() > 0
    assert (again.label[again.state == UNLOCKED] > 0).all()


def test_pixel_weights_follow_the_distance_to_mask_edges():
    mask = np.ones((40, 60), np.uint8)
    mask[:, 30:] = 2
    ranges = np.full((40, 60), 50.0, np.float32)
    confidence = np.full((40, 60), 204, np.uint8)
    edge = edge_distance(mask)
    picture = observe(mask, confidence, ranges, 1.5)
    assert edge[5, 29] == edge[5, 30] == 0.5 and edge[5, 20] == pytest.approx(9.5, abs=0.2)
    np.testing.assert_allclose(picture.weights, 0.8 * (1 - np.exp(-edge / 1.5)), atol=0.01)
    assert (picture.strict == (edge >= 1.5)).all()
    assert (observe(mask, None, ranges, 0).weights == 1).all()


def test_a_second_vote_of_a_single_view_unlocks_nothing():
    cloud, views = cloud_of(plane()), cameras_above(3)
    tilted = np.full((120, 120), 1, np.uint8)
    masks = {view.name: (tilted * (2 - (row == 0)), None) for row, view in enumerate(views)}
    labels = fuse(
        cloud,
        views,
        lambda view: masks[view.name],
        None,
        5,
        replace(PLAIN, consensus=1.0, mechanisms=SECOND_VOTE),
    ).labels
    assert (labels.state == LOCKED).all()


def test_edge_distance():
    mask = np.ones((20, 30), np.uint8)
    mask[:, 15:] = 2
    distance = edge_distance(mask)
    assert distance[10, 14] == distance[10, 15] == 0.5
    assert distance[10, 10] == pytest.approx(4.5, abs=0.2)
    assert edge_distance(np.ones((5, 5), np.uint8)).min() >= 10
