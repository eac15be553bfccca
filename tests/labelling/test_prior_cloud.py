"""Another program's classes as votes: by ASPRS code or by id, near the cloud or not at all."""

import json
import shutil

import laspy
import numpy as np
import open3d as o3d
import pytest

from sc3d.errors import InputError
from sc3d.io.clouds import read_cloud, write_geometry
from sc3d.scene.labels import SEED
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Label
from sc3d.stages import label as stage
from tests.builders import CLASSES, ORIGIN, ground, write_bare_scene

ROAD, GRASS = 1, 3
CODES = {ROAD: 11, GRASS: 3}


def laz(path, points, code):
    """A LAZ in the frame of the scene, which is UTM."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = ORIGIN, [0.001] * 3
    file = laspy.LasData(header)
    file.x, file.y, file.z = points.T
    file.classification = np.asarray(code, np.uint8)
    file.write(str(path))
    return path


@pytest.fixture
def scene(tmp_path):
    write_bare_scene(tmp_path / "scene")
    table = [entry | {"asprs": CODES[entry["id"]]} for entry in CLASSES]
    (tmp_path / "scene" / "classes.json").write_text(json.dumps(table))
    return Scene(tmp_path / "scene")


def found(scene):
    cloud = read_cloud(scene.seeds)
    points = cloud.point.positions.numpy() - ORIGIN
    return points, cloud.point["label"].numpy().ravel(), cloud


def halves(points):
    return np.where(points[:, 0] < ORIGIN[0], ROAD, GRASS)


def test_classes_of_a_laz_label_a_scene_without_masks(scene, tmp_path, caplog):
    points = ground(0.13)
    codes = np.where(points[:, 1] > ORIGIN[1] + 3, 64, np.vectorize(CODES.get)(halves(points)))
    prior = laz(tmp_path / "other.laz", points, codes)
    shutil.rmtree(scene.masks)
    stage.run(scene, Label(prior=prior))
    local, label, cloud = found(scene)
    inner = (local[:, 1] < 2.7) & (np.abs(local[:, 0]) > 0.3)
    assert (label[inner] == np.where(local[inner, 0] < 0, ROAD, GRASS)).all()
    assert (label[local[:, 1] > 3.4] == 0).all()
    assert set(cloud.point["state"].numpy().ravel()[inner]) == {SEED}
    assert "ASPRS code 64" in caplog.text


def test_weight_decides_against_masks(scene, tmp_path):
    points = ground(0.13)
    prior = laz(tmp_path / "other.laz", points, [CODES[label] for label in 4 - halves(points)])  # all wrong
    stage.run(scene, Label(prior=prior, method="majority", voxel_size=0.2))
    local, label, _ = found(scene)
    inner = (np.abs(local[:, 0]) > 0.3) & (np.abs(local[:, :2]).max(axis=1) < 3)
    right = np.where(local[:, 0] < 0, ROAD, GRASS)
    assert (label == right)[inner].mean() > 0.99  # five photos against one
    stage.run(scene, Label(prior=prior, prior_weight=15, method="majority", voxel_size=0.2))
    assert (found(scene)[1] != right)[inner].mean() > 0.99


def test_ids_in_a_column_label_count_before_codes(scene, tmp_path):
    points = ground(0.13)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    cloud.point["label"] = o3d.core.Tensor(halves(points).astype(np.uint8)[:, None])
    cloud.point["classification"] = o3d.core.Tensor(np.full((len(points), 1), 6, np.uint8))
    write_geometry(tmp_path / "other.ply", cloud)
    shutil.rmtree(scene.masks)
    stage.run(scene, Label(prior=tmp_path / "other.ply"))
    local, label, _ = found(scene)
    far = np.abs(local[:, 0]) > 0.3
    assert (label[far] == np.where(local[far, 0] < 0, ROAD, GRASS)).all()


@pytest.mark.parametrize(
    ("shift", "code", "table", "message"),
    [
        (50.0, 11, {}, "no classified point of .* lies within"),
        (0.0, 1, {}, "no point of a class of the scene"),
        (0.0, 11, {"asprs": 11}, "ASPRS code 11, which 'road' and 'grass' of classes.json share"),
    ],
)
def test_what_says_nothing_is_refused(scene, tmp_path, shift, code, table, message):
    points = ground(0.13) + [shift, 0, 0]
    prior = laz(tmp_path / "other.laz", points, np.full(len(points), code))
    if table:
        scene.classes.write_text(json.dumps([entry | table for entry in CLASSES]))
    with pytest.raises(InputError, match=message):
        stage.run(scene, Label(prior=prior))
    assert not scene.seeds.exists()


def test_the_labels_of_before_are_no_prior(scene):
    with pytest.raises(InputError, match="is what label writes"):
        stage.run(scene, Label(prior=scene.seeds))
