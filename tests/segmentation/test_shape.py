"""Masks from the shape of a scene: plane, slope, boxes, facades and green blobs whose classes are known."""

import json

import numpy as np
import open3d as o3d
import pycolmap
import pytest
from PIL import Image

from sc3d.cli import main
from sc3d.commands.run import choose_masks, list_stages
from sc3d.errors import InputError
from sc3d.geometry.cameras import View, look_at
from sc3d.scene.class_table import parse_classes, read_classes
from sc3d.scene.scene import Scene
from sc3d.segmentation.shape.backend import confidence_of
from sc3d.segmentation.shape.classes import DEFAULT, class_ids
from sc3d.segmentation.shape.frame import estimate_scale, find_frame, upright
from sc3d.segmentation.shape.points import (
    BUILDING,
    GROUND,
    HIGH_VEGETATION,
    LOW_VEGETATION,
    NONE,
    Thinned,
    classify,
)
from sc3d.settings.labels import Segment
from sc3d.settings.outputs import Run
from tests.builders import write_model

GRAY, GREEN, RED = (128, 128, 128), (70, 120, 50), (160, 90, 70)
STEP = 0.4  # m


def grid(width: float, depth: float) -> np.ndarray:
    """(N, 2) places, centered."""
    x, y = np.meshgrid(np.arange(-width / 2, width / 2, STEP), np.arange(-depth / 2, depth / 2, STEP))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def box(center, size, height: float) -> np.ndarray:
    """(N, 3) flat roof and four walls on z = 0."""
    half = np.array(size) / 2
    roof = np.pad(grid(*size), ((0, 0), (0, 1)), constant_values=height)
    parts = [roof]
    for axis in (0, 1):
        wall = grid(size[1 - axis], height)
        for side in (-1, 1):
            part = np.empty((len(wall), 3))
            part[:, axis], part[:, 1 - axis], part[:, 2] = (
                side * half[axis],
                wall[:, 0],
                wall[:, 1] + height / 2,
            )
            parts.append(part)
    return np.concatenate(parts) + [*center, 0]


def blob(center, radius: float, rng) -> np.ndarray:
    """(N, 3) leaves in a ball."""
    found = rng.uniform(-1, 1, (int(max(60 * radius**3, 150)), 3))
    return found[np.linalg.norm(found, axis=1) < 1] * radius + center


