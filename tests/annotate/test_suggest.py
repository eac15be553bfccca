"""Asking where an answer changes most: the ranking, the corrections that answers become, and the page in a
browser.
"""

import io
import json
import shutil
import threading
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sc3d.annotate.asking import StaleError
from sc3d.annotate.questions import Evidence, doubt_of, rank_places, rivals_of
from sc3d.annotate.server import AnnotationServer, SuggestHandler
from sc3d.annotate.suggestions import Suggestions
from sc3d.cli import main
from sc3d.errors import InputError
from sc3d.geometry.cameras import project
from sc3d.io.clouds import read_cloud, write_geometry
from sc3d.scene.corrections import Balls, Corrections, add_correction, undo
from sc3d.scene.labels import CORRECTED, LOCKED, SEED
from sc3d.scene.scene import Scene
from tests.annotate.test_annotate import ask, browser  # noqa: F401
from tests.builders import LARGE, ORIGIN, doubtful_scene

pytestmark = pytest.mark.usefixtures("one_thread")
ROAD, GRASS = 1, 3


def known(points: np.ndarray | None = None) -> Evidence:
    """A square of 40 x 40 points, 1 apart, grass: two blocks are doubtful, of 6 x 6 and of 3 x 3 points."""
    x, y = np.meshgrid(np.arange(40.0), np.arange(40.0))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(1600)], axis=1) if points is None else points
    large = (points[:, :2] >= 5).all(axis=1) & (points[:, :2] < 11).all(axis=1)
    small = (points[:, :2] >= 20).all(axis=1) & (points[:, :2] < 23).all(axis=1)
    confidence = np.where(large, 0.5, np.where(small, 0.4, 0.99)).astype(np.float32)
    votes = np.zeros((len(points), 2), np.float32)
    votes[:, 1] = 2
    votes[large | small, 0] = 1.5
    label, state = np.full(len(points), GRASS, np.uint8), np.full(len(points), SEED, np.uint8)
    return Evidence(points, label, confidence, state, votes, np.uint8([ROAD, GRASS]), None, 1.0)


def test_places_are_ranked_by_what_an_answer_changes():
    """Not by the least confidence, which is that of the small place."""
    evidence = known()
    places = rank_places(evidence)
    assert [len(place.rows) for place in places] == [36, 9]
    assert {(place.label, place.rival) for place in places} == {(GRASS, ROAD)}
    assert places[0].gain > places[1].gain > 0


def test_an_object_is_one_place_whatever_speaks_against_its_class():
    """Part of it has no label, because views disagreed; most votes there name the same class."""
    evidence = known()
    x, y = evidence.points[:, 0], evidence.points[:, 1]
    large = (x >= 5) & (x < 11) & (y >= 5) & (y < 11)
    votes = evidence.votes.copy()
    votes[large] = np.where((x >= 9)[large, None], [2, 0], [2, 1.5])
    label = np.where(large, np.where(x >= 9, 0, ROAD), evidence.label).astype(np.uint8)
    places = rank_places(replace(evidence, label=label, votes=votes))
    assert [len(place.rows) for place in places] == [36, 9]
    assert (places[0].label, places[0].rival) == (ROAD, GRASS)


def test_order_of_the_points_changes_nothing():
    evidence, order = known(), np.random.default_rng(0).permutation(1600)
    moved = Evidence(
        *(
            values if name in ("ids", "spacing", "colors") else values[order]
            for name, values in vars(evidence).items()
        )
    )
    for one, other in zip(rank_places(evidence), rank_places(moved), strict=True):
        assert set(one.rows) == set(order[other.rows]) and np.isclose(one.gain, other.gain)


def test_what_views_and_people_say_counts():
    evidence = known()
    doubt = doubt_of(evidence)
    agreed = replace(evidence, votes=np.where([True, False], 0, evidence.votes).astype(np.float32))
    assert (doubt[doubt > 0.1] > doubt_of(agreed)[doubt > 0.1]).all() and (rivals_of(agreed) == 0).all()
    locked = replace(evidence, state=np.full(1600, LOCKED, np.uint8))
    assert (doubt_of(locked) >= doubt).all() and (doubt_of(locked) > doubt).any()
    assert not rank_places(replace(evidence, state=np.full(1600, CORRECTED, np.uint8)))
    unlabelled = replace(evidence, label=np.zeros(1600, np.uint8))
    assert (doubt_of(unlabelled) == 1).all()


