"""Questions in headless Chromium: a place is flown to and marked, an answer is a correction, and what others answer
or take back is followed.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import open3d as o3d
import pytest

from sc3d.annotate.asking import evidence_of_scene
from sc3d.annotate.questions import rank_places
from sc3d.annotate.suggestions import Suggestions
from sc3d.io.clouds import read_cloud, write_geometry
from sc3d.scene.corrections import Balls, Corrections, add_correction, undo
from sc3d.scene.labels import CORRECTED
from sc3d.scene.scene import Scene
from tests.builders import CLASSES, LARGE, ORIGIN, SMALL, doubtful_scene, inspector_of
from tests.view.web.test_corrections import choose, press, ready
from tests.view.web.test_page import LEFT, Visit, browser, visit  # noqa: F401

if TYPE_CHECKING:
    from sc3d.view.web.question_panel import QuestionPanel

MARK = [255, 0, 200]
GRASS = CLASSES[1]["color"]
FIRST, SECOND = (
    "points, most labelled grass, some views say road",
    "points, most labelled road, some views say grass",
)
DONE = "Nothing is left to ask"
NOBODY = SimpleNamespace(client=None)  # an event of no browser

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def scene(tmp_path) -> Scene:
    pytest.importorskip("viser", reason="the viewer in the browser needs viser: pip install 'sc3d[web]'")
    return doubtful_scene(tmp_path / "scene")


def served(scene: Scene) -> AbstractContextManager[str]:
    from sc3d.view.web.page import WebView, serving

    return serving(WebView(scene, inspector_of(scene)))


@pytest.fixture
def quick(scene, monkeypatch) -> None:
    """Short flights, and soon a look at whether others answered."""
    monkeypatch.setattr("sc3d.view.web.orbit_camera._FLIGHT", 0.1)
    monkeypatch.setattr("sc3d.view.web.question_panel._PAUSE", 0.25)


@pytest.fixture
def opened(scene, browser, quick) -> Iterator[Visit]:  # noqa: F811
    """The page, with the first question asked."""
    with served(scene) as address, visit(browser, address, (900, 1100)) as found:
        ready(found)
        assert found.share(MARK) == 0 and not text(found, "places left")
        press(found, "Start")
        see(found, FIRST)
        yield found
        assert found.errors == []


def text(found: Visit, words: str) -> bool:
    """Whether the page says so."""
    return words in found.page.inner_text("body")


def see(found: Visit, words: str) -> None:
    found.wait_for(lambda: text(found, words) and found.is_still(), words)


def answers(scene: Scene) -> list[tuple[str | None, np.ndarray]]:
    """Class and middle, m, of the points of each correction that stands."""
    points = read_cloud(scene.labelled).point.positions.numpy()
    found = Corrections.of_scene(scene)
    return [
        (one.name, (points[found.contain(row, points)] - ORIGIN).mean(axis=0)[:2])
        for row, one in enumerate(found.corrections)
    ]


def marked(found: Visit) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Rows and columns of the pixels that are marked, and the size of the canvas, px."""
    box = found.page.locator("canvas").last.bounding_box()
    left, top, width, height = (int(box[name]) for name in ("x", "y", "width", "height"))
    picture = found.picture[top : top + height, left : left + width]
    return *np.nonzero((picture == MARK).all(axis=-1)), (height, width)


def test_a_place_is_flown_to_marked_answered_and_asked_again(scene, opened):
    rows, columns, (height, width) = marked(opened)
    assert abs(np.mean([rows.min(), rows.max()]) - height / 2) < 0.1 * height
    assert abs(np.mean([columns.min(), columns.max()]) - width / 2) < 0.1 * width
    assert 0.2 < np.ptp(rows) / height < 0.6 or 0.2 < np.ptp(columns) / width < 0.6
    assert text(opened, "0 answered, 0 skipped, 2 places left") and re.search(
        r"best in photo_\d.jpg", opened.page.inner_text("body")
    )
    press(opened, "1 road")
    see(opened, SECOND)
    ((name, middle),) = answers(scene)
    assert name == "road" and np.allclose(middle, LARGE, atol=0.1)
    assert text(opened, "1 answered, 0 skipped, 1 places left") and text(opened, "corrections: 1;")
    press(opened, "Undo")
    see(opened, FIRST)
    assert not answers(scene) and text(opened, "0 answered, 0 skipped, 2 places left")
    press(opened, "Redo")
    see(opened, SECOND)
    press(opened, "Skip")
    see(opened, DONE)
    assert text(opened, "1 answered, 1 skipped, 0 places left") and opened.share(MARK) == 0
    press(opened, "Stop")
    press(opened, "Start")  # what was skipped is asked again
    see(opened, SECOND)


