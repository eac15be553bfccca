"""Which place is asked about, what counts as answered, and from where a place can be looked at."""

from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest

from sc3d.annotate.asking import Asking, StaleError, evidence_of_scene
from sc3d.annotate.best_photo import BestPhoto
from sc3d.annotate.questions import LEAST
from sc3d.errors import InputError
from sc3d.geometry.raycast import RayTarget, Surface
from sc3d.io.clouds import read_cloud, write_geometry
from sc3d.scene.corrections import Balls, Corrections, add_correction, redo, undo
from sc3d.scene.labels import CORRECTED
from sc3d.scene.scene import Scene
from tests.builders import LARGE, LARGE_SIZE, ORIGIN, SMALL, doubtful_scene, views

HALF = 8.0  # half side of the squares that rays hit, m


def level(*heights: float) -> Surface:
    """Squares at these heights above the ground; a small pole stands nowhere."""
    corners = HALF * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Surface.from_meshes([(corners + ORIGIN + [0, 0, height], faces) for height in heights], ORIGIN)


def ground_only(_: np.ndarray) -> RayTarget:
    return level(0.0)


@pytest.fixture
def scene(tmp_path) -> Scene:
    return doubtful_scene(tmp_path / "scene")


def asking(scene: Scene) -> Asking:
    return Asking(scene, scene.model.views, ground_only)


def middle(one: Asking) -> np.ndarray:
    """(2,) of what is asked about, m."""
    found = one.current()
    return (found.known.points[found.place.rows] - ORIGIN)[:, :2].mean(axis=0)


def test_what_others_answer_take_back_and_restore_is_followed(scene):
    first, second = asking(scene), asking(scene)
    assert np.allclose(middle(first), LARGE, atol=0.1) and np.allclose(middle(second), LARGE, atol=0.1)
    asked = second.current()
    first.answer(first.current().number, "road")
    assert np.allclose(middle(second), SMALL, atol=0.1) and second.counts()["answered"] == 1
    with pytest.raises(StaleError, match="nothing is written"):
        second.answer(asked.number, "grass")
    with pytest.raises(StaleError):
        second.skip(asked.number)
    assert len(Corrections.of_scene(scene).corrections) == 1
    undo(scene)
    assert np.allclose(middle(first), LARGE, atol=0.1) and first.counts() == second.counts()
    redo(scene)
    assert np.allclose(middle(first), SMALL, atol=0.1) and np.allclose(middle(second), SMALL, atol=0.1)
    assert first.line() == second.line()


def test_undo_takes_back_own_answers_only(scene):
    mine, others = asking(scene), asking(scene)
    others.undo()  # without an answer nothing happens
    assert not scene.corrections.exists()
    mine.answer(mine.current().number, "road")
    others.answer(others.current().number, "grass")
    mine.undo()
    (left,) = Corrections.of_scene(scene).corrections
    assert left.name == "grass" and np.allclose(middle(mine), LARGE, atol=0.1)
    mine.answer(mine.current().number, None)
    undo(scene)  # in the viewer, say
    before = scene.corrections.read_bytes()
    with pytest.raises(StaleError, match="taken back elsewhere"):
        mine.undo()
    assert scene.corrections.read_bytes() == before and mine.num_own == 0
    others.undo()
    assert not Corrections.of_scene(scene).corrections


def test_a_place_is_asked_about_as_far_as_it_is_not_corrected(scene):
    one = asking(scene)
    whole = one.current().place
    west = ORIGIN + [*(LARGE - [LARGE_SIZE, 0]), 0]
    add_correction(scene, "grass", Balls(((west[None], LARGE_SIZE),)))
    rest = one.current()
    inside = Corrections.of_scene(scene).contain(0, rest.known.points)
    assert set(rest.place.rows) == set(whole.rows[~inside[whole.rows]]) and inside[whole.rows].any()
    assert one.counts() == {"answered": 0, "skipped": 0, "unseen": 0, "left": 2}
    one.answer(rest.number, "road")  # what is open now, and not what was corrected before
    labels = evidence_of_scene(scene)
    found = Corrections.of_scene(scene)
    given, _ = found.apply(scene_labels(scene), labels.points)
    assert (given.label[inside] == 3).all() and (given.label[rest.place.rows] == 1).all()


def test_few_points_that_are_left_of_a_place_are_not_asked_about(scene):
    one = asking(scene)
    place, known = one.current().place, one.current().known
    for left in (LEAST, LEAST - 1):
        covered = known.points[place.rows[left:]]
        add_correction(scene, "grass", Balls(((covered, known.spacing / 8),)))
        assert np.allclose(middle(one), SMALL, atol=0.1) == (left < LEAST)