def test_classes_with_few_sure_examples_come_first():
    evidence = known()
    label = evidence.label.copy()
    small = evidence.confidence < 0.45
    label[small] = 7
    votes = np.concatenate([evidence.votes, np.zeros((1600, 1), np.float32)], axis=1)
    votes[small, 2] = 9
    rare = replace(evidence, label=label, votes=votes, ids=np.uint8([ROAD, GRASS, 7]))
    plain = {place.label: place.gain for place in rank_places(rare)}
    assert np.isclose(plain[7], 2 * doubt_of(rare)[small].sum())


def test_colors_divide_places():
    evidence = known()
    colors = np.full((1600, 3), 100, np.uint8)
    colors[evidence.points[:, 0] >= 8] = 200
    assert sorted(len(place.rows) for place in rank_places(replace(evidence, colors=colors))) == [9, 18, 18]


# ---- the page


@pytest.fixture
def scene(tmp_path):
    return doubtful_scene(tmp_path / "scene")


@pytest.fixture
def server(scene):
    with AnnotationServer(Suggestions(scene), 0, SuggestHandler) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.02,))
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def corrected(scene) -> list[tuple[str | None, np.ndarray]]:
    """Class and middle, m, of the points of each correction."""
    points = read_cloud(scene.labelled).point.positions.numpy()
    found = Corrections.of_scene(scene)
    return [
        (one.name, (points[found.contain(row, points)] - ORIGIN).mean(axis=0)[:2])
        for row, one in enumerate(found.corrections)
    ]


def test_outline_lies_where_the_place_is_seen(scene):
    asked = Suggestions(scene).question()
    assert asked["label"] == "grass" and asked["rival"] == "road"
    view = next(view for view in scene.model.views if view.name == asked["name"])
    turn = np.linspace(0, 2 * np.pi, 60)
    rim = np.stack([LARGE[0] + 0.8 * np.cos(turn), LARGE[1] + 0.8 * np.sin(turn), 0 * turn], axis=1) + ORIGIN
    pixels = project(view, rim)[0]
    ring = np.concatenate([np.array(part) for part in asked["outline"]])
    assert np.allclose(ring.min(axis=0), pixels.min(axis=0), atol=4)
    assert np.allclose(ring.max(axis=0), pixels.max(axis=0), atol=4)


def test_answers_are_corrections_and_undo_takes_them_back(scene):
    page = Suggestions(scene)
    first = page.question()
    second = page.answer(first["place"], "road")
    assert second["answered"] == 1 and second["place"] == first["place"] + 1
    ((name, middle),) = corrected(scene)
    assert name == "road" and np.allclose(middle, LARGE, atol=0.1)
    with pytest.raises(StaleError):
        page.answer(first["place"], "road")
    last = page.skip(second["place"])
    assert last["place"] is None and last["skipped"] == 1
    assert last["own"] == 1
    again = page.undo()
    assert again["place"] == first["place"] and again["answered"] == again["own"] == 0
    assert not corrected(scene)
    page.answer(again["place"], None)
    assert corrected(scene)[0][0] is None
    assert Suggestions(scene).question()["points"] < first["points"]  # what is answered is not asked again


def test_lines_say_what_is_left(scene):
    page = Suggestions(scene)
    before = page.line()
    page.answer(0, "grass")
    assert before.startswith("0 answered, 0 skipped, 2 places left; about")
    assert page.line().startswith("1 answered, 0 skipped, 1 places left; about")
    wrong = [int(line.partition("about ")[2].split()[0]) for line in (before, page.line())]
    assert wrong[1] < wrong[0]


@pytest.mark.parametrize(
    ("path", "content", "status"),
    [
        ("/answer", {"place": 0, "class": "car"}, 422),
        ("/answer", {"place": 0, "class": 7}, 422),
        ("/answer", {"place": 5, "class": "road"}, 409),
        ("/answer", {"place": 0}, 404),
        ("/answer", [], 400),
        ("/strokes/photo_0", {"shapes": []}, 404),
    ],
)
def test_wrong_requests_write_nothing(server, scene, path, content, status):
    assert ask(server, path, content)[0] == status
    assert not scene.corrections.exists() and not scene.strokes.exists()
    assert ask(server, "/answer", {"place": 0, "class": "road"}, X_Token="other")[0] == 403
    assert ask(server, "/answer", {"place": 0, "class": "road"}, Origin="http://evil.example")[0] == 403
    assert not scene.corrections.exists()


