"""Truth masks that mark other and pixels not to judge: what their values stand for, and what `evaluate` makes of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from PIL import Image

from sc3d.errors import InputError
from sc3d.io.clouds import write_geometry
from sc3d.report.data import load_report_data
from sc3d.report.sections import headline, photo_section, quality_section
from sc3d.runner import execute
from sc3d.scene.class_table import OTHER, UNJUDGED, ClassTable, parse_classes
from sc3d.scene.mask_values import judged_labels, meanings_of_truth, read_labels
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Evaluate
from sc3d.tiling.evaluate import evaluate_scene as evaluate_by_tiles
from tests.builders import ORIGIN, ground, labelled_cloud, truth_mask, views, write_bare_scene


def table(*ids: int, colors: dict[int, list[int]] | None = None) -> ClassTable:
    colors = colors or {}
    return parse_classes(
        [{"id": n, "name": f"c{n}", "color": colors.get(n, [200, n, 7])} for n in ids], "classes"
    )


def read(file: Path, classes: ClassTable) -> list[int]:
    return read_labels(file, meanings_of_truth(classes)).ravel().tolist()


def test_values_of_truth(tmp_path):
    file = tmp_path / "a.png"
    Image.fromarray(np.uint8([[0, 1, 3, OTHER, UNJUDGED]])).save(file)
    labels = read_labels(file, meanings_of_truth(table(1, 3)))
    assert labels.tolist() == [[0, 1, 3, OTHER, UNJUDGED]]
    assert judged_labels(labels, table(1, 3), None).tolist() == [[0, 1, 3, OTHER, 0]]


def test_ids_of_classes_come_first():
    classes, labels = table(1, 254, 255), np.uint8([[0, 1, 254, 255]])
    assert not classes.leaves_other and not meanings_of_truth(classes).truth
    assert judged_labels(labels, classes, None).tolist() == labels.tolist()
    assert classes.name(254) == "c254" and table(1).name(254) == "other"


@pytest.mark.parametrize("margin", [0.0, 1.0, 3.0, 4.9, 10.0])
def test_zero_is_other_away_from_classes(margin):
    labels = np.zeros((21, 21), np.uint8)
    labels[10, 10], labels[0, 0], labels[0, 1] = 3, UNJUDGED, OTHER
    found = judged_labels(labels, table(3), margin)
    y, x = np.mgrid[:21, :21]
    expected = np.where(np.hypot(y - 10, x - 10) > margin, OTHER, 0)
    expected[10, 10], expected[0, 0], expected[0, 1] = 3, 0, OTHER
    np.testing.assert_array_equal(found, expected)


def test_zero_is_other_where_there_is_no_class():
    assert (judged_labels(np.zeros((3, 4), np.uint8), table(3), 10.0) == OTHER).all()


def test_black_and_white_pictures_still_hold_ids(tmp_path):
    file, samples = tmp_path / "a.png", np.uint8([[0, 1, 1, 0]])
    palette = Image.fromarray(samples, "P")
    palette.putpalette([0, 0, 0, 255, 255, 255])
    palette.save(file)
    assert read(file, table(1)) == [0, 1, 1, 0]
    Image.fromarray(samples > 0).save(file)  # 1 bit
    assert read(file, table(1)) == [0, 1, 1, 0]
    Image.fromarray(np.repeat(samples[..., None] * np.uint8(255), 3, axis=2)).save(file)
    assert read(file, table(1, colors={1: [255, 255, 255]})) == [0, 1, 1, 0]


def test_gray_palette_of_an_optimizer_with_other(tmp_path):
    file, palette = tmp_path / "a.png", Image.fromarray(np.uint8([[0, 1, 2, 3]]), "P")
    palette.putpalette([0, 0, 0, 9, 9, 9, 254, 254, 254, 255, 255, 255])
    palette.save(file)
    assert read(file, table(9)) == [0, 9, OTHER, UNJUDGED]
    with pytest.raises(InputError, match="stand for different classes"):
        read(file, table(1, 2, 3, 9))


@pytest.fixture()
def scene(tmp_path) -> Scene:
    """Road and grass; in the upper rows of the truth grass is other, in the uppermost not judged."""
    made = Scene(write_bare_scene(tmp_path / "scene"))
    points = ground() - ORIGIN
    label = np.where(points[:, 0] < 0, 1, 3).astype(np.uint8)
    write_geometry(made.labelled, labelled_cloud(points + ORIGIN, label))
    corners = np.array([[-4, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]]) + ORIGIN
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    write_geometry(made.mesh, o3d.t.geometry.TriangleMesh(o3d.core.Tensor(corners), o3d.core.Tensor(faces)))
    for view in views():
        truth = truth_mask(view)
        truth[:50][truth[:50] == 3] = OTHER
        truth[:20][truth[:20] == OTHER] = UNJUDGED
        Image.fromarray(truth).save(made.truth / f"{Path(view.name).stem}.png")
    return made


def counts(scene: Scene) -> tuple[int, int]:
    truths = [np.array(Image.open(file)) for file in scene.truth.iterdir()]
    return sum(int(np.isin(t, (1, 3)).sum()) for t in truths), sum(int((t == OTHER).sum()) for t in truths)


def test_evaluate_tells_of_other(scene):
    summary = execute("evaluate", scene, Evaluate())
    metrics = json.loads(scene.metrics.read_text())
    classes, other = counts(scene)
    for source in ("labels", "masks"):
        found = metrics[source]
        assert found["pixels"] == classes and found["other"]["pixels"] == other > 1000
        assert found["other"]["given_class"] > 0.999
        assert found["recall"]["grass"] > 0.97 and found["precision"]["road"] > 0.97
    right = metrics["masks"]["confusion"][2][3]
    assert metrics["masks"]["precision"]["grass"] == pytest.approx(right / (right + other))
    assert metrics["masks"]["iou"] == {"road": 1.0, "grass": 1.0}  # the closed set does not see it
    assert metrics["per_photo"]["photo_0.jpg"]["labels"]["other"]["pixels"] > 0
    assert f"of {other} px of other given a class" in summary["labels_with_other"]
    assert metrics["reliability_with_other"]["ece"] != metrics["reliability"]["ece"]


def test_masks_of_other_photos_than_the_judged_ones_are_not_judged(scene):
    for photo in ("photo_0", "photo_1"):
        (scene.truth / f"{photo}.png").rename(scene.path / f"{photo}.png")
    for file in scene.masks.iterdir():
        if (scene.truth / file.name).exists():
            file.unlink()
    summary = execute("evaluate", scene, Evaluate())
    assert "masks" not in json.loads(scene.metrics.read_text()) and "masks" not in summary
    assert "labels_with_other" in summary


def test_tiles_find_the_same(scene, tmp_path):
    whole, tiles = (
        Evaluate(truth_zero="other", margin=3, output=tmp_path / f"{name}.json")
        for name in ("whole", "tiles")
    )
    execute("evaluate", scene, whole)
    evaluate_by_tiles(scene, tiles)
    found, expected = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("tiles", "whole"))
    assert found["labels"]["other"] == expected["labels"]["other"]
    assert expected["labels"]["other"]["pixels"] > counts(scene)[1]  # what lies outside the ground, too


def test_truth_that_judges_nothing_is_refused(scene):
    for file in scene.truth.iterdir():
        Image.fromarray(np.where(np.array(Image.open(file)) > 0, 255, 0).astype(np.uint8)).save(file)
    with pytest.raises(InputError, match="no pixel of the 5 truth masks"):
        execute("evaluate", scene, Evaluate())
    execute("evaluate", scene, Evaluate(truth_zero="other"))


def test_masks_may_not_hold_other(scene):
    file = next(scene.masks.iterdir())
    Image.fromarray(np.full_like(np.array(Image.open(file)), OTHER)).save(file)
    with pytest.raises(InputError, match="class id 254, which is not in the class table"):
        execute("evaluate", scene, Evaluate())


def test_classes_in_the_way_of_other(scene):
    classes = json.loads(scene.classes.read_text())
    scene.classes.write_text(json.dumps([*classes, {"id": 255, "name": "high", "color": [1, 2, 3]}]))
    with pytest.raises(InputError, match="254.*classes.*253"):
        execute("evaluate", scene, Evaluate())
    for file in scene.truth.iterdir():
        Image.fromarray(np.where(np.array(Image.open(file)) == OTHER, 0, np.array(Image.open(file)))).save(
            file
        )
    execute("evaluate", scene, Evaluate())  # 255 is the class
    assert json.loads(scene.metrics.read_text())["labels"]["iou"]["high"] == 0
    with pytest.raises(InputError, match="smaller id"):
        execute("evaluate", scene, Evaluate(truth_zero="other"))


def test_transparent_pixels_are_never_other(scene):
    for view in views():
        pixels = np.full((view.height, view.width, 4), 255, np.uint8)
        pixels[:, :80, 3] = 0
        scene.images.mkdir(exist_ok=True)
        Image.fromarray(pixels).save(scene.images / view.name, format="PNG")
    file = next(scene.truth.iterdir())
    name = f"{file.stem}.jpg"
    found = scene.read_truth(file, name, zero_margin=0.0)
    assert not found[:, :80].any() and (found[:, 80:] == OTHER).any()


def test_report_shows_both(scene):
    execute("evaluate", scene, Evaluate())
    data = load_report_data(scene)
    page = headline(data) + quality_section(data)
    assert "All judged pixels" in page and "of the pixels of no class are given one" in page
    assert "of other given a class" in photo_section(data) and ">other</li>" in photo_section(data)
    assert "Precision, fused labels" in page and "Share of other, given masks" in page


def test_report_reads_truth_as_evaluate_did(scene):
    execute("evaluate", scene, Evaluate(truth_zero="other", margin=4))
    assert load_report_data(scene).zero_margin == 4
    execute("evaluate", scene, Evaluate(), overwrite=True)
    assert load_report_data(scene).zero_margin is None


def test_margin_is_not_negative():
    with pytest.raises(InputError, match="margin"):
        Evaluate(margin=-1)


def test_classes_without_surface_are_neither_judged_nor_other(scene):
    classes = json.loads(scene.classes.read_text())
    scene.classes.write_text(json.dumps([*classes, {"id": 7, "name": "sky", "color": [1, 2, 3]}]))
    classes_before, other = counts(scene)
    file = next(scene.truth.iterdir())
    truth = np.array(Image.open(file))
    truth[:10, :10] = 7
    Image.fromarray(truth).save(file)
    execute("evaluate", scene, Evaluate())
    metrics = json.loads(scene.metrics.read_text())
    assert metrics["without_surface"]["sky"]["pixels"] == 100
    assert (metrics["labels"]["pixels"], metrics["labels"]["other"]["pixels"]) == counts(scene)
    assert counts(scene)[0] <= classes_before and counts(scene)[1] == other