def scene_labels(scene):
    from sc3d.scene.labelled_cloud import read_labelled

    return read_labelled(scene.labelled, "propagate")[1]


def test_skipped_places_stay_out_also_after_undo(scene):
    one = asking(scene)
    one.skip(one.current().number)
    one.answer(one.current().number, "road")
    assert one.current() is None and one.counts() == {"answered": 1, "skipped": 1, "unseen": 0, "left": 0}
    one.undo()
    assert np.allclose(middle(one), SMALL, atol=0.1)
    add_correction(scene, "road", Balls(((ORIGIN[None], 20.0),)))  # all of it
    assert one.current() is None and one.counts()["answered"] == 2 and one.counts()["skipped"] == 0


def test_new_labels_are_asked_about_anew_and_old_numbers_answer_nothing(scene):
    one = asking(scene)
    old = one.current()
    one.answer(old.number, "road")
    one.skip(one.current().number)
    cloud = read_cloud(scene.labelled)
    label, state, confidence = (
        cloud.point[name].numpy().ravel() for name in ("label", "state", "confidence")
    )
    label[old.place.rows], state[old.place.rows], confidence[old.place.rows] = 1, CORRECTED, 1
    for name, values in (("label", label), ("state", state), ("confidence", confidence)):
        cloud.point[name] = o3d.core.Tensor(values[:, None])
    write_geometry(scene.labelled, cloud)
    assert not one.is_current
    new = one.current()
    assert one.is_current and np.allclose(middle(one), SMALL, atol=0.1)
    assert one.counts() == {"answered": 0, "skipped": 0, "unseen": 0, "left": 1}
    assert new.number > old.number + 1
    for number in (old.number, old.number + 1):
        with pytest.raises(StaleError):
            one.answer(number, "road")


def test_broken_files_are_told_and_followed_once_they_are_whole(scene):
    one, before = asking(scene), None
    one.answer(one.current().number, "road")
    before = scene.corrections.read_bytes()
    scene.corrections.write_text("[]")
    with pytest.raises(InputError, match="no log of corrections"):
        one.current()
    with pytest.raises(InputError, match="no log of corrections"):
        asking(scene)
    scene.corrections.write_bytes(before)
    assert np.allclose(middle(one), SMALL, atol=0.1)
    kept = scene.labelled.read_bytes()
    scene.labelled.unlink()
    with pytest.raises(InputError, match="run `sc3d propagate SCENE` first"):
        one.current()
    scene.labelled.write_bytes(kept)
    assert np.allclose(middle(one), SMALL, atol=0.1)


# ---- from where a place is looked at


def finder(scene: Scene, surface: RayTarget) -> tuple[BestPhoto, np.ndarray]:
    known = evidence_of_scene(scene)
    rows = np.flatnonzero(known.confidence == np.float32(0.5))
    return BestPhoto(known, views(), lambda: surface), rows


@pytest.mark.parametrize("ceiling", [None, 11.0, 30.0])
def test_line_is_free_up_to_what_stands_behind_the_photo(scene, ceiling):
    surface = level(0.0) if ceiling is None else level(0.0, ceiling)
    found, rows = finder(scene, surface)
    shown = found.find(rows)
    line = shown.line
    points = evidence_of_scene(scene).points
    assert np.isclose(points[shown.rows], line.target).all(axis=1).any()
    away = shown.view.center - line.target
    assert np.isclose(np.linalg.norm(line.towards), 1) and np.allclose(
        away / np.linalg.norm(away), line.towards
    )
    assert line.reach > np.linalg.norm(away)
    if ceiling is None:
        assert np.isinf(line.reach)
    else:  # below it, and not far
        height = (line.target + line.reach * line.towards - ORIGIN)[2]
        photo = (shown.view.center - ORIGIN)[2]
        assert photo < height < ceiling and height > photo + 0.8 * (ceiling - photo)


def test_a_hidden_place_is_in_no_photo(scene):
    found, rows = finder(scene, level(0.0, 3.0))
    assert found.find(rows) is None
    hidden = Asking(scene, scene.model.views, lambda _: level(0.0, 3.0))
    assert hidden.current() is None and hidden.counts()["unseen"] == 2
    assert ", 2 in no photo, 0 places left" in hidden.line()


def test_the_photo_that_sees_most_of_a_place_is_taken(scene):
    """One that stands nearer sees half of it."""
    known = evidence_of_scene(scene)
    rows = np.flatnonzero(known.confidence == np.float32(0.5))
    near = views()[2]
    near = replace(near, cam_from_world=near.cam_from_world.copy())
    near.cam_from_world[:3, 3] -= [2.6, 0, 4.0]  # aside, and closer
    found = BestPhoto(known, [near, *views()], lambda: level(0.0)).find(rows)
    assert found.view is not near and set(found.rows) == set(rows)
