"""Measuring in headless Chromium: by clicks and by keys alone, told in the scene's CRS, copied."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from sc3d.geometry.cameras import project
from sc3d.io.clouds import read_cloud
from sc3d.scene.scene import Scene
from tests.builders import ORIGIN, inspector_of, labelled_scene
from tests.view.web.test_corrections import GRASS, ROAD, choose, press
from tests.view.web.test_page import Visit, browser, home_of, in_canvas, visit  # noqa: F401

STEP = 0.5  # m, the grass lies above the road


@pytest.fixture(
    scope="module", params=[True, pytest.param(False, marks=pytest.mark.slow)], ids=["on Earth", "somewhere"]
)
def scene(request, tmp_path_factory) -> Scene:
    found = labelled_scene(tmp_path_factory.mktemp("measure") / "scene")
    cloud = read_cloud(found.labelled)
    points = cloud.point.positions.numpy()
    points[:, 2] += STEP * (points[:, 0] > ORIGIN[0])
    cloud.point.positions = o3d.core.Tensor(points)
    assert o3d.t.io.write_point_cloud(str(found.labelled), cloud)
    if request.param:
        place = {"epsg": 32632, "offset": [0, 0, 0]}
        (found.path / "georeference.json").write_text(json.dumps(place))
    return found


@pytest.fixture(scope="module")
def measured(scene, browser) -> Iterator[Visit]:  # noqa: F811
    pytest.importorskip("viser", reason="the viewer in the browser needs viser: pip install 'sc3d[web]'")
    from sc3d.view.web.page import WebView, serving

    view = WebView(scene, inspector_of(scene))
    with serving(view) as address, visit(browser, address, (1300, 1000)) as found:
        found.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
        found.page.get_by_text("Color by", exact=True).wait_for()
        found.page.locator(".mantine-Notification-closeButton").click()
        found.wait_for(
            lambda: (
                all((found.picture == color).all(axis=-1).mean() > 0.02 for color in (ROAD, GRASS))
                and found.is_still()
            ),
            "the cloud",
        )
        yield found
        assert found.errors == []


def click(found: Visit, scene: Scene, *targets: tuple[float, float]) -> None:
    """Shift + click on points of the ground, each when the one before is there."""
    home, display = home_of(scene)
    window, corner = in_canvas(found.page, home)
    for x, y in targets:
        before = found.page.locator("table").all_inner_texts()
        place = ORIGIN + [[x, y, STEP * (x > 0)]] - display.origin
        found.page.keyboard.down("Shift")
        found.page.mouse.click(*(corner + project(window, place)[0][0]))
        found.page.keyboard.up("Shift")
        found.wait_for(lambda: found.page.locator("table").all_inner_texts() != before, "the point")


def row(found: Visit, name: str) -> list[float]:
    """The numbers that a row of the panel has."""
    cells = found.page.locator("tr", has=found.page.get_by_text(name, exact=True)).locator("td")
    cells.nth(1).wait_for()
    return [float(number) for number in re.findall(r"[-+]?\d+\.?\d*", cells.nth(1).inner_text())]


def copied(found: Visit, button: str) -> str:
    found.page.evaluate("navigator.clipboard.writeText('')")
    press(found, button)
    found.wait_for(lambda: found.page.evaluate("navigator.clipboard.readText()") != "", "the copy")
    return found.page.evaluate("navigator.clipboard.readText()")


def typed(found: Visit, text: str) -> None:
    """Add a point by its numbers, as slowly as a person; the field's label has another id than the field."""
    found.page.locator("input.mantine-TextInput-input:visible").fill(text)
    found.page.wait_for_timeout(500)
    press(found, "Typed point")


def photographed(found: Visit, name: str) -> None:
    """Keep a picture of the page where SC3D_PICTURES says."""
    if folder := os.environ.get("SC3D_PICTURES"):
        found.page.wait_for_timeout(1500)
        found.page.screenshot(path=str(Path(folder) / f"{name}.png"))


