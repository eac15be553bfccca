"""What one site taught labels another: by color and relief in meters, as a prior beside votes, or it is
refused.
"""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from sc3d.errors import InputError
from sc3d.io.clouds import read_cloud, write_geometry
from sc3d.propagation.propagate import propagate_scene
from sc3d.runner import execute
from sc3d.scene.channels import Channels
from sc3d.scene.labelled_cloud import Votes, with_labels
from sc3d.scene.labels import CORRECTED, PROPAGATED
from sc3d.scene.scene import Scene
from sc3d.scene.site_model import ModelPart, read_model, write_model
from sc3d.settings.labels import Propagate
from sc3d.stages import propagate as stage
from sc3d.view.web.correction_panel import made_with
from tests.builders import views
from tests.builders import write_model as write_cameras
from tests.propagation.test_appearance import evidence_of, village

NAMES = {1: "lawn", 2: "roof", 3: "road"}
CLASSES = [{"id": label, "name": name, "color": [9, 9, 9]} for label, name in NAMES.items()]
CHANNELS = Channels.of_classes([1, 2, 3])
# world = CRS - offset, in meters
PLACE = {"epsg": 32615, "offset": [576000, 5188000, 0]}


def site(
    path: Path, seed: int, *, votes: bool, size: float = 1.0, place: dict | None = PLACE, every: int = 1
) -> tuple[Scene, np.ndarray]:
    """A village, as a scene with a cloud or seeds, and its truth. size: world units per meter; every: thins
    it.
    """
    points, normals, colors, truth = (part[::every] for part in village(seed))
    write_cameras(path / "sparse" / "0", views())
    (path / "classes.json").write_text(json.dumps(CLASSES))
    if place is not None:
        scaled = np.diag([1 / size, 1 / size, 1 / size, 1.0]).tolist()
        (path / "georeference.json").write_text(json.dumps(place | {"local_from_world": scaled}))
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points * size))
    cloud.point.normals, cloud.point.colors = o3d.core.Tensor(normals), o3d.core.Tensor(colors)
    scene = Scene(path)
    if votes:
        known = evidence_of(points, colors, truth)
        cloud = with_labels(cloud, normals, known.seeds, Votes(known.votes, CHANNELS))
    write_geometry(scene.seeds if votes else scene.cloud, cloud)
    return scene, truth


