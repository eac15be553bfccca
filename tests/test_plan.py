"""What `sc3d run` tells before it starts and at its end."""

import importlib.util
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import pytest
import torch

from sc3d.commands import plan as plans
from sc3d.commands.plan import EXPECTED, megapixels, pending, plan, results, warn_of_slow
from sc3d.commands.run import list_stages
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Segment
from sc3d.settings.outputs import Run
from sc3d.settings.reconstruction import Extract
from sc3d.settings.train import Train
from sc3d.sfm import num_pairs
from tests.builders import write_bare_scene

CHAIN = {  # what each reads and writes
    "map_photos": (["photos"], ["mapped"]),
    "depth": (["photos", "mapped"], ["depth"]),
    "segment": (["masks made elsewhere"], ["masks"]),
    "label": (["masks", "depth"], ["seeds"]),
    "propagate": (["seeds"], ["labelled"]),
}


@pytest.fixture
def chain(monkeypatch):
    """Runs what is asked of a chain whose stages `stale` are out of date."""

    def ask(stale, overwrite=False):
        monkeypatch.setattr(
            plans, "files", lambda name, *_: tuple([Path(path) for path in paths] for paths in CHAIN[name])
        )
        monkeypatch.setattr(plans, "up_to_date", lambda name, *_: name not in stale)
        runs = pending(Scene(Path("scene")), [(name, None) for name in CHAIN], overwrite)
        return {name for name, run in zip(CHAIN, runs, strict=True) if run}

    return ask


def test_what_runs_is_what_is_out_of_date_and_all_that_reads_it(chain):
    assert chain([]) == set()
    assert chain(["propagate"]) == {"propagate"}
    assert chain(["segment"]) == {"segment", "label", "propagate"}
    assert chain(["map_photos"]) == {"map_photos", "depth", "label", "propagate"}
    assert chain([], overwrite=True) == set(CHAIN)


@pytest.fixture
def stages(tmp_path):
    scene = Scene(write_bare_scene(tmp_path / "scene"))
    command = Run(tmp_path, scene.path, truth=scene.masks)
    return list_stages(command, scene, Segment(refine=True))


def test_every_stage_has_an_expected_time_that_grows_with_the_photos(stages):
    assert {name for name, _ in stages} == set(EXPECTED)
    for name, settings in stages:
        few, many = (EXPECTED[name](settings, [(800, 600)] * count) for count in (10, 40))
        assert few is not None and many is not None and 0 < few <= many
        assert few < many or name in ("train", "report")


def test_a_surface_from_depth_maps_is_not_trained_for(tmp_path):
    scene = Scene(write_bare_scene(tmp_path / "scene"))
    trained, from_depth = (
        [name for name, _ in list_stages(Run(tmp_path, scene.path, extract=extract), scene, Segment())]
        for extract in (Extract(), Extract(method="depth"))
    )
    assert "train" in trained and from_depth == [name for name in trained if name != "train"]


def test_pairs_are_counted_and_pixels_as_the_stages_make_them_smaller():
    assert num_pairs(24, "exhaustive") == len(list(combinations(range(24), 2)))
    assert num_pairs(100, "sequential") == 1000 and num_pairs(3, "sequential") == 6
    assert megapixels([(4000, 3000)] * 2) == 24
    assert megapixels([(4000, 3000), (600, 800)], 800) == pytest.approx((800 * 600 + 600 * 800) / 1e6)


def test_training_takes_as_long_as_its_steps_and_is_not_known_on_a_gpu(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    sizes = [(1600, 900)] * 18
    one, two = (EXPECTED["train"](Train(iterations=count), sizes) for count in (1000, 2000))
    assert one is not None and two == pytest.approx(2 * one)
    assert one == pytest.approx(0.49 * 1000 * 0.36)
    assert EXPECTED["train"](Train(device="cuda"), sizes) is None
    for pretended in (False, True):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=pretended: there)
        auto = EXPECTED["train"](Train(), sizes)
        assert auto is None if pretended else auto == pytest.approx(one)
        assert EXPECTED["train"](Train(device="cpu"), sizes) == pytest.approx(one)
    halved = EXPECTED["train"](Train(iterations=1000, downscale=4.0, device="cpu"), sizes)
    assert halved == pytest.approx(one / 4)


def test_the_plan_names_what_runs_and_adds_up_only_that(stages):
    runs = [name in ("map_photos", "depth") for name, _ in stages]
    told = plan(stages, runs, [(1600, 900)] * 18)
    assert told.startswith(f"plan: 2 of {len(stages)} stages to run, on 18 photos of 1600x900:")
    assert told.count("up to date") == len(stages) - 2
    # 18 x 1.44 MP at 1.35 s, 153 pairs at 0.14 s, 18 at 0.5 s; 18 x 0.36 MP at 9 s: 65.4 s and 58.3 s
    lines = [line.split(None, 1) for line in told.splitlines()[1:]]
    assert ["map_photos", "about 70 s"] in lines and ["depth", "about 60 s"] in lines
    assert "in all       about 2 min; rough" in told


@pytest.mark.parametrize("kernels", [[], ["label.voting-1.py311.nbi"]])
def test_the_first_run_is_told_to_compile(stages, tmp_path, monkeypatch, kernels):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    for name in kernels:
        (tmp_path / "cache").mkdir()
        (tmp_path / "cache" / name).touch()
    told = plan(stages, [True] * len(stages), [(1600, 900)] * 18)
    assert ("also compiles" in told) is not bool(kernels)
    assert "also compiles" not in plan(stages, [False] * len(stages), [(1600, 900)] * 18)


def test_what_was_never_measured_has_no_time(stages):
    stages = [
        (name, replace(settings, backend="strokes") if name == "segment" else settings)
        for name, settings in stages
    ]
    told = plan(stages, [name == "segment" for name, _ in stages], [(1600, 900)] * 18)
    assert told.count("not known how long") == 2 and "and what is not known" in told


def test_results_are_those_that_are_there(tmp_path):
    scene = Scene(write_bare_scene(tmp_path / "scene"))
    scene.report.write_text("page")
    told = results(scene)
    assert str(scene.report) in told and str(scene.masks) in told and str(scene.labelled) not in told


def test_what_takes_hours_is_told_with_what_makes_it_faster(stages, caplog):
    warn_of_slow(stages, [True] * len(stages), [(800, 600)] * 18)
    assert not caplog.records
    warn_of_slow(stages, [True] * len(stages), [(4000, 3000)] * 1000)
    assert (
        "map_photos about" in caplog.text
        and "--depth.num-sources" in caplog.text
        and "report" not in caplog.text
    )
    caplog.clear()
    warn_of_slow(stages, [False] * len(stages), [(4000, 3000)] * 1000)
    assert not caplog.records
