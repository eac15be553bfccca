"""Commands on a bare scene: no photos, no mesh, UTM positions."""

import json

import numpy as np
import open3d as o3d
import pytest
from PIL import Image

from sc3d.cli import main
from sc3d.runner import sidecar
from tests.builders import ORIGIN, ground, truth_mask, views, write_bare_scene


def run(*arguments) -> None:
    main([str(argument) for argument in arguments])


@pytest.fixture
def scene(tmp_path):
    return write_bare_scene(tmp_path / "scene")


def expected_labels(points: np.ndarray) -> np.ndarray:
    """0 where the masks' outlines are near; the masks say nothing of what is beyond 3.9 m."""
    sides = np.where(points[:, 0] < 512345.0 - 0.05, 1, np.where(points[:, 0] > 512345.0 + 0.15, 3, 0))
    return np.where(np.abs(points - ORIGIN).max(axis=1) < 3.75, sides, 0)


@pytest.mark.parametrize("method", ["knn", "geometry", "map"])
def test_bare_scene_keeps_order_count_and_millimeters(scene, method):
    run("label", scene)
    run("propagate", scene, "--method", method)
    cloud = o3d.t.io.read_point_cloud(str(scene / "labelled.ply"))
    positions = cloud.point.positions.numpy()
    assert positions.dtype == np.float64
    np.testing.assert_array_equal(positions, ground())
    label, expected = cloud.point["label"].numpy().ravel(), expected_labels(ground())
    judged = expected > 0
    assert (label[judged] == expected[judged]).mean() > 0.995
    assert cloud.point["confidence"].numpy().dtype == np.float32
    assert set(np.unique(cloud.point["state"].numpy())) <= {1, 3, 4}
    assert cloud.point["num_views"].numpy().max() == 5


def test_evaluate_perfect_labels_and_masks(scene):
    run("label", scene)
    run("propagate", scene)
    run("evaluate", scene)
    metrics = json.loads((scene / "metrics.json").read_text())
    assert metrics["masks"]["oa"] == metrics["masks"]["miou"] == 1.0
    assert metrics["labels"]["miou"] > 0.97 and metrics["labels"]["coverage"] > 0.999
    assert metrics["photos"] == [view.name for view in views()]


def test_label_works_with_larger_masks_than_photos_and_with_confidence(scene):
    (scene / "confidence").mkdir()
    for view in views():
        stem = view.name.removesuffix(".jpg")
        large = view.resized(480, 360)
        Image.fromarray(truth_mask(large)).save(scene / "masks" / f"{stem}.png")
        Image.fromarray(np.full((360, 480), 200, np.uint8)).save(scene / "confidence" / f"{stem}.png")
    run("label", scene)
    label = o3d.t.io.read_point_cloud(str(scene / "seeds.ply")).point["label"].numpy().ravel()
    expected = expected_labels(ground())
    assert (label[expected > 0] == expected[expected > 0]).mean() > 0.97


def test_finished_work_is_skipped_until_settings_or_inputs_change(scene):
    run("label", scene)
    record = json.loads(sidecar(scene / "seeds.ply").read_text())
    assert (
        record["stage"] == "label"
        and record["settings"]["consensus"] == 0.66
        and record["versions"]["sc3d"]
        and record["seconds"] >= 0
    )
    written = (scene / "seeds.ply").stat().st_mtime_ns
    run("label", scene)
    assert (scene / "seeds.ply").stat().st_mtime_ns == written
    run("label", scene, "--consensus", "0.9")
    changed = (scene / "seeds.ply").stat().st_mtime_ns
    assert changed != written
    Image.fromarray(np.zeros((120, 160), np.uint8) + np.uint8(1)).save(scene / "masks" / "photo_0.png")
    run("label", scene, "--consensus", "0.9")
    again = (scene / "seeds.ply").stat().st_mtime_ns
    assert again != changed
    run("label", scene, "--consensus", "0.9", "--overwrite")
    assert (scene / "seeds.ply").stat().st_mtime_ns != again


def test_output_and_cloud_options(scene, tmp_path):
    (scene / "cloud.ply").rename(tmp_path / "other.ply")
    run(
        "label",
        scene,
        "--cloud",
        tmp_path / "other.ply",
        "--output",
        tmp_path / "mine.ply",
        "--method",
        "majority",
    )
    run(
        "propagate",
        scene,
        "--seeds",
        tmp_path / "mine.ply",
        "--output",
        tmp_path / "full.ply",
        "--method",
        "knn",
    )
    run("evaluate", scene, "--labelled", tmp_path / "full.ply", "--output", tmp_path / "figures.json")
    assert json.loads((tmp_path / "figures.json").read_text())["labels"]["oa"] > 0.98
    assert not (scene / "seeds.ply").exists() and not (scene / "metrics.json").exists()


def test_a_second_run_writes_the_same_bytes(scene, tmp_path):
    run("label", scene, "--output", tmp_path / "one.ply")
    run("label", scene, "--output", tmp_path / "two.ply")
    assert (tmp_path / "one.ply").read_bytes() == (tmp_path / "two.ply").read_bytes()
