"""Buildings and trees: found, outlined, measured and counted, on shapes with a known answer and on a
synthetic site with its layout.
"""

import json

import numpy as np
import pyproj
import pytest
import shapely
from scipy import ndimage

from sc3d.errors import InputError
from sc3d.exporters import objects, projected_cloud
from sc3d.exporters.polygonize import main_direction, orthogonalized, polygonize, simplified
from sc3d.geometry.raster import Raster
from sc3d.instances.buildings import join_enclosed, roof_tops, split_buildings
from sc3d.instances.regions import cells_by_number, connected_cells, renumbered
from sc3d.instances.terrain import block_medians, ground_height
from sc3d.instances.trees import split_crowns, watershed
from sc3d.scene.class_table import OTHER
from sc3d.settings.outputs import Export
from sc3d.settings.synthesize import Synthesize
from sc3d.synthetic.cloud import truth_cloud
from sc3d.synthetic.world import build_world
from tests.builders import LABELLED_CLASSES as CLASSES
from tests.builders import labelled_cloud, write_scene
from tests.exporters.site_truth import compare_buildings, footprint, match_trees, trees

GRID = Raster(0.0, 30.0, 0.25, 120, 160)  # 40 x 30 m
UTM = {"epsg": 32615, "offset": [576000.0, 5188000.0, 200.0]}


@pytest.fixture(scope="module")
def site():
    """A small synthetic site and its true cloud."""
    world = build_world(Synthesize(extent=80.0, seed=3))
    cloud = truth_cloud(world, 250_000, np.random.default_rng(0))
    label = cloud.point.label.numpy()
    cloud.point.label = np.where(label == OTHER, 0, label)  # cars and walls: of no class in a labelled cloud
    return world, cloud


def exported(scene, settings=Export()) -> tuple[list[dict], list[dict]]:
    """Features of the two GeoJSON files."""
    objects.write(scene, settings)
    return tuple(json.loads(path.read_text())["features"] for path in objects.outputs(scene, settings)[:2])


def test_objects_of_a_synthetic_site_agree_with_its_layout(tmp_path, site):
    world, cloud = site
    buildings, crowns = exported(
        write_scene(
            tmp_path, labelled_cloud(cloud.point.positions.numpy(), cloud.point.label.numpy().ravel())
        )
    )
    found = [
        {"polygon": shapely.geometry.shape(item["geometry"]), "height": item["properties"]["height_m"]}
        for item in buildings
    ]
    result = compare_buildings(found, world.buildings)
    assert len(world.buildings) >= 5 and (result["iou"] > 0.8).all() and result["extra"] == 0
    assert (
        result["iou"].mean() > 0.93
        and np.abs(result["height_error"]).mean() < 0.35
        and np.abs(result["height_error"]).max() < 0.7
    )
    true = trees(world)
    places = np.array([shapely.geometry.shape(item["geometry"]).centroid.coords[0] for item in crowns])
    assert abs(len(places) - len(true)) <= 0.15 * len(true)
    assert match_trees(places, true) >= 0.85 * len(true)
    heights = np.array([item["properties"]["height_m"] for item in crowns])
    nearest = np.hypot(*(places[:, None] - true[None, :, :2]).transpose(2, 0, 1)).argmin(axis=1)
    assert np.median(np.abs(heights - true[nearest, 3])) < 0.6
    for item, shape in zip(buildings, found):
        assert item["properties"]["area_m2"] == pytest.approx(shape["polygon"].area, abs=0.2)
        # random in this cloud
        assert item["properties"]["class"] == "building" and 0.4 < item["properties"]["confidence"] < 0.6


def test_geojson_is_on_earth_and_geopackage_in_the_crs(tmp_path, site):
    world, cloud = site
    scene = write_scene(
        tmp_path, labelled_cloud(cloud.point.positions.numpy(), cloud.point.label.numpy().ravel()), UTM
    )
    buildings, crowns = exported(scene)
    true = shapely.union_all([footprint(building) for building in world.buildings])
    to_utm = pyproj.Transformer.from_crs(4326, 32615, always_xy=True).transform
    shapes = [shapely.geometry.shape(item["geometry"]) for item in buildings]
    local = shapely.union_all(
        [
            shapely.transform(shape, lambda corners: np.stack(to_utm(*corners.T), 1) - UTM["offset"][:2])
            for shape in shapes
        ]
    )
    assert local.intersection(true).area > 0.9 * local.union(true).area
    assert all(shape.is_valid and shape.exterior.is_ccw for shape in shapes)
    area = [abs(pyproj.Geod(ellps="WGS84").geometry_area_perimeter(shape)[0]) for shape in shapes]
    # the UTM scale is 0.9997 here
    assert np.allclose(area, [item["properties"]["area_m2"] for item in buildings], rtol=2e-3)
    assert all(item["properties"]["ground_m"] > 150 for item in buildings)
    raw = pytest.importorskip("pyogrio.raw")
    package = objects.outputs(scene, Export())[2]
    for layer, features in (("buildings", buildings), ("trees", crowns)):
        meta, _, geometry, columns = raw.read(package, layer=layer)
        assert pyproj.CRS(meta["crs"]).to_epsg() == 32615 and len(geometry) == len(features)
        assert np.allclose(
            columns[list(meta["fields"]).index("height_m")],
            [item["properties"]["height_m"] for item in features],
        )
    centers = [shapely.from_wkb(item).centroid.coords[0] for item in raw.read(package, layer="buildings")[2]]
    assert np.abs(np.array(centers) - [to_utm(*shape.centroid.coords[0]) for shape in shapes]).max() < 0.001


