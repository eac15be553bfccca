"""Maps from above: every cell shows what lies under its center, and GDAL understands the files."""

import xml.etree.ElementTree

import numpy as np
import open3d as o3d
import pytest
import rasterio
from scipy import ndimage

from sc3d.errors import InputError, MissingPackageError
from sc3d.exporters import orthophoto, packages
from sc3d.geometry import raster as grids
from sc3d.geometry.raster import Raster
from sc3d.settings.outputs import Export
from tests.builders import LABELLED_CLASSES as CLASSES
from tests.builders import labelled_cloud, write_scene

UTM = {"epsg": 32615, "offset": [576000.0, 5188000.0, 200.0]}
SIZE = (20.0, 12.0)  # of the ground, m; west half road, east half grass
ROOF = (3.0, 2.0, 9.0, 7.0, 4.0)  # x, y from, x, y to, z


def site(step: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Points and labels of the ground that slopes to the east, and of a flat roof over part of it."""
    x, y = np.meshgrid(np.arange(step / 2, SIZE[0], step), np.arange(step / 2, SIZE[1], step))
    ground = np.stack([x.ravel(), y.ravel(), 0.05 * x.ravel()], 1)
    over = (
        (ground[:, 0] > ROOF[0])
        & (ground[:, 0] < ROOF[2])
        & (ground[:, 1] > ROOF[1])
        & (ground[:, 1] < ROOF[3])
    )
    roof = ground[over] * [1, 1, 0] + [0, 0, ROOF[4]]
    points = np.concatenate([ground, roof])
    label = np.concatenate([np.where(ground[:, 0] < SIZE[0] / 2, 3, 4), np.ones(len(roof), int)])
    order = np.random.default_rng(0).permutation(len(points))
    return points[order], label[order]


def write_mesh(path, hole: bool = False) -> None:
    """The ground (its east end missing if `hole`) and the roof, two triangles each."""
    east = 15.0 if hole else SIZE[0]
    quads = [
        [[0, 0, 0], [east, 0, 0.05 * east], [east, SIZE[1], 0.05 * east], [0, SIZE[1], 0]],
        [
            [ROOF[0], ROOF[1], ROOF[4]],
            [ROOF[2], ROOF[1], ROOF[4]],
            [ROOF[2], ROOF[3], ROOF[4]],
            [ROOF[0], ROOF[3], ROOF[4]],
        ],
    ]
    triangles = [[base, base + 1, base + 2, base, base + 2, base + 3] for base in (0, 4)]
    mesh = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(np.array(quads, np.float64).reshape(-1, 3)),
        o3d.core.Tensor(np.array(triangles, np.int32).reshape(-1, 3)),
    )
    o3d.t.io.write_triangle_mesh(str(path), mesh)


def expected(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Class and height at places of the site."""
    over = (x > ROOF[0]) & (x < ROOF[2]) & (y > ROOF[1]) & (y < ROOF[3])
    return np.where(over, 1, np.where(x < SIZE[0] / 2, 3, 4)), np.where(over, ROOF[4], 0.05 * x)


def sampled(file, places) -> np.ndarray:
    """Values of a GeoTIFF at (N, 2) places of the CRS, through rasterio's own georeferencing."""
    with rasterio.open(file) as dataset:
        return np.array(list(dataset.sample(places)))


@pytest.mark.parametrize("mesh", [True, False])
def test_places_show_their_class_color_and_height(tmp_path, mesh):
    points, label = site()
    cloud = labelled_cloud(points, label)
    scene = write_scene(tmp_path, cloud, UTM)
    if mesh:
        write_mesh(scene.mesh)
    orthophoto.write(scene, Export(pixel_size=0.1))
    color, classes, _, height = orthophoto.outputs(scene, Export())
    rng = np.random.default_rng(3)
    rows, columns = rng.integers(0, 120, 3000), rng.integers(0, 200, 3000)
    x, y = (columns + 0.5) / 10, SIZE[1] - (rows + 0.5) / 10
    places = np.stack([x, y], 1) + UTM["offset"][:2]
    true_class, true_height = expected(x, y)
    assert (sampled(classes, places)[:, 0] == true_class).all()
    assert np.abs(sampled(height, places)[:, 0] - true_height - UTM["offset"][2]).max() < 1e-3
    top = cloud.point.positions.numpy()
    nearest = np.argmin(((np.stack([x, y, true_height], 1)[:300, None] - top[None]) ** 2).sum(2), axis=1)
    assert (
        sampled(color, places)[:300] == np.c_[cloud.point.colors.numpy()[nearest], np.full(300, 255)]
    ).all()


def test_files_are_what_map_programs_expect(tmp_path):
    points, label = site()
    scene = write_scene(
        tmp_path,
        labelled_cloud(points[points[:, 0] + points[:, 1] < 25], label[points[:, 0] + points[:, 1] < 25]),
        UTM,
    )
    figures = orthophoto.write(scene, Export(pixel_size=0.1))
    color, classes, names, height = orthophoto.outputs(scene, Export())
    empty = (576019.9, 5188011.9)  # the corner without points
    for file, dtype, empty_value in (
        (color, "uint8", (0, 0, 0, 0)),
        (classes, "uint8", (0,)),
        (height, "float32", (-9999.0,)),
    ):
        with rasterio.open(file) as dataset:
            assert dataset.crs.to_epsg() == 32615 and dataset.res == (0.1, 0.1)
            assert np.allclose(dataset.bounds, (576000, 5188000, 576020, 5188012), atol=1e-6)
            assert (
                dataset.dtypes[0] == dtype
                and dataset.profile["tiled"]
                and dataset.profile["compress"] == "deflate"
            )
            assert tuple(next(dataset.sample([empty]))) == empty_value
            assert dataset.dataset_mask()[0, -1] == 0 and dataset.dataset_mask()[-1, 0] == 255
    with rasterio.open(classes) as dataset:
        palette = dataset.colormap(1)
    assert all(palette[entry["id"]] == (*entry["color"], 255) for entry in CLASSES) and palette[0][3] == 0
    categories = [node.text or "" for node in xml.etree.ElementTree.parse(names).iter("Category")]
    assert categories == ["unlabelled", "building", "tree", "road", "grass / lawn", "", "", "", "", "car"]
    assert figures["size"] == "200 x 120 px of 0.1 m" and figures["crs"] == "EPSG:32615"


def test_strips_and_point_order_do_not_show(tmp_path, monkeypatch):
    points, label = site(0.25)
    points += np.random.default_rng(2).uniform(-0.05, 0.05, points.shape)  # no two points are equally near
    cloud = labelled_cloud(points, label)
    scene = write_scene(tmp_path / "a", cloud)
    write_mesh(scene.mesh)
    orthophoto.write(scene, Export(pixel_size=0.2))
    order = np.random.default_rng(1).permutation(len(points))
    shuffled = o3d.t.geometry.PointCloud(
        {
            name: o3d.core.Tensor(np.ascontiguousarray(cloud.point[name].numpy()[order]))
            for name in cloud.point
        }
    )
    other = write_scene(tmp_path / "b", shuffled)
    write_mesh(other.mesh)
    monkeypatch.setattr(orthophoto, "TILE", 16)
    orthophoto.write(other, Export(pixel_size=0.2))
    for file, twin in zip(orthophoto.outputs(scene, Export()), orthophoto.outputs(other, Export())):
        if file.suffix == ".tif":
            with rasterio.open(file) as first, rasterio.open(twin) as second:
                same = (first.read() == second.read()).all(axis=0)
                assert same.mean() > 0.99  # cells whose center is as far from two points may show either
                if first.dtypes[0] == "float32":
                    assert same.all()


def test_points_stand_in_where_the_mesh_has_a_hole(tmp_path):
    points, label = site()
    scene = write_scene(tmp_path, labelled_cloud(points, label))
    write_mesh(scene.mesh, hole=True)
    orthophoto.write(scene, Export(pixel_size=0.1))
    places = np.array([[17.05, 5.05], [19.95, 11.95]])
    _, classes, _, height = orthophoto.outputs(scene, Export())
    assert (sampled(classes, places) == 4).all()
    assert np.abs(sampled(height, places)[:, 0] - 0.05 * places[:, 0]).max() < 1e-3


def test_the_default_pixel_is_the_spacing(tmp_path):
    points, label = site(0.18)
    scene = write_scene(tmp_path, labelled_cloud(points, label))
    write_mesh(scene.mesh)
    assert orthophoto.write(scene, Export())["size"].endswith("of 0.2 m")
    scene.mesh.unlink()
    assert orthophoto.write(scene, Export())["size"].endswith("of 0.3 m")


def test_stray_points_are_an_error_not_a_huge_file(tmp_path):
    points, label = site(0.5)
    points[0] = [1e7, 1e7, 0]
    with pytest.raises(InputError, match="--pixel-size.*stray points"):
        orthophoto.write(write_scene(tmp_path, labelled_cloud(points, label)), Export(pixel_size=0.1))
    assert not (tmp_path / "export").exists()


def test_missing_package_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "rasterio", None)
    with pytest.raises(MissingPackageError, match=r"needs rasterio: pip install 'sc3d\[geo\]'"):
        packages.load("rasterio")


