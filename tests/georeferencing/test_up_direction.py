"""Up from cameras whose truth is known: every scene is made with z up, and turned as a mapper may leave it."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from sc3d.georeferencing.up_direction import (
    Poses,
    Stated,
    UpDirection,
    angle,
    find_up,
    gimbal_up,
    read_stated,
    upside_down,
)
from sc3d.io.orientation import turned_points

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
        exif[0x0112] = 6
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