def test_keys_answer_but_not_while_something_is_typed(scene, opened):
    page = opened.page
    choose(opened, "Tool", "brush")
    box = page.get_by_label("Brush radius", exact=True)
    box.fill("")
    box.press_sequentially("2")
    page.wait_for_timeout(1500)
    assert not scene.corrections.exists()
    choose(opened, "Tool", "off")
    page.locator("canvas").last.focus()
    page.evaluate("document.activeElement?.blur()")
    page.keyboard.press("0")
    see(opened, SECOND)
    ((name, middle),) = answers(scene)
    assert name is None and np.allclose(middle, LARGE, atol=0.1)
    page.keyboard.press("n")
    see(opened, DONE)
    assert text(opened, "1 answered, 1 skipped")
    press(opened, "Stop")
    page.keyboard.press("1")
    page.wait_for_timeout(500)
    assert len(answers(scene)) == 1


def test_the_mark_can_be_taken_off_and_the_place_found_again(opened):
    before = opened.picture
    opened.page.get_by_role("checkbox", name="mark the place").click()
    opened.wait_for(lambda: opened.share(MARK) == 0, "the mark to go")
    press(opened, "Overview")
    opened.wait_for(lambda: opened.is_still() and opened.share(GRASS) > 0.02, "the way back")
    opened.page.get_by_role("checkbox", name="mark the place").click()
    opened.wait_for(lambda: opened.share(MARK) > 0, "the mark")
    assert (opened.picture[LEFT] != before[LEFT]).any(axis=-1).mean() > 0.1
    press(opened, "Look again")
    opened.wait_for(
        lambda: (opened.picture[LEFT] != before[LEFT]).any(axis=-1).mean() < 0.01, "the place, as before"
    )


def test_two_pages_and_annotate_follow_one_another(scene, browser, opened):  # noqa: F811
    photos = Suggestions(scene)
    with served(scene) as address, visit(browser, address, (900, 1100)) as other:
        ready(other)
        press(other, "Start")
        see(other, FIRST)
        press(opened, "2 grass")
        see(other, SECOND)
        assert photos.question()["label"] == "road" and text(other, "1 answered, 0 skipped, 1 places left")
        assert text(other, "corrections: 1;")
        press(other, "Undo")
        see(opened, FIRST)
        assert photos.question()["label"] == "grass" and not answers(scene)
        photos.answer(photos.question()["place"], "road")
        for page in (opened, other):
            see(page, SECOND)
        photos.undo()
        for page in (opened, other):
            see(page, FIRST)
        assert other.errors == []


def test_tabs_share_the_question_and_only_who_takes_part_flies(scene, browser, quick):  # noqa: F811
    with served(scene) as address, visit(browser, address) as first, visit(browser, address) as second:
        for tab in (first, second):
            ready(tab)
        press(first, "Start")
        see(first, FIRST)
        see(second, FIRST)
        assert first.share(MARK) > 4 * second.share(MARK) > 0
        press(second, "Look again")
        second.wait_for(lambda: abs(second.share(MARK) - first.share(MARK)) < 0.01, "the second tab to fly")


def test_apply_asks_about_the_new_labels(scene, opened):
    points = read_cloud(scene.labelled).point.positions.numpy()
    press(opened, "1 road")
    see(opened, SECOND)
    press(opened, "Apply")
    opened.wait_for(lambda: text(opened, "applied: corrections: 1; points that wait for Apply: 0"), "labels")
    cloud = read_cloud(scene.labelled)
    state, label = (cloud.point[name].numpy().ravel() for name in ("state", "label"))
    inside = Corrections.of_scene(scene).contain(0, points)
    assert (state[inside] == CORRECTED).all() and (label[inside] == 1).all()
    places = rank_places(evidence_of_scene(scene))
    assert places and not np.isin(places[0].rows, np.flatnonzero(inside)).any()
    see(opened, f"{len(places[0].rows)} points, most labelled")
    assert text(opened, f"0 answered, 0 skipped, {len(places)} places left")
    assert np.allclose((points[places[0].rows] - ORIGIN)[:, :2].mean(axis=0), SMALL, atol=0.3)


def test_clouds_without_votes_and_with_colors_are_asked_about(scene, browser, quick):  # noqa: F811
    scene.seeds.unlink()
    cloud = read_cloud(scene.labelled)
    cloud.point["colors"] = o3d.core.Tensor(np.full((len(cloud.point.positions), 3), 100, np.uint8))
    write_geometry(scene.labelled, cloud)
    tinted = [round(0.6 * mark + 0.4 * 100) for mark in MARK]
    with served(scene) as address, visit(browser, address, (900, 1100)) as found:
        ready(found)
        press(found, "Start")
        see(found, "points, most labelled grass. What is marked?")
        assert not text(found, "some views say") and found.share(tinted) > 0.01
        found.page.get_by_role("checkbox", name="mark the place").click()
        found.wait_for(lambda: found.share([100, 100, 100]) > 0.01, "the colors of the photos")
        press(found, "1 road")
        see(found, "points, most labelled road. What is marked?")
        ((name, middle),) = answers(scene)
        assert name == "road" and np.allclose(middle, LARGE, atol=0.1)


