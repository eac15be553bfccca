"""Classes without surface, such as the sky: allowed in masks and truth, never given to a point, judged apart."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sc3d.errors import InputError
from sc3d.geometry.cameras import rays
from sc3d.labelling.label import label_scene
from sc3d.metrics import evaluate_scene
from sc3d.scene.class_table import parse_classes
from sc3d.scene.labelled_cloud import read_labelled
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Evaluate, Label
from sc3d.tiling.evaluate import evaluate_scene as evaluate_by_tiles
from sc3d.tiling.label import label_scene as label_by_tiles
from tests.builders import CLASSES, ORIGIN, truth_mask, views, write_bare_scene

SKY = {"id": 7, "name": "Sky", "color": [90, 160, 250]}


def table_with(*entries: dict):
    return parse_classes([*CLASSES, *entries], "test")


def test_sky_has_no_surface_unless_the_table_says_so():
    assert [entry.id for entry in table_with(SKY).without_surface] == [7]
    assert table_with(SKY).channels.ids.tolist() == [0, 1, 3]
    assert not table_with(SKY | {"surface": True}).without_surface
    people = {"id": 2, "name": "people", "color": [1, 2, 3], "surface": False}
    table = table_with(people)
    assert table.shows_no_surface(np.uint8([[0, 1], [2, 3]])).tolist() == [[False, False], [True, False]]
    for entries in ([SKY], [SKY | {"surface": True}], [people], []):
        assert parse_classes(table_with(*entries).as_json(), "test") == table_with(*entries)
    assert "surface" not in str(table_with(SKY).as_json())


@pytest.mark.parametrize("value", [0, "no", None, []])
def test_surface_must_be_true_or_false(value):
    with pytest.raises(InputError, match="surface of class 7 must be true or false"):
        table_with(SKY | {"surface": value})


def test_a_table_without_any_surface_is_refused():
    with pytest.raises(InputError, match="no class has a surface"):
        parse_classes([SKY], "test")


def place_on_ground(view) -> np.ndarray:
    """(H, W, 2) where the ray of a pixel meets the ground, around ORIGIN."""
    directions, _ = rays(view)
    away = -(view.center[2] - ORIGIN[2]) / directions[:, 2]
    return (view.center + directions * away[:, None] - ORIGIN)[:, :2].reshape(view.height, view.width, 2)


def scene_with(folder: Path, value: int, entries: list[dict]) -> Scene:
    """The scene of the builders, where masks hold `value` on a strip of ground and truth beyond the ground and
    on a spot of it.
    """
    scene = Scene(write_bare_scene(folder))
    (folder / "classes.json").write_text(json.dumps([*CLASSES, *entries]))
    for view in views():
        mask, place = truth_mask(view), place_on_ground(view)
        name = f"{Path(view.name).stem}.png"
        strip, spot = np.abs(place[..., 1]) < 0.5, np.linalg.norm(place - [2, 2], axis=2) < 0.5
        Image.fromarray(np.where(strip, np.uint8(value), mask)).save(scene.masks / name)
        truth = np.where((np.abs(place).max(axis=2) > 4.5) | spot, np.uint8(value), mask)
        Image.fromarray(truth).save(scene.truth / name)
    return scene


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> tuple[Scene, Scene]:
    """The same scene with sky in its masks, and with pixels that say nothing in its place; labelled."""
    scenes = (
        scene_with(tmp_path_factory.mktemp("sky"), 7, [SKY]),
        scene_with(tmp_path_factory.mktemp("nothing"), 0, []),
    )
    for scene in scenes:
        label_scene(scene, Label())
    return scenes


def test_sky_in_masks_never_votes(pair):
    with_sky, without = pair
    label = read_labelled(with_sky.seeds, "label")[1].label
    assert set(np.unique(label)) == {0, 1, 3}
    assert with_sky.seeds.read_bytes() == without.seeds.read_bytes()


def test_nor_by_tiles(pair, tmp_path):
    files = [tmp_path / name for name in ("sky.ply", "nothing.ply")]
    for scene, file in zip(pair, files, strict=True):
        label_by_tiles(scene, Label(cloud=pair[1].seeds, output=file))  # which has normals
    assert files[0].read_bytes() == files[1].read_bytes()
    assert set(np.unique(read_labelled(files[0], "label")[1].label)) == {0, 1, 3}


def test_labelling_says_what_does_not_vote(pair, tmp_path, caplog):
    with caplog.at_level("INFO"):
        label_scene(pair[0], Label(output=tmp_path / "a.ply"))
    assert "mask pixels of classes without surface do not vote: Sky" in caplog.text


@pytest.mark.parametrize("evaluate", [evaluate_scene, evaluate_by_tiles])
def test_truth_of_sky_is_right_where_nothing_is_hit(pair, evaluate):
    settings = Evaluate(labelled=pair[0].seeds)
    summary, other = evaluate(pair[0], settings), evaluate(pair[1], settings)
    places = [place_on_ground(view) for view in views()]
    beyond = sum(int((np.abs(place).max(axis=2) > 4.5).sum()) for place in places)
    spot = sum(int((np.linalg.norm(place - [2, 2], axis=2) < 0.5).sum()) for place in places)
    assert beyond > 1000 and spot > 100
    assert summary.empty == {"Sky": {"pixels": beyond + spot, "right": beyond}}
    assert summary.figures()["without_surface"].startswith("judged apart, nothing is hit: Sky")
    assert json.loads(pair[0].metrics.read_text())["without_surface"] == summary.empty
    assert other.empty == {} and "without_surface" not in other.figures()
    for source in ("labels", "labels_near_edges", "labels_elsewhere"):
        for figure in ("oa", "miou", "iou", "pixels", "coverage"):
            assert summary.totals[source][figure] == other.totals[source][figure]