def test_measures_by_clicks(scene, measured):
    unit = "m" if (scene.path / "georeference.json").exists() else "units"
    frame = "EPSG:32632" if unit == "m" else "scene, scale unknown"
    choose(measured, "Measure", "coordinates")
    click(measured, scene, (-2, -1))
    assert measured.page.get_by_text(frame, exact=True).count() == 1
    assert np.abs(np.array(row(measured, "1")) - ORIGIN - [-2, -1, 0]).max() < 0.2
    assert (
        np.abs(np.array(copied(measured, "Copy coordinates").split(), float) - row(measured, "1")).max()
        < 1e-9
    )
    press(measured, "Clear")
    choose(measured, "Measure", "distance")
    click(measured, scene, (-3, -2), (1, -2))
    first, second = (np.array(row(measured, name)) for name in ("1", "2"))
    assert row(measured, "distance") == pytest.approx([np.linalg.norm(second - first)], abs=2e-3)
    assert row(measured, "horizontal") == pytest.approx([np.hypot(*(second - first)[:2])], abs=2e-3)
    assert row(measured, "height difference") == pytest.approx([STEP], abs=1e-3)
    assert f"height difference,+{STEP:.3f} {unit}" in copied(measured, "Copy lengths")
    photographed(measured, f"distance_{unit}")
    press(measured, "Clear")
    choose(measured, "Measure", "area")
    click(measured, scene, (-3, -2), (-1, -2), (-1, 1), (-3, 1))
    corners = np.array([row(measured, str(number)) for number in range(1, 5)])
    x, y = corners[:, :2].T
    expected = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
    assert row(measured, "area on the plan (horizontal)")[0] == pytest.approx(expected, abs=2e-3)
    assert row(measured, "area on the best-fit plane")[0] == pytest.approx(expected, abs=2e-3)
    photographed(measured, f"area_{unit}")
    press(measured, "Remove last")
    measured.wait_for(lambda: measured.page.get_by_text("area on", exact=False).count() > 0, "three corners")
    press(measured, "Clear")


def test_measures_by_keys_alone(scene, measured):
    """A profile across the step: one point is typed, the others are taken from the middle of the view."""
    choose(measured, "Measure", "profile")
    for x in (-3.0, 3.0):
        typed(measured, "nonsense")
        measured.page.get_by_text("type three numbers").wait_for()
        typed(measured, " ".join(f"{value:.3f}" for value in ORIGIN + [x, 0.52, 0]))
        measured.page.get_by_text("type three numbers").wait_for(state="detached")
    measured.page.locator("svg.profile").wait_for()
    assert row(measured, "length on the plan") == pytest.approx([6], abs=1e-6)
    lines = copied(measured, "Copy CSV").splitlines()
    table = np.array([line.split(",") for line in lines[1:]], float)
    assert lines[0].startswith(
        "distance_m," if (scene.path / "georeference.json").exists() else "distance_units,"
    )
    expected = ORIGIN[2] + np.where(table[:, 0] > 3.1, STEP, 0)
    clear = np.abs(table[:, 0] - 3) > 0.3
    assert np.abs(table[clear, 2] - expected[clear]).max() < 2e-3
    points = inspector_of(scene).cloud.point.positions.numpy() - ORIGIN
    half = row(measured, "half width")[0]
    within = (np.abs(points[:, 1] - 0.52) <= half) & (np.abs(points[:, 0]) <= 3)
    assert table[:, 4].sum() == np.count_nonzero(within) == row(measured, "points")[0] > 100
    photographed(measured, f"profile_{lines[0].split(',')[0]}")
    press(measured, "Clear")
    measured.page.get_by_role("button", name="Copy coordinates").wait_for(state="detached")
    press(measured, "Middle of view")
    measured.page.get_by_role("button", name="Copy coordinates").wait_for()
    home, display = home_of(scene)
    towards = (np.array(row(measured, "1")) - display.origin - home.position) / home.distance
    middle = (home.look_at - home.position) / home.distance
    assert np.linalg.norm(np.cross(towards, middle)) < 0.03
    choose(measured, "Measure", "off")
    measured.page.get_by_text("Copy coordinates").wait_for(state="detached")


def test_one_tool_at_a_time(scene, measured):
    choose(measured, "Measure", "distance")
    choose(measured, "Tool", "brush")
    measured.wait_for(
        lambda: measured.page.get_by_label("Measure", exact=True).first.input_value() == "off", "off"
    )
    choose(measured, "Measure", "area")
    measured.wait_for(
        lambda: measured.page.get_by_label("Tool", exact=True).first.input_value() == "off", "off"
    )
    click(measured, scene, (2, 1))
    assert not scene.corrections.exists()
    choose(measured, "Measure", "off")
