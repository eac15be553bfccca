"""Corrections in 3D: shapes by their definition, the log and its writers, and what propagation makes of them."""

import json
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation

from sc3d.errors import InputError
from sc3d.geometry.cameras import View
from sc3d.io.clouds import read_cloud
from sc3d.propagation.labelled_points import LabelledPoints
from sc3d.propagation.potts import sure_examples
from sc3d.runner import execute
from sc3d.scene import corrections
from sc3d.scene.corrections import Balls, Corrections, Prism, add_correction, read_log, redo, undo
from sc3d.scene.labels import CORRECTED, Labels
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Propagate
from sc3d.stages import propagate as stage
from sc3d.tiling import propagate as tiled_propagate
from tests.builders import ORIGIN, ground, labelled_scene, views, write_model

HERE = Balls(((ORIGIN + [[-2.0, -2.0, 0.0], [-1.5, -2.0, 0.0]], 0.45),))
EAST = Prism(ORIGIN[:2] + [[1, -1], [3, -1], [3, 1], [1, 1]], ORIGIN[2] - 1, ORIGIN[2] + 1)


def ball(center: list[float], radius: float) -> Balls:
    return Balls(((ORIGIN[None] + center, radius),))


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """Seeds of road in the west and grass in the east, with votes."""
    found = labelled_scene(tmp_path / "scene")
    cloud = read_cloud(found.labelled)
    count = len(cloud.point.positions)
    cloud.point["state"] = o3d.core.Tensor(np.ones((count, 1), np.uint8))
    cloud.point["confidence"] = o3d.core.Tensor(np.ones((count, 1), np.float32))
    cloud.point["num_views"] = o3d.core.Tensor(np.full((count, 1), 5, np.int32))
    cloud.point["normals"] = o3d.core.Tensor(np.tile(np.float32([0, 0, 1]), (count, 1)))
    o3d.t.io.write_point_cloud(str(found.seeds), cloud)
    found.labelled.unlink()
    return found


def unlabelled(points: np.ndarray) -> Labels:
    return Labels(*(np.zeros(len(points), kind) for kind in (np.uint8, np.float32, np.uint8, np.int32)))


def labels_of(scene: Scene, settings: Propagate = Propagate()) -> dict[str, np.ndarray]:
    stage.run(scene, settings)
    cloud = read_cloud(settings.output or scene.labelled)
    return {name: cloud.point[name].numpy().ravel() for name in ("label", "confidence", "state")}


def test_balls_are_all_points_within_the_radius_of_a_center():
    points = np.random.default_rng(0).uniform(-3, 3, (4000, 3)) + ORIGIN
    groups = (*HERE.groups, (ORIGIN[None] + [1, 1, 1], 1.5))
    expected = np.any(
        [
            (np.linalg.norm(points[:, None] - centers, axis=2) <= radius).any(axis=1)
            for centers, radius in groups
        ],
        axis=0,
    )
    assert 50 < expected.sum() and (Balls(groups).contain(points) == expected).all()
    edge = ORIGIN + [[-2.0 - 0.25, -2.0, 0.0], [-2.5, -2.0, 0.0]]
    assert ball([-2, -2, 0], 0.25).contain(edge).tolist() == [True, False]


def test_a_prism_is_its_polygon_in_the_plane_and_its_range_in_z():
    corners = np.float32([[0, 0], [4, 0], [4, 3], [2, 1], [0, 3]])  # not convex
    points = np.random.default_rng(1).uniform(-1, 5, (2000, 3))
    inside = [cv2.pointPolygonTest(corners, (float(x), float(y)), False) > 0 for x, y, _ in points]
    expected = np.array(inside) & (points[:, 2] >= 1) & (points[:, 2] <= 2)
    assert 20 < expected.sum() and (Prism(corners.astype(float), 1, 2).contain(points) == expected).all()


def test_later_corrections_win_and_points_outside_keep_what_they_have():
    found = Corrections(
        tuple(
            corrections.Correction(str(row), "2026-01-01", name, shape)
            for row, (name, shape) in enumerate([("road", EAST), (None, ball([1, 0, 0], 0.5))])
        ),
        (1, 0),
        (None, None),
    )
    points = ORIGIN + [[2.0, 0, 0], [1.2, 0, 0], [-3, 0, 0]]
    labels, counts = found.apply(unlabelled(points), points)
    assert labels.label.tolist() == [1, 0, 0] and labels.state.tolist() == [CORRECTED, CORRECTED, 0]
    assert labels.confidence.tolist() == [1, 0, 0] and counts.tolist() == [2, 1]


