"""World to CRS and back, GPS and control points of photos, and models brought onto them; pycolmap's own
geodesy is the oracle.
"""

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, look_at, pinhole_view, project
from sc3d.georeferencing.alignment import (
    Similarity,
    fit_similarity,
    fit_similarity_robust,
    flight_shape,
    roll_upright,
)
from sc3d.georeferencing.control_points import (
    ControlPoints,
    align_to_control_points,
    read_control_points,
    transform,
    triangulate,
)
from sc3d.georeferencing.focal import adjustment_options, anchor_focal, exif_focal, tells_focal
from sc3d.georeferencing.georeference import (
    Georeference,
    enu_to_geodetic,
    from_origin,
    geodetic_to_enu,
    read_georeference,
    utm_epsg,
    write_georeference,
)
from sc3d.georeferencing.geotags import Geotag, read_geotag
from sc3d.georeferencing.gps import Flight, find_georeference, place, read_flight, residuals
from sc3d.scene.scene import Scene
from sc3d.synthetic.exif import photo_exif

BRIGHTON = (46.84269, -91.99443, 198.6)
MELBOURNE = (-37.9042, 144.9886, 20.0)
PLACES = [(BRIGHTON, 32615), (MELBOURNE, 32755), ((0.01, -0.02, 5.0), 32630), ((69.6, 18.95, 100.0), 32634)]


def random_points(count: int = 500, half: float = 800.0, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-half, half, (count, 3)) * [1, 1, 0.1]


def no_up() -> np.ndarray:
    raise AssertionError("an area says itself where up is")


def turned(axis: np.ndarray, angle: float) -> np.ndarray:
    return pycolmap.Rotation3d(np.asarray(axis, float) / np.linalg.norm(axis) * angle).matrix()


class TestCrs:
    @pytest.mark.parametrize("origin, epsg", PLACES)
    def test_enu_goes_to_utm_as_pycolmap_computes_it(self, origin, epsg):
        found, points = from_origin(origin), random_points()
        assert found.epsg == epsg == utm_epsg(*origin[:2])
        geodesy = pycolmap.GPSTransform()
        expected, _ = geodesy.ellipsoid_to_utm(np.asarray(geodesy.enu_to_ellipsoid(points, *origin)))
        # PROJ and pycolmap differ by 0.1 mm in northing
        np.testing.assert_allclose(found.to_crs(points), expected, rtol=0, atol=2e-4)
        # PROJ and pycolmap differ by 0.1 mm in northing
        np.testing.assert_allclose(found.from_crs(expected), points, rtol=0, atol=2e-4)
        # an offset alone will not do
        assert np.abs(found.to_crs(points) - found.offset - points)[:, :2].max() > 0.2

    @pytest.mark.parametrize("epsg", [32615, 26915, 6344, 26991, 2232])
    def test_round_trip_in_other_crs_keeps_micrometers(self, epsg):
        found, points = from_origin(BRIGHTON, epsg, altitude_offset=-31.5), random_points()
        there = found.to_crs(points)
        np.testing.assert_allclose(found.from_crs(there), points, rtol=0, atol=1e-6)
        # feet too
        assert there[0, 2] * found.unit == pytest.approx(
            enu_to_geodetic(points, BRIGHTON)[0, 2] - 31.5, abs=1e-6
        )

    def test_similarity_in_front(self):
        matrix = Similarity(3.0, turned([1, 2, 3], 1.0), np.array([5.0, -7.0, 2.0])).matrix
        plain = from_origin(BRIGHTON)
        found = replace(plain, local_from_world=tuple(map(tuple, matrix.tolist())))
        points = random_points()
        np.testing.assert_allclose(
            found.to_crs(points), plain.to_crs(points @ matrix[:3, :3].T + matrix[:3, 3]), atol=1e-9
        )
        np.testing.assert_allclose(found.from_crs(found.to_crs(points)), points, atol=1e-6)

    def test_world_is_crs_minus_offset(self, tmp_path):
        (tmp_path / "georeference.json").write_text('{"epsg": 32615, "offset": [576000, 5188000, 0]}')
        found = read_georeference(Scene(tmp_path))
        np.testing.assert_array_equal(
            found.to_crs(np.array([[673.25, 174.5, 199.0]])), [[576673.25, 5188174.5, 199.0]]
        )
        np.testing.assert_array_equal(
            found.from_crs(np.array([[576673.25, 5188174.5, 199.0]])), [[673.25, 174.5, 199.0]]
        )

    def test_file_round_trip(self, tmp_path):
        scene = Scene(tmp_path)
        assert read_georeference(scene) is None
        for found in (
            from_origin(BRIGHTON, altitude_offset=2.5, figures={"gps": {"rms": 0.4}}),
            Georeference(2232, (1.0, 2.0, 3.0)),
            replace(
                from_origin(MELBOURNE),
                local_from_world=(
                    (2.0, 0.0, 0.0, 1.0),
                    (0.0, 2.0, 0.0, 0.0),
                    (0.0, 0.0, 2.0, 0.0),
                    (0.0, 0.0, 0.0, 1.0),
                ),
            ),
        ):
            write_georeference(scene, found)
            assert read_georeference(scene) == found

    @pytest.mark.parametrize(
        "content, word",
        [
            ("{}", "epsg"),
            ('{"epsg": 32615}', "offset"),
            ('{"epsg": 32615, "offset": [1, 2]}', "offset"),
            ("[]", "offset"),
            ('{"epsg": 4326, "offset": [1, 2, 3]}', "not a projected"),
            ('{"epsg": 99, "offset": [1, 2, 3]}', "unknown"),
            ('{"epsg": 32615, "offset": [1, 2, NaN]}', "finite"),
        ],
    )
    def test_broken_files(self, tmp_path, content, word):
        (tmp_path / "georeference.json").write_text(content)
        with pytest.raises(InputError, match=word):
            read_georeference(Scene(tmp_path))

    def test_wkt_is_read_back_as_the_same_crs(self):
        import pyproj

        assert pyproj.CRS.from_wkt(from_origin(BRIGHTON).crs.to_wkt("WKT1_GDAL")).to_epsg() == 32615


