"""Where photos say they were taken: wrong, stale, coarse, missing and exchanged positions, in EXIF and XMP; and CRSs
that do not belong to them.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from PIL.ExifTags import GPS, IFD
from PIL.TiffImagePlugin import IFDRational

from sc3d.errors import InputError
from sc3d.geometry.cameras import look_at
from sc3d.georeferencing.alignment import Similarity, fit_similarity
from sc3d.georeferencing.georeference import (
    crs_to_geodetic,
    enu_to_geodetic,
    from_origin,
    geodetic_to_enu,
    projected_crs,
    triple,
)
from sc3d.georeferencing.geotags import Geotag, read_geotag
from sc3d.georeferencing.gps import Flight, agree, find_georeference, place, read_flight
from sc3d.georeferencing.up_direction import Poses, upside_down
from sc3d.synthetic.exif import photo_exif

MELBOURNE = (-37.9042, 144.9886, 20.0)
ROME = (41.9, 12.5, 50.0)
XMP = '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description {}/></rdf:RDF></x:xmpmeta>'


def write_photo(path: Path, position: tuple, xmp: str = "", **changes: object) -> Path:
    """A photo at latitude, longitude, height; `changes` of GPS tags by name, None = leave out."""
    exif = photo_exif(0, np.array(position, float))
    block = exif.get_ifd(IFD.GPSInfo)
    for name, value in changes.items():
        block.pop(GPS[name], None)
        if value is not None:
            block[GPS[name]] = value
    Image.new("RGB", (40, 30)).save(path, exif=exif, **({"xmp": XMP.format(xmp).encode()} if xmp else {}))
    return path


def grid() -> np.ndarray:
    """12 cameras, m, over 60 x 40 m at 60 m, on a slope."""
    x, y = np.meshgrid(np.arange(4) * 20.0, np.arange(3) * 20.0)
    return np.stack([x.ravel(), y.ravel(), 60 + 0.27 * x.ravel()], axis=1)


def names(count: int) -> list[str]:
    return [f"{row:02d}.jpg" for row in range(count)]


def write_flight(
    folder: Path, positions: np.ndarray, wrong: dict[int, tuple], origin: tuple = MELBOURNE
) -> None:
    """Photos at ENU `positions`; `wrong`: shift in degrees and m by row."""
    for row, geodetic in enumerate(enu_to_geodetic(positions, origin)):
        write_photo(
            folder / names(len(positions))[row], tuple(geodetic + np.array(wrong.get(row, (0, 0, 0))))
        )


def no_up() -> np.ndarray:
    raise AssertionError("an area says itself where up is")


def some_frame(positions: np.ndarray) -> dict[str, np.ndarray]:
    """Camera centers as structure from motion may find them, by name."""
    rotation = pycolmap.Rotation3d(np.array([0.4, -1.0, 0.7])).matrix()
    return dict(
        zip(names(len(positions)), Similarity(0.05, rotation, np.array([1.0, 2, 3])).apply(positions))
    )


STALE = (1.5, -2.0, 0.0)


class TestWrongPositions:
    @pytest.mark.parametrize(
        "wrong",
        [
            {},
            {7: STALE},
            {0: STALE},
            {0: STALE, 5: STALE, 11: STALE},
            {0: STALE, 3: (20.0, -30.0, 0.0), 9: (0.0, 35.0, 4000.0)},
            {0: (0.003, 0, 0), 4: (0, -0.002, 0), 8: (0, 0, 90.0)},
            {0: (0.003, 0, 0), 1: (0.003, 0, 0)},
            {0: STALE, 1: (0.003, 0, 0), 2: (0, 0, -95.0)},
        ],
    )
    def test_shape_zone_and_origin_come_from_the_others(self, tmp_path, caplog, wrong):
        write_flight(tmp_path, grid(), wrong)
        flight = read_flight(tmp_path, names(12))
        assert flight is not None
        centers = some_frame(grid())
        agreed = agree(flight, centers)
        assert agreed is not None and agreed.shape == "area" and "line" not in caplog.text
        assert set(agreed.tags) == set(names(12)) - {names(12)[row] for row in wrong}
        fit = place(agreed, centers, no_up)
        assert fit is not None
        found = from_origin(agreed.origin)
        assert found.epsg == 32755
        placed = found.to_crs(fit.apply(np.array(list(centers.values()))))
        np.testing.assert_allclose(placed, from_origin(MELBOURNE).to_crs(grid()), atol=0.01)
        assert np.abs(fit.apply(np.array(list(centers.values())))).max() < 200
        if wrong:
            assert f"GPS of {len(wrong)} of 12 photos is wrong" in caplog.text
        else:
            assert agreed is flight

    def test_all_that_agreed_count(self):
        """No triple of them decides: the fit is that of least squares over all."""
        random, centers = np.random.default_rng(0), some_frame(grid())
        geodetic = enu_to_geodetic(grid() + random.normal(0, 2.0, (12, 3)), MELBOURNE)
        tags = {name: Geotag(triple(row)) for name, row in zip(centers, geodetic, strict=True)}
        flight = Flight(tags, "area", MELBOURNE)
        fit = place(flight, centers, no_up)
        positions = np.array(list(flight.positions.values()))
        best = fit_similarity(np.array(list(centers.values())), positions)
        np.testing.assert_allclose(fit.matrix, best.matrix, atol=1e-6)

    def test_an_imported_model_is_placed_by_the_others(self, tmp_path):
        write_flight(tmp_path, grid(), {0: STALE, 5: (0.003, 0, 0)})
        flight, centers = read_flight(tmp_path, names(12)), some_frame(grid())
        found = find_georeference(flight, centers, no_up, None)
        assert found.epsg == 32755 and found.figures["gps"]["photos"] == 10
        np.testing.assert_allclose(
            found.to_crs(np.array(list(centers.values()))), from_origin(MELBOURNE).to_crs(grid()), atol=0.01
        )

    def test_a_wrong_one_beside_a_line_leaves_it_a_line(self, tmp_path, caplog):
        positions = np.outer(np.arange(12) * 15.0, [0.8, 0.6, 0]) + [0, 0, 50]
        write_flight(tmp_path, positions, {3: (0.002, 0, 0)})
        flight, centers = read_flight(tmp_path, names(12)), some_frame(positions)
        ground = np.random.default_rng(3).uniform(-40, 40, (400, 3)) * [1, 1, 0.01]
        moved = Similarity(
            0.05, pycolmap.Rotation3d(np.array([0.4, -1.0, 0.7])).matrix(), np.array([1.0, 2, 3])
        )
        agreed = agree(flight, centers)
        assert agreed.shape == "line" and flight.shape == "area"
        assert (
            np.ptp(place(agreed, centers, lambda: moved.rotation[:, 2]).apply(moved.apply(ground))[:, 2])
            < 1.5
        )

    def test_long_lines_and_sites_side_by_side_are_no_outliers(self, tmp_path):
        line = np.outer(np.linspace(0, 9000, 40), [0.8, 0.6, 0]) + [0, 0, 80]
        site = np.random.default_rng(0).uniform(-30, 30, (40, 3)) + [0, 0, 80]
        hover = np.concatenate([site[:30] * 0.01, np.outer(np.geomspace(20, 5000, 10), [1.0, 0, 0])])
        two = site + np.outer(np.arange(40) % 2, [3000.0, 0, 0])
        for number, positions in enumerate((line, hover, two)):
            folder = tmp_path / str(number)
            folder.mkdir()
            write_flight(folder, positions, {})
            assert not read_flight(folder, names(40)).astray

    def test_one_place_and_a_stale_fix_give_no_scale(self, tmp_path, caplog):
        write_flight(tmp_path, np.random.default_rng(0).normal(0, 0.3, (12, 3)), {4: STALE})
        assert read_flight(tmp_path, names(12)) is None and "no scale" in caplog.text

    def test_too_many_wrong_ones_place_nothing(self, tmp_path, caplog):
        rng = np.random.default_rng(1)
        wrong = {row: tuple(rng.uniform(-0.01, 0.01, 2)) + (0.0,) for row in range(8)}
        write_flight(tmp_path, grid(), wrong)
        assert agree(read_flight(tmp_path, names(12)), some_frame(grid())) is None
        assert "does not fit the cameras" in caplog.text

    def test_duplicates_of_the_last_position_are_left_out(self, tmp_path):
        positions = grid()
        measured = positions.copy()
        measured[[5, 6, 7]] = measured[4]
        write_flight(tmp_path, measured, {})
        agreed = agree(read_flight(tmp_path, names(12)), some_frame(positions))
        assert set(agreed.tags) == set(names(12)) - {"05.jpg", "06.jpg", "07.jpg"}

    @pytest.mark.parametrize("step", [10.0, 60.0])  # in a small flight half may fit by chance
    def test_exchanged_latitude_and_longitude(self, tmp_path, caplog, step):
        x, y = np.meshgrid(np.arange(4) * step, np.arange(3) * step)
        positions = np.stack([x.ravel(), y.ravel(), np.random.default_rng(0).uniform(50, 90, 12)], axis=1)
        tags = {
            name: Geotag((longitude, latitude, height))
            for name, (latitude, longitude, height) in zip(names(12), enu_to_geodetic(positions, ROME))
        }
        flight = Flight(tags, "area", next(iter(tags.values())).geodetic)
        assert agree(flight, some_frame(positions)) is None and "exchanged" in caplog.text

    def test_a_flight_at_one_height_that_is_mirrored_stands_on_its_head(self):
        rotations = np.array(
            [look_at(np.array([x, y, 60.0]), np.array([x + 5, y, 0]))[:3, :3] for x, y in grid()[:, :2]]
        )
        flat = grid() * [1, 1, 0]
        poses = Poses.from_cameras(rotations, flat)
        assert not upside_down(poses, fit_similarity(flat, flat).rotation[2])
        assert upside_down(poses, fit_similarity(flat, flat[:, [1, 0, 2]]).rotation[2])


class TestFiles:
    @pytest.mark.parametrize(
        "latitude, longitude",
        [
            ("drone-dji:GpsLatitude", "drone-dji:GpsLongitude"),
            ("drone-dji:GpsLatitude", "drone-dji:GpsLongtitude"),
            ("drone:GpsLatitude", "drone:GpsLongitude"),
            ("drone-skydio:Latitude", "drone-skydio:Longitude"),
        ],
    )
    @pytest.mark.parametrize("in_exif", ["seconds", "degrees", "nothing"])
    def test_position_in_xmp_where_exif_is_cut_or_missing(self, tmp_path, latitude, longitude, in_exif):
        place, step = (-37.90435892, 144.98856994, 75.25), {"seconds": 3600, "degrees": 100}.get(in_exif, 1)
        cut = tuple(float(np.trunc(value * step) / step) for value in place[:2])
        prefix = latitude.split(":")[0]
        xmp = f'{latitude}="{place[0]:+.8f}" {longitude}="{place[1]:+.8f}" {prefix}:AbsoluteAltitude="{place[2]:+.3f}"'
        changes = (
            {} if in_exif != "nothing" else {"GPSLatitude": None, "GPSLongitude": None, "GPSAltitude": None}
        )
        tag = read_geotag(write_photo(tmp_path / "a.jpg", (*cut, 75.0), xmp, **changes))
        np.testing.assert_allclose(tag.geodetic, place, atol=1e-7)

    def test_positions_that_were_corrected_in_exif_stay(self, tmp_path):
        place = (-37.90435892, 144.98856994, 75.123)
        xmp = 'drone-dji:GpsLatitude="-37.9043720" drone-dji:GpsLongitude="+144.9885500" drone-dji:AbsoluteAltitude="+74.100"'
        tag = read_geotag(write_photo(tmp_path / "a.jpg", place, xmp))
        np.testing.assert_allclose(tag.geodetic, place, atol=1e-7)

    def test_position_in_the_xmp_of_a_photo_editor(self, tmp_path):
        xmp = 'exif:GPSLatitude="46,50.5614N" exif:GPSLongitude="91,59.6658W" exif:GPSAltitude="1986/10" exif:GPSAltitudeRef="1"'
        gone = dict.fromkeys(("GPSLatitude", "GPSLongitude", "GPSAltitude"))
        tag = read_geotag(write_photo(tmp_path / "a.jpg", MELBOURNE, xmp, **gone))
        np.testing.assert_allclose(tag.geodetic, (46 + 50.5614 / 60, -91 - 59.6658 / 60, -198.6), atol=1e-9)

    @pytest.mark.parametrize(
        "xmp, deviation, rtk",
        [
            (
                'drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.01" drone-dji:RtkStdLat="0.02" drone-dji:RtkStdHgt="0.03"',
                (0.01, 0.02, 0.03),
                True,
            ),
            ('drone-dji:RtkFlag="34"', None, True),
            ('drone-dji:RtkFlag="16"', None, False),  # without a reference station
            (
                'drone-dji:RtkStdLon="9999" drone-dji:RtkStdLat="9999" drone-dji:RtkStdHgt="9999"',
                None,
                False,
            ),
            ('Camera:GPSXYAccuracy="1/20" Camera:GPSZAccuracy="0.1"', (0.05, 0.05, 0.1), False),
        ],
    )
    def test_stated_accuracy(self, tmp_path, xmp, deviation, rtk):
        tag = read_geotag(write_photo(tmp_path / "a.jpg", MELBOURNE, xmp))
        assert tag.deviation == deviation and tag.rtk == rtk

    @pytest.mark.parametrize("reference, sign", [(b"\0", 1), (b"\1", -1), (b"\2", 1), (b"\3", -1)])
    def test_altitude_references(self, tmp_path, reference, sign):
        tag = read_geotag(write_photo(tmp_path / "a.jpg", MELBOURNE, GPSAltitudeRef=reference))
        assert tag.geodetic[2] == sign * 20

    @pytest.mark.parametrize(
        "parts, angle",
        [
            ((IFDRational(3790420, 100000),) * 1, -37.9042),
            ((IFDRational(37, 1), IFDRational(54252, 1000)), -37.9042),
            ((IFDRational(37, 1), IFDRational(54, 1), IFDRational(1512, 100)), -37.9042),
        ],
    )
    def test_degrees_and_minutes_with_fractions(self, tmp_path, parts, angle):
        tag = read_geotag(write_photo(tmp_path / "a.jpg", MELBOURNE, GPSLatitude=parts))
        assert tag.geodetic[0] == pytest.approx(angle, abs=1e-9)

    @pytest.mark.parametrize(
        "changes, word",
        [
            ({"GPSAltitude": None}, "without an altitude"),
            ({"GPSAltitude": IFDRational(0, 0)}, "without an altitude"),
            ({"GPSLatitude": (IFDRational(0, 0),) * 3}, None),
            (
                {"GPSLatitude": (IFDRational(144, 1), IFDRational(59, 1), IFDRational(0, 1))},
                "not on Earth",
            ),
            (
                {name: (IFDRational(0, 1),) * 3 for name in ("GPSLatitude", "GPSLongitude")},
                "latitude 0, longitude 0",
            ),
        ],
    )
    def test_what_cannot_be_used_is_counted_and_named(self, tmp_path, caplog, changes, word):
        write_flight(tmp_path, grid(), {})
        write_photo(tmp_path / "02.jpg", MELBOURNE, **changes)
        with caplog.at_level(logging.WARNING):
            flight = read_flight(tmp_path, names(12))
        assert len(flight.tags) == 11 and "11 of 12 photos have GPS" in caplog.text
        assert word is None or (word in caplog.text and "02.jpg" in caplog.text)

    @pytest.mark.parametrize("altitude", [4294967295, 65535, 99999, 20001, -501, -9999, -32768])
    def test_altitudes_that_cannot_be_are_none(self, tmp_path, caplog, altitude):
        write_flight(tmp_path, grid(), {})
        stated = {"GPSAltitude": IFDRational(abs(altitude), 1), "GPSAltitudeRef": bytes([altitude < 0])}
        for name in names(12)[2:4]:
            write_photo(tmp_path / name, MELBOURNE, **stated)
        flight = read_flight(tmp_path, names(12))
        assert len(flight.tags) == 10
        assert "10 of 12 photos have GPS" in caplog.text
        assert "2 with an altitude that no photo has: 02.jpg, 03.jpg" in caplog.text
        # what XMP says instead counts, unless that cannot be either
        xmp = 'drone-dji:AbsoluteAltitude="{}" drone-dji:RelativeAltitude="-9999"'
        found = [
            read_geotag(write_photo(tmp_path / "a.jpg", MELBOURNE, xmp.format(height), **stated))
            for height in ("75.5", "+4294967.3")
        ]
        assert found[0].geodetic[2] == 75.5 and found[0].above_takeoff is None and found[1] is None
        # and it does not replace what EXIF says
        right = write_photo(tmp_path / "b.jpg", MELBOURNE, xmp.format(altitude))
        assert read_geotag(right).geodetic[2] == 20

    @pytest.mark.parametrize("altitude", [-430, 8849, 12000, 0])
    def test_altitudes_from_the_dead_sea_to_an_airplane(self, tmp_path, altitude):
        photo = write_photo(tmp_path / "a.jpg", (*MELBOURNE[:2], float(altitude)))
        assert read_geotag(photo).geodetic[2] == altitude

    def test_a_flight_of_which_no_altitude_can_be_says_so(self, tmp_path, caplog):
        write_flight(tmp_path, grid(), {})
        for name in names(12):
            write_photo(tmp_path / name, MELBOURNE, GPSAltitude=IFDRational(4294967295, 1))
        assert read_flight(tmp_path, names(12)) is None
        assert "12 with an altitude that no photo has: 00.jpg" in caplog.text

    def test_positions_cut_to_seconds_are_said_to_be_coarse(self, tmp_path, caplog):
        positions = grid() * [8, 8, 1]
        for name, (latitude, longitude, height) in zip(names(12), enu_to_geodetic(positions, MELBOURNE)):
            cut = [float(np.trunc(value * 3600) / 3600) for value in (latitude, longitude)]
            write_photo(tmp_path / name, (*cut, height))
        flight = read_flight(tmp_path, names(12))
        assert "cut to steps of 31 m" in caplog.text
        # not one of them is an outlier for that
        assert agree(flight, some_frame(positions)) is flight

    def test_whole_degrees_give_no_scale(self, tmp_path, caplog):
        for name in names(12):
            write_photo(tmp_path / name, (-38.0, 145.0, 75.3))
        assert read_flight(tmp_path, names(12)) is None and "no scale" in caplog.text


class TestCrs:
    def test_compound_crs_is_refused_with_its_horizontal_part(self):
        with pytest.raises(InputError, match=r"EPSG:27700\b"):
            projected_crs(7405)

    @pytest.mark.parametrize("epsg", [27700, 2056, 32633])
    def test_crs_of_another_country_is_refused(self, epsg):
        with pytest.raises(InputError, match=f"EPSG:{epsg}"):
            from_origin(MELBOURNE, epsg)

    def test_neighboring_zone_is_used_with_a_warning(self, caplog):
        assert from_origin(MELBOURNE, 32754).epsg == 32754 and "outside" in caplog.text

    def test_crs_that_stretches_is_said_so(self, caplog):
        assert from_origin(MELBOURNE, 3857).epsg == 3857 and "27 %" in caplog.text

    @pytest.mark.parametrize("longitude", [179.5, -179.5])
    def test_area_across_the_date_line(self, caplog, longitude):
        from_origin((-17.0, longitude, 0.0), 3460)
        assert "outside" not in caplog.text

    @pytest.mark.parametrize(
        "crs, plane, height",
        [
            ("EPSG:26915+6360", 1.0, 1200 / 3937),
            ("EPSG:26915+8228", 1.0, 0.3048),
            ("EPSG:26915", 1.0, 1.0),
            ("EPSG:2232", 1200 / 3937, 1200 / 3937),
            ("EPSG:2232+5703", 1200 / 3937, 1.0),
            ("+proj=utm +zone=15 +datum=WGS84 +vunits=us-ft +type=crs", 1.0, 1200 / 3937),
            ("EPSG:4326+6360", None, 1200 / 3937),
            ("EPSG:4979", None, 1.0),
        ],
    )
    def test_heights_are_in_their_own_unit(self, crs, plane, height):
        import pyproj

        start = [500000.0, 5000000.0] if plane else [-93.0, 45.0]
        if plane and plane < 1:
            start = [3000000.0, 1700000.0]
        points = np.array([[*start, 0.0], [*start, 100.0]])
        geodetic = crs_to_geodetic(points, pyproj.CRS(crs))
        assert geodetic[1, 2] - geodetic[0, 2] == pytest.approx(100 * height)
        if plane:
            east = crs_to_geodetic(points + [1000.0, 0, 0], pyproj.CRS(crs))
            length = np.linalg.norm(geodetic_to_enu(east, tuple(geodetic[0]))[0])
            assert length == pytest.approx(1000 * plane, rel=2e-3)
