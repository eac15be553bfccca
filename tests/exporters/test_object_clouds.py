"""Objects that `propagate` told apart, written: in LAZ, one PLY each, and as the features of `objects.geojson`."""

from __future__ import annotations

import json

import laspy
import numpy as np
import open3d as o3d
import pytest
import shapely

from sc3d.errors import InputError
from sc3d.exporters import laz, object_clouds, objects, projected_cloud
from sc3d.exporters.best_photo import best_photos
from sc3d.exporters.projected_cloud import MapProjection
from sc3d.geometry.cameras import look_at, pinhole_view
from sc3d.geometry.raster import Raster
from sc3d.io.clouds import read_cloud, write_geometry
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export
from tests.builders import labelled_cloud, write_scene

NUMBERS = (4, 9)  # of the two halves of a house, west and east, as somebody who knows better has them


@pytest.fixture
def scene(tmp_path) -> Scene:
    """A house of 16 m by 10 m on a flat lawn, whose halves are two objects."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 40, (2, 40_000))
    house = (np.abs(x - 20) < 8) & (np.abs(y - 20) < 5)
    points = np.column_stack([x, y, np.where(house, 6.0, 0.0)])
    cloud = labelled_cloud(points, np.where(house, 1, 3))
    instance = np.where(house, np.where(x < 20, *NUMBERS), 0).astype(np.uint32)
    scene = write_scene(tmp_path / "scene", cloud)
    cloud.point["instance"] = o3d.core.Tensor(instance[:, None])
    write_geometry(scene.labelled, cloud)
    return scene


def features(scene: Scene, settings: Export = Export()) -> list[dict]:
    objects.write(scene, settings)
    return json.loads(objects.outputs(scene, settings)[-1].read_text())["features"]


def test_the_map_has_the_objects_of_the_cloud(scene):
    found = features(scene)
    assert (
        [item["id"] for item in found] == [item["properties"]["instance"] for item in found] == list(NUMBERS)
    )
    for item, middle in zip(found, (16, 24)):
        shape, row = shapely.geometry.shape(item["geometry"]), item["properties"]
        assert shape.area == pytest.approx(80, rel=0.06)
        assert shape.centroid.x == pytest.approx(middle, abs=0.3)
        assert row["height_m"] == pytest.approx(6, abs=0.01) and row["class"] == "building"
        assert row["volume_m3"] == pytest.approx(480, rel=0.06) and row["best_photo"] == ""
    # a smaller limit than that of the cloud's objects tells them apart anew
    assert [item["properties"]["instance"] for item in features(scene, Export(min_area=5.0))] == [0]
    assert features(scene, Export(min_area=100.0)) == []


def test_objects_in_laz_and_in_files_of_their_own(scene):
    laz.write(scene, Export())
    las, cloud = laspy.read(laz.outputs(scene, Export())[0]), read_cloud(scene.labelled)
    instance = cloud.point["instance"].numpy().ravel()
    assert las["instance"].dtype == np.uint32 and (las["instance"] == instance).all()
    figures = object_clouds.write(scene, Export())
    folder = object_clouds.outputs(scene, Export())[0]
    assert sorted(file.name for file in folder.iterdir()) == ["4_building.ply", "9_building.ply"]
    assert (figures["objects"], figures["points"]) == (2, int((instance > 0).sum()))
    for number in NUMBERS:
        part = read_cloud(folder / f"{number}_building.ply").point.positions.numpy()
        np.testing.assert_array_equal(part, cloud.point.positions.numpy()[instance == number])


def test_objects_of_a_cloud_that_does_not_fit_are_written_part_by_part(scene, monkeypatch):
    """The same points and attributes, and the same files whatever the parts."""
    folder, found = object_clouds.outputs(scene, Export())[0], []
    monkeypatch.setattr(projected_cloud, "fits", lambda _, resources: not resources.max_memory)
    for memory, rows in (("", 10**6), ("2G", 7000), ("2G", 999)):
        monkeypatch.setattr("sc3d.io.chunked_clouds.RECORDS_AT_ONCE", rows)
        figures = object_clouds.write(scene, Export(max_memory=memory, classes=("building",)))
        files = sorted(folder.iterdir())
        found.append((figures, {file.name: (file.read_bytes(), read_cloud(file).point) for file in files}))
    whole, parts, smaller = (files for _, files in found)
    assert found[0][0] == found[1][0] == found[2][0] and whole.keys() == parts.keys() and len(whole) == 2
    for name, (content, points) in parts.items():
        assert content == smaller[name][0] and set(points) == set(whole[name][1])
        for attribute, values in whole[name][1].items():
            np.testing.assert_array_equal(points[attribute].numpy(), values.numpy(), err_msg=attribute)


def test_a_cloud_without_objects_says_what_to_do(scene):
    cloud = read_cloud(scene.labelled)
    del cloud.point["instance"]
    write_geometry(scene.labelled, cloud)
    with pytest.raises(InputError, match="tell objects apart: run `sc3d propagate"):
        object_clouds.write(scene, Export())
    assert [item["properties"]["instance"] for item in features(scene)] == [0]
    laz.write(scene, Export())
    assert not laspy.read(laz.outputs(scene, Export())[0])["instance"].any()


def test_the_best_photo_is_near_and_nothing_stands_before_it():
    grid = Raster(0.0, 40.0, 0.5, 80, 80)
    tops = np.zeros(grid.shape)
    x = grid.centers()[:, 0].reshape(grid.shape)
    tops[(x > 14) & (x < 16)] = 12.0  # a wall
    points = np.random.default_rng(0).uniform([20, 18, 0], [24, 22, 1], (200, 3))
    middle = points.mean(axis=0)
    cameras = {
        "far": [38, 20, 20],
        "near": [32, 20, 10],
        "behind the wall": [10, 20, 4],
        "away": [32, 20, 10],
    }
    targets = {"away": [60, 20, 10]}
    views = [
        pinhole_view(
            name,
            (600, 400),
            (500, 500, 300, 200),
            look_at(np.array(eye, float), np.array(targets.get(name, middle))),
        )
        for name, eye in cameras.items()
    ]
    rows = [np.arange(200), np.arange(0)]
    found = best_photos(rows, (points, points), (grid, tops), views, MapProjection())
    assert found == ["near", ""]
    assert best_photos(rows, (points, points), (grid, tops), views[2:], MapProjection()) == ["", ""]
    assert best_photos([], (points, points), (grid, tops), views, MapProjection()) == []