def test_feet_and_meters_count_the_same(tmp_path, site):
    _, cloud = site
    georeference = {"epsg": 32611, "offset": [384000.0, 3768000.0, 90.0]}
    scene = write_scene(
        tmp_path,
        labelled_cloud(cloud.point.positions.numpy(), cloud.point.label.numpy().ravel()),
        georeference,
    )
    meters, feet = exported(scene), exported(scene, Export(epsg=2229))
    for kind in (0, 1):
        assert abs(len(meters[kind]) - len(feet[kind])) <= 1
    area = [sum(item["properties"]["area_m2"] for item in kind[0]) for kind in (meters, feet)]
    assert area[0] == pytest.approx(area[1], rel=0.02)


def test_point_order_changes_nothing(tmp_path, site):
    _, cloud = site
    points, label = cloud.point.positions.numpy(), cloud.point.label.numpy().ravel()
    order = np.random.default_rng(1).permutation(len(points))
    first, second = (
        exported(write_scene(tmp_path / str(number), labelled_cloud(points[rows], label[rows])))
        for number, rows in enumerate((slice(None), order))
    )
    for one, two in zip(first, second):
        assert [item["geometry"] for item in one] == [item["geometry"] for item in two]


def test_classes_without_asprs_codes_are_an_error(tmp_path, site):
    _, cloud = site
    made = labelled_cloud(cloud.point.positions.numpy()[:1000], cloud.point.label.numpy().ravel()[:1000])
    with pytest.raises(InputError, match="ASPRS code.*classes.json"):
        objects.write(
            write_scene(tmp_path, made, classes=[entry | {"asprs": 1} for entry in CLASSES]), Export()
        )
    only = labelled_cloud(cloud.point.positions.numpy()[:1000], np.ones(1000))
    with pytest.raises(InputError, match="ground class"):
        objects.write(write_scene(tmp_path, only), Export())


def test_a_scene_without_objects_gives_empty_layers(tmp_path):
    points = np.random.default_rng(0).uniform(0, 20, (4000, 3)) * [1, 1, 0.001]
    assert exported(write_scene(tmp_path, labelled_cloud(points, np.full(len(points), 3)))) == ([], [])


def test_ground_under_a_house_on_a_slope():
    """The plane is found to a centimeter, also under the roof and around mislabelled roof points."""
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(0, 40, 40_000), rng.uniform(0, 30, 40_000), np.zeros(40_000)]
    points[:, 2] = 0.1 * points[:, 0] - 0.05 * points[:, 1]
    roof = (np.abs(points[:, 0] - 20) < 6) & (np.abs(points[:, 1] - 15) < 5)
    points[roof, 2] += 5
    mislabelled = roof & (np.abs(points[:, 0] - 20) < 2)
    found = ground_height(points, ~roof | mislabelled, GRID)
    centers = GRID.centers()
    error = found.ravel() - (0.1 * centers[:, 0] - 0.05 * centers[:, 1])
    inner = (np.abs(centers - [20, 15]) < [17, 12]).all(axis=1)
    assert np.abs(error[inner]).max() < 0.25 and np.median(np.abs(error[inner])) < 0.03


