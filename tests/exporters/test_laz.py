"""LAZ and clouds per class: nothing is lost, and everything lies where the CRS says."""

import io

import laspy
import numpy as np
import open3d as o3d
import pyproj
import pytest

from sc3d.errors import InputError
from sc3d.exporters import clouds, laz
from sc3d.georeferencing.georeference import read_georeference
from sc3d.settings.outputs import Export
from tests.builders import LABELLED_CLASSES as CLASSES
from tests.builders import labelled_cloud, write_scene

UTM = {"epsg": 32615, "offset": [576000.0, 5188000.0, 200.0]}
ENU = UTM | {"origin": [46.8427, -91.9944, 198.6]}


def random_cloud(count: int = 2000, **options) -> o3d.t.geometry.PointCloud:
    rng = np.random.default_rng(1)
    return labelled_cloud(
        rng.uniform(-150, 150, (count, 3)), rng.choice([0, 1, 2, 3, 4, 9], count), **options
    )


def read(scene, settings=Export()) -> laspy.LasData:
    laz.write(scene, settings)
    return laspy.read(laz.outputs(scene, settings)[0])


def array(cloud, name) -> np.ndarray:
    return cloud.point[name].numpy().squeeze()


def test_laz_keeps_positions_to_the_millimeter_and_everything_else_exactly(tmp_path):
    cloud = random_cloud()
    las = read(write_scene(tmp_path, cloud, UTM))
    assert (str(las.header.version), las.header.point_format.id) == ("1.4", 7)
    assert las.header.global_encoding.wkt and las.header.parse_crs().to_epsg() == 32615
    assert len([vlr for vlr in las.header.vlrs if vlr.record_id == 2112]) == 1
    assert np.abs(las.xyz - (array(cloud, "positions") + UTM["offset"])).max() < 0.00051
    codes = {0: 1} | {entry["id"]: entry["asprs"] for entry in CLASSES}
    assert (las.classification == [codes[label] for label in array(cloud, "label")]).all()
    assert (
        np.stack([las.red, las.green, las.blue], 1) == array(cloud, "colors").astype(np.uint16) * 257
    ).all()
    for name, dtype in (
        ("confidence", np.float32),
        ("state", np.uint8),
        ("num_views", np.uint16),
        ("label", np.uint8),
    ):
        assert las[name].dtype == dtype
        assert (las[name] == array(cloud, name)).all()
    assert (las.return_number == 1).all() and (las.number_of_returns == 1).all()


def test_laz_of_local_enu_lies_where_proj_says(tmp_path):
    """Independent route: ENU to geocentric by the rotation matrix, then PROJ's own geocentric to UTM."""
    cloud = random_cloud()
    las = read(write_scene(tmp_path, cloud, ENU))
    latitude, longitude, height = ENU["origin"]
    center = np.array(
        pyproj.Transformer.from_crs(4979, 4978, always_xy=True).transform(longitude, latitude, height)
    )
    a, b = np.radians([longitude, latitude])
    east, up = (
        np.array([-np.sin(a), np.cos(a), 0]),
        np.array([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)]),
    )
    axes = np.stack([east, np.cross(up, east), up])
    geocentric = center + array(cloud, "positions") @ axes
    geodetic = pyproj.Transformer.from_crs(4978, 4979, always_xy=True).transform(*geocentric.T)
    east, north = pyproj.Proj("EPSG:32615")(geodetic[0], geodetic[1])
    assert np.abs(las.xyz - np.stack([east, north, geodetic[2]], 1)).max() < 0.001


def test_chunks_do_not_show(tmp_path, monkeypatch):
    scene = write_scene(tmp_path, random_cloud(), UTM)
    whole = read(scene)
    monkeypatch.setattr(laz, "POINTS_AT_ONCE", 77)
    assert (read(scene).points.array == whole.points.array).all()