def test_where_nothing_is_doubtful_nothing_is_asked_and_errors_are_told(scene, browser, quick):  # noqa: F811
    cloud, seeds = read_cloud(scene.labelled), scene.seeds.read_bytes()
    cloud.point["confidence"] = o3d.core.Tensor(np.ones((len(cloud.point.positions), 1), np.float32))
    write_geometry(scene.labelled, cloud)
    write_geometry(scene.seeds, read_cloud(scene.seeds).select_by_index([0, 1, 2]))
    with served(scene) as address, visit(browser, address, (900, 1100)) as found:
        ready(found)
        press(found, "Start")
        see(found, "are not of the same points: run `sc3d propagate` again")
        scene.seeds.write_bytes(seeds)
        press(found, "Start")
        see(found, "No label is doubtful")
        assert not text(found, "1 road") and text(found, "the rest is 100.0% sure") and found.share(MARK) == 0


# ---- without a browser


@pytest.mark.parametrize(
    ("change", "shown"), [("none", True), ("no cameras", False), ("no labels", False), ("for all", False)]
)
def test_there_are_questions_where_there_can_be_answers(scene, monkeypatch, change, shown):
    import viser

    from sc3d.view.web.page import WebView, serving

    folders: list[str] = []
    add = viser.GuiApi.add_folder
    monkeypatch.setattr(
        viser.GuiApi,
        "add_folder",
        lambda gui, label, **kinds: folders.append(label) or add(gui, label, **kinds),
    )
    view = WebView(scene, inspector_of(scene))
    if change == "no cameras":
        view.inspector.views.clear()
    if change == "no labels":
        scene.labelled.unlink()
    with serving(view, "0.0.0.0" if change == "for all" else "127.0.0.1"):
        assert ("Questions" in folders) == shown and "Show" in folders


@contextmanager
def panel_of(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> Iterator[QuestionPanel]:
    """The panel of a page that is served."""
    from sc3d.view.web import page, question_panel

    made: list[QuestionPanel] = []
    monkeypatch.setattr(
        page, "QuestionPanel", lambda one: made.append(question_panel.QuestionPanel(one)) or made[0]
    )
    with served(scene):
        yield made[0]


def test_nothing_is_looked_for_before_start_and_nothing_after_the_end(scene, monkeypatch):
    from sc3d.view.web import question_panel

    asked, real = [], question_panel.Asking
    monkeypatch.setattr(question_panel, "Asking", lambda *given: asked.append(real(*given)) or asked[0])
    with panel_of(scene, monkeypatch) as panel:
        panel.follow()  # as the panel of corrections calls it
        assert not asked
        panel._press(panel._begin, NOBODY)
        assert len(asked) == 1 and panel._asked is not None
        (watcher,) = (one for one in threading.enumerate() if one.name == question_panel.WATCHER)
    watcher.join(5)
    assert not watcher.is_alive()


def test_presses_while_something_is_done_and_for_what_was_answered_elsewhere_write_nothing(
    scene, monkeypatch
):
    with panel_of(scene, monkeypatch) as panel:
        panel._press(panel._begin, NOBODY)
        with panel._busy:
            panel._press(lambda: panel._answer("road"), NOBODY)
        assert not scene.corrections.exists()
        number = panel._asked.number
        with monkeypatch.context() as patch:
            patch.setattr(panel, "follow", lambda: None)  # before the look of each second
            add_correction(scene, "grass", Balls(((ORIGIN[None] + [*LARGE, 0], 1.0),)))
            panel._press(lambda: panel._answer("road"), NOBODY)
        assert len(answers(scene)) == 1 and panel._asked.number != number
        assert "nothing is written" in panel._line.content
        undo(scene)
        panel.follow()
        assert panel._asked.number == number and "nothing is written" not in panel._line.content


def test_questions_that_do_not_fit_into_memory_are_refused(scene, monkeypatch):
    from sc3d.view.picking import Inspector

    monkeypatch.setattr(Inspector, "has_room", lambda inspector, needed: needed < 100 * 6400)
    with panel_of(scene, monkeypatch) as panel:
        panel._press(panel._begin, NOBODY)
        assert panel._asking is None and "more memory" in panel._line.content and panel._start.visible