def test_highest_points_against_a_loop():
    rng = np.random.default_rng(2)
    points = np.c_[rng.uniform(0, 5, (400, 2)), rng.integers(0, 3, 400)]
    grid = Raster.around(points, 0.7)
    best = {}
    for row, cell in enumerate(grid.flat_cells(points)):
        if cell not in best or (points[row, 2], points[row, 0]) > (
            points[best[cell], 2],
            points[best[cell], 0],
        ):
            best[cell] = row
    found = grids.highest_points(grid, points).ravel()
    assert {cell: row for cell, row in enumerate(found) if row >= 0} == best
    assert np.allclose(grid.centers()[grid.flat_cells(points)], points[:, :2], atol=0.35 + 1e-9)


def test_grids_of_neighbors_share_their_lines():
    first, second = (
        Raster.around(np.array([[576000.03, 5188000.0, 0], [576010.0, 5188010.0, 0]]), 0.3),
        Raster.around(np.array([[576011.0, 5188007.7, 0]]), 0.3),
    )
    steps = np.array([second.left - first.left, second.top - first.top]) / 0.3
    assert np.abs(steps - np.round(steps)).max() < 1e-6


def test_gaps_close_but_outlines_stay():
    rows = np.full((40, 40), -1)
    rows[5:35, 5:35] = np.arange(900).reshape(30, 30)
    holes = rows.copy()
    holes[10:13, 10:13], holes[20:30, 20:30] = -1, -1  # narrow, and wide
    closed = grids.close_gaps(holes, 2)
    assert (closed[10:13, 10:13] >= 0).all() and (closed[22:28, 22:28] == -1).all()
    assert (closed[rows < 0] == -1).all() and (closed[holes >= 0] == holes[holes >= 0]).all()


def test_interpolation_keeps_what_is_known_and_stays_between():
    rng = np.random.default_rng(4)
    known = rng.random((37, 50)) < 0.3
    known[10:25, 10:30] = False
    plane = np.add.outer(0.3 * np.arange(37), -0.2 * np.arange(50))
    filled = grids.interpolate(np.where(known, plane, np.nan), known)
    assert (filled[known] == plane[known]).all()
    inside = ndimage.binary_erosion(np.ones_like(known), iterations=5)
    assert np.abs(filled - plane)[inside].max() < 1.0 and np.median(np.abs(filled - plane)[inside]) < 0.1
    assert (grids.interpolate(np.full((5, 5), 7.0), np.eye(5) > 0) == 7).all()
