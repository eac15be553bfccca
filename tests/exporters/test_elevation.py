"""Terrain: ground, surface, heights above the ground and contour lines against exact terrain."""

from dataclasses import replace

import numpy as np
import pyogrio.raw
import pyproj
import pytest
import rasterio
import shapely

from sc3d.errors import InputError
from sc3d.exporters import elevation, height_grids, laz
from sc3d.exporters.projected_cloud import projected_chunks
from sc3d.geometry.ground_filter import low_objects
from sc3d.scene.class_table import OTHER, parse_classes
from sc3d.settings.outputs import Export
from sc3d.settings.synthesize import Synthesize
from sc3d.stages import export
from sc3d.synthetic.cloud import truth_cloud
from sc3d.synthetic.mesh import LEAF
from sc3d.synthetic.world import build_world
from tests.builders import LABELLED_CLASSES, labelled_cloud, write_scene
from tests.exporters.site_truth import footprint

ALL = Export(format=("dtm", "dsm", "ndsm", "contours"))
UTM = {"epsg": 32615, "offset": [576000.0, 5188000.0, 200.0]}
HALF = 20.0  # of the analytic site, m
WALL = 4.0  # half width of its house, m


def terrain(x, y):
    """An analytic hill, m."""
    return 0.1 * x + 2.0 * np.exp(-(x**2 + y**2) / 200)