XMP = '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description {attributes}>{elements}</rdf:Description></rdf:RDF></x:xmpmeta>'


def write_photo(
    path: Path, position: tuple[float, float, float] | None, xmp: str = "", size: tuple[int, int] = (40, 30)
) -> Path:
    exif = photo_exif(0, np.array(position)) if position else Image.Exif()
    Image.new("RGB", size).save(path, exif=exif, **({"xmp": xmp.encode()} if xmp else {}))
    return path


class TestGeotags:
    @pytest.mark.parametrize("position", [BRIGHTON, MELBOURNE, (12.5, 98.25, -3.75)])
    def test_exif(self, tmp_path, position):
        tag = read_geotag(write_photo(tmp_path / "a.jpg", position))
        np.testing.assert_allclose(tag.geodetic, position, atol=1e-3 / 111e3)
        assert tag.deviation is None and not tag.rtk and (tag.sigma == 1).all()

    def test_dji_xmp_as_attributes_and_as_elements(self, tmp_path):
        attributes = 'drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.0131" drone-dji:RtkStdLat="0.0125" drone-dji:RelativeAltitude="+40.10"'
        elements = "<drone-dji:RtkStdHgt>0.21</drone-dji:RtkStdHgt><drone-dji:Model>FC</drone-dji:Model>"
        tag = read_geotag(
            write_photo(tmp_path / "a.jpg", BRIGHTON, XMP.format(attributes=attributes, elements=elements))
        )
        assert tag.deviation == (0.0131, 0.0125, 0.21) and tag.rtk and tag.above_takeoff == 40.1
        np.testing.assert_allclose(tag.sigma, [0.05, 0.05, 0.21])

    def test_no_gps(self, tmp_path):
        assert read_geotag(write_photo(tmp_path / "a.jpg", None)) is None
        assert read_geotag(write_photo(tmp_path / "b.jpg", (0.0, 0.0, 0.0))) is None
        (tmp_path / "c.jpg").write_bytes(b"no image")
        with pytest.raises(InputError, match="c.jpg"):
            read_geotag(tmp_path / "c.jpg")

    @pytest.mark.parametrize(
        "offsets, shape, word",
        [
            ([[0, 0], [60, 0], [0, 60], [60, 60]], "area", None),
            ([[0, 0], [30, 0.4], [60, -0.4], [90, 0]], "line", "one line"),
            ([[0, 0], [0.5, 0], [0, 0.5], [0.3, 0.3]], None, "within"),
            ([[0, 0], [60, 0]], None, "2 of 3 photos have GPS, 3 are needed"),
            ([], None, "no photo has GPS"),
        ],
    )
    def test_degenerate_flights_are_called_so(self, tmp_path, caplog, offsets, shape, word):
        positions = enu_to_geodetic(
            np.c_[np.reshape(offsets, (-1, 2)), np.full(len(offsets), 50.0)], BRIGHTON
        )
        for row, position in enumerate(positions):
            write_photo(tmp_path / f"{row}.jpg", tuple(position))
        write_photo(tmp_path / "without.jpg", None)
        with caplog.at_level(logging.WARNING):
            flight = read_flight(tmp_path, sorted(file.name for file in tmp_path.iterdir()))
        assert (flight.shape if flight else None) == shape
        assert word is None or word in caplog.text

    def test_focal_length_in_exif(self, tmp_path):
        # 28 mm on film of 36 x 24 mm; a photo of 16:9 is a crop of a 4:3 sensor as wide
        assert exif_focal(write_photo(tmp_path / "a.jpg", BRIGHTON, size=(400, 300))) == pytest.approx(
            28 / 43.27 * 500
        )
        assert exif_focal(write_photo(tmp_path / "b.jpg", BRIGHTON, size=(400, 225))) == pytest.approx(
            28 / 43.27 * 500
        )
        assert exif_focal(write_photo(tmp_path / "c.jpg", None)) is None
        calibrated = XMP.format(attributes='drone-dji:CalibratedFocalLength="3666.6"', elements="")
        assert exif_focal(write_photo(tmp_path / "d.jpg", BRIGHTON, calibrated)) == 3666.6


