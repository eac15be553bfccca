"""What masks leave unlabelled: holes are voted away, a surface of none of the classes stays unlabelled."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sc3d.errors import InputError
from sc3d.geometry.cameras import look_at, pinhole_view
from sc3d.geometry.raycast import Surface
from sc3d.io.clouds import read_cloud, write_geometry
from sc3d.labelling.cloud import Cloud
from sc3d.labelling.fusion import fuse
from sc3d.labelling.label import label_scene
from sc3d.propagation.labelled_points import LabelledPoints
from sc3d.propagation.none_evidence import NoneRates, count_votes, none_share
from sc3d.propagation.propagate import propagate, propagate_scene
from sc3d.scene.channels import Channels
from sc3d.scene.class_table import parse_classes
from sc3d.scene.labelled_cloud import vote_channels
from sc3d.scene.labels import SEED
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Label, Propagate
from sc3d.tiling import label as tiled_label
from sc3d.tiling import propagate as tiled_propagate
from sc3d.tiling.label import label_scene as label_by_tiles
from sc3d.tiling.propagate import propagate_scene as propagate_by_tiles
from tests.builders import CLASSES, ORIGIN, truth_mask, views, write_bare_scene

SIZE, NONE = 160, 3  # classes 1 and 2; channel 3 = looked at, none of them
VIEWS = [
    pinhole_view(
        f"view_{row}.jpg",
        (SIZE, SIZE),
        (SIZE, SIZE, SIZE / 2, SIZE / 2),
        look_at(np.array([x, y, 12.0]), np.array([x, y, 0.0])),
    )
    for row, (x, y) in enumerate(
        [(-0.6, -0.4), (0.5, -0.5), (0.4, 0.6), (-0.5, 0.5), (0.0, 0.1), (0.2, -0.1)]
    )
]


def plane(step: float = 0.1, half: float = 4.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-half, half, step), np.arange(-half, half, step))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def mask(view, holes: float, seed: int) -> np.ndarray:
    """Class 1 where x < -1, 2 where x < 1.5, none beyond; patches of 8 px are holes at random."""
    columns = (np.arange(SIZE) + 0.5 - SIZE / 2) * 12 / SIZE + view.center[0]
    found = np.where(columns < -1, 1, np.where(columns < 1.5, 2, NONE))
    result = np.repeat(found[None], SIZE, axis=0)
    patches = np.random.default_rng(seed).random((SIZE // 8, SIZE // 8)) < holes
    return np.where(np.kron(patches, np.ones((8, 8), bool)), NONE, result).astype(np.uint8)


def labels_of(holes: float, none: bool, settings: Propagate = Propagate(appearance=False)) -> np.ndarray:
    """(N,) channels of the plane's points; without `none`, unlabelled pixels say nothing."""
    points = plane()
    cloud = Cloud(points, np.tile(np.float32([0, 0, 1]), (len(points), 1)))
    masks = {view.name: mask(view, holes, row) for row, view in enumerate(VIEWS)}
    if not none:
        masks = {name: np.where(values == NONE, 0, values).astype(np.uint8) for name, values in masks.items()}
    surface = Surface.from_cloud(points, cloud.normals, np.zeros(3))
    settings_of = Label(voxel_size=0.2)
    fusion = fuse(
        cloud, VIEWS, lambda view: (masks[view.name], None), surface, NONE + none, settings_of, none
    )
    known = LabelledPoints(points, fusion.labels, fusion.votes, None, none=none)
    return propagate(known, cloud.normals, settings).label


def inner(points: np.ndarray, low: float, high: float) -> np.ndarray:
    return (points[:, 0] > low + 0.4) & (points[:, 0] < high - 0.4)


@pytest.mark.parametrize("holes", [0.0, 0.15, 0.3])
@pytest.mark.parametrize("method", ["map", "geometry", "knn"])
def test_holes_are_voted_away_and_the_rest_stays_unlabelled(holes, method):
    found, points = labels_of(holes, True, Propagate(method=method, appearance=False)), plane()
    assert (found[inner(points, -4, -1)] == 1).mean() > 0.97
    assert (found[inner(points, -1, 1.5)] == 2).mean() > 0.97
    assert (found[inner(points, 1.5, 4)] == NONE).mean() > 0.99


