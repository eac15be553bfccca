"""Objects of photos: read back as they were written, and asked where shapes do not tell."""

from __future__ import annotations

import logging

import numpy as np
import pycolmap
import pytest

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, look_at, rays
from sc3d.instances.object_map import Chunk, map_objects
from sc3d.instances.photo_votes import PhotoVotes
from sc3d.instances.site_frame import SiteFrame
from sc3d.scene.class_table import parse_classes
from sc3d.scene.scene import Scene
from sc3d.segmentation.instances import read_objects, write_instances
from tests.builders import LABELLED_CLASSES, instance_of, write_model

TABLE = parse_classes(LABELLED_CLASSES, "test")
FRAME = SiteFrame(np.eye(3), True)
HEIGHT, SPLIT = (
    5.0,
    21.0,
)  # of a flat roof from x = 10 to 30 and y = 10 to 20, and where its two houses meet, m


def test_objects_are_read_as_they_were_written(tmp_path):
    masks = np.zeros((3, 40, 60), bool)
    masks[0, 5:30, 10:40], masks[1, 20:40, 30:60], masks[2, :, 0] = True, True, True
    scores = (0.9, 0.8, 0.7)
    found = tuple(
        instance_of(mask, label, score, 1.0) for mask, label, score in zip(masks, (1, 2, 1), scores)
    )
    write_instances(tmp_path / "a.json", "a.jpg", (40, 60), found, TABLE)
    image = read_objects(tmp_path / "a.json")
    assert image.numbers.shape == (40, 60)
    best = np.where(masks[0], 0.9, np.where(masks[1], 0.8, np.where(masks[2], 0.7, 0)))
    np.testing.assert_array_equal(np.array([0, 0.7, 0.8, 0.9])[image.numbers], best)
    np.testing.assert_array_equal(image.class_ids, [0, 1, 2, 1])
    write_instances(tmp_path / "none.json", "a.jpg", (40, 60), (), TABLE)
    assert not read_objects(tmp_path / "none.json").numbers.any()
    (tmp_path / "a.json").write_text((tmp_path / "a.json").read_text().replace('"counts": "', '"counts": "0'))
    with pytest.raises(InputError, match="is not what `sc3d segment` wrote"):
        read_objects(tmp_path / "a.json")


def cloud() -> Chunk:
    """Two houses under one flat roof, on a flat lawn."""
    x, y = np.random.default_rng(0).uniform(0, [[40], [30]], (2, 40_000))
    roof = (x > 10) & (x < 30) & (y > 10) & (y < 20)
    points = np.column_stack([x, y, np.where(roof, HEIGHT, 0.0)])
    return Chunk(points, np.where(roof, 1, 3).astype(np.uint8), np.ones(len(x), bool))


@pytest.fixture
def scene(tmp_path) -> Scene:
    """Four photos from above that see two houses, one that takes them for one, and one that is damaged."""
    camera = pycolmap.Camera(model="PINHOLE", width=160, height=120, params=[120, 120, 80, 60], camera_id=1)
    eyes = [[15, 12, 35], [25, 12, 35], [15, 18, 35], [25, 18, 35], [20, 15, 35], [20, 14, 35]]
    views = [
        View(f"photo_{row}.jpg", camera, look_at(np.array(eye, float), np.array([20.0, 15.0, 0.0])))
        for row, eye in enumerate(eyes)
    ]
    write_model(tmp_path / "sparse" / "0", views)
    (tmp_path / "instances").mkdir()
    for row, view in enumerate(views):
        directions = rays(view)[0].reshape(view.height, view.width, 3)
        hits = view.center + directions * ((HEIGHT - view.center[2]) / directions[..., 2])[..., None]
        roof = (hits[..., 0] > 10) & (hits[..., 0] < 30) & (hits[..., 1] > 10) & (hits[..., 1] < 20)
        west = hits[..., 0] < SPLIT
        masks = [roof] if row == 4 else [roof & west, roof & ~west]
        found = tuple(instance_of(mask, 1, 0.9, 0.9) for mask in masks)
        write_instances(tmp_path / "instances" / f"photo_{row}.json", view.name, (120, 160), found, TABLE)
    (tmp_path / "instances" / "photo_5.json").write_text("{}")
    return Scene(tmp_path)


def test_photos_part_what_one_roof_covers(scene, caplog):
    chunk, votes = cloud(), PhotoVotes.of_scene(scene, FRAME, read_objects)
    assert map_objects(lambda: iter([chunk]), TABLE).counts(TABLE) == {"building": 1}
    with caplog.at_level(logging.WARNING):
        found = map_objects(lambda: iter([chunk]), TABLE, votes.refine)
    assert found.counts(TABLE) == {"building": 2}
    assert caplog.text.count("photos whose objects cannot be read") == 1 and "photo_5.json" in caplog.text
    instance = found.find(chunk.points, chunk.label)
    own = [
        instance[(chunk.label == 1) & side]
        for side in (chunk.points[:, 0] < SPLIT, chunk.points[:, 0] > SPLIT)
    ]
    majority = [int(np.bincount(numbers).argmax()) for numbers in own]
    assert majority[0] != majority[1] and min(majority) > 0
    assert all((numbers == most).mean() > 0.93 for numbers, most in zip(own, majority))


def test_photos_without_objects_have_no_say(scene):
    for file in (scene.path / "instances").iterdir():
        file.unlink()
    assert PhotoVotes.of_scene(scene, FRAME, read_objects) is None
