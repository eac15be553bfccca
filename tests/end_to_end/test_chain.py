"""The whole chain on synthetic photos: cameras from SfM, Gaussians, labels, report. The first test is small;
the slow one is the acceptance size.
"""

import json
import re
import shutil

import numpy as np
import pytest
from PIL import Image

from sc3d.cli import main
from sc3d.georeferencing.alignment import fit_similarity
from sc3d.scene.scene import read_sparse_model


def run(*arguments) -> None:
    main([str(argument) for argument in arguments])


def center_error(found, truth) -> tuple[int, float, float]:
    """Photos in both models, largest distance of the centers after similarity alignment over the extent of
    the true ones, and the scale found.
    """
    true_centers = {view.name: view.center for view in truth.views}
    names = [view.name for view in found.views if view.name in true_centers]
    source = np.array([view.center for view in found.views if view.name in true_centers])
    target = np.array([true_centers[name] for name in names])
    fit = fit_similarity(source, target)
    error = np.linalg.norm(target - fit.apply(source), axis=1).max()
    return len(names), float(error / np.linalg.norm(np.ptp(target, axis=0))), fit.scale


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    path = tmp_path_factory.mktemp("synthetic") / "site"
    run(
        "synthesize",
        path,
        "--views",
        12,
        "--width",
        400,
        "--extent",
        70,
        "--altitude",
        45,
        "--num-points",
        50000,
    )
    return path


def chain(site) -> list:
    """The arguments of `sc3d run` for the scene beside the site."""
    return [
        *without_masks(site, site.parent / "scene"),
        *("--masks", site / "masks"),
        *("--confidence", site / "confidence"),
        *("--classes", site / "classes.json"),
        *("--truth", site / "truth"),
        *("--log", site.parent / "file.log"),
    ]


def without_masks(site, scene) -> list:
    """Those for a scene of photos alone."""
    return [
        "run",
        site / "images",
        scene,
        *("--depth.max-size", 200),
        *("--train.iterations", 150),
        *("--train.max-size", 240),
        *("--train.max-gaussians", 20000),
        *("--extract.max-size", 240),
    ]


@pytest.fixture(scope="module")
def scene(site):
    run(*chain(site))
    return site.parent / "scene"


def test_the_log_has_plan_stages_and_results_and_no_control_characters(scene):
    log = (scene.parent / "file.log").read_text(encoding="utf-8")
    assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", log)
    places = [
        log.index(told) for told in ("plan: 10 of 10 stages", "wrote", "look at", "labelled cloud", "--web")
    ]
    assert places == sorted(places)


def test_cameras_are_metric_and_right(site, scene):
    count, error, scale = center_error(
        read_sparse_model(scene / "sparse" / "0"), read_sparse_model(site / "sparse" / "0")
    )
    assert count == 12
    assert error < 0.005  # small photos of a small site; the slow test has the acceptance figure
    assert scale == pytest.approx(1, abs=0.01)  # GPS in the photos


def test_labels_beat_the_masks_that_went_in(scene):
    metrics = json.loads((scene / "metrics.json").read_text())
    assert metrics["labels"]["miou"] > metrics["masks"]["miou"] + 0.03
    assert metrics["labels"]["coverage"] > 0.9


def test_report_is_one_page_with_pictures_and_nothing_from_outside(scene):
    page = (scene / "report.html").read_text()
    assert page.count("data:image/") > 8
    assert not re.findall(r'(?:src|href)="https?://', page)
    assert "building" in page and "mIoU" in page


def test_second_run_does_nothing_and_a_changed_option_reruns_what_follows(site, scene, caplog):
    before = {
        name: (scene / name).stat().st_mtime_ns
        for name in ("gaussians.ply", "cloud.ply", "seeds.ply", "labelled.ply", "metrics.json", "report.html")
    }
    run(*chain(site))
    assert before == {name: (scene / name).stat().st_mtime_ns for name in before}
    run(*chain(site), "--propagate.method", "knn")
    after = {name: (scene / name).stat().st_mtime_ns for name in before}
    assert [name for name in before if after[name] != before[name]] == [
        "labelled.ply",
        "metrics.json",
        "report.html",
    ]


@pytest.mark.slow
def test_photos_alone_give_ground_trees_and_buildings(site, scene, tmp_path, caplog):
    alone, truth = tmp_path / "scene", tmp_path / "truth"
    shutil.copytree(scene, alone, symlinks=True)
    for path in [*alone.glob("masks*"), *alone.glob("confidence*"), alone / "classes.json"]:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    ids = np.arange(256, dtype=np.uint8)
    ids[1:5] = 4, 3, 1, 1  # building, tree, road, grass of the site in the classes that are made up
    truth.mkdir()
    for file in (site / "truth").iterdir():
        Image.fromarray(ids[np.array(Image.open(file))]).save(truth / file.name)
    arguments = [*without_masks(site, alone), "--truth", truth]
    run(*arguments)
    assert "made from the shape of the scene" in caplog.text
    metrics = json.loads((alone / "metrics.json").read_text())
    assert metrics["classes"] == ["ground", "low vegetation", "high vegetation", "building"]
    confusion = np.array(metrics["labels"]["confusion"])  # truth by row, found by column, the first none
    right = confusion[0, 1] + confusion[0, 2] + confusion[2, 3] + confusion[3, 4]
    assert right > 0.85 * confusion.sum()
    before = (alone / "labelled.ply").stat().st_mtime_ns, (alone / "depth.json").stat().st_mtime_ns
    run(*arguments)
    assert before == ((alone / "labelled.ply").stat().st_mtime_ns, (alone / "depth.json").stat().st_mtime_ns)


@pytest.mark.slow
def test_forty_views_register_within_two_thousandths(tmp_path):
    run("synthesize", tmp_path / "site", "--views", 40)
    run("reconstruct", tmp_path / "site" / "images", tmp_path / "scene")
    count, error, scale = center_error(
        read_sparse_model(tmp_path / "scene" / "sparse" / "0"),
        read_sparse_model(tmp_path / "site" / "sparse" / "0"),
    )
    assert count == 40 and error < 0.002 and scale == pytest.approx(1, abs=0.005)