def test_without_evidence_the_rest_gets_a_class_as_before():
    found, points = labels_of(0.15, False), plane()
    assert (found[inner(points, 1.5, 4)] == 2).all()


def test_votes_for_classes_are_those_without_evidence():
    points = plane()
    cloud = Cloud(points, np.tile(np.float32([0, 0, 1]), (len(points), 1)))
    surface = Surface.from_cloud(points, cloud.normals, np.zeros(3))
    both = []
    for none in (False, True):

        def read(view, none=none):
            values = mask(view, 0.2, 1)
            return (values if none else np.where(values == NONE, 0, values).astype(np.uint8)), None

        both.append(fuse(cloud, VIEWS, read, surface, NONE + none, Label(voxel_size=0.2), none))
    # a class vote in a hole's neighborhood weighs what it weighed: classes are decided as before
    np.testing.assert_array_equal(both[0].votes, both[1].votes[:, :NONE])
    kept = both[1].labels.state == SEED
    named = kept & (both[1].labels.label != NONE)
    np.testing.assert_array_equal(both[0].labels.label[named], both[1].labels.label[named])


def test_rates_are_those_of_the_votes():
    rng = np.random.default_rng(0)
    count, views = 20_000, 6
    truth = rng.integers(0, 3, count)  # 0 = none of the classes
    silent = rng.random((count, views)) < np.array([0.95, 0.3, 0.05])[truth][:, None]
    votes = np.zeros((count, 4), np.float32)
    votes[:, 3] = silent.sum(axis=1)
    named = np.where(truth == 0, rng.integers(1, 3, count), truth)
    votes[np.arange(count), named] = views - votes[:, 3]
    rates = NoneRates.from_counts(count_votes(votes[truth > 0]))
    assert rates.missed[1:] == pytest.approx([0.3, 0.05], abs=0.01)
    whole = sum(count_votes(part) for part in np.array_split(votes, 7))
    np.testing.assert_array_equal(whole, count_votes(votes))
    odds = NoneRates.from_counts(whole).log_odds(votes)
    assert ((odds > 0) == (truth == 0)).mean() > 0.97
    assert (odds[none_share(votes) <= 0.5] <= 0).all()
    assert (NoneRates.from_counts(whole).log_odds(np.zeros((3, 4), np.float32)) == 0).all()


def test_channels_of_none():
    channels = replace(Channels.of_classes([1, 7]), none=True)
    assert channels.names == ["0", "1", "7", "none"]
    ids = np.array([0, 1, 7, 0], np.uint8)
    found = channels.with_none(channels.from_ids(ids), np.array([True, True, True, False]))
    np.testing.assert_array_equal(found, [3, 1, 2, 0])
    np.testing.assert_array_equal(channels.to_ids(found), ids)
    assert vote_channels(["votes_0", "votes_1", "votes_7", "votes_none"]) is not None
    assert (
        not vote_channels(["votes_0", "votes_1"]).none
        and vote_channels(["votes_0", "votes_1", "votes_none"]).none
    )
    with pytest.raises(InputError, match="votes_5"):
        channels.from_ids(np.array([5], np.uint8))


@pytest.mark.parametrize("method", ["direct", "majority", "paper"])
def test_baselines_ignore_what_is_unlabelled(method):
    assert Label(method=method).resolved.unlabelled == "ignore"


def scene_without_grass(folder: Path, confidence: int | None, entries: list[dict] = CLASSES) -> Scene:
    """The scene of the builders, whose masks say road or nothing; confidence: of what has no class."""
    scene = Scene(write_bare_scene(folder))
    scene.classes.write_text(json.dumps(entries))
    for view in views():
        road = truth_mask(view) == 1
        name = f"{Path(view.name).stem}.png"
        Image.fromarray(np.where(road, np.uint8(1), np.uint8(0))).save(scene.masks / name)
        if confidence is not None:
            scene.confidence.mkdir(exist_ok=True)
            Image.fromarray(np.where(road, np.uint8(200), np.uint8(confidence))).save(scene.confidence / name)
    return scene


