"""Photos of two places that do not hang together, of which no model is lost; and the mapper of many photos."""

import json
import logging
import shutil

import pytest

from sc3d.cli import main
from sc3d.runner import sidecar
from sc3d.scene.scene import Scene


def run(*arguments) -> None:
    main([str(argument) for argument in arguments])


@pytest.mark.slow  # two flights are mapped
def test_a_second_model_is_kept_and_becomes_a_scene_of_its_own(tmp_path, caplog):
    photos = tmp_path / "photos"
    for kind, width in (
        ("street", 640),
        ("aerial", 480),
    ):  # two aerial sites would match: their ground is alike
        site = tmp_path / kind
        views = ["--views", 14] if kind == "aerial" else []
        run("synthesize", site, "--kind", kind, "--width", width, "--num-points", 20000, "--no-gps", *views)
        shutil.copytree(site / "images", photos / kind)
    scene = Scene(tmp_path / "scene")
    with caplog.at_level(logging.WARNING):
        run("reconstruct", photos, scene.path)
    found = json.loads(sidecar(scene.mapped).read_text())["summary"]
    ((model, count),) = found["other_models"].items()
    assert model == str(scene.mapped / "2") and f"{model} ({count} photos)" in caplog.text
    assert len(scene.model.views) == found["registered"] >= count >= 10
    first = {view.name.split("/")[0] for view in scene.model.views}

    other = Scene(tmp_path / "other")
    run("import", model, other.path, "--images", photos)
    second = {view.name.split("/")[0] for view in other.model.views}
    assert len(other.model.views) == count and {*first, *second} == {"street", "aerial"} and len(first) == 1


@pytest.mark.slow  # 24 photos are mapped
def test_all_cameras_at_once_are_where_the_photos_were_taken(tmp_path):
    site, scene = tmp_path / "site", Scene(tmp_path / "scene")
    run("synthesize", site, "--views", 24, "--width", 480, "--num-points", 20000)
    run("reconstruct", site / "images", scene.path, "--mapper", "global")
    found = json.loads(sidecar(scene.sparse).read_text())["summary"]
    assert found["registered"] == 24 and found["rms_to_gps_m"] < 0.1