class TestAlignment:
    def test_similarity_is_found_exactly_and_robustly(self):
        true = Similarity(2.5, turned([1, -2, 0.5], 2.0), np.array([100.0, -50.0, 7.0]))
        source = random_points(12, 50)
        target = true.apply(source)
        fit = fit_similarity(source, target)
        np.testing.assert_allclose(fit.matrix, true.matrix, atol=1e-9)
        target[[2, 7, 9]] += [[30, 0, 0], [0, -5, 20], [900, 900, 0]]
        fit, kept = fit_similarity_robust(source, target, 0.5)
        assert set(np.flatnonzero(~kept)) == {2, 7, 9}
        np.testing.assert_allclose(fit.matrix, true.matrix, atol=1e-9)

    def test_shapes(self):
        rng = np.random.default_rng(0)
        noise = rng.normal(0, 0.3, (30, 3))
        assert flight_shape(noise, 0.3) == "point"
        assert flight_shape(noise + np.outer(np.linspace(0, 100, 30), [0.6, 0.8, 0]), 0.3) == "line"
        # RTK, but hardly any width
        assert flight_shape(noise * 0.5 + np.outer(np.linspace(0, 100, 30), [0.6, 0.8, 0]), 0.01) == "line"
        assert flight_shape(noise + rng.uniform(0, 100, (30, 3)) * [1, 0.3, 0], 0.3) == "area"

    def test_roll(self):
        axis = np.array([1.0, 0.3, 0.1])
        for angle in (0.3, -1.2, 3.0):
            normal = turned(axis, angle) @ roll_upright(np.array([0, 0, 1.0]), axis) @ [0, 0, 1]
            back = roll_upright(normal, axis)
            np.testing.assert_allclose(back @ normal, [0, 0, 1], atol=1e-9)
            np.testing.assert_allclose(back @ axis, axis, atol=1e-12)
            np.testing.assert_allclose(back @ back.T, np.eye(3), atol=1e-12)


def flown(positions: np.ndarray, origin: tuple = BRIGHTON) -> Flight:
    tags = {
        f"{row}.jpg": Geotag(tuple(geodetic))
        for row, geodetic in enumerate(enu_to_geodetic(positions, origin))
    }
    return Flight(tags, flight_shape(positions, 1.0), next(iter(tags.values())).geodetic)


