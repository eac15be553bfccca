"""Corrections in headless Chromium: each tool, undo and redo, two tabs, a page opened again, and labels made anew."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import open3d as o3d
import pytest

from sc3d.geometry.cameras import project
from sc3d.io.clouds import read_cloud
from sc3d.runner import execute
from sc3d.scene.corrections import Balls, Corrections, add_correction, read_log
from sc3d.scene.labels import CORRECTED, UNSEEN
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Propagate
from sc3d.stages import propagate
from sc3d.view.web.correction_panel import made_with, propagate_again
from tests.builders import CLASSES, ORIGIN, ground, inspector_of, labelled_scene
from tests.view.web.test_page import Visit, browser, home_of, in_canvas, visit  # noqa: F401

ROAD, GRASS = CLASSES[0]["color"], CLASSES[1]["color"]
NONE = "(none of the classes)"


@pytest.fixture
def scene(tmp_path) -> Scene:
    """Road in the west, where nothing is known in the north; grass in the east."""
    found = labelled_scene(tmp_path / "scene")
    cloud, points = read_cloud(found.labelled), ground()
    count = len(points)
    columns = {"confidence": np.ones(count), "state": np.ones(count), "num_views": np.full(count, 5)}
    kinds = {"confidence": np.float32, "state": np.uint8, "num_views": np.int32}
    for name, values in columns.items():
        cloud.point[name] = o3d.core.Tensor(values.astype(kinds[name])[:, None])
    cloud.point["normals"] = o3d.core.Tensor(np.tile(np.float32([0, 0, 1]), (count, 1)))
    o3d.t.io.write_point_cloud(str(found.seeds), cloud)
    propagate.run(found, Propagate())
    return found


@pytest.fixture
def address(scene) -> Iterator[str]:
    pytest.importorskip("viser", reason="the viewer in the browser needs viser: pip install 'sc3d[web]'")
    from sc3d.view.web.page import WebView, serving

    with serving(WebView(scene, inspector_of(scene))) as found:
        yield found


def ready(found: Visit) -> None:
    """Wait until the page is drawn."""
    found.page.get_by_text("Color by", exact=True).wait_for()
    found.page.locator(".mantine-Notification-closeButton").click()
    found.wait_for(lambda: found.is_still_with(0.02, ROAD, GRASS), "the cloud")


def choose(found: Visit, name: str, value: str) -> None:
    """Choose in one of the panel's lists, by keys alone; a list that is left shows what it holds, not what was typed."""
    box = found.page.get_by_label(name, exact=True).first
    box.fill(value)
    offered = found.page.locator("[role=option]:visible")
    found.wait_for(lambda: offered.all_inner_texts() == [value], f"only {value} to be offered")
    marked = found.page.locator("[role=option][data-combobox-selected]:visible")

    def is_marked() -> bool:
        box.press("ArrowDown")  # lost while the list opens
        return marked.all_inner_texts() == [value]

    found.wait_for(is_marked, f"{value} to be marked")
    box.press("Enter")
    box.press("Tab")
    found.wait_for(lambda: box.input_value() == value, f"{value} to be chosen")


def click(found: Visit, scene: Scene, *targets: tuple[float, float]) -> None:
    """Shift + click on points of the ground, seen from where the page starts."""
    home, display = home_of(scene)
    window, corner = in_canvas(found.page, home)
    found.page.keyboard.down("Shift")
    for x, y in targets:
        found.page.mouse.click(*(corner + project(window, ORIGIN + [[x, y, 0]] - display.origin)[0][0]))
        found.page.wait_for_timeout(300)
    found.page.keyboard.up("Shift")


def standing(scene: Scene) -> tuple:
    return Corrections.of_scene(scene).corrections if scene.corrections.exists() else ()


def press(found: Visit, name: str) -> None:
    """Press a button of the panel by keys alone."""
    button = found.page.get_by_role("button", name=name, exact=True)
    button.focus()
    button.press("Enter")


