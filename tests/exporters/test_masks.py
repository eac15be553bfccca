"""Labels back in the photos: exported masks, and doubted ones."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sc3d.cli import main
from sc3d.geometry.cameras import rays
from sc3d.io.clouds import read_cloud
from sc3d.runner import sidecar
from sc3d.segmentation import mask_refinement as refinement
from tests.builders import CLASSES, ORIGIN, ground, truth_mask, views, write_bare_scene


def run(*arguments) -> None:
    main([str(argument) for argument in arguments])


def stem(view) -> str:
    return f"{Path(view.name).stem}.png"


@pytest.fixture
def scene(tmp_path):
    """One photo of five has road and grass exchanged in its upper half."""
    path = write_bare_scene(tmp_path / "scene")
    wrong = truth_mask(views()[0])
    wrong[:60] = np.array([0, 3, 0, 1], np.uint8)[wrong[:60]]
    Image.fromarray(wrong).save(path / "masks" / stem(views()[0]))
    return path


def test_masks_back_are_right_where_the_given_ones_are_not(scene):
    run("label", scene)
    run("propagate", scene)
    run("export", scene, "--format", "masks")
    for view in views():
        mask, truth = np.array(Image.open(scene / "export" / "masks" / stem(view))), truth_mask(view)
        assert mask.shape == truth.shape == (120, 160)
        assert (mask == truth)[truth > 0].mean() > 0.985
        confidence = np.array(Image.open(scene / "export" / "confidence" / stem(view)))
        assert (confidence[mask > 0] > 0).all() and np.median(confidence[mask > 0]) > 200
    # masks in and back; there are no photos
    assert Image.open(scene / "export" / "masks.jpg").size[0] >= 1200


def test_none_of_the_classes_survives_the_way_through_masks(scene, tmp_path):
    for view in views():  # the same hole in the ground, in all views
        file = scene / "masks" / stem(view)
        directions, _ = rays(view)
        hits = view.center + directions * ((ORIGIN[2] - view.center[2]) / directions[:, 2])[:, None] - ORIGIN
        hole = (np.hypot(hits[:, 0] - 2, hits[:, 1]) < 1.2).reshape(view.height, view.width)
        Image.fromarray(np.where(hole, 0, truth_mask(view)).astype(np.uint8)).save(file)
    run("label", scene)
    run("propagate", scene)
    run("export", scene, "--format", "masks")
    middle = np.hypot(*(ground()[:, :2] - ORIGIN[:2] - [2, 0]).T) < 1
    given = [read_cloud(scene / "labelled.ply").point["label"].numpy().ravel()[middle]]
    for folder in ("masks", "confidence"):
        shutil.rmtree(scene / folder, ignore_errors=True)
        shutil.copytree(scene / "export" / folder, scene / folder)
    run("label", scene)
    run("propagate", scene)
    given.append(read_cloud(scene / "labelled.ply").point["label"].numpy().ravel()[middle])
    assert middle.sum() > 200 and all((label == 0).mean() > 0.95 for label in given)


def test_masks_back_can_be_small_and_go_in_again(scene):
    run("label", scene)
    run("propagate", scene)
    run("export", scene, "--format", "masks", "--max-size", "80")
    assert Image.open(scene / "export" / "masks" / stem(views()[0])).size == (80, 60)
    (scene / "images").mkdir()
    for view in views():
        Image.new("RGB", (160, 120)).save(scene / "images" / view.name)
    run(
        "segment",
        scene,
        "--masks",
        scene / "export" / "masks",
        "--confidence",
        scene / "export" / "confidence",
    )
    assert (
        Image.open(scene / "masks" / stem(views()[0])).size
        == Image.open(scene / "confidence" / stem(views()[0])).size
        == (80, 60)
    )


def test_doubt_is_the_product_of_confidence_and_contradiction():
    mask = np.uint8([[1, 1, 0, 1], [2, 2, 2, 2]])
    fused = np.uint8([[1, 2, 2, 0], [1, 1, 2, 1]])
    sure = np.float32([[0.9, 0.75, 1, 0], [0.5, 1.0, 1, 0.2]])
    confidence = np.uint8([[100, 200, 50, 7], [100, 100, 100, 10]])
    np.testing.assert_array_equal(
        refinement.downweight_conflicts(mask, confidence, fused, sure), [[100, 50, 50, 7], [50, 0, 100, 8]]
    )
    np.testing.assert_array_equal(
        refinement.downweight_conflicts(mask, None, fused, sure), [[255, 64, 255, 255], [128, 0, 255, 204]]
    )


def test_refined_confidence_is_low_where_a_mask_is_wrong_and_label_takes_it(scene, monkeypatch):
    figures = iter([0.8, 0.9])
    monkeypatch.setattr(refinement, "_agreement", lambda *_: next(figures))
    run("segment", scene, "--refine")
    for row, view in enumerate(views()):
        confidence, truth = np.array(Image.open(scene / "confidence_refined" / stem(view))), truth_mask(view)
        given = np.array(Image.open(scene / "masks" / stem(view)))
        wrong = (given != truth) & (truth > 0)
        assert wrong.any() == (row == 0)
        assert (confidence[~wrong] > 250).mean() > 0.98
        if row == 0:
            assert (confidence[wrong] < 100).mean() > 0.95
    run("label", scene)
    used = json.loads(sidecar(scene / "seeds.ply").read_text())["inputs"]
    assert any(path.endswith("confidence_refined") for path in used)


def test_refinement_that_does_not_help_on_photos_left_out_is_not_kept(scene, monkeypatch):
    (scene / "confidence_refined").mkdir()
    monkeypatch.setattr(refinement, "_agreement", lambda *_: 0.8)
    run("segment", scene, "--refine")
    assert not (scene / "confidence_refined").exists()


def test_agreement_is_measured_on_photos_left_out(scene):
    from sc3d.labelling.inputs import Masks
    from sc3d.scene.scene import Scene

    opened = Scene(scene)
    masks = Masks.load(opened, None)
    asked = []
    result = refinement.refine(
        refinement.load_refinement_inputs(opened, masks),
        masks.views,
        lambda view: asked.append(view.name) or masks.read(view),
    )
    assert 0.9 < result.before <= 1 and 0.9 < result.after <= 1
    first_fusion = asked[: asked.index("photo_2.jpg")]
    assert set(first_fusion) == {"photo_0.jpg", "photo_1.jpg", "photo_3.jpg", "photo_4.jpg"}


def test_refinement_knows_which_classes_stand(scene, monkeypatch):
    from sc3d.labelling.inputs import Masks
    from sc3d.scene.class_table import ON_GROUND, STANDING
    from sc3d.scene.scene import Scene

    codes = [entry | {"asprs": code} for entry, code in zip(CLASSES, (11, 5), strict=True)]
    (scene / "classes.json").write_text(json.dumps(codes))
    masks, known = Masks.load(Scene(scene), None), []
    monkeypatch.setattr(refinement, "propagate", lambda points, *_: known.append(points) or points.seeds)
    refinement.load_refinement_inputs(Scene(scene), masks).labels(masks.views, masks.read)
    assert [points.levels.tolist() for points in known] == [[ON_GROUND, STANDING]]


def test_refine_wants_masks_in_the_scene(scene, capsys):
    with pytest.raises(SystemExit) as stopped:
        run("segment", scene, "--refine", "--masks", scene / "truth")
    assert stopped.value.code == 2 and "--refine" in capsys.readouterr().err