class TestGps:
    def centers(self) -> np.ndarray:
        x, y = np.meshgrid(np.arange(5) * 20.0, np.arange(4) * 25.0)
        return np.stack([x.ravel(), y.ravel(), 60 + np.random.default_rng(1).normal(0, 1, 20)], axis=1)

    def test_scene_in_enu_is_recognized_with_its_origin(self):
        measured = self.centers() + np.random.default_rng(2).normal(0, 0.3, (20, 3))
        # as a GPS-aligned model lies
        world = dict(
            zip(
                [f"{row}.jpg" for row in range(20)],
                fit_similarity(self.centers(), measured).apply(self.centers()),
            )
        )
        found = find_georeference(flown(measured), world, no_up, None)
        assert found.epsg == 32615 and not found.is_moved
        np.testing.assert_allclose(
            geodetic_to_enu(np.array([found.origin]), BRIGHTON), [[0, 0, 0]], atol=0.02
        )
        assert 0.2 < found.figures["gps"]["rms"] < 0.9

    def test_scene_in_utm_is_recognized(self):
        centers = from_origin(BRIGHTON).to_crs(self.centers())
        found = find_georeference(
            flown(self.centers()), dict(zip([f"{row}.jpg" for row in range(20)], centers)), no_up, None
        )
        assert found == Georeference(32615, (0.0, 0.0, 0.0))

    def test_scene_in_any_other_frame_gets_a_similarity_and_one_wrong_position_does_no_harm(self):
        measured = self.centers()
        measured[4] += [300.0, 0, 40]
        other = Similarity(0.02, turned([1, 1, 0], 2.5), np.array([3.0, 4.0, 5.0]))
        found = find_georeference(
            flown(measured),
            dict(zip([f"{row}.jpg" for row in range(20)], other.apply(self.centers()))),
            no_up,
            None,
        )
        assert found.is_moved
        np.testing.assert_allclose(
            found.to_crs(other.apply(self.centers())), from_origin(BRIGHTON).to_crs(self.centers()), atol=1e-5
        )

    def test_flight_along_a_line_is_levelled_by_its_cameras(self):
        centers = np.outer(np.linspace(-60, 60, 9), [0.8, 0.6, 0]) + [0, 0, 50]
        ground = np.random.default_rng(3).uniform(-40, 40, (400, 3)) * [1, 1, 0.01]
        other = Similarity(0.5, turned([3, 1, 2], 1.9), np.array([1.0, 2.0, 3.0]))
        flight = flown(centers)
        assert flight.shape == "line"
        fit = place(flight, dict(zip(flight.tags, other.apply(centers))), lambda: other.rotation[:, 2])
        levelled = fit.apply(other.apply(ground))
        assert (
            np.ptp(levelled[:, 2]) < 1.5
            and levelled[:, 2].mean() < fit.apply(other.apply(centers))[:, 2].mean() - 49
        )

    def test_residuals_are_root_mean_squares(self):
        flight = flown(self.centers())
        shifted = {name: position + [0.3, 0.4, 1.2] for name, position in flight.positions.items()}
        assert residuals(flight, shifted) == {
            "photos": 20,
            "rms": 1.3,
            "rms_horizontal": 0.5,
            "rms_vertical": 1.2,
            "rtk_photos": 0,
        }