def test_scenes_without_labels_are_refused(scene, capsys):
    shutil.copy(scene.labelled, scene.path / "kept.ply")
    for change, words in (
        (
            lambda: write_geometry(scene.seeds, read_cloud(scene.seeds).select_by_index([0, 1, 2])),
            "not of the same points",
        ),
        (scene.labelled.unlink, "run `sc3d propagate SCENE` first"),
    ):
        change()
        with pytest.raises(SystemExit) as stopped:
            main(["annotate", str(scene.path), "--port", "0", "--suggest"])
        assert stopped.value.code == 2 and words in capsys.readouterr().err.replace("\n", " ")


def test_a_class_without_surface_is_no_answer(scene):
    table = json.loads(scene.classes.read_text())
    scene.classes.write_text(json.dumps([*table, {"id": 9, "name": "sky", "color": [1, 2, 3]}]))
    page = Suggestions(Scene(scene.path))
    assert [entry["name"] for entry in page.question()["classes"]] == ["road", "grass"]
    with pytest.raises(InputError, match="no point can be"):
        page.answer(0, "sky")


@pytest.fixture
def page(browser, server):  # noqa: F811
    opened = browser.new_page(viewport={"width": 1000, "height": 700})
    opened.set_default_timeout(60_000)
    opened.wrong, opened.hosts = [], set()
    opened.on(
        "console",
        lambda message: opened.wrong.append(message.text) if message.type in ("error", "warning") else None,
    )
    opened.on("pageerror", lambda error: opened.wrong.append(str(error)))
    opened.on("request", lambda request: opened.hosts.add(request.url.split("/")[2]))
    load(opened, server)
    yield opened
    opened.close()


def load(page, server) -> None:
    page.goto(server.url)
    page.wait_for_selector("#status:has-text('places left')")
    page.wait_for_selector("body[data-busy=no]")


def test_one_key_answers(page, server, scene):
    assert page.inner_text("#question").startswith("197 points, most labelled grass, some views say road")
    picture = np.array(Image.open(io.BytesIO(page.locator("#canvas").screenshot())).convert("RGB")).astype(
        int
    )
    outlined = (np.abs(picture - [255, 0, 200]) < 30).all(axis=2)
    rows, columns = np.nonzero(outlined)
    middle = [(rows.min() + rows.max()) / 2, (columns.min() + columns.max()) / 2]
    assert np.allclose(middle, np.array(picture.shape[:2]) / 2, atol=25)
    page.keyboard.press("1")
    page.wait_for_selector("#status:has-text('1 answered')")
    ((name, middle),) = corrected(scene)
    assert name == "road" and np.allclose(middle, LARGE, atol=0.1)
    page.keyboard.press("f")
    assert page.get_attribute("#wide", "aria-pressed") == "true"
    page.keyboard.press("s")
    page.wait_for_selector("#question:has-text('Nothing is left to ask')")
    page.keyboard.press("Control+z")
    page.wait_for_selector("#status:has-text('0 answered')")
    assert not corrected(scene)
    page.click("#classes button:has-text('none of them')")
    page.wait_for_selector("#status:has-text('1 answered')")
    assert corrected(scene)[0][0] is None
    assert not page.wrong and page.hosts == {f"127.0.0.1:{server.server_port}"}


def test_two_windows_do_not_answer_one_place_twice(page, browser, server, scene):  # noqa: F811
    other = browser.new_page()
    load(other, server)
    page.keyboard.press("1")
    page.wait_for_selector("#status:has-text('1 answered')")
    asked = other.inner_text("#question")
    other.keyboard.press("2")
    other.wait_for_selector("#status.bad:has-text('nothing is written')")
    assert [name for name, _ in corrected(scene)] == ["road"]
    assert other.inner_text("#question") == page.inner_text("#question") != asked  # what is asked now
    other.keyboard.press("2")
    other.wait_for_selector("#status:not(.bad):has-text('2 answered')")
    other.close()


def test_what_is_answered_elsewhere_is_seen_on_return(page, scene):
    """In the viewer, say; and an answer of this page that was taken back there is not taken back twice."""
    asked = page.inner_text("#question")
    page.keyboard.press("1")
    page.wait_for_selector("#status:has-text('1 answered')")
    undo(scene)
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    page.wait_for_selector("#status:has-text('0 answered')")
    assert page.inner_text("#question") == asked
    add_correction(scene, "grass", Balls(((ORIGIN[None], 20.0),)))
    page.keyboard.press("Control+z")
    page.wait_for_selector("#status.bad:has-text('taken back elsewhere')")
    assert page.inner_text("#question").startswith("Nothing is left") and page.is_disabled("#undo")
    assert [name for name, _ in corrected(scene)] == ["grass"]