def test_corrections_are_drawn_saved_undone_and_applied(scene, browser, address):  # noqa: F811
    points = ground()
    with visit(browser, address) as found:
        ready(found)
        choose(found, "Class", "grass")
        before = found.share(GRASS)
        choose(found, "Tool", "lasso")
        click(found, scene, (-3, -2), (-1, -2), (-1, 0), (-3, 0))
        press(found, "Close lasso")
        found.wait_for(lambda: len(standing(scene)) == 1, "the lasso to be saved")
        found.wait_for(lambda: found.share(GRASS) > before + 0.01, "what is corrected to be shown")
        x, y = (points - ORIGIN)[:, :2].T
        inside = standing(scene)[0].shape.contain(points)
        clear = (np.abs(x + 2) < 0.8) & (np.abs(y + 1) < 0.8)
        assert inside[clear].all() and not inside[(np.abs(x + 2) > 1.3) | (np.abs(y + 1) > 1.3)].any()
        press(found, "Undo")
        found.wait_for(lambda: not standing(scene), "undo")
        found.wait_for(lambda: found.share(GRASS) < before + 0.005, "what was undone to go")
        press(found, "Redo")
        found.wait_for(lambda: len(standing(scene)) == 1, "redo")
        choose(found, "Class", NONE)
        choose(found, "Tool", "brush")
        click(found, scene, (2, 1))
        found.wait_for(lambda: len(standing(scene)) == 2, "the brush")
        press(found, "Apply")
        found.wait_for(
            lambda: (
                found.page.get_by_text("applied: corrections: 2; points that wait for Apply: 0").count() > 0
            ),
            "labels",
        )
        assert found.errors == []
    cloud = read_cloud(scene.labelled)
    label, state = (cloud.point[name].numpy().ravel() for name in ("label", "state"))
    none = standing(scene)[1].shape.contain(points)
    assert none.any() and (label[none] == 0).all() and (label[inside] == 3).all()
    assert ((state == CORRECTED) == (none | inside)).all() and UNSEEN not in state


def test_a_region_is_corrected_whole_and_two_tabs_keep_each_others(scene, browser, address):  # noqa: F811
    with visit(browser, address) as first, visit(browser, address) as second:
        for tab in (first, second):
            ready(tab)
        click(first, scene, (-2, -1))  # no tool is chosen
        choose(first, "Tool", "region")  # in both tabs: the panel is one
        assert not scene.corrections.exists()
        choose(first, "Class", "grass")
        click(first, scene, (-2, -1))
        first.wait_for(lambda: len(standing(scene)) == 1, "the region")
        second.wait_for(lambda: second.share(ROAD) < 0.01, "the road to go, in the other tab too")
        choose(second, "Class", "road")
        click(second, scene, (2, -1))
        second.wait_for(lambda: len(standing(scene)) == 2, "the other tab's region")
        points, road = ground(), ground()[:, 0] < ORIGIN[0]
        west, east = (one.shape.contain(points) for one in standing(scene))
        assert west[road].all() and east[~road].all()
        assert west[~road].mean() < 0.05 and east[road].mean() < 0.05  # the border, one spacing wide
    with visit(browser, address) as again:
        again.page.get_by_text("corrections: 2").wait_for()
    assert len(read_log(scene.corrections)) == 2


def test_labels_are_made_again_from_the_seeds_and_with_the_options_that_they_had(scene):
    scene.seeds.rename(scene.path / "other.ply")
    asked = Propagate(method="knn", color=False, num_neighbors=7, seeds=scene.path / "other.ply")
    execute("propagate", scene, asked)
    assert made_with(scene) == asked
    add_correction(scene, "grass", Balls(((ORIGIN[None], 1.0),)))
    propagate_again(scene)
    assert (read_cloud(scene.labelled).point["state"].numpy() == CORRECTED).any()