def final_labels(scene: Scene, **options) -> dict[str, np.ndarray]:
    label_scene(scene, Label(**options))
    propagate_scene(scene, Propagate())
    return {name: values.numpy() for name, values in read_cloud(scene.labelled).point.items()}


@pytest.mark.parametrize("confidence", [None, 200])
def test_what_is_looked_at_and_not_found_stays_unlabelled(tmp_path, confidence):
    found = final_labels(scene_without_grass(tmp_path / "scene", confidence))
    label, right = found["label"].ravel(), found["positions"][:, 0] - ORIGIN[0]
    assert (label[right < -0.4] == 1).all() and (label[right > 0.4] == 0).all()
    assert (found["confidence"].ravel()[right > 0.4] > 0.5).all()  # it is known to be none of the classes


def test_what_is_not_looked_at_says_nothing(tmp_path):
    scene = scene_without_grass(tmp_path / "scene", 0)
    assert (final_labels(scene)["label"] == 1).all()
    assert not read_cloud(scene.seeds).point["votes_none"].numpy().any()
    label_scene(scene, Label(unlabelled="ignore", output=tmp_path / "old.ply"))
    assert "votes_none" not in read_cloud(tmp_path / "old.ply").point


def test_a_class_may_be_the_rest(tmp_path):
    scene = scene_without_grass(tmp_path / "scene", None, [CLASSES[0], CLASSES[1] | {"rest": True}])
    found = final_labels(scene)
    inside = np.abs(found["positions"] - ORIGIN).max(axis=1) < 3.6  # of what the masks show
    label, right = found["label"].ravel()[inside], found["positions"][inside, 0] - ORIGIN[0]
    assert (label[right < -0.4] == 1).all() and (label[right > 0.4] == 3).all()


@pytest.mark.parametrize(
    "entries", [[{"rest": 1}, {}], [{"rest": True}, {"rest": True}], [{"rest": True, "surface": False}, {}]]
)
def test_a_rest_that_cannot_be_is_refused(entries):
    with pytest.raises(InputError, match="rest"):
        parse_classes([entry | more for entry, more in zip(CLASSES, entries, strict=True)], "classes.json")


def test_by_tiles_it_is_the_same(tmp_path, monkeypatch):
    scene = scene_without_grass(tmp_path / "scene", 200)
    label_scene(scene, Label(output=tmp_path / "whole.ply"))  # which has normals
    cloud = read_cloud(tmp_path / "whole.ply")  # off the regular grid, where neighbors are as near as others
    cloud.point["positions"] += np.random.default_rng(1).normal(0, 0.01, cloud.point["positions"].shape)
    write_geometry(tmp_path / "whole.ply", cloud)
    for module in (tiled_label, tiled_propagate):
        monkeypatch.setattr(module, "max_points", lambda *_: 4000)
    label_by_tiles(scene, Label(cloud=tmp_path / "whole.ply", output=tmp_path / "tiled.ply"))
    label_scene(scene, Label(cloud=tmp_path / "whole.ply", output=tmp_path / "again.ply"))
    first, second = (read_cloud(tmp_path / name).point for name in ("again.ply", "tiled.ply"))
    assert set(first) == set(second) and "votes_none" in first
    for name in first:
        np.testing.assert_array_equal(first[name].numpy(), second[name].numpy(), err_msg=name)
    results = []
    for run, name in ((propagate_scene, "a.ply"), (propagate_by_tiles, "b.ply")):
        settings = Propagate(seeds=tmp_path / "tiled.ply", output=tmp_path / name)
        figures = run(scene, settings).figures()
        results.append((read_cloud(tmp_path / name).point, figures["labelled"]))
    (whole, share), (tiled, other) = results
    assert share == other and share != "100.0%"
    np.testing.assert_array_equal(whole["label"].numpy(), tiled["label"].numpy())
    np.testing.assert_array_equal(whole["state"].numpy(), tiled["state"].numpy())
    np.testing.assert_allclose(whole["confidence"].numpy(), tiled["confidence"].numpy(), atol=1e-3)