def test_laszip_reads_the_same_points(tmp_path):
    """LASzip is the reference implementation of LAZ."""
    pytest.importorskip("laszip")
    scene = write_scene(tmp_path, random_cloud(), UTM)
    ours = read(scene)
    assert (
        laspy.read(laz.outputs(scene, Export())[0], laz_backend=laspy.LazBackend.Laszip).points.array
        == ours.points.array
    ).all()


def test_without_georeference_there_is_no_crs_and_nothing_moves(tmp_path):
    cloud = random_cloud()
    scene = write_scene(tmp_path, cloud)
    assert laz.write(scene, Export())["crs"].startswith("none")
    las = laspy.read(laz.outputs(scene, Export())[0])
    assert las.header.parse_crs() is None and np.abs(las.xyz - array(cloud, "positions")).max() < 0.00051
    declared = read(scene, Export(epsg=25832))
    assert declared.header.parse_crs().to_epsg() == 25832 and (declared.xyz == las.xyz).all()


@pytest.mark.parametrize("georeference", [UTM, ENU])
def test_a_chosen_crs_moves_the_points(tmp_path, georeference):
    scene = write_scene(tmp_path, random_cloud(), georeference)
    here, there = read(scene), read(scene, Export(epsg=32616))
    assert there.header.parse_crs().to_epsg() == 32616
    longitude, latitude = pyproj.Proj("EPSG:32615")(here.x, here.y, inverse=True)
    expected = pyproj.Proj("EPSG:32616")(longitude, latitude)
    assert np.abs(there.xyz[:, :2] - np.stack(expected, 1)).max() < 0.002 and (there.z == here.z).all()


def test_feet_stay_feet(tmp_path):
    """EPSG:2229 is in US survey feet, heights too."""
    cloud = random_cloud(50)
    georeference = {"epsg": 32611, "offset": [384000.0, 3768000.0, 90.0]}
    feet, meters = (
        read(write_scene(tmp_path, cloud, georeference), Export(epsg=2229)),
        read(write_scene(tmp_path, cloud, georeference)),
    )
    assert np.abs(feet.z * 1200 / 3937 - meters.z).max() < 0.001
    distance = [np.hypot(*np.diff(las.xyz[:2, :2], axis=0)[0]) for las in (feet, meters)]
    assert distance[0] * 1200 / 3937 == pytest.approx(distance[1], rel=1e-3)


def test_chosen_classes_only(tmp_path):
    scene = write_scene(tmp_path, random_cloud(), UTM)
    assert set(np.unique(read(scene, Export(classes=("car", "road"))).classification)) == {64, 11}
    with pytest.raises(InputError, match="no class 'roof'.*building, tree"):
        laz.write(scene, Export(classes=("roof",)))


def test_bad_input_says_what_to_do(tmp_path):
    far = np.zeros((3, 3))
    far[0, 0] = 3e6
    scene = write_scene(tmp_path, labelled_cloud(far, np.ones(3)))
    with pytest.raises(InputError, match="stray points"):
        laz.write(scene, Export())
    with pytest.raises(InputError, match="EPSG:4326.*projected"):
        laz.write(scene, Export(epsg=4326))
    with pytest.raises(InputError, match="class id 7"):
        laz.write(write_scene(tmp_path, labelled_cloud(far, np.full(3, 7))), Export())
    assert not (tmp_path / "export").exists()


def test_a_cloud_without_colors_has_point_format_6(tmp_path):
    las = read(write_scene(tmp_path, random_cloud(colors=False), UTM))
    assert las.header.point_format.id == 6 and "red" not in las.point_format.dimension_names


def test_clouds_together_are_the_cloud(tmp_path):
    cloud = random_cloud()
    scene = write_scene(tmp_path, cloud, UTM)
    figures = clouds.write(scene, Export())
    folder = clouds.outputs(scene, Export())[0]
    names = ["0_unlabelled", "1_building", "2_tree", "3_road", "4_grass_lawn", "9_car"]
    assert sorted(file.stem for file in folder.iterdir()) == names
    parts = [o3d.t.io.read_point_cloud(str(folder / f"{name}.ply")) for name in names]
    order = np.argsort(array(cloud, "label"), kind="stable")
    assert sum(figures["points_by_class"].values()) == len(order)
    for name in cloud.point:
        together = np.concatenate([array(part, name) for part in parts])
        expected = array(cloud, name)[order] + (UTM["offset"] if name == "positions" else 0)
        assert together.dtype == array(cloud, name).dtype
        assert np.abs(together - expected).max() < (1e-6 if name in ("positions", "normals") else 1e-12), name