def village(slope: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 3) m, colors (N, 3) uint8 and shapes (N,): a road, a lawn, two houses and a tree."""
    rng = np.random.default_rng(0)
    flat = np.pad(grid(60, 60), ((0, 0), (0, 1))) + rng.normal(0, 0.01, (len(grid(60, 60)), 3))
    houses = [box((-15, 15), (10, 8), 6.0), box((15, -12), (8, 8), 7.0)]
    for house in houses:  # nothing is seen of the ground below
        low, high = house[:, :2].min(axis=0), house[:, :2].max(axis=0)
        flat = flat[~((flat[:, :2] > low) & (flat[:, :2] < high)).all(axis=1)]
    crown = blob((15, 15, 5.0), 3.0, rng)
    lawn = flat[:, 0] > 0
    points = np.concatenate([flat, *houses, crown])
    shapes = np.concatenate(
        [
            np.where(lawn, LOW_VEGETATION, GROUND),
            np.full(sum(map(len, houses)), BUILDING),
            np.full(len(crown), HIGH_VEGETATION),
        ]
    )
    colors = np.array([GRAY, GREEN, GREEN, RED])[shapes] + rng.integers(-4, 5, (len(points), 1))
    points[:, 2] += slope * points[:, 0]
    return points, colors.astype(np.uint8), shapes


def right(points, colors, shapes) -> dict[int, float]:
    """Share of the points of each shape that are found to be of it."""
    found = classify(points, colors).argmax(axis=1)
    return {shape: float((found == shape)[shapes == shape].mean()) for shape in np.unique(shapes)}


@pytest.mark.parametrize("slope", [0.0, 0.15])
def test_road_lawn_houses_and_tree_are_found_on_the_level_and_on_a_slope(slope):
    shares = right(*village(slope))
    assert shares[GROUND] > 0.97 and shares[LOW_VEGETATION] > 0.9
    assert shares[BUILDING] > 0.87 and shares[HIGH_VEGETATION] > 0.9


def test_without_colors_crowns_are_told_by_their_roughness_and_lawn_is_ground():
    points, _, shapes = village()
    shares = right(points, None, np.where(shapes == LOW_VEGETATION, GROUND, shapes))
    assert shares[GROUND] > 0.97 and shares[BUILDING] > 0.8 and shares[HIGH_VEGETATION] > 0.8


def test_a_facade_is_building_down_to_its_foot():
    pavement = np.pad(grid(30, 8), ((0, 0), (0, 1)))
    wall = grid(30, 9)
    wall = np.stack([wall[:, 0], np.full(len(wall), 4.0), wall[:, 1] + 4.5], axis=1)
    points = np.concatenate([pavement, wall])
    shapes = np.repeat([GROUND, BUILDING], [len(pavement), len(wall)])
    shares = right(points, np.broadcast_to(GRAY, points.shape), shapes)
    assert shares[GROUND] > 0.9 and shares[BUILDING] > 0.87


def test_a_car_is_none_of_the_classes_and_a_bush_is_vegetation():
    points, colors, _ = village()
    car, bush = box((-20, -15), (4.5, 1.8), 1.4), blob((-15, -22, 0.8), 0.8, np.random.default_rng(1))
    more = np.concatenate([points, car, bush])
    paint = np.repeat([RED, GREEN], [len(car), len(bush)], axis=0)
    found = classify(more, np.concatenate([colors, paint])).argmax(axis=1)[len(points) :]
    assert (found[: len(car)][car[:, 2] > 0.8] == NONE).mean() > 0.8
    assert (found[len(car) :][bush[:, 2] > 0.8] == HIGH_VEGETATION).mean() > 0.8


def test_points_come_in_any_order_and_probabilities_add_up_to_one():
    points, colors, _ = village()
    found = []
    for order in (np.arange(len(points)), np.random.default_rng(3).permutation(len(points))):
        thinned = Thinned.from_points(points[order], colors[order], 0.7)
        probabilities = np.empty((len(points), 5), np.float32)
        probabilities[order] = classify(thinned.points, thinned.colors)[thinned.rows]
        found.append(probabilities)
    np.testing.assert_array_equal(*found)
    np.testing.assert_allclose(found[0].sum(axis=1), 1, atol=1e-5)
    assert estimate_scale(points) == estimate_scale(points[order])


def test_points_are_thinned_to_one_per_cube_with_the_mean_of_its_colors():
    points = np.array([[0.0, 0, 0], [0.1, 0, 0], [5.0, 5, 5]])
    thinned = Thinned.from_points(points, np.uint8([[0, 0, 0], [100, 0, 0], [7, 7, 7]]), 1.0)
    assert len(thinned.points) == 2 and thinned.rows[0] == thinned.rows[1] != thinned.rows[2]
    np.testing.assert_allclose(thinned.points[thinned.rows[0]], [0.05, 0, 0])
    np.testing.assert_allclose(thinned.colors[thinned.rows], [[50, 0, 0], [50, 0, 0], [7, 7, 7]])


def test_a_cloud_of_a_few_points_is_refused():
    with pytest.raises(InputError, match="has 99 points"):
        classify(np.zeros((99, 3)), None)


@pytest.mark.parametrize("unit", [0.02, 1.0, 30.0])
def test_the_guessed_scale_follows_the_unit(unit):
    points = village()[0]
    assert estimate_scale(points * unit) * unit == pytest.approx(estimate_scale(points), rel=1e-6)
    assert 0.6 < estimate_scale(points) < 2.5


def test_a_plane_has_a_scale_too_and_is_ground():
    plane = np.pad(grid(40, 40), ((0, 0), (0, 1)))
    scale = estimate_scale(plane)
    assert np.isfinite(scale) and scale > 0
    assert (classify(plane * scale, None).argmax(axis=1) == GROUND).all()


def test_upright_axes_are_a_rotation_with_up_last():
    up = np.array([0.6, 0.0, 0.8])
    axes = upright(up)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(axes[2], up)
    assert np.linalg.det(axes) == pytest.approx(1)


def table(*entries):
    return parse_classes(
        [{"id": 5 * row + 5, "color": [1, 2, 3], **entry} for row, entry in enumerate(entries)], "classes"
    )


def test_shapes_are_classes_by_name_else_by_asprs_code():
    names = {"name": "Building"}, {"name": "tree"}, {"name": "road", "asprs": 11}, {"name": "grass"}
    assert class_ids(table(*names)).tolist() == [15, 20, 10, 5, 0]
    codes = {"name": "a", "asprs": 2}, {"name": "b", "asprs": 4}, {"name": "c", "asprs": 6}
    assert class_ids(table(*codes)).tolist() == [5, 5, 10, 15, 0]  # lawn is ground where nothing else is
    assert class_ids(DEFAULT).tolist() == [1, 2, 3, 4, 0]


@pytest.mark.parametrize(
    "entries, told",
    [
        ([{"name": "ground"}, {"name": "tree"}], r"no class for building \(ASPRS code 6\)"),
        ([{"name": "a"}], "no class for ground .* and low vegetation .* and high vegetation .* and building"),
        (
            [
                {"name": "roof", "asprs": 6},
                {"name": "wall", "asprs": 6},
                {"name": "ground"},
                {"name": "tree"},
            ],
            "roof and wall of classes.json all have the ASPRS code 6",
        ),
    ],
)
def test_what_stands_for_nothing_or_for_several_classes_is_refused(entries, told):
    with pytest.raises(InputError, match=told):
        class_ids(table(*entries))


def test_confidence_is_the_probability_of_the_class_not_of_the_shape():
    probabilities = np.array([[0.5, 0.4, 0.1, 0, 0], [0, 0.1, 0, 0, 0.9]], np.float32)
    same = np.array([1, 1, 3, 4, 0], np.uint8)
    assert confidence_of(probabilities, same).tolist() == [round(0.9 * 255), round(0.9 * 255)]
    assert confidence_of(probabilities, np.uint8([1, 2, 3, 4, 0]))[0] == round(0.5 * 255)


TURN = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], float)  # z to y: a world whose up is y


@pytest.fixture
def scene(tmp_path):
    """The village in a world whose up is -y, half as large, with four photos from above; no classes, no
    place.
    """
    points, colors, _ = village()
    world = 0.5 * points @ TURN.T
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(world))
    cloud.point.colors = o3d.core.Tensor(colors)
    o3d.t.io.write_point_cloud(str(tmp_path / "cloud.ply"), cloud)
    camera = pycolmap.Camera(model="PINHOLE", width=120, height=90, params=[90, 90, 60, 45], camera_id=1)
    views = []
    (tmp_path / "images").mkdir()
    for row, center in enumerate([(-30, -30, 40), (30, -30, 40), (30, 30, 40), (-30, 30, 40)]):
        pose = look_at(np.array(center, float), np.zeros(3))
        pose[:3, :3] = pose[:3, :3] @ TURN.T
        pose[:3, 3] *= 0.5
        views.append(View(f"photo_{row}.png", camera, pose))
        Image.fromarray(np.full((90, 120, 3), 99, np.uint8)).save(tmp_path / "images" / f"photo_{row}.png")
    write_model(tmp_path / "sparse" / "0", views)
    return Scene(tmp_path)


def mask(scene, name: str) -> np.ndarray:
    return np.array(Image.open(scene.path / name / "photo_0.png"))


def test_up_is_that_of_the_cameras_where_the_scene_has_no_place(scene):
    points = 0.5 * village()[0] @ TURN.T
    frame = find_frame(scene, points)
    assert not frame.measured
    np.testing.assert_allclose(frame.axes[2], TURN[:, 2], atol=0.05)
    assert frame.scale == pytest.approx(2 * estimate_scale(village()[0]), rel=0.2)


def test_masks_and_a_table_of_classes_are_made_and_label_takes_them(scene, caplog):
    main(["segment", str(scene.path), "--backend", "geometry"])
    assert "lengths are a guess" in caplog.text
    assert [entry.name for entry in read_classes(scene.classes)] == [entry.name for entry in DEFAULT]
    labels, sure = mask(scene, "masks"), mask(scene, "confidence")
    assert {1, 2, 3, 4} <= set(np.unique(labels).tolist())
    assert (
        (sure[labels > 0] > 0).all() and (sure[0] == 0).all() and (labels[0] == 0).all()
    )  # above the horizon
    main(["segment", str(scene.path), "--backend", "geometry"])
    assert "up to date" in caplog.text
    main(["label", str(scene.path)])
    seeds = o3d.t.io.read_point_cloud(str(scene.seeds)).point["label"].numpy().ravel()
    wanted = class_ids(DEFAULT)[village()[2]]
    assert (seeds == wanted)[seeds > 0].mean() > 0.9 and (seeds > 0).mean() > 0.6


def test_masks_that_were_there_are_set_aside_and_unfit_classes_change_nothing(scene, capsys):
    scene.classes.write_text(json.dumps([{"id": 1, "name": "car", "color": [1, 2, 3]}]))
    scene.masks.mkdir()
    Image.fromarray(np.zeros((90, 120), np.uint8)).save(scene.masks / "photo_0.png")
    with pytest.raises(SystemExit):
        main(["segment", str(scene.path), "--backend", "geometry"])
    assert "finds no class for ground" in capsys.readouterr().err
    assert not mask(scene, "masks").any() and not (scene.path / "masks.before").exists()
    scene.classes.unlink()
    main(["segment", str(scene.path), "--backend", "geometry"])
    assert (scene.path / "masks.before" / "photo_0.png").exists() and mask(scene, "masks").any()


def test_without_a_cloud_it_says_what_to_do(scene, capsys):
    scene.cloud.unlink()
    with pytest.raises(SystemExit):
        main(["segment", str(scene.path), "--backend", "geometry"])
    assert "cloud.ply is missing" in capsys.readouterr().err


def test_run_takes_the_shape_where_nothing_else_is_given(scene):
    assert choose_masks(scene, Segment()).backend == "geometry"
    assert choose_masks(scene, Segment(backend="strokes")).backend == "strokes"
    assert choose_masks(scene, Segment(confidence=scene.path)).backend == "files"
    main(["segment", str(scene.path), "--backend", "geometry"])
    assert choose_masks(scene, Segment()).backend == "geometry"  # again, not as somebody's masks
    (scene.path / "masks.json").unlink()
    assert choose_masks(scene, Segment()).backend == "files"


def test_run_makes_masks_of_the_shape_after_the_surface_and_depth_does_not_wait_for_their_sky(scene):
    scene.classes.write_text(json.dumps([*DEFAULT.as_json(), {"id": 9, "name": "sky", "color": [9, 9, 200]}]))
    command = Run(scene.images, scene.path)
    stages = dict(list_stages(command, scene, Segment(backend="geometry")))
    names = list(stages)
    assert names.index("extract") < names.index("segment") < names.index("label")
    assert stages["depth"].ignore_masks
    assert [name for name, _ in list_stages(command, scene, Segment())].index("segment") < names.index(
        "depth"
    ) + 1
