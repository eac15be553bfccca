"""Ground control points as people have them: lists of many editors, handheld GPS, wrong marks, missing heights; and
what is kept where they do not fit.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, look_at
from sc3d.georeferencing.alignment import Similarity, fit_similarity
from sc3d.georeferencing.control_fit import fit_upright, fit_weighted
from sc3d.georeferencing.control_points import (
    ControlPoints,
    align_to_control_points,
    check_control_points,
    drop_wrong_marks,
    read_control_points,
    transform,
)
from sc3d.georeferencing.georeference import enu_to_geodetic, from_origin, geodetic_to_enu, read_georeference
from sc3d.georeferencing.placement import georeference_control_points
from sc3d.georeferencing.up_direction import find_up, model_poses
from sc3d.io.colmap import load_model, registered_images, write_model
from sc3d.scene.scene import Scene
from tests.georeferencing.test_georeference import build_model, fly, pinhole_view, pixels_of, site

ORIGIN = (46.84269, -91.99443, 200.0)
SHIFT = Similarity(0.1, pycolmap.Rotation3d(np.array([0.4, -1.0, 0.7])).matrix(), np.array([9.0, 8, 7]))
# on ground with a slope of 8 degrees
SURVEYED = np.array(
    [
        [x, y, 0.14 * x]
        for x, y in [(-18, -14), (19, -12), (-15, 15), (16, 14), (1, 2), (-2, -13), (9, -3), (-9, 4)]
    ]
)


def control(measured: np.ndarray, views: list[View], level: bool = False) -> ControlPoints:
    """Control points that the photos show at SURVEYED, and that were measured at ENU `measured`."""
    geodetic = enu_to_geodetic(measured, ORIGIN)
    if level:
        geodetic[:, 2] = 0
    return ControlPoints(
        [f"gcp{row:02d}" for row in range(len(measured))],
        geodetic,
        [pixels_of(point, views) for point in SURVEYED[: len(measured)]],
        None,
    )


def centers_crs(model: pycolmap.Reconstruction, origin: tuple) -> np.ndarray:
    centers = {image.name: image.projection_center() for image in registered_images(model)}
    return from_origin(origin, 32615).to_crs(np.array([centers[f"{row}.jpg"] for row in range(len(centers))]))


def true_crs(views: list[View]) -> np.ndarray:
    return from_origin(ORIGIN, 32615).to_crs(np.array([view.center for view in views]))


def moved_model(views: list[View]) -> pycolmap.Reconstruction:
    model = build_model(views, site())
    transform(model, SHIFT)
    return model


class TestHandheldGps:
    NOISE = np.random.default_rng(5).normal(0, 1.0, (8, 3)) * [1, 1, 2.0]

    def test_points_worse_than_the_cameras_fit_as_well_as_they_are(self, caplog):
        views = fly(6)
        model = moved_model(views)
        figures = align_to_control_points(model, control(SURVEYED + self.NOISE, views))
        assert figures["left_out"] == 0 and 0.5 < figures["rms_horizontal"] < 1.6
        horizontal, vertical = figures["accuracy_horizontal_vertical_m"]
        assert 0.5 < horizontal < 2 and 0.7 < vertical < 4
        assert figures["leave_one_out_rms"] > figures["rms"]
        assert "fit to" in caplog.text and "keep their shape" in caplog.text
        # the cameras are not bent onto them: the model is the true one but for a similarity
        assert model.compute_mean_reprojection_error() < 1e-6
        errors = np.linalg.norm(
            centers_crs(model, control(SURVEYED + self.NOISE, views).origin) - true_crs(views), axis=1
        )
        assert errors.max() < 4

    def test_one_wrong_point_is_named_with_its_distance(self, caplog):
        views = fly(6)
        measured = SURVEYED + 0.5 * self.NOISE
        measured[4] += [9.0, -5, 0]
        figures = align_to_control_points(moved_model(views), control(measured, views))
        assert list(figures["residuals_left_out"]) == ["gcp04"] and "gcp04 (" in caplog.text
        assert 8 < np.linalg.norm(figures["residuals_left_out"]["gcp04"]["east_north_up_m"][:2]) < 13
        assert all(row["leave_one_out_m"] > 0 for row in figures["residuals"].values())

    def test_a_point_in_another_country_does_not_move_the_origin(self):
        measured = SURVEYED.copy()
        measured[0] += [0, -400_000.0, 5000.0]
        views = fly(6)
        points = control(measured, views)
        assert np.abs(geodetic_to_enu(np.array([points.origin]), ORIGIN)).max() < 30
        model = moved_model(views)
        figures = align_to_control_points(model, points)
        assert list(figures["residuals_left_out"]) == ["gcp00"]
        np.testing.assert_allclose(centers_crs(model, points.origin), true_crs(views), atol=0.05)

    def test_given_accuracy_decides_what_is_wrong(self, caplog):
        views = fly(6)
        measured = SURVEYED + 0.5 * self.NOISE
        measured[4] += [4.0, -3, 0]
        model = moved_model(views)
        figures = align_to_control_points(model, control(measured, views), accuracy=(3.0, 5.0))
        assert figures["left_out"] == 0 and figures["accuracy_horizontal_vertical_m"] == [3.0, 5.0]
        assert model.compute_mean_reprojection_error() < 1e-6
        # as good as the cameras after all: they are bent onto them
        exact = align_to_control_points(moved_model(views), control(SURVEYED, views), accuracy=(0.02, 0.03))
        assert exact["rms"] < 1e-3

    @pytest.mark.parametrize("noise", [0.0, 1.0])
    def test_heights_that_are_all_zero_leave_up_to_the_cameras(self, caplog, noise):
        views = fly(1.0)
        model = moved_model(views)
        figures = align_to_control_points(model, control(SURVEYED + noise * self.NOISE, views, level=True))
        assert figures["up_from_cameras"] and "heights are all 0" in caplog.text
        assert find_up(model_poses(model, None), site()).up[2] > 0.999
        # level cameras stay level, though the points lie on a slope
        assert np.ptp([image.projection_center()[2] for image in registered_images(model)]) < 3
        points = np.array([model.point3D(point_id).xyz for point_id in sorted(model.point3D_ids())])
        assert np.std(points[:, 2] - site()[:, 2]) < 0.5 + noise

    def test_heights_of_no_worth_are_not_used(self):
        views = fly(1.0)
        measured = SURVEYED + self.NOISE * [0.2, 0.2, 25]
        figures = align_to_control_points(moved_model(views), control(measured, views), accuracy=(0.5, 50.0))
        assert figures["up_from_cameras"] and figures["rms"] < 0.6

    def test_equal_heights_of_level_ground_are_believed(self):
        views = fly(6)
        level = SURVEYED * [1, 1, 0]
        points = ControlPoints(
            [f"p{row}" for row in range(8)],
            enu_to_geodetic(level, ORIGIN),
            [pixels_of(point, views) for point in level],
            None,
        )
        figures = align_to_control_points(moved_model(views), points)
        assert not figures["up_from_cameras"] and figures["rms"] < 1e-3

    def test_nothing_fits(self):
        views = fly(6)
        measured = np.random.default_rng(2).uniform(-20, 20, (8, 3))
        model = moved_model(views)
        before = [image.projection_center() for image in registered_images(model)]
        with pytest.raises(InputError, match=r"do not fit the model: .*gcp0\d \d"):
            align_to_control_points(model, control(measured, views))
        np.testing.assert_array_equal(
            before, [image.projection_center() for image in registered_images(model)]
        )

    @pytest.mark.parametrize("level", [False, True])
    def test_exchanged_east_and_north_are_said_to_be(self, level):
        views = fly(6)
        points = control((SURVEYED + 0.3 * self.NOISE)[:, [1, 0, 2]], views, level)
        with pytest.raises(InputError, match="x and y exchanged|order x y"):
            align_to_control_points(moved_model(views), points)

    def test_weighted_and_upright_fits_are_exact_on_exact_points(self):
        source = np.random.default_rng(0).uniform(-20, 20, (7, 3))
        rotation = pycolmap.Rotation3d(np.array([0.1, -0.2, 2.0])).matrix()
        true = Similarity(2.5, rotation, np.array([5.0, -6, 7]))
        for accuracy in (None, (1.0, 3.0)):
            np.testing.assert_allclose(
                fit_weighted(source, true.apply(source), accuracy).matrix, true.matrix, atol=1e-9
            )
        found = fit_upright(source, true.apply(source), rotation[2])
        np.testing.assert_allclose(found.matrix, true.matrix, atol=1e-9)

    def test_poor_heights_weigh_less(self):
        rng = np.random.default_rng(3)
        source = rng.uniform(-20, 20, (12, 3)) * [1, 1, 0.2]
        errors = {True: [], False: []}
        for _ in range(40):
            target = source + rng.normal(0, 1, (12, 3)) * [0.05, 0.05, 3.0]
            for given in errors:
                fit = fit_weighted(source, target, (0.05, 3.0) if given else (1.0, 1.0))
                errors[given].append(np.linalg.norm(fit.apply(source)[:, :2] - source[:, :2]))
        assert np.mean(errors[True]) < 0.8 * np.mean(errors[False])


FEET = 1 / 0.3048
GROUND = {
    "flat": lambda x, y: 0.02 * np.sin(x),
    "gentle": lambda x, y: np.sin(x / 6) * np.cos(y / 7),
    "slope": lambda x, y: np.tan(np.radians(10)) * x + 0.05 * np.sin(y),
    "hilly": lambda x, y: 4 * np.sin(x / 7 + 1) + 3 * np.cos(y / 5),
}
# (-18, -14) to (16, 14), then inside
PLACES = np.array(
    [
        (-18, -14),
        (19, -12),
        (-15, 15),
        (16, 14),
        (2, 5),
        (-2, -13),
        (9, -3),
        (-9, 4),
        (12, 6),
        (-17, 1),
        (3, 13),
        (-7, -6),
    ],
    float,
)


def oblique() -> list[View]:
    """12 views around the site, 45 degrees down."""
    turn = np.arange(12) * np.pi / 6
    centers = np.column_stack([40 * np.cos(turn), 40 * np.sin(turn), np.full(12, 40.0)])
    return [
        pinhole_view(f"{row}.jpg", (640, 480), (420, 420, 320, 240), look_at(center, np.zeros(3), (0, 0, 1)))
        for row, center in enumerate(centers)
    ]


class TestHeights:
    """Heights that are in another unit, fillers or none, over several kinds of ground, by few points and many."""

    def place(self, views, ground, count, change, noise=0.01):
        """Tilt in degrees, height error in m of the cameras, figures; `change` of heights (count,) in m."""
        surveyed = np.column_stack([PLACES, GROUND[ground](*PLACES.T)])[:count]
        measured = surveyed + np.random.default_rng(4).normal(0, noise, surveyed.shape) * [1, 1, 2]
        geodetic = enu_to_geodetic(measured, ORIGIN)
        geodetic[:, 2] = change(geodetic[:, 2])
        names = [f"gcp{row:02d}" for row in range(count)]
        points = ControlPoints(names, geodetic, [pixels_of(point, views) for point in surveyed], None)
        model = moved_model(views)
        figures = georeference_control_points(model, points, 32615).figures["control_points"]
        centers = {image.name: image.projection_center() for image in registered_images(model)}
        placed = geodetic_to_enu(
            enu_to_geodetic(np.array([centers[view.name] for view in views]), points.origin), ORIGIN
        )
        true = np.array([view.center for view in views])
        found = fit_similarity(true, placed)
        assert found.scale == pytest.approx(1, abs=5e-3)
        return np.degrees(np.arccos(found.rotation[2, 2])), abs((placed - true)[:, 2].mean()), figures

    @pytest.mark.parametrize("views", [lambda: fly(2), oblique])
    @pytest.mark.parametrize("count", [4, 12])
    @pytest.mark.parametrize("ground", GROUND)
    def test_right_heights_stay(self, caplog, views, count, ground):
        tilt, height, figures = self.place(views(), ground, count, lambda heights: heights)
        assert tilt < 0.12 and height < 0.05 and figures["left_out"] == 0
        assert figures["height_unit"] == "as given" and figures["heights_not_used"] == []
        assert not caplog.text

    @pytest.mark.parametrize("views", [lambda: fly(2), oblique])
    @pytest.mark.parametrize(
        "count, ground", [(4, "slope"), (4, "hilly"), (12, "gentle"), (12, "slope"), (12, "hilly")]
    )
    def test_feet(self, caplog, views, count, ground):
        tilt, height, figures = self.place(views(), ground, count, lambda heights: heights * FEET)
        assert tilt < 0.12 and height < 0.05 and figures["left_out"] == 0
        assert figures["height_unit"] == "feet" and figures["rms_vertical"] < 0.05
        assert "heights are 3.2" in caplog.text and "taken for feet" in caplog.text

    @pytest.mark.parametrize("count", [4, 12])
    def test_meters_where_the_crs_has_feet(self, caplog, count):
        tilt, height, figures = self.place(fly(2), "hilly", count, lambda heights: heights * 0.3048)
        assert tilt < 0.12 and height < 0.05 and figures["left_out"] == 0
        assert "heights are 0.3" in caplog.text and "taken for meters" in caplog.text

    def test_poor_heights_are_not_taken_for_another_unit(self):
        for ground in ("flat", "gentle"):
            for count in (5, 8, 12):
                _, _, figures = self.place(fly(2), ground, count, lambda heights: heights.round(), 0.1)
                assert figures["height_unit"] == "as given" and figures["heights_not_used"] == []

    @pytest.mark.parametrize("views", [lambda: fly(2), oblique])
    @pytest.mark.parametrize("filler", [0.0, -9999.0, 4294967295.0])
    @pytest.mark.parametrize("real", [1, 3, 6])
    @pytest.mark.parametrize("ground", ["slope", "hilly"])
    def test_fillers_count_horizontally_only(self, caplog, views, filler, real, ground):
        tilt, height, figures = self.place(
            views(), ground, 12, lambda heights: np.where(np.arange(12) < real, heights, filler)
        )
        assert figures["left_out"] == 0 and figures["points"] == 12 and height < 0.3
        assert figures["up_from_cameras"] == (real == 1)
        assert tilt < (2.0 if real == 1 else 0.12)  # cameras may be askew
        assert figures["heights_not_used"] == [f"gcp{row:02d}" for row in range(real, 12)]
        assert f"heights of {12 - real} of 12 are {filler:g}, which is no measurement" in caplog.text

    def test_a_measurement_for_all_others_that_the_ground_contradicts(self, caplog):
        tilt, _, figures = self.place(
            fly(2), "hilly", 12, lambda heights: np.where(np.arange(12) == 2, heights, 187.0)
        )
        assert tilt < 2 and figures["left_out"] == 0 and len(figures["heights_not_used"]) == 11
        assert "up comes from the cameras" in caplog.text

    def test_no_height_that_can_be_one(self, caplog):
        tilt, _, figures = self.place(fly(2), "hilly", 12, lambda heights: np.full(12, -9999.0))
        assert tilt < 2 and figures["up_from_cameras"] and len(figures["heights_not_used"]) == 12

    def test_half_fillers_among_feet(self, caplog):
        tilt, height, figures = self.place(
            fly(2), "hilly", 12, lambda heights: np.where(np.arange(12) % 2, heights * FEET, 0)
        )
        assert tilt < 0.2 and height < 0.3 and figures["height_unit"] == "feet"
        assert len(figures["heights_not_used"]) == 6

    def test_equal_heights_among_right_ones_count(self):
        # whole meters, of which some are the same
        _, _, figures = self.place(fly(2), "hilly", 12, np.round)
        assert figures["left_out"] == 0 and figures["heights_not_used"] == []


class TestExchanged:
    @pytest.mark.parametrize("views", [lambda: fly(2), oblique])
    @pytest.mark.parametrize("ground", GROUND)
    @pytest.mark.parametrize("count", [4, 12])
    def test_coordinates(self, views, ground, count):
        surveyed = np.column_stack([PLACES, GROUND[ground](*PLACES.T)])[:count]
        points = ControlPoints(
            [f"gcp{row:02d}" for row in range(count)],
            enu_to_geodetic(surveyed[:, [1, 0, 2]], ORIGIN),
            [pixels_of(point, views()) for point in surveyed],
            None,
        )
        with pytest.raises(InputError, match="with x and y exchanged they fit: the order is x y"):
            align_to_control_points(moved_model(views()), points)

    @pytest.mark.parametrize("header", ["EPSG:32615", "EPSG:26991", "WGS84 UTM 15N"])
    def test_northing_first_outside_the_crs_is_read_so(self, tmp_path, caplog, header):
        import pyproj

        crs = pyproj.CRS.from_epsg(26991 if "26991" in header else 32615)
        place = from_origin(ORIGIN, crs.to_epsg()).to_crs(SURVEYED)
        for name, order in (("right", [0, 1, 2]), ("exchanged", [1, 0, 2])):
            rows = [
                [*position[order], 10 + row, 20, "a.jpg", f"p{row}"] for row, position in enumerate(place)
            ]
            text = "\n".join("\t".join(map(str, row)) for row in rows)
            (tmp_path / f"{name}.txt").write_text(f"{header}\n{text}\n")
        right = read_control_points(tmp_path / "right.txt", ["a.jpg"])
        assert not caplog.text
        exchanged = read_control_points(tmp_path / "exchanged.txt", ["a.jpg"])
        np.testing.assert_allclose(exchanged.geodetic, right.geodetic)
        assert "x and y are exchanged" in caplog.text and "read so" in caplog.text

    @pytest.mark.parametrize("kind, words", [("exchanged", "column, row"), ("upwards", "runs downwards")])
    @pytest.mark.parametrize("views", [lambda: fly(6), oblique])
    def test_pixels(self, kind, words, views):
        points = control(SURVEYED, views())
        for seen in points.observations:
            for photo, pixel in seen.items():
                seen[photo] = pixel[[1, 0]] if kind == "exchanged" else np.array([pixel[0], 480 - pixel[1]])
        with pytest.raises(InputError, match=f"do not meet, but would with .*{words}"):
            align_to_control_points(moved_model(views()), points)

    def test_pixels_outside_their_photos(self):
        points = control(SURVEYED, views := fly(6))
        for seen in points.observations:
            for photo, pixel in seen.items():
                seen[photo] = pixel[[1, 0]]
        with pytest.raises(InputError, match=r"outside their photos .* exchanged all lie inside"):
            check_control_points(points, {view.name: (640, 480) for view in views}, None)


class TestMarks:
    def test_a_wrong_mark_is_left_out_and_its_point_kept(self, caplog):
        views = fly(6)
        points = control(SURVEYED, views)
        photo = next(iter(points.observations[4]))
        points.observations[4][photo] = points.observations[4][photo] + [120.0, -60]
        figures = align_to_control_points(moved_model(views), points)
        assert f"gcp04 in {photo}" in caplog.text and figures["rms"] < 1e-3 and figures["points"] == 8

    def test_marks_that_cannot_tell_take_their_point_with_them(self, caplog):
        views = fly(6)
        points = control(SURVEYED, views)
        two = dict(list(points.observations[4].items())[:2])
        first = next(iter(two))
        points.observations[4].clear()
        points.observations[4].update(two | {first: two[first] + [150.0, 0], "gone.jpg": np.zeros(2)})
        kept = drop_wrong_marks(moved_model(views), points)
        assert (
            kept.observations[4] == {}
            and "do not meet in one place" in caplog.text
            and "gcp04" in caplog.text
        )

    def test_before_hours_of_work(self, caplog):
        views = fly(6)
        points, sizes = control(SURVEYED, views), {view.name: (640, 480) for view in views}
        check_control_points(points, sizes, ORIGIN)
        with pytest.raises(InputError, match=r"marks .* outside their photos .*320 x 240"):
            check_control_points(points, {view.name: (320, 240) for view in views}, None)
        assert "km from the GPS" not in caplog.text
        check_control_points(points, sizes, (48.1, 11.5, 500.0))
        assert "km from the GPS" in caplog.text


LINES = {
    "tabs": "EPSG:32615\n{e}\t{n}\t{h}\t{x}\t{y}\t{photo}\t{name}\textra\t7\n",
    "tabs, CRLF, BOM": "\ufeffEPSG:32615\t\r\n# a comment\r\n\r\n{e}\t{n}\t{h}\t{x}\t{y}\t{photo}\t{name}\r\n",
    "blanks": "EPSG:32615\n{e} {n} {h} {x} {y} {photo} {name}\n",
    "quotes": 'EPSG:32615\n{e} {n} {h} {x} {y} "{photo}" {name}\n',
    "commas": "EPSG:32615\nx,y,z,px,py,photo,name\n{e},{n},{h},{x},{y},{photo},{name}\n",
    "semicolons": "EPSG:32615;\n{e};{n};{h};{x};{y};{photo};{name}\n",
    "Windows path": "EPSG:32615\n{e}\t{n}\t{h}\t{x}\t{y}\tD:\\photos of May\\{photo}\t{name}\n",
    "title": "EPSG:32615\ngeo_x\tgeo_y\tgeo_z\tim_x\tim_y\timage_name\tgcp_name\n{e}\t{n}\t{h}\t{x}\t{y}\t{photo}\t{name}\n",
}


class TestLists:
    PHOTOS = [f"2026-11-29 10-15-00 view_{row}.jpg" for row in range(3)]

    def write(self, path: Path, text: str, comma: bool = False, change: str = "") -> Path:
        *head, line = text.splitlines(keepends=True)
        rows = []
        for number, (east, north) in enumerate([(0, 0), (10, 0), (0, 10), (10, 10)]):
            for column, photo in enumerate(self.PHOTOS):
                values = {
                    "e": f"{576000.25 + east}",
                    "n": f"{5188000.5 + north}",
                    "h": "300.125",
                    "x": f"{100.5 + column}",
                    "y": f"{90.25 + number}",
                }
                values = {key: value.replace(".", ",") if comma else value for key, value in values.items()}
                rows.append(
                    line.format(
                        photo=getattr(photo, change)() if change else photo, name=f"gcp {number}", **values
                    )
                )
        path.write_bytes("".join(head + rows).encode())
        return path

    @pytest.mark.parametrize(
        "kind, comma",
        [(kind, False) for kind in LINES] + [(kind, True) for kind in ("tabs", "blanks", "semicolons")],
    )
    def test_separators(self, tmp_path, kind, comma):
        points = read_control_points(self.write(tmp_path / "gcp_list.txt", LINES[kind], comma), self.PHOTOS)
        assert points.names == [f"gcp {row}" for row in range(4)] and points.epsg == 32615
        assert all(list(seen) == self.PHOTOS for seen in points.observations)
        np.testing.assert_allclose(points.observations[2][self.PHOTOS[1]], [102.0, 92.75])
        placed = geodetic_to_enu(points.geodetic, points.origin)
        np.testing.assert_allclose(np.ptp(placed[:, :2], axis=0), 10, atol=0.35)
        np.testing.assert_allclose(points.geodetic[:, 2], 300.125)

    @pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "cp1252"])
    def test_encodings(self, tmp_path, encoding):
        path = self.write(tmp_path / "gcp_list.txt", LINES["tabs"])
        path.write_bytes(("EPSG:32615\n# Höhe\n" + path.read_text().partition("\n")[2]).encode(encoding))
        assert len(read_control_points(path, self.PHOTOS).names) == 4

    def test_photos_in_other_case(self, tmp_path):
        path = self.write(tmp_path / "gcp_list.txt", LINES["tabs"], change="upper")
        assert list(read_control_points(path, self.PHOTOS).observations[0]) == self.PHOTOS

    def test_names_of_two_photos_are_told_apart_by_their_folder(self, tmp_path):
        photos = [f"{folder}/{name}" for folder in ("100MEDIA", "101MEDIA") for name in self.PHOTOS]
        path = self.write(tmp_path / "gcp_list.txt", LINES["tabs"])
        with pytest.raises(InputError, match=r"line 2: .* may be 100MEDIA/.* or 101MEDIA/"):
            read_control_points(path, photos)
        path = self.write(tmp_path / "gcp_list.txt", LINES["tabs"].replace("{photo}", "101MEDIA/{photo}"))
        assert list(read_control_points(path, photos).observations[0]) == photos[3:]

    def test_a_second_mark_in_the_same_photo_is_said(self, tmp_path, caplog):
        path = self.write(tmp_path / "gcp_list.txt", LINES["tabs"])
        last = path.read_text().splitlines()[-1]
        path.write_text(path.read_text() + last.replace("93.25", "17.5") + "\n")
        points = read_control_points(path, self.PHOTOS)
        assert "twice" in caplog.text and points.observations[3][self.PHOTOS[2]][1] == 93.75

    @pytest.mark.parametrize(
        "header, epsg, height",
        [
            ("EPSG:26915+6360", 26915, 0.3048006096),
            ("EPSG:26915", 26915, 1.0),
            ("+proj=utm +zone=15 +datum=NAD83 +units=m +vunits=us-ft +no_defs", 26915, 0.3048006096),
            ("WGS 84 / UTM zone 15N", 32615, 1.0),
        ],
    )
    def test_units_of_heights(self, tmp_path, header, epsg, height):
        path = self.write(tmp_path / "gcp_list.txt", LINES["tabs"].replace("EPSG:32615", header))
        points = read_control_points(path, self.PHOTOS)
        assert points.epsg == epsg
        np.testing.assert_allclose(points.geodetic[:, 2], 300.125 * height, rtol=1e-9)

    def test_exchanged_degrees_lie_outside(self, tmp_path):
        text = "EPSG:4326\n" + "".join(
            f"46.84{row}\t-91.99{row}\t0\t1\t2\t{self.PHOTOS[0]}\tp{row}\n" for row in range(3)
        )
        (tmp_path / "gcp_list.txt").write_text(text)
        with pytest.raises(InputError, match="longitude, latitude"):
            read_control_points(tmp_path / "gcp_list.txt", self.PHOTOS)

    def test_a_line_without_numbers_further_down_is_refused(self, tmp_path):
        path = self.write(tmp_path / "gcp_list.txt", LINES["tabs"])
        path.write_text(path.read_text() + "these are all\n")
        with pytest.raises(InputError, match="line 14"):
            read_control_points(path, self.PHOTOS)


class TestKept:
    """A model that took hours stays, whatever the control points say. Mapping is replaced by a model made here."""

    @pytest.fixture
    def flown(self, tmp_path, monkeypatch):
        views, calls = fly(6), []

        def map_photos(images, names, output, settings):
            calls.append(settings)
            write_model(output, moved_model(views))
            return {"photos": len(names), "registered": len(names), "left_out": {}}

        monkeypatch.setattr("sc3d.stages.map_photos.map_photos", map_photos)
        (tmp_path / "photos").mkdir()
        for view in views:
            Image.new("RGB", (view.width, view.height)).save(tmp_path / "photos" / view.name)
        return tmp_path, views, calls

    def write(self, path: Path, measured: np.ndarray, views: list[View]) -> Path:
        lines = ["EPSG:32615"]
        for row, position in enumerate(from_origin(ORIGIN, 32615).to_crs(measured)):
            for photo, pixel in pixels_of(SURVEYED[row], views).items():
                columns = [*position, *(pixel - 0.5), photo, f"gcp{row:02d}"]
                lines.append("\t".join(str(column) for column in columns))
        path.write_text("\n".join(lines) + "\n")
        return path

    def run(self, *arguments: object) -> int:
        from sc3d.cli import main

        try:
            main([str(argument) for argument in arguments])
        except SystemExit as error:
            return int(error.code or 0)
        return 0

    def test_refused_points_keep_the_cameras_and_the_next_run_goes_on(self, flown, capsys):
        folder, views, calls = flown
        bad = self.write(folder / "bad.txt", np.random.default_rng(2).uniform(-20, 20, (8, 3)), views)
        good = self.write(folder / "good.txt", SURVEYED, views)
        scene = Scene(folder / "scene")
        assert self.run("reconstruct", folder / "photos", scene.path, "--gcp", bad) == 2
        assert "kept" in capsys.readouterr().err and len(calls) == 1
        assert len(load_model(scene.sparse).reg_image_ids()) == 12 and read_georeference(scene) is None
        assert self.run("reconstruct", folder / "photos", scene.path, "--gcp", good) == 0
        assert len(calls) == 1
        found = read_georeference(scene)
        assert found.figures["control_points"]["rms"] < 1e-3
        np.testing.assert_allclose(
            centers_crs(load_model(scene.sparse), found.origin), true_crs(views), atol=1e-2
        )
        # refused once more: what was right stays
        before = (scene.sparse / "images.bin").read_bytes()
        assert self.run("reconstruct", folder / "photos", scene.path, "--gcp", bad) == 2
        assert (scene.sparse / "images.bin").read_bytes() == before and read_georeference(scene) == found
        assert len(calls) == 1

    def test_what_decides_cameras_maps_again(self, flown):
        folder, _, calls = flown
        for options in ([], ["--epsg", "32615"], ["--altitude-offset", "3"], ["--max-features", "4096"]):
            assert self.run("reconstruct", folder / "photos", folder / "scene", *options) == 0
        assert len(calls) == 2

    def test_georeference_places_a_model_that_is_there(self, flown):
        folder, views, calls = flown
        scene = Scene(folder / "scene")
        assert self.run("reconstruct", folder / "photos", scene.path) == 0
        good = self.write(folder / "good.txt", SURVEYED, views)
        before = (scene.sparse / "images.bin").read_bytes()
        assert self.run("georeference", scene.path, "--gcp", good) == 0
        assert (scene.sparse / "images.bin").read_bytes() == before and len(calls) == 1
        found = read_georeference(scene)
        model = load_model(scene.sparse)
        centers = {image.name: image.projection_center() for image in registered_images(model)}
        placed = found.to_crs(np.array([centers[view.name] for view in views]))
        np.testing.assert_allclose(placed, true_crs(views), atol=1e-2)
        record = json.loads((scene.path / "georeference.json.json").read_text())
        assert record["summary"]["rms_to_control_points_m"] < 1e-3

    def test_bad_input_is_refused_before_the_hours(self, flown, capsys):
        folder, views, calls = flown
        far = self.write(folder / "gcp.txt", SURVEYED, views)
        far.write_text(far.read_text().replace("EPSG:32615", "EPSG:32615+nonsense"))
        assert self.run("reconstruct", folder / "photos", folder / "scene", "--gcp", far) == 2
        good = self.write(folder / "good.txt", SURVEYED, views)
        arguments = ("reconstruct", folder / "photos", folder / "scene", "--gcp", good)
        assert self.run(*arguments, "--epsg", "27700") == 2 and "United Kingdom" in capsys.readouterr().err
        assert self.run(*arguments, "--epsg", "7405") == 2 and "27700" in capsys.readouterr().err
        for accuracy in (("0", "1"), ("nan", "1"), ("1", "-2")):
            assert self.run(*arguments, "--gcp-accuracy", *accuracy) == 2
        assert self.run(*arguments[:-2], "--gcp-accuracy", "1", "2") == 2
        assert calls == []


def test_similarity_of_georeferenced_control_points_moves_nothing_else(caplog):
    views = fly(6)
    model = moved_model(views)
    with caplog.at_level(logging.WARNING):
        found = georeference_control_points(model, control(SURVEYED, views), 32615)
    np.testing.assert_allclose(
        found.to_crs(SHIFT.apply(np.array([view.center for view in views]))), true_crs(views), atol=1e-2
    )
    assert not caplog.text
