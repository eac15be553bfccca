"""Two dates: what changed is found, measured and named, and nothing else."""

import json
from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
import rasterio
import shapely
from PIL import Image

from sc3d.commands.compare import main
from sc3d.errors import InputError
from sc3d.exporters.changes import joint_table
from sc3d.scene.class_table import OTHER, parse_classes
from sc3d.settings.outputs import Compare
from sc3d.settings.synthesize import Synthesize
from sc3d.synthetic.cloud import truth_cloud
from sc3d.synthetic.mesh import BARK, BUILDING
from sc3d.synthetic.world import World, build_world
from tests.builders import LABELLED_CLASSES, labelled_cloud, write_scene
from tests.exporters.site_truth import footprint

UTM = {"epsg": 32615, "offset": [576000.0, 5188000.0, 200.0]}


def without(world: World, number: int) -> World:
    """The site before an object was built, or after it was felled."""
    kept = world.ints[:, 2] != number
    corners, scene = np.ascontiguousarray(world.corners[kept]), o3d.t.geometry.RaycastingScene()
    triangles = np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(o3d.core.Tensor(corners.reshape(-1, 3)), o3d.core.Tensor(triangles))
    return replace(world, corners=corners, floats=world.floats[kept], ints=world.ints[kept], scene=scene)


def noisy(world: World, seed: int) -> o3d.t.geometry.PointCloud:
    """A true cloud with 5 cm of noise and 2 % wrong labels."""
    rng = np.random.default_rng(seed)
    cloud = truth_cloud(world, 80_000, rng)
    label = cloud.point.label.numpy().ravel().copy()
    label[label == OTHER] = 0
    wrong = rng.random(len(label)) < 0.02
    label[wrong] = rng.integers(1, 5, wrong.sum())
    return labelled_cloud(cloud.point.positions.numpy() + rng.normal(0, 0.05, (len(label), 3)), label)


