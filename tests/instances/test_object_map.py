"""Objects of clouds with a known answer: two houses that touch, crowns, cars; in any order and in any parts."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from sc3d.geometry.raster import Raster
from sc3d.instances.agglomeration import agglomerate
from sc3d.instances.facades import find_facades
from sc3d.instances.object_map import Chunk, ObjectMap, map_objects
from sc3d.instances.scene_objects import SceneObjects
from sc3d.instances.sight import in_sight
from sc3d.instances.site_frame import SiteFrame, turned_up
from sc3d.scene.class_table import parse_classes
from tests.builders import LABELLED_CLASSES

TABLE = parse_classes(LABELLED_CLASSES, "test")
BUILDING, TREE, ROAD, CAR = 1, 2, 3, 9


def site(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, labels and true objects (N,): a low and a high house that touch, two crowns that touch, two cars."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 40, (2, 60_000))
    label, truth, z = np.full(len(x), ROAD), np.zeros(len(x), int), 0.05 * x
    for number, (a, b, c, d, height) in enumerate([(3, 3, 11, 13, 4.0), (11, 3, 19, 13, 9.0)], start=1):
        inside = (x > a) & (x <= c) & (y > b) & (y <= d)
        label[inside], truth[inside], z[inside] = BUILDING, number, height + 0.05 * x[inside]
    crowns = [(26.0, 8.0, 3.0, 8.0), (30.6, 8.0, 3.0, 9.0)]
    heights = np.array([h - 0.5 * h * (np.hypot(x - a, y - b) / r) ** 2 for a, b, r, h in crowns])
    inside = np.array([np.hypot(x - a, y - b) < r for a, b, r, _ in crowns])
    best = np.where(inside, heights, -1).argmax(axis=0)
    tree = inside.any(axis=0)
    label[tree], truth[tree] = TREE, 3 + best[tree]
    z[tree] = heights.max(axis=0, initial=0, where=inside)[tree] + 0.05 * x[tree]
    for number, (a, b) in enumerate([(10, 25), (13, 25)], start=5):
        car = (np.abs(x - a) < 0.9) & (np.abs(y - b) < 2)
        label[car], truth[car], z[car] = CAR, number, 1.4 + 0.05 * x[car]
    return np.column_stack([x, y, z]), label.astype(np.uint8), truth


def mapped(points: np.ndarray, label: np.ndarray, parts: int = 1, **options) -> tuple[ObjectMap, np.ndarray]:
    def chunks():
        for rows in np.array_split(np.arange(len(points)), parts):
            yield Chunk(points[rows], label[rows], np.ones(len(rows), bool))

    found = map_objects(chunks, TABLE, **options)
    return found, found.find(points, label)


def test_houses_crowns_and_cars_are_told_apart():
    points, label, truth = site()
    found, instance = mapped(points, label)
    assert found.counts(TABLE) == {"building": 2, "tree": 2, "car": 2}
    assert instance.dtype == np.uint32 and (instance[label == ROAD] == 0).all()
    for number in range(1, 7):
        own, counts = np.unique(instance[truth == number], return_counts=True)
        most = own[counts.argmax()]
        union = ((instance == most) | (truth == number)).sum()
        assert most > 0 and counts.max() / union > 0.9, number
    assert len(np.unique(instance[instance > 0])) == 6


def test_neither_order_nor_parts_of_the_cloud_matter():
    points, label, _ = site()
    order = np.random.default_rng(1).permutation(len(points))
    once, shuffled = mapped(points, label)[1], mapped(points[order], label[order], parts=7)[1]
    np.testing.assert_array_equal(once[order], shuffled)


def test_points_beyond_the_site_and_doubted_ones():
    """What no label or no second photo speaks for makes no object; a doubted point on one is of it."""
    points, label, truth = site()
    far = np.array([[400.0, 8.0, 3.0], [26.0, 8.0, 7.0]])
    more, labels = np.concatenate([points, far]), np.append(label, np.uint8([TREE, TREE]))
    sure = np.append(np.ones(len(points), bool), [False, False])
    found = map_objects(lambda: iter([Chunk(more, labels, sure)]), TABLE)
    instance = found.find(more, labels)
    np.testing.assert_array_equal(instance[:-2], mapped(points, label)[1])
    assert instance[-2] == 0 and instance[-1] == instance[:-2][truth == 3][0]


def test_without_ground_there_are_no_objects_and_a_reason():
    points, label, _ = site()
    only = label == BUILDING
    found, instance = mapped(points[only], label[only])
    assert "ground" in found.why and not instance.any()
    assert not mapped(points[label == ROAD], label[label == ROAD])[1].any()


def test_the_class_table_says_what_is_counted():
    points, label, _ = site()
    classes = [entry | ({"countable": entry["name"] == "car"}) for entry in LABELLED_CLASSES]
    table = parse_classes(classes, "test")
    found = map_objects(lambda: iter([Chunk(points, label, np.ones(len(points), bool))]), table)
    assert found.counts(table) == {"car": 2}
    assert parse_classes(table.as_json(), "again") == table
    assert "countable" not in TABLE.as_json()[0]
    with pytest.raises(Exception, match="countable of class 1 must be true or false"):
        parse_classes([LABELLED_CLASSES[0] | {"countable": "yes"}], "test")


def test_photos_join_and_part(tmp_path):
    """Cells of a roof that photos see as two objects are two; `refine` gets the regions of each kind."""
    points, label, _ = site()
    seen = []

    def halves(tops, number, kind, regions):
        seen.append(kind.how)
        columns = np.arange(regions.shape[1])[None] > regions.shape[1] // 2
        return np.where(regions > 0, 1 + (columns & (kind.how == "crowns")), 0).astype(np.int32)

    found, instance = mapped(points, label, refine=halves)
    assert seen == ["roofs", "crowns", "parts"] and found.counts(TABLE)["building"] == 1
    assert len(np.unique(instance[label == BUILDING])) == 1


def test_agglomeration_against_all_partitions():
    """On graphs small enough to try every partition: never worse than the parts by themselves, and right where one
    partition agrees with every edge.
    """
    rng = np.random.default_rng(0)
    for _ in range(30):
        group = rng.integers(0, 3, 7)
        edges = np.array([(a, b) for a in range(7) for b in range(a + 1, 7)])
        weights = np.where(group[edges[:, 0]] == group[edges[:, 1]], 1, -1) * rng.integers(1, 5, len(edges))
        order = rng.permutation(len(edges))
        found = agglomerate(7, edges[order], weights[order])
        assert ((found[:, None] == found) == (group[:, None] == group)).all()
        np.testing.assert_array_equal(found, agglomerate(7, edges[:, ::-1], weights))


def test_walls_alone_are_buildings_where_they_are_long_and_high():
    grid = Raster(0.0, 20.0, 0.25, 80, 120)
    tops, lows = np.full(grid.shape, -np.inf), np.full(grid.shape, np.inf)
    tops[40, 10:50], tops[40, 50:100], lows[40, 10:100] = 6.0, 11.0, 0.0  # two facades of one row
    tops[60, 10:14], lows[60, 10:14] = 6.0, 0.0  # a meter of wall
    found = find_facades(tops, lows, np.zeros(grid.shape, np.int32), grid)
    assert found.max() == 2 and found[40, 20] != found[40, 80] and found[60, 12] == 0
    roof = np.zeros(grid.shape, np.int32)
    roof[44:52, 5:105] = 1
    np.testing.assert_array_equal(
        find_facades(tops, lows, roof, grid) > 0, roof > 0
    )  # the walls of that roof


def test_in_sight_of_a_camera_behind_a_house():
    grid = Raster(0.0, 20.0, 0.5, 40, 40)
    tops = np.zeros(grid.shape)
    x = grid.centers()[:, 0].reshape(grid.shape)
    tops[(x > 9) & (x < 11)] = 6.0
    points = np.array([[3.0, 10.0, 0.0], [17.0, 10.0, 0.0], [10.0, 10.0, 6.0]])
    assert in_sight(grid, tops, points, np.array([19.0, 10.0, 3.0])).tolist() == [False, True, True]
    assert in_sight(grid, tops, points, np.array([10.0, 10.0, 80.0])).all()
    assert in_sight(
        grid, tops, points[:1], np.array([-30.0, 10.0, 3.0])
    ).all()  # beyond the edge nothing is known


def test_turned_up_and_back():
    for up in ([0, 0, 1], [0, 0, -1], [0.6, 0, 0.8], [0, -1, 0]):
        frame = SiteFrame(turned_up(np.array(up, float)), False)
        np.testing.assert_allclose(frame.place(np.array([up])), [[0, 0, 1]], atol=1e-12)
        np.testing.assert_allclose(frame.site_from_world @ frame.site_from_world.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(frame.to_world(frame.place(np.eye(3))), np.eye(3), atol=1e-12)


def test_lost_points_are_told_in_one_line(caplog):
    points, label, _ = site()
    label = label.copy()
    label[np.hypot(points[:, 0] - 35, points[:, 1] - 35) < 1] = BUILDING  # flat
    found, _ = mapped(points, label)
    objects = SceneObjects(SiteFrame(np.eye(3), True), TABLE, found)
    instance = objects.find(points, label)
    lost = int(((label == BUILDING) & (instance == 0)).sum())
    with caplog.at_level(logging.INFO):
        assert objects.figures()["building"] == 2
    assert lost and f"building {lost:,} of {(label == BUILDING).sum():,}" in caplog.text