def test_block_medians_against_numpy():
    rng = np.random.default_rng(1)
    blocks, values = rng.integers(0, 30, 500), rng.normal(size=500)
    blocks[blocks == 7] = 8
    found = block_medians(blocks, values, 30)
    for block in range(30):
        own = np.sort(values[blocks == block])
        assert found[block] == own[(len(own) - 1) // 2] if len(own) else np.isnan(found[block])


def test_connected_cells_against_scipy():
    rng = np.random.default_rng(2)
    groups, heights = (rng.random((40, 50)) < 0.6).astype(int), rng.normal(size=(40, 50))
    expected = ndimage.label(groups)[0]
    found = connected_cells(groups, heights, np.inf)
    assert (
        len(np.unique(np.stack([expected.ravel(), found.ravel()], 1), axis=0))
        == expected.max() + 1
        == found.max() + 1
    )
    split = connected_cells(groups, heights, 0.5)
    assert split.max() > found.max()
    same = (split[:, 1:] == split[:, :-1]) & (groups[:, 1:] > 0)
    assert (
        (np.abs(np.diff(heights, axis=1)) < 0.5) & (groups[:, 1:] > 0) & (groups[:, :-1] > 0) <= same
    ).all()
    assert all(
        (split.ravel()[cells] == number).all()
        for number, cells in enumerate(cells_by_number(split, split.max()), start=1)
    )


def box(grid: Raster, x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    x, y = grid.centers().T
    return ((x > x0) & (x < x1) & (y > y0) & (y < y1)).reshape(grid.shape)


def test_roofs_split_where_their_heights_part_and_towers_stay():
    low, high, tower, shed = (
        box(GRID, 5, 5, 15, 15),
        box(GRID, 15, 5, 25, 15),
        box(GRID, 18, 8, 22, 12),
        box(GRID, 30, 5, 32, 7),
    )
    covered = low | high | shed
    heights = np.select([tower, low, high, shed], [15.0, 4.0, 9.0, 3.0], np.nan)
    found = split_buildings(covered, heights, GRID, min_area=10.0)
    assert found.max() == 2 and (found[shed] == 0).all()
    assert (
        len(np.unique(found[low])) == 1
        and len(np.unique(found[high])) == 1
        and found[low][0] != found[high][0]
    )
    # the same cells under one steep roof
    sloping = np.where(low | high, GRID.centers()[:, 0].reshape(GRID.shape), np.nan)
    assert split_buildings(low | high, sloping, GRID, 10.0).max() == 1


def test_join_enclosed_takes_chains():
    parts = np.zeros((9, 9), int)
    parts[1:8, 1:8], parts[2:7, 2:7], parts[4, 4] = 1, 2, 3
    assert set(np.unique(join_enclosed(parts))) == {0, 2} or set(np.unique(join_enclosed(parts))) == {0, 1}
    row = np.zeros((3, 30), int)
    row[:, :10], row[:, 10:20], row[:, 20:] = 1, 2, 3  # terraced houses
    assert set(np.unique(join_enclosed(np.pad(row, 1)))) == {0, 1, 2, 3}


def test_roof_tops_leave_out_chimneys():
    building = box(GRID, 5, 5, 15, 12).astype(np.int32)
    y = GRID.centers()[:, 1].reshape(GRID.shape)
    heights = np.where(building, 6 - 0.6 * np.abs(y - 8.5), np.nan)
    heights[box(GRID, 7, 9, 7.8, 9.8)] += 1.5
    assert roof_tops(building, heights, 0.25)[0] == pytest.approx(6.0, abs=0.15)


@pytest.mark.parametrize("turn", [0.0, 0.3, 1.1])
def test_rectangular_outline_of_a_noisy_l(turn):
    """Turned, sampled on cells, its border frayed: the corners come back."""
    corners = np.array([[-8, -5], [8, -5], [8, 1], [1, 1], [1, 6], [-8, 6]], float) @ [
        [np.cos(turn), np.sin(turn)],
        [-np.sin(turn), np.cos(turn)],
    ] + [20, 15]
    true = shapely.Polygon(corners)
    noisy = shapely.contains_xy(true.buffer(0.01), *GRID.centers().T).reshape(GRID.shape)
    edge = ndimage.binary_dilation(noisy) & ~ndimage.binary_erosion(noisy)
    noisy = np.where(edge & (np.random.default_rng(3).random(GRID.shape) < 0.3), ~noisy, noisy)
    noisy = ndimage.binary_opening(ndimage.binary_closing(noisy))
    outline = polygonize(noisy.astype(np.int32), GRID)[1]
    found = orthogonalized(outline, 0.5)
    assert len(found.exterior.coords) == 7
    assert found.intersection(true).area > 0.96 * found.union(true).area
    off = (main_direction(found) - turn + np.pi / 4) % (np.pi / 2) - np.pi / 4
    assert abs(off) < np.radians(1.5)


def test_round_buildings_are_not_squared():
    disk = (np.hypot(*(GRID.centers() - [20, 15]).T) < 8).reshape(GRID.shape)
    outline = polygonize(disk.astype(np.int32), GRID)[1]
    found = orthogonalized(outline, 0.5)
    assert len(found.exterior.coords) > 7 and found.symmetric_difference(outline).area < 0.06 * outline.area
    assert found.equals(simplified(outline, 0.5))


def test_trace_keeps_area_and_holes():
    regions = np.where(box(GRID, 5, 5, 25, 20), 1, 0).astype(np.int32)
    regions[box(GRID, 10, 10, 15, 15)] = 0
    outline = polygonize(regions, GRID)[1]
    assert outline.area == pytest.approx(300 - 25) and len(outline.interiors) == 1
    assert orthogonalized(outline, 0.5).area == pytest.approx(275, rel=0.01)


def canopy_of(trees_: list[tuple[float, float, float, float]]) -> np.ndarray:
    """Highest of several round crowns (x, y, radius, height); NaN outside."""
    x, y = (values.reshape(GRID.shape) for values in GRID.centers().T)
    layers = [
        np.where(
            np.hypot(x - a, y - b) < radius,
            height - 0.4 * height * (np.hypot(x - a, y - b) / radius) ** 2,
            np.nan,
        )
        for a, b, radius, height in trees_
    ]
    return np.fmax.reduce(layers)


def test_touching_crowns_are_told_apart():
    # the last one is a bush
    planted = [(10, 10, 3, 8), (14.5, 10, 3, 9), (12, 14, 2.5, 7), (30, 20, 3, 10), (33, 5, 1.2, 1.5)]
    crowns = split_crowns(canopy_of(planted), GRID, 2.0)
    assert crowns.max() == 4
    rows, columns = GRID.cells(np.array([[x, y] for x, y, _, _ in planted]))
    assert len(set(crowns[rows[:4], columns[:4]])) == 4 and crowns[rows[4], columns[4]] == 0
    area = np.bincount(crowns.ravel())[crowns[rows[3], columns[3]]] * GRID.pixel**2
    assert area == pytest.approx(np.pi * 9, rel=0.05)


def test_a_lumpy_crown_is_one_tree():
    lobes = [
        (20 + 1.2 * np.cos(angle), 15 + 1.2 * np.sin(angle), 1.4, 8 + 0.3 * np.cos(3 * angle))
        for angle in np.arange(0, 6.2, 1.2)
    ]
    assert split_crowns(canopy_of(lobes + [(20, 15, 1.6, 8.2)]), GRID, 2.0).max() == 1


def test_every_cell_climbs_upwards():
    rng = np.random.default_rng(6)
    heights = ndimage.gaussian_filter(rng.random((60, 60)), 3) * 40
    tall = heights > np.quantile(heights, 0.3)
    crowns = watershed(heights, tall, 0.5)
    assert (crowns > 0).sum() == tall.sum() and (crowns[~tall] == 0).all()
    for cells in cells_by_number(crowns, crowns.max()):
        peak = cells[np.argmax(heights.ravel()[cells])]
        around = np.hypot(*(np.argwhere(tall) - np.unravel_index(peak, tall.shape)).T) <= 0.5 * 2.51503 / 0.5
        assert heights[tall][around].max() == heights.ravel()[peak]


def test_numbers_follow_the_order_of_cells():
    assert (
        renumbered(np.array([[0, 9, 9], [4, 4, 0], [9, 2, 2]])) == [[0, 1, 1], [2, 2, 0], [1, 3, 3]]
    ).all()
    assert (renumbered(np.array([[7, 7], [3, 7]])) == [[1, 1], [2, 1]]).all()


def test_volume_above_the_ground_of_a_house_on_a_slope(tmp_path):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-15, 15, (2, 60_000))
    house, ground = (np.abs(x) < 5) & (np.abs(y) < 4), 0.1 * x
    points = np.stack([x, y, np.where(house, 6.0, ground)], 1)
    buildings, _ = exported(write_scene(tmp_path, labelled_cloud(points, np.where(house, 1, 3))))
    # 80 m2, on average 6 m above the plane of the slope
    assert buildings[0]["properties"]["volume_m3"] == pytest.approx(480, rel=0.05)


def test_a_cloud_that_does_not_fit_is_refused_with_the_number(tmp_path, monkeypatch):
    scene = write_scene(
        tmp_path, labelled_cloud(np.random.default_rng(0).uniform(0, 9, (400, 3)), np.ones(400))
    )
    monkeypatch.setattr(projected_cloud, "num_points", lambda path: 40_000_000)
    told = (
        r"objects of 40.0 million points needs about 10\d\d\d MiB, and --max-memory leaves 4096: allow more"
    )
    with pytest.raises(InputError, match=told):
        objects.write(scene, Export(format=("objects",), max_memory="4G"))
