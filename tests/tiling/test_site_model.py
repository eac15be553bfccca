"""What one site teaches another, both in tiles, is what it teaches as a whole."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sc3d.io.clouds import read_cloud, write_geometry
from sc3d.scene.labelled_cloud import Votes, with_labels
from sc3d.scene.labels import PROPAGATED, UNSEEN
from sc3d.scene.scene import Scene
from sc3d.scene.site_model import read_model
from sc3d.settings.labels import Propagate
from sc3d.stages import propagate as stage
from sc3d.tiling import propagate as tiled
from sc3d.tiling.store import TileStore
from tests.propagation.test_appearance import evidence_of, village
from tests.propagation.test_saved_appearance import CHANNELS, site

FEW, MANY = "2G", "3G"  # --max-memory that stands for tiles of so many points
ROOM = {FEW: 18_500, MANY: 9_000}


@pytest.fixture(autouse=True)
def made(monkeypatch) -> list[int]:
    """Room for few points, whatever a point needs; how many tiles there were."""
    counts: list[int] = []
    build = TileStore.build

    def counted(*given):
        store = build(*given)
        counts.append(len(store.tiles))
        return store

    monkeypatch.setattr(tiled, "max_points", lambda resources, _: ROOM[resources.max_memory])
    monkeypatch.setattr(tiled, "fits", lambda _, resources: not resources.max_memory)
    monkeypatch.setattr(TileStore, "build", counted)
    return counts


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> Scene:
    scene, _ = site(tmp_path_factory.mktemp("first"), 0, votes=True)
    return scene


@pytest.fixture(scope="module")
def model(first) -> Path:
    stage.run(first, Propagate(save_model=first.path / "whole.npz"))
    return first.path / "whole.npz"


def columns(scene: Scene, **options) -> dict[str, np.ndarray]:
    stage.run(scene, Propagate(**options))
    assert not list(scene.path.glob(".*.parts"))
    return {name: values.numpy() for name, values in read_cloud(scene.labelled).point.items()}


def assert_alike(whole: dict[str, np.ndarray], tiles: dict[str, np.ndarray]) -> None:
    """As `map` by tiles is like that of the whole."""
    assert whole.keys() == tiles.keys()
    for name in whole:
        assert whole[name].dtype == tiles[name].dtype, name
    for name in ("label", "state"):
        assert (whole[name] != tiles[name]).mean() <= 1e-4, name
    assert (np.abs(whole["confidence"] - tiles["confidence"]) > 1e-3).mean() <= 1e-3
    for name in whole.keys() - {"label", "state", "confidence"}:
        np.testing.assert_array_equal(whole[name], tiles[name], err_msg=name)


def without_normals(scene: Scene) -> None:
    cloud = read_cloud(scene.cloud)
    del cloud.point["normals"]
    write_geometry(scene.cloud, cloud)


def test_a_model_saved_by_tiles_is_that_of_the_whole(first, model, made):
    table, wanted = first.class_table(), read_model(model, first.class_table(), "appearance")
    for memory, tiles in ((FEW, 4), (MANY, 9)):
        stage.run(first, Propagate(save_model=first.path / "tiles.npz", max_memory=memory))
        assert made[-1] == tiles
        found = read_model(first.path / "tiles.npz", table, "appearance")
        assert found.facts == wanted.facts and found.arrays.keys() == wanted.arrays.keys()
        for name, values in wanted.arrays.items():
            if name.endswith("counts"):  # of points that are as sure by tiles
                assert values.sum() > 30_000
                assert np.abs(values.astype(int) - found.arrays[name]).sum() <= 1e-4 * values.sum(), name
            else:
                np.testing.assert_array_equal(values, found.arrays[name], err_msg=name)


@pytest.mark.parametrize("place", [True, False])
@pytest.mark.parametrize("given", [True, False])
def test_a_cloud_without_a_mask_is_labelled_by_tiles_as_in_one_piece(tmp_path, made, given, place):
    """Also where its normals must be estimated, and where heights are in point spacings."""
    options: dict = {} if place else {"place": None}
    teacher, _ = site(tmp_path / "teacher", 0, votes=True, **options)
    stage.run(teacher, Propagate(save_model=tmp_path / "site.npz"))
    scene, truth = site(tmp_path / "scene", 1, votes=False, **options)
    if not given:
        without_normals(scene)
    whole, tiles = (columns(scene, model=tmp_path / "site.npz", max_memory=memory) for memory in ("", FEW))
    assert made[-1] == 4
    assert_alike(whole, tiles)
    assert (tiles["label"].ravel() == truth).mean() > 0.97 and (tiles["state"] == PROPAGATED).all()


def test_a_model_beside_votes_is_the_same_prior_by_tiles(model, tmp_path):
    """No photo names a roof: alone, the site cannot know of any, and no seed of one is anywhere to be reached."""
    scene, truth = site(tmp_path, 1, votes=True)
    points, normals, colors, _ = village(1)
    known = evidence_of(
        points, colors, np.where((truth == 2) | (points[:, 0] > 60), 0, truth).astype(np.uint8)
    )
    votes = np.where((known.seeds.label == 0)[:, None], 0, known.votes).astype(np.float32)
    write_geometry(
        scene.seeds, with_labels(read_cloud(scene.seeds), normals, known.seeds, Votes(votes, CHANNELS))
    )
    assert (known.seeds.state == UNSEEN).mean() > 0.3
    whole, tiles = (columns(scene, model=model, max_memory=memory) for memory in ("", FEW))
    assert_alike(whole, tiles)
    assert (tiles["label"].ravel() == truth).mean() > 0.97


def test_neither_workers_nor_the_size_of_tiles_change_a_byte(model, tmp_path):
    scene, _ = site(tmp_path, 1, votes=False)
    without_normals(scene)
    options = Propagate(model=model, save_model=tmp_path / "next.npz")
    found = []
    for memory, workers in ((FEW, 0), (FEW, 1), (FEW, 2), (MANY, 2)):
        stage.run(scene, replace(options, max_memory=memory, workers=workers))
        found.append((scene.labelled.read_bytes(), options.save_model.read_bytes()))
    assert found.count(found[0]) == 4
