"""Another program's classes as votes: to the bit the same in tiles as in one piece."""

import json
import shutil
from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest

from sc3d.errors import InputError
from sc3d.io.clouds import read_cloud, write_geometry
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Label
from sc3d.stages import label as stage
from sc3d.tiling import label as tiled
from sc3d.tiling import prior_votes
from tests.builders import CLASSES, ORIGIN, ground, write_bare_scene
from tests.labelling.test_prior_cloud import CODES, GRASS, ROAD, halves, laz
from tests.tiling.test_tiling import blocks

PARTS = "2G"  # --max-memory that stands for small tiles


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """Off the regular grid, where neighbors are as near as others; in tiles of at most 4000 points."""
    write_bare_scene(tmp_path / "scene")
    table = [entry | {"asprs": CODES[entry["id"]]} for entry in CLASSES]
    (tmp_path / "scene" / "classes.json").write_text(json.dumps(table))
    scene, rng = Scene(tmp_path / "scene"), np.random.default_rng(1)
    cloud = read_cloud(scene.cloud)
    points = cloud.point["positions"].numpy() + rng.normal(0, 0.01, (len(cloud.point["positions"]), 3))
    cloud.point["positions"] = o3d.core.Tensor(points)
    cloud.point["normals"] = o3d.core.Tensor(np.tile(np.float32([0, 0, 1]), (len(points), 1)))
    write_geometry(scene.cloud, cloud)
    monkeypatch.setattr(tiled, "max_points", lambda *_: 4000)
    monkeypatch.setattr(tiled, "fits", lambda _, resources: not resources.max_memory)
    monkeypatch.setattr(prior_votes, "AT_ONCE", 700)
    return scene


def columns(scene: Scene, settings: Label) -> dict[str, np.ndarray]:
    stage.run(scene, settings)
    assert not list(scene.path.glob(".*"))
    return {name: values.numpy() for name, values in read_cloud(scene.seeds).point.items()}


def assert_same(scene: Scene, settings: Label, **tiles) -> dict[str, np.ndarray]:
    """Labels, votes and the voxel field in one piece and by tiles."""
    whole, field = columns(scene, settings), blocks(scene.votes_of(None))
    parts = columns(scene, replace(settings, max_memory=PARTS, **tiles))
    assert whole.keys() == parts.keys()
    for name, values in whole.items():
        np.testing.assert_array_equal(values, parts[name], err_msg=name)
    for first, second in zip(field, blocks(scene.votes_of(None)), strict=True):
        np.testing.assert_array_equal(first, second)
    return parts


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("masks", [True, False])
def test_labels_and_votes_by_tile_are_those_of_the_whole_to_the_bit(scene, tmp_path, masks, workers):
    points = ground(0.13) + [0.03, 0.01, 0.02]
    codes = np.where(points[:, 1] > ORIGIN[1] + 3, 64, np.vectorize(CODES.get)(halves(points)))
    prior = laz(tmp_path / "other.laz", points, codes)
    if not masks:
        shutil.rmtree(scene.masks)
    settings = Label(prior=prior, voxel_size=0.12, depth_filter=False)
    found = assert_same(scene, settings, workers=workers)
    local = found["positions"] - ORIGIN
    inner = (local[:, 1] < 2.7) & (np.abs(local[:, 0]) > 0.3) & (np.abs(local[:, :2]).max(axis=1) < 3.5)
    assert (found["label"].ravel()[inner] == np.where(local[inner, 0] < 0, ROAD, GRASS)).mean() > 0.99
    assert (found["votes_0"].ravel() > 0).any()
    if not masks:
        assert (found["label"].ravel()[local[:, 1] > 3.4] == 0).all()


def test_of_points_at_one_place_the_same_one_is_heard(scene, tmp_path):
    """Each place twice, of both classes, in a random order; where only one half of the ground is classified."""
    places = ground(0.13)
    places = places[places[:, 0] < ORIGIN[0]]
    points, ids = np.concatenate([places, places]), np.repeat([ROAD, GRASS], len(places)).astype(np.uint8)
    order = np.random.default_rng(3).permutation(len(points))
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points[order]))
    cloud.point["label"] = o3d.core.Tensor(ids[order][:, None])
    write_geometry(tmp_path / "other.ply", cloud)
    shutil.rmtree(scene.masks)
    settings = Label(prior=tmp_path / "other.ply", voxel_size=0.1, method="majority", depth_filter=False)
    label = assert_same(scene, settings)["label"]
    assert set(np.unique(label)) == {0, ROAD, GRASS}


@pytest.mark.parametrize(
    ("shift", "code", "table", "message"),
    [
        (50.0, 11, {}, "no classified point of .*other.laz lies within"),
        (0.0, 1, {}, "other.laz has no point of a class of the scene"),
        (0.0, 11, {"asprs": 11}, "ASPRS code 11, which 'road' and 'grass' of classes.json share"),
    ],
)
def test_what_says_nothing_is_refused_by_tiles_too(scene, tmp_path, shift, code, table, message):
    points = ground(0.13) + [shift, 0, 0]
    prior = laz(tmp_path / "other.laz", points, np.full(len(points), code))
    if table:
        scene.classes.write_text(json.dumps([entry | table for entry in CLASSES]))
    with pytest.raises(InputError, match=message):
        stage.run(scene, Label(prior=prior, max_memory=PARTS))
    assert not scene.seeds.exists()


def test_a_classified_cloud_that_does_not_fit_into_memory_keeps_its_classes(scene, tmp_path, monkeypatch):
    prior = laz(tmp_path / "other.laz", ground(0.13), np.vectorize(CODES.get)(halves(ground(0.13))))
    shutil.rmtree(scene.masks)
    settings = Label(prior=prior, max_memory=PARTS, voxel_size=0.12)
    whole = columns(scene, settings)
    monkeypatch.setattr("sc3d.importers.given_cloud.fits", lambda *_: False)
    monkeypatch.setattr("sc3d.io.chunked_clouds.RECORDS_AT_ONCE", 700)
    for name, values in columns(scene, settings).items():
        np.testing.assert_array_equal(values, whole[name], err_msg=name)
    assert (whole["label"] > 0).mean() > 0.9