def build_model(views: list[View], points: np.ndarray) -> pycolmap.Reconstruction:
    """A COLMAP model with exact observations of `points`."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(views[0].camera.todict())
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in points]
    for number, view in enumerate(views, start=1):
        pixels, _ = project(view, points)
        seen = np.flatnonzero(((pixels >= 0) & (pixels < [view.width, view.height])).all(axis=1))
        image = pycolmap.Image(
            name=view.name,
            camera_id=1,
            image_id=number,
            points2D=pycolmap.Point2DList([pycolmap.Point2D(pixels[row]) for row in seen]),
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world[:3]))
        for position, row in enumerate(seen):
            tracks[row].add_element(number, position)
    for point, track in zip(points, tracks):
        model.add_point3D(point, track)
    return model


def pixels_of(point: np.ndarray, views: list[View]) -> dict[str, np.ndarray]:
    """Where the views that see a point see it, px."""
    found = {view.name: project(view, point[None])[0][0] for view in views}
    return {
        name: pixel
        for name, pixel in found.items()
        if np.isfinite(pixel).all() and (pixel > 1).all() and (pixel < [639, 479]).all()
    }


def fly(tilt: float, seed: int = 0) -> list[View]:
    """12 views from 40 m over 60 x 60 m; `tilt` in m moves the point that they look at."""
    rng = np.random.default_rng(seed)
    centers = np.stack(np.meshgrid([-20.0, -7, 7, 20], [-15.0, 0, 15]), -1).reshape(-1, 2)
    views = []
    for row, (x, y) in enumerate(centers):
        center = np.array([x, y, 40 + rng.normal(0, 0.5)])
        target = np.array([x, y, 0]) + [*rng.uniform(-tilt, tilt, 2), 0]
        views.append(
            pinhole_view(f"{row}.jpg", (640, 480), (600, 600, 320, 240), look_at(center, target, (0, 1, 0)))
        )
    return views


def site(seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-18, -18, -2], [18, 18, 6], (200, 3))


class TestControlPoints:
    SURVEYED = np.array([[-18.0, -14, 1], [20, -12, 0.5], [-15, 16, 3], [17, 15, -1], [1, 2, 4]])

    def write(
        self,
        path: Path,
        header: str,
        positions: np.ndarray,
        views: list[View],
        names: bool = True,
        errors: dict | None = None,
    ) -> Path:
        lines = [header, "# x y z px py photo name"]
        for row, point in enumerate(self.SURVEYED):
            position = positions[row] + (errors or {}).get(row, 0)
            # the file's convention: the first pixel's center is (0, 0)
            for photo, pixel in pixels_of(point, views).items():
                lines.append(
                    " ".join(
                        [
                            *(f"{value:.9f}" for value in position),
                            *(f"{value:.6f}" for value in pixel - 0.5),
                            photo,
                        ]
                        + [f"p{row}"] * names
                    )
                )
        path.write_text("\n".join(lines) + "\n")
        return path

    @pytest.mark.parametrize(
        "header, epsg",
        [
            ("EPSG:32615", 32615),
            ("WGS84 UTM 15N", 32615),
            ("+proj=utm +zone=15 +datum=WGS84 +units=m +no_defs", None),
            ("EPSG:26991", 26991),
            ("WGS84", None),
            ("EPSG:2232", 2232),
        ],
    )
    def test_model_is_brought_onto_them_whatever_the_crs(self, tmp_path, header, epsg):
        views = fly(6)
        there = (
            enu_to_geodetic(self.SURVEYED, BRIGHTON)[:, [1, 0, 2]]
            if header == "WGS84"
            else from_origin(BRIGHTON, epsg or 32615).to_crs(self.SURVEYED)
        )
        points = read_control_points(
            self.write(tmp_path / "gcp_list.txt", header, there, views), [view.name for view in views]
        )
        assert points.epsg in (epsg, 32615) and points.names == [f"p{row}" for row in range(5)]
        model = build_model(views, site())
        transform(model, Similarity(0.1, turned([1, 2, 3], 2.0), np.array([9.0, 8.0, 7.0])))
        figures = align_to_control_points(model, points)
        found = from_origin(points.origin, 32615).to_crs(
            np.array([model.image(row + 1).projection_center() for row in range(12)])
        )
        np.testing.assert_allclose(
            found, from_origin(BRIGHTON).to_crs(np.array([view.center for view in views])), atol=1e-3
        )
        assert figures["points"] == 5 and figures["rms"] < 1e-3 and figures["leave_one_out_rms"] < 1e-3
        assert all(point["reprojection_px"] < 1e-2 for point in figures["residuals"].values())
        # nothing of the points stays behind
        assert model.num_points3D() == 200 and model.compute_mean_reprojection_error() < 1e-2

    def test_blunders_are_left_out_and_named(self, tmp_path, caplog):
        views = fly(6)
        there = from_origin(BRIGHTON).to_crs(self.SURVEYED)
        points = read_control_points(
            self.write(tmp_path / "gcp.txt", "EPSG:32615", there, views, errors={3: [5.0, 0, 0]}),
            [view.name for view in views],
        )
        figures = align_to_control_points(build_model(views, site()), points)
        assert (
            figures["left_out"] == 1
            and "p3" in caplog.text
            and "p3" not in figures["residuals"]
            and figures["rms"] < 1e-3
        )

    def test_adjustment_pulls_a_bent_model_onto_them(self, tmp_path):
        views = fly(6)
        there = from_origin(BRIGHTON).to_crs(self.SURVEYED)
        points = read_control_points(
            self.write(tmp_path / "gcp.txt", "EPSG:32615", there, views), [view.name for view in views]
        )
        model = build_model(views, site())
        for point_id in model.point3D_ids():  # 1 % too deep, as a wrong focal length makes it
            point = model.point3D(point_id)
            point.xyz = point.xyz * [1, 1, 1.0] + [0, 0, -0.01 * (40 - point.xyz[2])]
        camera = model.camera(1)
        camera.params = [606, 606, 320, 240]
        figures = align_to_control_points(model, points)
        assert figures["rms"] < 0.02 < figures["leave_one_out_rms"]

    def test_without_names_points_are_told_apart_by_position(self, tmp_path):
        views = fly(6)
        path = self.write(
            tmp_path / "gcp.txt",
            "EPSG:32615",
            from_origin(BRIGHTON).to_crs(self.SURVEYED),
            views,
            names=False,
        )
        assert len(read_control_points(path, [f"flight/{view.name}" for view in views]).names) == 5

    @pytest.mark.parametrize(
        "text, word",
        [
            ("", "empty"),
            ("nonsense\n", "CRS is expected"),
            ("WGS84 UTM 99N\n", "CRS is expected"),
            ("EPSG:4978\n1 2 3 4 5 a.jpg", "neither"),
            ("EPSG:32615\n1 2 3 4 0.jpg", "line 2"),
            ("EPSG:32615\n1 2 NaN 4 5 0.jpg", "line 2"),
            ("EPSG:32615\n1 2 3 4 5 0.jpg a\n9 2 3 4 5 0.jpg a", "another position"),
            ("EPSG:32615\n1 2 3 4 5 0.jpg a\n", "at least 3"),
            ("EPSG:32615\n1 2 3 4 5 other.jpg a\n", "0 points"),
        ],
    )
    def test_bad_files_are_refused_with_the_line(self, tmp_path, text, word):
        (tmp_path / "gcp.txt").write_text(text)
        with pytest.raises(InputError, match=word):
            read_control_points(tmp_path / "gcp.txt", ["0.jpg"])

    def test_triangulation_is_exact_and_needs_two_photos(self):
        views = fly(6)
        model, point = build_model(views, site()), np.array([1.0, 2, 3])
        pixels = pixels_of(point, views)
        found, errors = triangulate(model, pixels)
        np.testing.assert_allclose(found, point, atol=1e-9)
        assert errors.max() < 1e-6
        assert (
            triangulate(model, {next(iter(pixels)): next(iter(pixels.values())), "unknown.jpg": np.zeros(2)})[
                0
            ]
            is None
        )

    def test_points_on_a_line_are_refused(self):
        views = fly(6)
        surveyed = np.outer([-1, -0.3, 0.4, 1], [15.0, 10, 0])
        points = ControlPoints(
            list("abcd"),
            enu_to_geodetic(surveyed, BRIGHTON),
            [pixels_of(point, views) for point in surveyed],
            None,
        )
        with pytest.raises(InputError, match="one line"):
            align_to_control_points(build_model(views, site()), points)


class TestFocal:
    def test_only_views_that_differ_tell_it(self):
        assert not tells_focal(build_model(fly(1.0), site()))
        assert tells_focal(build_model(fly(25.0), site()))

    @pytest.mark.parametrize("with_gps", [True, False])
    def test_height_follows_exif(self, tmp_path, with_gps, caplog):
        views = fly(1.0)
        flight = flown(np.array([view.center for view in views])) if with_gps else None
        for view in views:
            write_photo(
                tmp_path / view.name,
                None,
                XMP.format(attributes='drone-dji:CalibratedFocalLength="600"', elements=""),
                (640, 480),
            )
        model = build_model(views, site())
        # what self-calibration may return: 20 % longer focal length, 20 % higher flight
        for point_id in model.point3D_ids():
            point = model.point3D(point_id)
            point.xyz = [*point.xyz[:2], 40 - 1.2 * (40 - point.xyz[2])]
        camera = model.camera(1)
        camera.params = [720, 720, 320, 240]
        figures = anchor_focal(model, tmp_path, flight)
        assert (
            figures == {"focal_free_px": 720.0, "focal_exif_px": 600.0}
            and "looks" not in caplog.text
            and "same way" in caplog.text
        )
        assert model.compute_mean_reprojection_error() < 0.01
        points = np.array([model.point3D(point_id).xyz for point_id in sorted(model.point3D_ids())])
        fit = fit_similarity(points, site())
        # the shape is right again; with GPS the frame too
        assert np.abs(fit.apply(points) - site()).max() < 0.05
        if with_gps:
            centers = np.array([model.image(row + 1).projection_center() for row in range(12)])
            np.testing.assert_allclose(centers, list(flight.positions.values()), atol=0.02)

    def test_photos_without_focal_length_are_left_as_they_are(self, tmp_path, caplog):
        views = fly(1.0)
        for view in views:
            write_photo(tmp_path / view.name, None)
        assert (
            anchor_focal(build_model(views, site()), tmp_path, None) == {}
            and "constant factor" in caplog.text
        )


@pytest.mark.usefixtures("one_thread")
def test_reconstruct_with_control_points_and_georeference_command(tmp_path, caplog):
    """Photos of a synthetic site: positions on Earth to a few cm with control points; another CRS, and
    recovery from GPS alone.
    """
    from sc3d.cli import main
    from sc3d.scene.scene import read_sparse_model
    from sc3d.synthetic.exif import REFERENCE

    main(
        [
            "synthesize",
            str(tmp_path / "site"),
            "--views",
            "8",
            "--width",
            "400",
            "--extent",
            "60",
            "--altitude",
            "40",
            "--num-points",
            "2000",
        ]
    )
    truth = read_sparse_model(tmp_path / "site" / "sparse" / "0")
    rows = np.argsort(-np.bincount(np.concatenate(truth.tracks), minlength=len(truth.points)), kind="stable")[
        :200
    ]
    rows = rows[
        np.unique(
            [
                np.argmax(truth.points[rows] @ [np.cos(angle), np.sin(angle), 0])
                for angle in np.linspace(0, 2 * np.pi, 9)[:-1]
            ]
        )
    ]
    there = from_origin(REFERENCE).to_crs(truth.points[rows])
    lines = ["EPSG:32755"]
    for name, point, position in zip("abcdefgh", truth.points[rows], there):
        for view in truth.views:
            pixel = project(view, point[None])[0][0] - 0.5
            if (
                np.isfinite(pixel).all()
                and (pixel > 0).all()
                and (pixel < [view.width - 1, view.height - 1]).all()
            ):
                lines.append(
                    f"{position[0]:.4f} {position[1]:.4f} {position[2]:.4f} {pixel[0]:.3f} {pixel[1]:.3f} {view.name} {name}"
                )
    (tmp_path / "gcp_list.txt").write_text("\n".join(lines))
    scene = tmp_path / "scene"
    main(
        [
            "reconstruct",
            str(tmp_path / "site" / "images"),
            str(scene),
            "--gcp",
            str(tmp_path / "gcp_list.txt"),
        ]
    )
    true_centers = {view.name: view.center for view in truth.views}

    def errors() -> np.ndarray:
        """Distance of every camera from its true position, in the scene's CRS, m."""
        views, found = read_sparse_model(scene / "sparse" / "0").views, read_georeference(Scene(scene))
        expected = from_origin(REFERENCE, found.epsg).to_crs(
            np.array([true_centers[view.name] for view in views])
        )
        return np.linalg.norm(found.to_crs(np.array([view.center for view in views])) - expected, axis=1)

    assert errors().max() < 0.15
    figures = json.loads((scene / "georeference.json").read_text())["figures"]["control_points"]
    assert figures["rms"] < 0.05 and figures["points"] >= 4
    main(["georeference", str(scene), "--epsg", "28355"])
    assert read_georeference(Scene(scene)).epsg == 28355 and errors().max() < 0.15
    main(["georeference", str(scene), "--from-gps", "--epsg", "32755"])
    assert errors().max() < 1.0  # GPS noise of the site


def test_bundle_adjustments_have_one_thread():
    """On small models more threads show nothing: on Brighton Beach each run had other last digits."""
    for refine in (True, False):
        options = adjustment_options(refine)
        assert options.ceres.solver_options.num_threads == 1
        assert options.refine_focal_length == refine