def house_on_a_hill(count: int = 60_000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points and labels of grass, and of a house 6 m above the hill's foot under which nothing is seen."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-HALF, HALF, (2, count))
    house = np.maximum(np.abs(x), np.abs(y)) < WALL
    z = np.where(house, 8.0, terrain(x, y)) + rng.normal(0, 0.03, count)
    return np.stack([x, y, z], 1), np.where(house, 1, 4)


def read(path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(H, W) values, NaN = none, and x and y of the cells' centers."""
    with rasterio.open(path) as dataset:
        values = dataset.read(1, masked=True).astype(np.float64).filled(np.nan)
        rows, columns = np.mgrid[: dataset.height, : dataset.width]
        x, y = (np.reshape(part, rows.shape) for part in dataset.xy(rows.ravel(), columns.ravel()))
    return values, x, y


def rms(values) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


@pytest.fixture(scope="module")
def site():
    """A synthetic site, and its true cloud with 5 cm of noise and 2 % wrong labels."""
    world, rng = build_world(Synthesize(extent=60.0, seed=3)), np.random.default_rng(0)
    cloud = truth_cloud(world, 60_000, rng)
    label = cloud.point.label.numpy().ravel().copy()
    label[label == OTHER] = 0
    wrong = rng.random(len(label)) < 0.02
    label[wrong] = rng.integers(1, 5, wrong.sum())
    return world, cloud.point.positions.numpy() + rng.normal(0, 0.05, (len(label), 3)), label


def test_ground_and_roofs_of_a_synthetic_site_are_at_their_heights(tmp_path, site):
    world, points, label = site
    scene = write_scene(tmp_path, labelled_cloud(points, label))
    elevation.write(scene, Export(format=("dtm", "ndsm"), pixel_size=0.5))
    ground, x, y = read(scene.export / "dtm.tif")
    true = world.ground.height(np.stack([x.ravel(), y.ravel()], 1)).reshape(x.shape)
    origins = np.stack([x.ravel(), y.ravel(), np.full(x.size, 100.0)], 1)
    distance, triangles = world.cast(origins, np.tile([0.0, 0.0, -1.0], (x.size, 1)))
    under = ((triangles >= 0) & (world.ints[triangles, 0] == LEAF)).reshape(x.shape)
    buildings = [footprint(building) for building in world.buildings]
    inside = shapely.contains_xy(shapely.union_all(buildings), x, y)
    assert rms((ground - true)[~inside & ~under]) < 0.1
    assert under.sum() > 200 and rms((ground - true)[under & ~inside]) < 0.2
    above, _, _ = read(scene.export / "ndsm.tif")
    error = above - (100.0 - distance.reshape(x.shape) - true)
    for outline in buildings:
        roof = shapely.contains_xy(outline.buffer(-1.0), x, y) & np.isfinite(error)
        assert roof.sum() > 10 and abs(np.median(error[roof])) < 0.3


def test_holes_are_interpolated_and_marked(tmp_path):
    scene = write_scene(tmp_path, labelled_cloud(*house_on_a_hill()), UTM)
    elevation.write(scene, ALL)
    ground, x, y = read(scene.export / "dtm.tif")
    distance, _, _ = read(scene.export / "dtm_distance.tif")
    x, y = x - UTM["offset"][0], y - UTM["offset"][1]
    house = np.maximum(np.abs(x), np.abs(y)) < WALL - 0.5
    error = ground - UTM["offset"][2] - terrain(x, y)
    outside = np.maximum(np.abs(x), np.abs(y)) > WALL + 0.5
    assert rms(error[outside]) < 0.03 and rms(error[house]) < 0.7
    assert (distance[house] > 0).all() and np.nanmax(distance) == pytest.approx(WALL, abs=0.6)
    assert (distance[outside & np.isfinite(distance)] == 0).mean() > 0.98
    with rasterio.open(scene.export / "dtm.tif") as dataset:
        assert dataset.crs.to_epsg() == 32615 and dataset.nodata == -9999 and dataset.units == ("metre",)
    above, surface = (read(scene.export / name)[0] for name in ("ndsm.tif", "dsm.tif"))
    assert np.nanmax(np.abs(above - (surface - ground))) < 1e-4
    assert np.abs(surface[house] - 208.0).max() < 0.1


def test_contours_lie_at_their_heights(tmp_path):
    scene = write_scene(tmp_path, labelled_cloud(*house_on_a_hill()), UTM)
    elevation.write(scene, Export(format=("contours",), contour_interval=0.5))
    meta, _, geometry, columns = pyogrio.raw.read(scene.export / "contours.gpkg")
    assert "32615" in meta["crs"] and list(meta["fields"]) == ["elevation", "major", "interpolated"]
    measured = 0
    for shape, level, major, share in zip(geometry, *columns):
        corners = shapely.get_coordinates(shapely.from_wkb(shape)) - UTM["offset"][:2]
        assert level % 0.5 == 0 and major == (level % 2.5 == 0)
        if share == 0:
            measured += 1
            away = np.abs(corners).max(axis=1) < HALF - 2
            assert np.abs(terrain(*corners[away].T) + 200 - level).max(initial=0.0) < 0.12
    assert measured >= 4 and (columns[2] > 0).any()


def test_a_cloud_in_parts_gives_the_same(tmp_path, monkeypatch):
    scene = write_scene(tmp_path, labelled_cloud(*house_on_a_hill()), UTM)
    whole = elevation.write(scene, ALL)
    first = [read(path)[0] for path in elevation.outputs(scene, ALL)[:4]]
    chunk = next(projected_chunks(scene, ALL))

    def parts(*_):
        for rows in np.array_split(np.random.default_rng(1).permutation(len(chunk.points)), 3):
            cloud = chunk.cloud.select_by_index(rows)
            labels = type(chunk.labels)(*(values[rows] for values in vars(chunk.labels).values()))
            yield type(chunk)(cloud, labels, chunk.points[rows], chunk.projection)

    monkeypatch.setattr(height_grids, "projected_chunks", parts)
    assert elevation.write(scene, ALL) == whole
    for one, path in zip(first, elevation.outputs(scene, ALL)[:4]):
        assert np.array_equal(one, read(path)[0], equal_nan=True)


def test_feet_and_meters_say_the_same(tmp_path):
    scene = write_scene(
        tmp_path, labelled_cloud(*house_on_a_hill()), {"epsg": 32611, "offset": [384000.0, 3768000.0, 90.0]}
    )
    heights, place = [], (384006.0, 3768012.0)
    for settings in (Export(format=("dtm",)), Export(format=("dtm",), epsg=2229)):
        elevation.write(scene, settings)
        with rasterio.open(scene.export / "dtm.tif") as dataset:
            there = pyproj.Transformer.from_crs(32611, dataset.crs, always_xy=True).transform(*place)
            heights.append(next(dataset.sample([there]))[0])
    assert heights[0] == pytest.approx(90 + terrain(6, 12), abs=0.05)
    assert heights[1] * 1200 / 3937 == pytest.approx(heights[0], abs=0.05)


@pytest.mark.parametrize("steep", [0.0, 0.3, 0.7])
def test_cars_are_cut_off_and_ridges_stay(steep):
    pixel = 0.5
    y, x = np.mgrid[-30:30:pixel, -30:30:pixel]
    ridge = -steep * np.abs(x)
    assert not low_objects(ridge, pixel).any() and not low_objects(-ridge, pixel).any()
    car = (np.abs(x - 12) < 1) & (np.abs(y) < 2.2)
    roof = (np.abs(x + 15) < 6) & (np.abs(y) < 6)
    found = low_objects(ridge + np.where(car, 1.4, 0.0) + np.where(roof, 9.0 + steep * 6, 0.0), pixel)
    assert not (found & ~car & ~roof).any()
    if steep < 0.5:
        assert found[car].all() and found[roof].mean() > 0.9


def test_ground_is_told_by_the_codes_of_the_class_table(tmp_path):
    def table(*codes):
        classes = [{"id": 5 + row, "name": f"c{row}", "color": [1, 2, 3]} for row in range(len(codes))]
        return parse_classes([entry | {"asprs": code} for entry, code in zip(classes, codes)], "here")

    assert table(2, 3, 5, 6, 11, 1, 9).ground_classes == [5, 6, 9, 11]
    assert table(3, 11).ground_classes == [6]  # the only vegetation: trees
    codes = laz.asprs_codes(table(2, 3, 5, 6, 11, 1), ground_as_2=True)
    assert codes[5:11].tolist() == [2, 2, 5, 6, 2, 1] and codes[0] == 1
    scene = write_scene(
        tmp_path,
        labelled_cloud(*house_on_a_hill(2000)),
        classes=[entry | {"asprs": 6} for entry in LABELLED_CLASSES],
    )
    for settings in (Export(format=("dtm",)), Export(format=("laz",), ground_as_2=True)):
        with pytest.raises(InputError, match='no class is ground.*add "asprs"'):
            export.run(scene, settings)
    export.run(scene, Export(format=("dsm",)))  # needs no ground


def test_one_stage_writes_all_of_them(tmp_path):
    scene = write_scene(tmp_path, labelled_cloud(*house_on_a_hill(4000)), UTM)
    settings = Export(format=("ndsm", "laz", "dtm"))
    figures = export.run(scene, settings)
    written = export.outputs(scene, settings)
    assert len(written) == len(set(written)) == 4 and all(path.exists() for path in written)
    assert {"ndsm_interpolated", "laz_points"} <= set(figures) and not any("dtm_" in key for key in figures)
    with pytest.raises(InputError, match="contour-interval"):
        export.run(scene, Export(format=("contours",), contour_interval=0.0005))
    with pytest.raises(InputError, match="must not be negative"):
        export.run(scene, Export(format=("dtm",), pixel_size=-1.0))


@pytest.mark.parametrize("size", [(0.0, 0.0), (9.0, 0.0), (0.3, 0.3), (9.0, 9.0)])
@pytest.mark.parametrize("height", [3.25, 3.0])  # between contour lines, and at the height of one
def test_tiny_and_level_clouds_have_terrain_too(tmp_path, size, height):
    places = np.random.default_rng(0).uniform(0, 1, (50, 2)) * size
    scene = write_scene(tmp_path, labelled_cloud(np.c_[places, np.full(50, height)], np.full(50, 3)))
    figures = elevation.write(scene, replace(ALL, pixel_size=0.5))
    assert figures["contours"] == 0 and figures["ground_points_left_out"] == "0.0%"
    for name, expected in (("dtm.tif", height), ("dsm.tif", height), ("ndsm.tif", 0.0)):
        values, _, _ = read(scene.export / name)
        assert np.isfinite(values).any() and np.nanmax(np.abs(values - expected)) < 1e-4
