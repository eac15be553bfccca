"""Up from cameras whose truth is known: every scene is made with z up, and turned as a mapper may leave it."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from sc3d.geometry.cameras import pinhole_view
from sc3d.georeferencing.alignment import fit_similarity
from sc3d.georeferencing.georeference import enu_to_geodetic, triple
from sc3d.georeferencing.geotags import Geotag
from sc3d.georeferencing.gps import Flight, place
from sc3d.georeferencing.placement import make_level
from sc3d.georeferencing.up_direction import (
    Poses,
    Stated,
    UpDirection,
    angle,
    find_up,
    gimbal_up,
    read_stated,
    scene_up,
    settle_up,
    tell_tilt,
    upside_down,
)
from sc3d.io.orientation import ORIENTATION, turned_points
from sc3d.propagation.terrain import GroundModel, NormalStatistics
from sc3d.scene.scene import Scene
from tests.georeferencing.test_georeference import BRIGHTON, build_model

FRAME = pycolmap.Rotation3d(np.array([0.4, -1.0, 0.7])).matrix()  # world of the model from the true one
RNG = np.random.default_rng


def camera(azimuth: float, pitch: float, roll: float = 0.0) -> np.ndarray:
    """(3, 3) cam_from_world, degrees: azimuth east of north, pitch above the horizon, roll about the axis."""
    azimuth, pitch, roll = np.radians([azimuth, pitch, roll])
    right = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
    forward = np.array([np.sin(azimuth) * np.cos(pitch), np.cos(azimuth) * np.cos(pitch), np.sin(pitch)])
    down = np.cross(forward, right)
    turn = np.array([[np.cos(roll), np.sin(roll), 0], [-np.sin(roll), np.cos(roll), 0], [0, 0, 1.0]])
    return turn @ np.stack([right, down, forward])


def cameras(azimuths, pitches, noise: float = 1.0, seed: int = 0) -> np.ndarray:
    """(N, 3, 3) with some degrees of roll."""
    rolls = RNG(seed).normal(0, noise, len(azimuths))
    return np.stack([camera(*each) for each in zip(azimuths, np.broadcast_to(pitches, len(azimuths)), rolls)])


def as_stored(rotations: np.ndarray, orientations: list[int]) -> np.ndarray:
    """Cameras of photos as stored, from those of the photos as shown."""
    stored = []
    for rotation, orientation in zip(rotations, orientations, strict=True):
        axes = turned_points(np.array([[0.0, 0], [1, 0], [0, 1]]), (1, 1), orientation)
        flat = np.eye(3)
        flat[:2, :2] = axes[1:] - axes[0]  # rows: where a stored axis points to as shown
        stored.append(flat @ rotation)
    return np.stack(stored)


def found_up(
    rotations: np.ndarray, centers: np.ndarray, points: np.ndarray, stated: list[Stated] | None = None
) -> tuple[UpDirection, float]:
    """What is found in the turned model, and how far that is from the truth, degrees."""
    poses = Poses.from_cameras(rotations @ FRAME.T, centers @ FRAME.T, stated)
    found = find_up(poses, points @ FRAME.T)
    assert np.linalg.norm(found.up) == pytest.approx(1)
    return found, angle(found.up, FRAME[:, 2])


def facade(seed: int = 0, slope: float = 0.0) -> np.ndarray:
    """Points of a wall, 30 m wide and 12 m high, at y = 20, and a third as many of the ground before it."""
    rng = RNG(seed)
    wall = np.stack([rng.uniform(-15, 15, 900), rng.normal(20, 0.05, 900), rng.uniform(0, 12, 900)], axis=1)
    ground = np.stack([rng.uniform(-15, 15, 300), rng.uniform(6, 20, 300), rng.normal(0, 0.03, 300)], axis=1)
    ground[:, 2] += np.tan(np.radians(slope)) * (ground[:, 0])
    return np.concatenate([wall, ground])


def terrain(slope: float = 0.0, seed: int = 0) -> np.ndarray:
    points = RNG(seed).uniform(-40, 40, (1500, 3)) * [1, 1, 0.01]
    points[:, 2] += np.tan(np.radians(slope)) * points[:, 0]
    return points


def on_foot(count: int = 11, half: float = 25.0) -> tuple[np.ndarray, np.ndarray]:
    """Azimuths of people who look at the facade from eye height on an arc before it, and where they stand."""
    azimuths = np.linspace(-half, half, count)
    reach = 18 + RNG(1).normal(0, 1.0, count)
    flat = np.stack([-np.sin(np.radians(azimuths)) * reach, 20 - np.cos(np.radians(azimuths)) * reach], 1)
    return azimuths, np.column_stack([flat, RNG(2).normal(1.7, 0.05, count)])


def grid(heights: float = 50.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-2, 3) * 12.0, np.arange(-2, 3) * 12.0)
    return np.column_stack([x.ravel(), y.ravel(), RNG(3).normal(heights, 0.3, 25)])


class TestFromTheGround:
    @pytest.mark.parametrize("seed", range(4))
    def test_a_facade_is_no_ground(self, seed):
        azimuths, centers = on_foot()
        pitches = RNG(seed).normal(8, 3, 11)
        found, off = found_up(cameras(azimuths, pitches, 1.5, seed), centers, facade(seed))
        assert off < 3.0 and off < 2 * found.deviation and not found.doubt

    @pytest.mark.parametrize("seed", range(3))
    def test_around_an_object_a_slope_does_not_tilt_the_world(self, seed):
        azimuths = np.arange(0, 360, 20.0)
        flat = np.stack([-np.sin(np.radians(azimuths)), -np.cos(np.radians(azimuths))], 1) * 20
        centers = np.column_stack([flat, np.full(18, 9.0)])
        found, off = found_up(cameras(azimuths, -20.0, 1.0, seed), centers, terrain(12.0))
        assert off < 1.0 and found.how == "rows of 18 of 18 photos"

    def test_all_looking_the_same_way_the_wall_says_the_pitch(self):
        centers = np.column_stack([np.arange(9) * 2.0 - 8, [0, 3, 1, 4, 0, 2, 5, 1, 3], np.full(9, 1.7)])
        found, off = found_up(cameras(RNG(0).normal(0, 0.5, 9), 9.0, 0.5), centers, facade())
        assert off < 3.0 and "upright wall" in found.how

    def test_a_line_before_a_wall_needs_the_ground(self):
        centers = np.column_stack([np.arange(9) * 2.0 - 8, np.zeros(9), np.full(9, 1.7)])
        views = cameras(RNG(0).normal(0, 0.5, 9), 6.0, 0.5)
        found, off = found_up(views, centers, facade())
        assert off < 3.0 and "ground" in found.how
        # without one it may as well be a flight along a line: it is said
        found, off = found_up(views, centers, facade()[:900])
        assert "not sure" in found.doubt

    def test_photos_that_look_far_up(self):
        azimuths, centers = on_foot()
        views = cameras(azimuths, 55.0)
        found, off = found_up(views, centers, facade())
        assert off < 4.0
        assert not upside_down(Poses.from_cameras(views, centers), np.array([0, 0, 1.0]))
        assert upside_down(Poses.from_cameras(views, centers), np.array([0, 0, -1.0]))

    def test_one_camera_held_askew_counts_little(self):
        azimuths, centers = on_foot()
        views = cameras(azimuths, 5.0, 0.5)
        views[3] = camera(azimuths[3], 5.0, 25.0)
        found, off = found_up(views, centers, facade())
        assert off < 1.5 and "10 of 11" in found.how


class TestOrientation:
    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_turned_photos_are_turned_back(self, orientation):
        azimuths, centers = on_foot()
        views = cameras(azimuths, 8.0, 0.5)
        orientations = [orientation] * 6 + [1] * 5
        stored = as_stored(views, orientations)
        poses = Poses.from_cameras(stored, centers, [Stated(each) for each in orientations])
        np.testing.assert_allclose(np.abs(poses.right), np.abs(views[:, 0]), atol=1e-12)
        np.testing.assert_allclose(poses.down, views[:, 1], atol=1e-12)
        assert not upside_down(poses, np.array([0, 0, 1.0]))
        found, off = found_up(stored, centers, facade(), [Stated(each) for each in orientations])
        assert off < 1.5 and not found.doubt

    def test_portraits_that_do_not_say_so(self):
        azimuths, centers = on_foot()
        stored = as_stored(cameras(azimuths, 8.0, 0.5), [8 if row % 3 == 1 else 1 for row in range(11)])
        found, off = found_up(stored, centers, facade())
        assert off < 2.0 and "4 of them turned" in found.how

    @pytest.mark.parametrize("orientation", [6, 8])
    def test_nothing_but_portraits_that_do_not_say_so(self, orientation):
        azimuths = np.arange(0, 360, 20.0)
        flat = np.stack([-np.sin(np.radians(azimuths)), -np.cos(np.radians(azimuths))], 1) * 20
        stored = as_stored(cameras(azimuths, -20.0), [orientation] * 18)
        found, off = found_up(stored, np.column_stack([flat, np.full(18, 9.0)]), terrain())
        assert off < 2.0 and "columns" in found.how

    def test_read_from_photos(self, tmp_path: Path):
        exif = Image.Exif()
        exif[ORIENTATION] = 6
        Image.new("RGB", (40, 30)).save(tmp_path / "a.jpg", exif=exif)
        xmp = (
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description drone-dji:GimbalPitchDegree="-30.0" '
            'drone-dji:GimbalRollDegree="+0.00" drone-dji:GimbalYawDegree="+50.0"/></x:xmpmeta>'
        )
        Image.new("RGB", (40, 30)).save(tmp_path / "b.jpg", xmp=xmp.encode())
        turned, drone, missing = read_stated(tmp_path, ["a.jpg", "b.jpg", "c.jpg"])
        assert turned.orientation == 6 and turned.up is None
        np.testing.assert_allclose(drone.up, gimbal_up(-30, 0))
        assert missing == Stated()


class TestFlights:
    @pytest.mark.parametrize("slope", [0.0, 10.0])
    @pytest.mark.parametrize("headings", [[0.0], [0.0, 180.0], [0.0, 90.0]])
    def test_looking_down(self, slope, headings):
        azimuths = np.resize(headings, 25) + RNG(0).normal(0, 4, 25)
        pitches = RNG(1).normal(-90, 1.0, 25)
        found, off = found_up(cameras(azimuths, pitches), grid(), terrain(slope))
        assert off < 1.5 and not found.doubt

    @pytest.mark.parametrize("pitch", [-75.0, -60.0, -40.0])
    def test_oblique_in_one_direction_the_height_of_the_flight_tells(self, pitch):
        views = cameras(RNG(0).normal(0, 3, 25), pitch, 0.7)
        found, off = found_up(views, grid(), terrain(5.0))
        assert off < max(5.0, 2 * found.deviation) and off < 16

    def test_a_grid_and_a_ring(self):
        azimuths = np.concatenate([np.resize([0.0, 180.0], 25), np.arange(0, 360, 30.0)])
        ring = np.stack([-np.sin(np.radians(azimuths[25:])), -np.cos(np.radians(azimuths[25:]))], 1) * 45
        centers = np.concatenate([grid(), np.column_stack([ring, np.full(12, 45.0)])])
        pitches = np.concatenate([np.full(25, -90.0), np.full(12, -45.0)])
        found, off = found_up(cameras(azimuths, pitches), centers, terrain(8.0))
        assert off < 1.0 and not found.doubt

    @pytest.mark.parametrize("pitch", [-90.0, -60.0, 0.5])
    def test_gimbal_angles_tell_where_nothing_else_does(self, pitch):
        """A grid before a wall, upright: the photos alone could as well be of a flight over level ground."""
        centers = grid()[:, [0, 2, 1]] if pitch > 0 else grid()
        views = cameras(np.zeros(25), pitch, 0.0)
        stated = [Stated(1, gimbal_up(pitch, 0.0))] * 25
        found, off = found_up(views, centers, facade(), stated)
        assert off < 0.1 and found.deviation < 1.5 and found.how == "gimbal angles of 25 photos"

    def test_gimbal_angles_of_another_camera_are_not_used(self):
        azimuths, centers = on_foot()
        pitches = RNG(0).uniform(-60, 60, 11)
        stated = [Stated(1, gimbal_up(pitch, 0.0)) for pitch in pitches]
        found, off = found_up(cameras(azimuths, 8.0, 0.5), centers, facade(), stated)
        assert off < 1.5 and "gimbal angles in XMP do not fit" in found.doubt

    @pytest.mark.parametrize("pitch, roll", [(0, 0), (-90, 0), (-37, 12), (20, -5), (-90, 180)])
    def test_up_by_gimbal_angles_is_that_of_the_camera(self, pitch, roll):
        np.testing.assert_allclose(gimbal_up(pitch, roll), camera(33.0, pitch, roll)[:, 2], atol=1e-12)

    def test_cameras_at_all_angles_are_a_guess(self):
        views = np.array([pycolmap.Rotation3d(each).matrix() for each in RNG(0).normal(0, 2, (25, 3))])
        found, _ = found_up(views, grid(), terrain())
        assert found.deviation > 30 and "not sure" in found.doubt

    def test_little_to_go_by(self):
        for count in (1, 2, 3):
            for points in (np.zeros((0, 3)), terrain()[:2], terrain()):
                found, _ = found_up(cameras(np.arange(count) * 20.0, 5.0), grid()[:count], points)
                assert np.isfinite(found.up).all() and found.deviation <= 90


class TestModels:
    @staticmethod
    def model(tmp_path: Path, points: np.ndarray) -> pycolmap.Reconstruction:
        """A turned model of portraits of a facade, and their photos, which say that they are turned."""
        azimuths, centers = on_foot()
        stored = as_stored(cameras(azimuths, 8.0, 0.5), [6] * 11)
        views = []
        for row, (rotation, center) in enumerate(zip(stored, centers, strict=True)):
            cam_from_world = np.eye(4)
            cam_from_world[:3, :3] = rotation @ FRAME.T
            cam_from_world[:3, 3] = -rotation @ center
            views.append(pinhole_view(f"{row:02d}.jpg", (80, 60), (60, 60, 40, 30), cam_from_world))
            exif = Image.Exif()
            exif[ORIENTATION] = 6
            Image.new("RGB", (80, 60)).save(tmp_path / views[-1].name, exif=exif)
        return build_model(views, points @ FRAME.T)

    def test_make_level(self, tmp_path):
        points = facade()
        model = self.model(tmp_path, points)
        figures = make_level(model, tmp_path)
        assert figures["up_from"] == "rows of 11 of 11 photos, an upright wall"
        assert 0 < figures["up_deviation_deg"] < 5
        leveled = np.array([model.point3D(number).xyz for number in sorted(model.point3D_ids())])
        turn = fit_similarity(points, leveled)
        assert turn.scale == pytest.approx(1) and turn.rotation[2, 2] > np.cos(np.radians(2))
        # x along the wall, the middle of the points at the origin
        assert abs(turn.rotation[0, 0]) > 0.99
        middle = np.median(points @ FRAME.T, axis=0) @ FRAME
        np.testing.assert_allclose(turn.apply(middle[None]), 0, atol=1e-6)

    def test_photos_of_people_that_walk_along_a_wall_with_gps(self):
        """GPS along a line leaves the roll about it to the cameras; the main plane is the wall."""
        line = np.column_stack([np.linspace(-14, 14, 11), np.zeros(11), np.full(11, 1.7)])
        azimuths = np.degrees(np.arctan2(-line[:, 0], 20))
        rotations, points = cameras(azimuths, 8.0, 0.5) @ FRAME.T, facade() @ FRAME.T
        poses, centers = (
            Poses.from_cameras(rotations, line @ FRAME.T),
            dict(zip("abcdefghijk", line @ FRAME.T)),
        )
        tags = {name: Geotag(triple(row)) for name, row in zip(centers, enu_to_geodetic(line, BRIGHTON))}
        flight = Flight(tags, "line", BRIGHTON)
        fit = place(flight, centers, lambda: settle_up(poses, points).up)
        assert (fit.rotation @ FRAME)[2, 2] > np.cos(np.radians(2))

    def test_up_of_a_scene_in_any_frame(self, tmp_path, caplog):
        scene = Scene(tmp_path / "scene")
        assert scene_up(scene) is None
        photos = tmp_path / "photos"
        photos.mkdir()
        model = self.model(photos, facade())
        scene.sparse.mkdir(parents=True)
        model.write(str(scene.sparse))
        scene.images.symlink_to(photos)
        assert angle(scene_up(scene), FRAME[:, 2]) < 2.0
        tell_tilt(scene)
        tilt = round(angle(scene_up(scene), np.array([0, 0, 1.0])))
        assert f"is {tilt} degrees off up by its cameras" in caplog.text
        caplog.clear()
        make_level(model, photos)
        model.write(str(scene.sparse))
        tell_tilt(Scene(scene.path))
        assert not caplog.text


class TestGroundModel:
    @staticmethod
    def ground_model(share_of_wall: float, camera_up: np.ndarray | None) -> GroundModel:
        normals = np.zeros((1000, 3), np.float32)
        normals[: int(1000 * share_of_wall), 1] = -1
        normals[int(1000 * share_of_wall) :] = [np.sin(0.2), 0, np.cos(0.2)]  # a slope
        normals = normals @ FRAME.T.astype(np.float32)
        corner = np.full(3, 10.0)
        statistics = NormalStatistics.from_normals(normals, np.full(1000, 0.1, np.float32))
        return GroundModel.from_statistics(statistics, -corner, corner, camera_up)

    def test_before_a_facade_heights_count_along_the_cameras_up(self):
        found = self.ground_model(0.7, FRAME[:, 2])
        assert angle(found.up, FRAME[:, 2]) == pytest.approx(0, abs=1e-3)
        axes = np.column_stack([found.up, found.axes])
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)
        assert angle(self.ground_model(0.7, None).up, -FRAME[:, 1]) < 1

    def test_on_a_slope_they_count_across_it_as_before(self):
        found, before = self.ground_model(0.2, FRAME[:, 2]), self.ground_model(0.2, None)
        np.testing.assert_array_equal(found.up, before.up)
        np.testing.assert_array_equal(found.axes, before.axes)
        assert angle(found.up, FRAME[:, 2]) == pytest.approx(np.degrees(0.2), abs=0.1)