def test_the_log_gives_back_what_was_added_undone_and_redone(scene):
    assert undo(scene) is None and redo(scene) is None and not scene.corrections.exists()
    add_correction(scene, "grass", HERE)
    add_correction(scene, None, EAST)
    first, second = Corrections.of_scene(scene).corrections
    assert first.name == "grass" and first.shape.groups[0][1] == HERE.groups[0][1]
    assert (first.shape.groups[0][0] == HERE.groups[0][0]).all() and (
        second.shape.polygon == EAST.polygon
    ).all()
    assert undo(scene).key == second.key and undo(scene).key == first.key and undo(scene) is None
    assert Corrections.of_scene(scene).corrections == ()
    assert redo(scene).key == first.key
    assert [one.key for one in Corrections.of_scene(scene).corrections] == [first.key]
    add_correction(scene, "road", EAST)
    assert redo(scene) is None and len(read_log(scene.corrections)) == 6  # nothing is ever taken out
    assert Corrections.of_scene(scene).ids == (3, 1)


def test_one_of_several_is_taken_back_by_its_key(scene):
    first, second = add_correction(scene, "grass", HERE), add_correction(scene, "road", EAST)
    assert undo(scene, "other") is None
    assert undo(scene, first).key == first and undo(scene, first) is None
    assert [one.key for one in Corrections.of_scene(scene).corrections] == [second]
    assert redo(scene).key == first and Corrections.of_scene(scene).ids == (3, 1)


def test_writers_at_the_same_time_lose_nothing(scene):
    code = (
        "import sys, numpy as np; from pathlib import Path; from sc3d.scene.scene import Scene;"
        "from sc3d.scene.corrections import Balls, add_correction\n"
        "for _ in range(10): add_correction(Scene(Path(sys.argv[1])), None, Balls(((np.zeros((1, 3)), 1.0),)))"
    )
    others = [subprocess.Popen([sys.executable, "-c", code, str(scene.path)]) for _ in range(2)]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: add_correction(scene, "road", EAST), range(20)))
    assert [other.wait(60) for other in others] == [0, 0]
    log = read_log(scene.corrections)
    assert len(log) == len({entry["id"] for entry in log}) == 40
    assert [entry["time"] for entry in log] == sorted(entry["time"] for entry in log)


GOOD = {
    "id": "a",
    "time": "2026-05-01T12:00:00Z",
    "class": "road",
    "balls": [{"radius": 1, "centers": [[0, 0, 0]]}],
}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[", "not valid JSON"),
        ([GOOD], "no log of corrections"),
        ({"version": 2, "log": []}, "version 1"),
        ({"version": 1, "log": [GOOD, GOOD]}, "entry 2 needs an id"),
        *(
            ({"version": 1, "log": [GOOD | change]}, message)
            for change, message in (
                ({"class": 1}, "entry 1 needs a class"),
                ({"class": "house"}, "'house', which is no class"),
                ({"time": "yesterday"}, "entry 1 needs a time"),
                ({"balls": []}, "needs balls"),
                ({"balls": [{"radius": 1, "centers": [[0, 0]]}]}, "needs centers"),
                ({"balls": [{"radius": 1, "centers": [[0, 0, float("nan")]]}]}, "needs centers"),
                ({"balls": [{"radius": 1, "centers": [[0, 0, "1"]]}]}, "needs centers"),
                ({"balls": [{"radius": 0, "centers": [[0, 0, 0]]}]}, "needs a radius"),
                ({"balls": [{"radius": True, "centers": [[0, 0, 0]]}]}, "needs a radius"),
                ({"undo": "b"}, "needs one of"),
                ({"cameras": {"a.jpg": [[1, 0, 0]]}}, "needs cameras"),
                ({"cameras": {"a.jpg": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}}, "needs cameras"),
            )
        ),
        ({"version": 1, "log": [{"id": "a", "time": "2026-05-01", "undo": "b"}]}, "nothing to undo"),
        ({"version": 1, "log": [GOOD, {"id": "b", "time": "2026-05-01", "redo": "a"}]}, "nothing to redo"),
        (
            {"version": 1, "log": [{"id": "a", "time": "2026-05-01", "class": None, "polygon": [[0, 0], [1, 1]], "z": [0, 1]}]},
            "needs a polygon",
        ),
        (
            {"version": 1, "log": [{"id": "a", "time": "2026-05-01", "class": None, "polygon": [[0, 0], [1, 1], [1, 0]], "z": [2, 1]}]},
            "needs z",
        ),
    ],
)  # fmt: skip
def test_a_malformed_file_is_refused_in_one_line(scene, content, message):
    scene.corrections.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(InputError, match=message) as refused:
        Corrections.of_scene(scene)
    assert "\n" not in str(refused.value) and str(scene.corrections) in str(refused.value)
    before = scene.corrections.read_bytes()
    if "no class" not in message:
        with pytest.raises(InputError):
            add_correction(scene, None, EAST)
    assert scene.corrections.read_bytes() == before or "no class" in message