def labels_of(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    cloud = read_cloud(scene.labelled)
    return cloud.point["label"].numpy().ravel(), cloud.point["state"].numpy().ravel()


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("first")
    scene, _ = site(folder / "scene", 0, votes=True)
    stage.run(scene, Propagate(save_model=folder / "site.npz"))
    return folder / "site.npz"


def test_another_site_is_labelled_without_a_mask(model, tmp_path):
    """In feet, and with half of the points: heights are those of the model in meters."""
    scene, truth = site(tmp_path, 1, votes=False, size=1 / 0.3048, every=2)
    with pytest.raises(InputError, match="run `sc3d label SCENE`"):
        stage.run(scene, Propagate())
    figures = stage.run(scene, Propagate(model=model))
    label, state = labels_of(scene)
    assert figures["labelled"] == "100.0%" and (state == PROPAGATED).all()
    assert (label == truth).mean() > 0.97


def test_model_is_a_prior_where_there_are_votes(model, tmp_path):
    """No photo names a roof: alone, the site cannot know of any."""
    scene, truth = site(tmp_path, 1, votes=True)
    points, normals, colors, _ = village(1)
    known = evidence_of(points, colors, np.where(truth == 2, 0, truth).astype(np.uint8))
    votes = np.where(truth[:, None] == 2, 0, known.votes).astype(np.float32)
    write_geometry(
        scene.seeds, with_labels(read_cloud(scene.seeds), normals, known.seeds, Votes(votes, CHANNELS))
    )
    propagate_scene(scene, Propagate())
    alone = labels_of(scene)[0]
    propagate_scene(scene, Propagate(model=model))
    label = labels_of(scene)[0]
    assert not (alone == 2).any() and (label == truth)[truth == 2].mean() > 0.95
    assert (label == truth)[truth != 2].mean() > 0.99


def test_corrections_hold_against_a_model(model, tmp_path):
    scene, _ = site(tmp_path, 1, votes=False)
    entry = {
        "id": "a",
        "time": "2026-05-01T12:00:00Z",
        "class": "road",
        "balls": [{"radius": 9.0, "centers": [[9, 9, 0]]}],
    }
    scene.corrections.write_text(json.dumps({"version": 1, "log": [entry]}))
    propagate_scene(scene, Propagate(model=model))
    label, state = labels_of(scene)
    assert (state == CORRECTED).any() and (label[state == CORRECTED] == 3).all()


def test_saved_model_is_the_same_file_and_says_its_units(model, tmp_path):
    scene, _ = site(tmp_path / "scene", 0, votes=True)
    stage.run(scene, Propagate(save_model=tmp_path / "again.npz"))
    assert (tmp_path / "again.npz").read_bytes() == model.read_bytes()
    with zipfile.ZipFile(model) as archive:
        head = json.loads(archive.read("model.json"))
    assert head["classes"] == [{"id": label, "name": name} for label, name in NAMES.items()]
    assert head["parts"]["appearance"]["heights"] == "meters"
    assert all(
        np.load(model, allow_pickle=False)[f"appearance.{name}"].size
        for name in head["parts"]["appearance"]["arrays"]
    )


@pytest.mark.parametrize(
    ("classes", "message"),
    [
        (
            [*CLASSES[:2], CLASSES[2] | {"name": "street"}],
            "another class table: only the model has class 3 'road'",
        ),
        (CLASSES[:2], "only the model has class 3 'road'"),
        ([*CLASSES, {"id": 4, "name": "car", "color": [9, 9, 9]}], "only the scene has class 4 'car'"),
    ],
)
def test_other_classes_are_refused(model, tmp_path, classes, message):
    scene, _ = site(tmp_path, 1, votes=False)
    scene.classes.write_text(json.dumps(classes))
    with pytest.raises(InputError, match=message):
        stage.run(scene, Propagate(model=model))
    assert not scene.labelled.exists()


def test_scale_must_be_known_on_both_sites_or_on_none(model, tmp_path, caplog):
    plain, _ = site(tmp_path / "plain", 0, votes=True, place=None)
    with pytest.raises(InputError, match="heights in meters, but the scene has no scale"):
        stage.run(plain, Propagate(model=model))
    stage.run(plain, Propagate(save_model=tmp_path / "plain.npz"))
    placed, _ = site(tmp_path / "placed", 1, votes=False)
    with pytest.raises(InputError, match="heights in point spacings, as its scene was not georeferenced"):
        stage.run(placed, Propagate(model=tmp_path / "plain.npz"))
    other, truth = site(tmp_path / "other", 1, votes=False, place=None, size=3)
    stage.run(other, Propagate(model=tmp_path / "plain.npz"))
    assert "only if both clouds are equally dense" in caplog.text
    assert (labels_of(other)[0] == truth).mean() > 0.97


def test_what_does_not_fit_together_is_refused_at_once(model):
    for wrong in (Propagate, replace):
        with pytest.raises(InputError, match="need --method map"):
            wrong(*([] if wrong is Propagate else [Propagate(model=model)]), method="knn", save_model=model)


def test_damaged_models_are_refused(model, tmp_path):
    scene, _ = site(tmp_path / "scene", 1, votes=False)
    table = scene.class_table()
    good, broken = read_model(model, table, "appearance"), tmp_path / "broken.npz"
    broken.write_bytes(model.read_bytes()[:-100])
    with pytest.raises(InputError, match="no model"):
        propagate_scene(scene, Propagate(model=broken))
    damages = [
        ({}, {"relief_edges": good.arrays["relief_edges"][:, ::-1]}),
        ({}, {"relief_counts": good.arrays["relief_counts"][:-1]}),
        ({}, {"color_counts": -good.arrays["color_counts"]}),
        ({"heights": "feet"}, {}),
        ({"ground_cell": float("inf")}, {}),
    ]
    for facts, arrays in damages:
        write_model(broken, table, {"appearance": ModelPart(good.facts | facts, {**good.arrays, **arrays})})
        with pytest.raises(InputError, match="damaged"):
            propagate_scene(scene, Propagate(model=broken))
    write_model(broken, table, {"other": good})
    with pytest.raises(InputError, match="holds no appearance, but other"):
        propagate_scene(scene, Propagate(model=broken))


def test_too_little_to_learn_from_is_said_and_labels_are_kept(tmp_path):
    scene, truth = site(tmp_path / "scene", 0, votes=True)
    points, normals, colors, _ = village(0)
    known = evidence_of(points, colors, np.ones_like(truth))
    write_geometry(
        scene.seeds, with_labels(read_cloud(scene.seeds), normals, known.seeds, Votes(known.votes, CHANNELS))
    )
    with pytest.raises(InputError, match="is not written, as fewer than two classes"):
        stage.run(scene, Propagate(save_model=tmp_path / "site.npz"))
    assert scene.labelled.exists() and not (tmp_path / "site.npz").exists()


def test_apply_in_the_viewer_starts_from_the_same_model(model, tmp_path):
    scene, _ = site(tmp_path, 1, votes=False)
    (scene.path / "town.npz").write_bytes(model.read_bytes())
    execute("propagate", scene, Propagate(model=scene.path / "town.npz", save_model=scene.path / "again.npz"))
    assert made_with(scene) == Propagate(model=scene.path / "town.npz")


def test_a_model_replaces_a_model_only(model, tmp_path):
    stage.begin(Scene(tmp_path), Propagate(save_model=tmp_path / "new.npz"))
    stage.begin(Scene(tmp_path), Propagate(save_model=model))
    np.savez(tmp_path / "votes.npz", np.zeros(3))
    (tmp_path / "cloud.ply").write_text("ply\n")
    for path in (tmp_path, tmp_path / "votes.npz", tmp_path / "cloud.ply"):
        with pytest.raises(InputError, match="exists and is no model"):
            stage.begin(Scene(tmp_path), Propagate(save_model=path))