def lawn(step: float = 0.2, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """20 m x 20 m of level grass, as points and labels."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(0, 20, step), np.arange(0, 20, step))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    return points + rng.uniform(0, step, points.shape) * [1, 1, 0], np.full(len(points), 4)


def compared(tmp_path, before, after, georeference=UTM, **options) -> list[dict]:
    """Properties of the changes that are found between two clouds (points, labels)."""
    for name, cloud in (("before", before), ("after", after)):
        cloud = cloud if isinstance(cloud, o3d.t.geometry.PointCloud) else labelled_cloud(*cloud)
        write_scene(tmp_path / name, cloud, georeference)
    main(Compare(tmp_path / "before", tmp_path / "after", **options))
    name = "changes.geojson" if georeference else "changes_local.geojson"
    features = json.loads((tmp_path / "after" / "export" / "compare" / name).read_text())["features"]
    return [feature["properties"] | {"shape": feature["geometry"]} for feature in features]


def test_a_new_building_and_a_felled_tree_are_found_and_nothing_else(tmp_path):
    world = build_world(Synthesize(extent=60.0, seed=3))
    middle, objects = world.corners.mean(axis=1), world.ints[:, 2]
    outline = max((footprint(building) for building in world.buildings), key=lambda shape: shape.area)
    over = shapely.contains_xy(outline, middle[:, 0], middle[:, 1]) & (world.ints[:, 1] == BUILDING)
    building = int(np.bincount(objects[over]).argmax())
    trunks = np.unique(objects[world.ints[:, 0] == BARK])
    places = {tree: middle[objects == tree][:, :2].mean(axis=0) for tree in trunks}
    near = [
        tree
        for tree, place in places.items()
        if np.abs(place).max() < 24 and outline.distance(shapely.Point(place)) > 6
    ]
    tree = max(near, key=lambda tree: np.ptp(middle[objects == tree][:, 2]))
    found = compared(tmp_path, noisy(without(world, building), 1), noisy(without(world, tree), 2), None)
    assert [change["kind"] for change in found] == ["higher", "lower"]
    new, gone = (shapely.geometry.shape(change["shape"]) for change in found)
    assert new.intersection(outline).area > 0.8 * new.union(outline).area
    assert found[0]["class_after"] == "building" and found[0]["class_before"] != "building"
    assert gone.distance(shapely.Point(places[tree])) == 0 and found[1]["class_before"] == "tree"
    assert found[0]["volume_m3"] > 200 and found[1]["volume_m3"] < -10
    folder = tmp_path / "after" / "export" / "compare"
    picture = np.asarray(Image.open(folder / "changes.png"))
    assert picture.shape[2] == 3 and (picture == [255, 220, 0]).all(axis=-1).sum() > 100


def test_sizes_and_maps_are_right(tmp_path, caplog):
    caplog.set_level("INFO")
    points, label = lawn()
    later, changed = lawn(seed=1)
    shed = (np.abs(later[:, :2] - [5, 6]) < [2, 1.5]).all(axis=1)
    path = (np.abs(later[:, :2] - [14, 14]) < [4, 1.5]).all(axis=1)
    later[shed, 2], changed[shed], changed[path] = 3.0, 1, 3
    found = compared(tmp_path, (points, label), (later, changed), pixel_size=0.5)
    assert [(item["kind"], item["class_before"], item["class_after"]) for item in found] == [
        ("class", "grass / lawn", "road"),
        ("higher", "grass / lawn", "building"),
    ]
    assert found[0]["area_m2"] == pytest.approx(24, abs=5) and found[0]["rise_m"] == pytest.approx(
        0, abs=0.01
    )
    assert found[1]["area_m2"] == pytest.approx(12, abs=4)
    assert found[1]["volume_m3"] == pytest.approx(3 * found[1]["area_m2"], rel=0.02)
    folder = tmp_path / "after" / "export" / "compare"
    places = [(UTM["offset"][0] + x, UTM["offset"][1] + y) for x, y in ((5, 6), (14, 14), (2, 18))]
    for name, values in (("height_change", [3, 0, 0]), ("class_change", [1, 3, 0])):
        with rasterio.open(folder / f"{name}.tif") as dataset:
            assert dataset.crs.to_epsg() == 32615
            assert np.ravel(list(dataset.sample(places))) == pytest.approx(values, abs=0.01)
    assert "noise 0.000 m" in caplog.text and "2 changes" in caplog.text


def test_a_shift_and_noise_are_told(tmp_path, caplog):
    points, label = lawn()
    rng = np.random.default_rng(0)
    for kind, moved in (
        ("shift", points + [0, 0, 0.3]),
        ("noise", points + rng.normal(0, 0.4, points.shape) * [0, 0, 1]),
    ):
        compared(tmp_path / kind, (points, label), (moved, label))
    assert "lies 0.30 m higher than the earlier one" in caplog.text and "raise --min-height" in caplog.text


def test_order_of_dates_turns_the_sign(tmp_path):
    points, label = lawn()
    later, changed = points.copy(), label.copy()
    shed = (np.abs(points[:, :2] - 8) < 2).all(axis=1)
    later[shed, 2], changed[shed] = 3.0, 1
    there = compared(tmp_path / "there", (points, label), (later, changed))
    back = compared(tmp_path / "back", (later, changed), (points, label))
    assert [item["kind"] for item in there + back] == ["higher", "lower"]
    assert there[0]["volume_m3"] == -back[0]["volume_m3"] and there[0]["shape"] == back[0]["shape"]


def test_scenes_that_do_not_fit_are_refused(tmp_path):
    points, label = lawn(0.5)
    with pytest.raises(InputError, match="do not overlap"):
        compared(tmp_path / "apart", (points, label), (points + [100, 0, 0], label))
    with pytest.raises(InputError, match="no georeference and the other scene has one"):
        one, two = tmp_path / "one", tmp_path / "two"
        write_scene(one, labelled_cloud(points, label), UTM)
        write_scene(two, labelled_cloud(points, label))
        main(Compare(one, two))
    with pytest.raises(InputError, match="same folder"):
        main(Compare(one, one))
    with pytest.raises(InputError, match="sc3d propagate"):
        (two / "labelled.ply").unlink()
        main(Compare(two, one))
    with pytest.raises(InputError, match="above 0"):
        main(Compare(one, two, min_area=0.0))
    with pytest.raises(InputError, match="min-height"):
        main(Compare(one, two, min_height=float("nan")))


def test_classes_of_both_tables_are_the_same_by_name():
    before = parse_classes(LABELLED_CLASSES, "before")
    names = [("road", 1), ("pond", 3), ("Tree", 7), ("rail", 8)]
    after = parse_classes([{"id": label, "name": name, "color": [9, 9, 9]} for name, label in names], "after")
    table, ids = joint_table(before, after)
    assert ids[[1, 7]].tolist() == [3, 2] and ids[0] == 0
    assert {table.name(int(ids[3])), table.name(int(ids[8]))} == {"pond", "rail"}
    assert len(table) == 7 and len({entry.id for entry in table}) == 7