def test_what_is_no_correction_is_not_written(scene):
    for name, shape in (
        ("house", HERE),
        ("road", Balls(((np.zeros((0, 3)), 1.0),))),
        (None, ball([0, 0, 0], 0.0)),
    ):
        with pytest.raises(InputError):
            add_correction(scene, name, shape)
    assert not scene.corrections.exists()


@pytest.mark.parametrize("method", ["map", "geometry", "knn"])
def test_corrected_points_are_never_voted_away(scene, method):
    """Three photos say road all around: the votes and the neighbors are against what is corrected."""
    settings = Propagate(method=method)
    before = labels_of(scene, settings)
    add_correction(scene, "grass", HERE)
    add_correction(scene, None, EAST)
    after, points = labels_of(scene, settings), ground()
    grass, none = HERE.contain(points), EAST.contain(points)
    assert (after["label"][grass] == 3).all() and (after["confidence"][grass] == 1).all()
    assert (after["label"][none] == 0).all() and (after["confidence"][none] == 0).all()
    assert (after["state"] == CORRECTED).tolist() == (grass | none).tolist()
    far = ~Balls(((HERE.groups[0][0], 1.5),)).contain(points) & ~none
    assert (after["label"][far] == before["label"][far]).all()
    undo(scene), undo(scene)
    again = labels_of(scene, settings)
    assert all((again[name] == before[name]).all() for name in before)


def test_labels_spread_from_a_correction_where_nothing_else_is_known(scene):
    cloud, points = read_cloud(scene.seeds), ground()
    west = points[:, 0] < ORIGIN[0] - 0.05
    for name in ("label", "confidence", "state", "num_views", "votes_0", "votes_1", "votes_3"):
        values = cloud.point[name].numpy().copy()
        values[west] = 0
        cloud.point[name] = o3d.core.Tensor(values)
    o3d.t.io.write_point_cloud(str(scene.seeds), cloud)
    assert (labels_of(scene)["label"] == 3).all()  # road has no seed
    add_correction(scene, "road", HERE)
    after = labels_of(scene)
    near = Balls(((HERE.groups[0][0], 0.7),)).contain(points)
    assert (after["label"][near] == 1).all() and (after["label"][points[:, 0] > ORIGIN[0]] == 3).all()


def test_the_look_of_classes_is_learned_from_corrections_however_few_views_there_were():
    points = ground(0.2)
    seeds, _ = corrections.Corrections(
        (
            corrections.Correction("a", "2026-01-01", "road", HERE),
            corrections.Correction("b", "2026-01-01", None, EAST),
        ),
        (1, 0),
        (None, None),
    ).apply(unlabelled(points), points)
    known = LabelledPoints(points, seeds, np.zeros((len(points), 4), np.float32), None)
    inside = HERE.contain(points)
    assert inside.any() and (known.agreed_by(3) == inside).all() and (known.seed_labels == inside).all()
    assert known.agreement()[:, 1].tolist() == [inside.sum()] * 3
    marginals = np.tile(np.float32([0.99, 0.005, 0.005]), (len(points), 1))
    assert (sure_examples(marginals, known) == inside).all()  # no view saw the others