def test_normals_turn_with_the_grid(tmp_path):
    """Grid north is turned against true north by the meridian convergence."""
    cloud = random_cloud(200)
    scene = write_scene(tmp_path, cloud, ENU)
    clouds.write(scene, Export(classes=("road",)))
    part = o3d.t.io.read_point_cloud(str(clouds.outputs(scene, Export())[0] / "3_road.ply"))
    before, after = array(cloud, "normals")[array(cloud, "label") == 3], array(part, "normals")
    turned = np.degrees(np.angle((after[:, 0] + 1j * after[:, 1]) / (before[:, 0] + 1j * before[:, 1])))
    convergence = (
        pyproj.Proj("EPSG:32615").get_factors(ENU["origin"][1], ENU["origin"][0]).meridian_convergence
    )
    steep = np.hypot(before[:, 0], before[:, 1]) < 0.2  # their direction in plan is uncertain
    assert np.abs(turned[~steep] - convergence).max() < 0.02 and abs(convergence) > 0.5
    assert (
        np.abs(
            array(part, "positions")
            - read_georeference(scene).to_crs(array(cloud, "positions")[array(cloud, "label") == 3])
        ).max()
        < 1e-6
    )


def test_laz_in_parts_holds_what_the_whole_does(tmp_path, monkeypatch):
    scene = write_scene(tmp_path, random_cloud(), UTM)
    for settings in (Export(), Export(classes=("building", "road"))):
        laz.write(scene, settings)
        whole = laz.outputs(scene, settings)[0].read_bytes()
        with monkeypatch.context() as patch:
            patch.setattr("sc3d.exporters.projected_cloud.fits", lambda *_: False)
            patch.setattr("sc3d.io.chunked_clouds.RECORDS_AT_ONCE", 300)
            figures = laz.write(scene, settings)
        las, again = (laspy.read(source) for source in (io.BytesIO(whole), laz.outputs(scene, settings)[0]))
        assert len(las.points) == figures["points"] == len(again.points)
        for name in las.point_format.dimension_names:
            np.testing.assert_array_equal(las[name], again[name], err_msg=name)
        np.testing.assert_array_equal(las.header.offsets, again.header.offsets)


@pytest.mark.parametrize("whole", [True, False])
def test_points_that_no_second_photo_confirms_are_left_out_or_flagged(tmp_path, monkeypatch, whole):
    if not whole:
        monkeypatch.setattr("sc3d.exporters.projected_cloud.fits", lambda *_: False)
    cloud = random_cloud()
    flags = (np.arange(2000) % 3 == 0).astype(np.uint8)
    cloud.point.unconfirmed = o3d.core.Tensor(flags[:, None])
    scene = write_scene(tmp_path, cloud, UTM)
    np.testing.assert_array_equal(read(scene).label, array(cloud, "label")[flags == 0])
    assert not np.array(read(scene).synthetic).any()
    las = read(scene, Export(unconfirmed=True))
    np.testing.assert_array_equal(las.label, array(cloud, "label"))
    np.testing.assert_array_equal(las.synthetic, flags)


@pytest.mark.parametrize("whole", [True, False])
def test_a_cloud_without_any_confirmed_point_is_refused(tmp_path, monkeypatch, whole):
    if not whole:
        monkeypatch.setattr("sc3d.exporters.projected_cloud.fits", lambda *_: False)
    cloud = random_cloud(50)
    cloud.point.unconfirmed = o3d.core.Tensor(np.ones((50, 1), np.uint8))
    with pytest.raises(InputError, match="--unconfirmed"):
        read(write_scene(tmp_path, cloud, UTM))
