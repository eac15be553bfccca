"""Photos of two places that do not hang together: none of the models is lost."""

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
    for seed, count in ((0, 14), (1, 11)):
        site = tmp_path / f"site{seed}"
        run("synthesize", site, "--seed", seed, "--views", count, "--width", 480, "--num-points", 20000)
        shutil.copytree(site / "images", photos / str(seed))
    scene = Scene(tmp_path / "scene")
    with caplog.at_level(logging.WARNING):
        run("reconstruct", photos, scene.path, "--matching", "exhaustive")
    found = json.loads(sidecar(scene.mapped).read_text())["figures"]
    assert found["registered"] == 14 and {view.name[:2] for view in scene.model.views} == {"0/"}
    assert found["other_models"] == {str(scene.mapped / "2"): 11}
    assert f"{scene.mapped / '2'} (11 photos)" in caplog.text

    other = Scene(tmp_path / "other")
    run("import", scene.mapped / "2", other.path, "--images", photos)
    run("georeference", other.path)
    assert {view.name[:2] for view in other.model.views} == {"1/"} and len(other.model.views) == 11