def test_other_clouds_get_the_same_corrections(scene):
    """Another order, another spacing and another box around the points: each point is judged by itself."""
    add_correction(scene, "grass", HERE)
    add_correction(scene, None, EAST)
    found, points = Corrections.of_scene(scene), ground()
    whole, _ = found.apply(unlabelled(points), points)
    order = np.random.default_rng(2).permutation(len(points))[: len(points) // 2]
    part, _ = found.apply(unlabelled(points[order]), points[order])
    assert (part.label == whole.label[order]).all() and (part.state == whole.state[order]).all()
    fine = ground(0.04)
    labels, _ = found.apply(unlabelled(fine), fine)
    assert (labels.label == 3 * HERE.contain(fine)).all()


def test_by_tiles_they_are_those_of_the_whole(scene, monkeypatch):
    add_correction(scene, "grass", HERE)
    add_correction(scene, None, EAST)
    monkeypatch.setattr(tiled_propagate, "max_points", lambda resources, _: 4500)
    monkeypatch.setattr(tiled_propagate, "fits", lambda _, resources: resources.max_memory != "2G")
    settings = Propagate(num_neighbors=4, appearance=False)
    whole = labels_of(scene, settings)
    tiled = labels_of(
        scene, Propagate(num_neighbors=4, appearance=False, max_memory="2G", output=scene.path / "t.ply")
    )
    corrected = whole["state"] == CORRECTED  # elsewhere ties of the regular grid fall otherwise in a tile
    assert corrected.any() and (whole["confidence"] == tiled["confidence"])[corrected].all()
    for name in ("label", "state"):
        np.testing.assert_array_equal(whole[name], tiled[name], err_msg=name)


def test_corrections_are_an_input_where_there_are_some(scene):
    assert scene.corrections not in stage.inputs(scene, Propagate())
    execute("propagate", scene, Propagate())
    before = scene.labelled.stat().st_mtime_ns
    execute("propagate", scene, Propagate())
    assert scene.labelled.stat().st_mtime_ns == before
    add_correction(scene, "grass", HERE)
    assert scene.corrections in stage.inputs(scene, Propagate())
    summary = execute("propagate", scene, Propagate())
    assert scene.labelled.stat().st_mtime_ns > before and summary["corrected"] == HERE.contain(ground()).sum()


def test_they_move_turn_and_grow_with_the_scene(scene, caplog):
    add_correction(scene, "grass", HERE)
    add_correction(scene, None, EAST)
    points = ground() + [0.031, 0.017, 0]  # not on a border
    before, _ = Corrections.of_scene(scene).apply(unlabelled(points), points)
    turn = Rotation.from_euler("xyz", [0.3, -0.8, 2.0]).as_matrix()
    moved = [
        replace(view, cam_from_world=moved_pose(view, turn, 2.5, np.array([7.0, -3, 20]))) for view in views()
    ]
    shutil.rmtree(scene.sparse)
    write_model(scene.sparse, moved)
    points = 2.5 * points @ turn.T + [7.0, -3, 20]
    after, _ = Corrections.of_scene(Scene(scene.path)).apply(unlabelled(points), points)
    assert (before.label == 3).sum() > 50 and (after.label == before.label).mean() > 0.999
    assert (after.state == before.state).mean() > 0.999 and not caplog.records
    add_correction(Scene(scene.path), "road", Balls(((points[:1], 1.0),)))  # in the new frame
    again, _ = Corrections.of_scene(Scene(scene.path)).apply(unlabelled(points), points)
    assert again.label[0] == 1
    write_model(scene.path / "other", [replace(view, name=f"other_{view.name}") for view in views()])
    shutil.rmtree(scene.sparse)
    (scene.path / "other").rename(scene.sparse)
    Corrections.of_scene(Scene(scene.path))
    assert caplog.records[-1].getMessage().startswith("3 of 3 corrections were made with cameras that")


def moved_pose(view: View, turn: np.ndarray, scale: float, shift: np.ndarray) -> np.ndarray:
    """(4, 4) cam_from_world after x -> scale * turn @ x + shift."""
    result, rotation = np.eye(4), view.cam_from_world[:3, :3] @ turn.T
    result[:3, :3], result[:3, 3] = rotation, -rotation @ (scale * turn @ view.center + shift)
    return result


@pytest.mark.parametrize("memory", ["", "2G"])
def test_corrections_that_touch_no_point_are_told(scene, caplog, monkeypatch, memory):
    monkeypatch.setattr(tiled_propagate, "fits", lambda _, resources: resources.max_memory != "2G")
    add_correction(scene, "grass", HERE)
    add_correction(scene, "road", ball(-ORIGIN, 1.0))
    stage.run(scene, Propagate(max_memory=memory))
    lines = [record.getMessage() for record in caplog.records if "touch no point" in record.getMessage()]
    assert len(lines) == 1 and lines[0].startswith("1 of 2 corrections in") and "road of 20" in lines[0]


@pytest.mark.parametrize("memory", ["", "2G"])
def test_none_everywhere_is_named_where_nothing_is_left_to_start_from(scene, monkeypatch, memory):
    monkeypatch.setattr(tiled_propagate, "fits", lambda _, resources: resources.max_memory != "2G")
    add_correction(scene, None, ball([0.0, 0.0, 0.0], 100.0))
    with pytest.raises(InputError, match=r"no labelled point .* take back what .*corrections\.json sets"):
        stage.run(scene, Propagate(max_memory=memory))
