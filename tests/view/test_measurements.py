"""Lengths, areas and profiles against what geometry says."""

import json

import numpy as np
import pyproj
import pytest

from sc3d.errors import InputError
from sc3d.georeferencing.georeference import Georeference, read_georeference
from sc3d.scene.scene import Scene
from sc3d.view.measurements import Area, Line, MeasureFrame, Profile

ENU = Georeference(32615, (576000.0, 5188000.0, 0.0), (46.8427, -91.9944, 198.6))


def test_lengths_are_those_on_the_ground_not_on_the_grid():
    """UTM shrinks lengths by 0.04 %; the geodesic of PROJ does not."""
    points = np.array([[0, 0, 0], [300.0, 400.0, 20.0]])
    line = Line.through(MeasureFrame(ENU).lengths(points))
    longitude, latitude = pyproj.Transformer.from_crs(32615, 4326, always_xy=True).transform(
        *MeasureFrame(ENU).coordinates(points)[:, :2].T
    )
    _, _, along = pyproj.Geod(ellps="WGS84").inv(longitude[0], latitude[0], longitude[1], latitude[1])
    # the scene lies 200 m above the ellipsoid
    assert line.horizontal == pytest.approx(500, abs=1e-6) and along * (1 + 209 / 6.38e6) == pytest.approx(
        500, abs=2e-3
    )
    grid = np.linalg.norm(np.diff(MeasureFrame(ENU).coordinates(points)[:, :2], axis=0))
    assert abs(grid - 500) > 0.1
    assert line.height == pytest.approx(np.diff(ENU.to_crs(points)[:, 2])[0], abs=1e-9)


def test_a_scaled_and_turned_world_is_measured_in_meters():
    matrix = np.eye(4)
    matrix[:3, :3] = 2.5 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    place = Georeference(32615, ENU.offset, ENU.origin, tuple(map(tuple, matrix.tolist())))
    line = Line.through(MeasureFrame(place).lengths(np.array([[0, 0, 0], [4.0, 0, 3.0]])))
    assert (line.horizontal, line.direct) == pytest.approx((10, 12.5), abs=1e-4)
    feet = Georeference(2229, (6.5e6, 1.8e6, 0.0))
    assert Line.through(
        MeasureFrame(feet).lengths(np.array([[0, 0, 0], [100.0, 0, 0]]))
    ).length == pytest.approx(100 * 1200 / 3937)


def test_without_a_place_lengths_have_no_known_unit():
    frame = MeasureFrame()
    assert (frame.unit, frame.name) == ("units", "scene, scale unknown")
    assert (frame.lengths(np.eye(3)) == np.eye(3)).all() and frame.tell([1, 2, 3]) == [
        "1.0000",
        "2.0000",
        "3.0000",
    ]


def test_coordinates_are_those_of_the_crs_and_back(tmp_path):
    (tmp_path / "georeference.json").write_text(json.dumps({"epsg": 32615, "offset": [576000, 5188000, 200]}))
    frame = MeasureFrame(read_georeference(Scene(tmp_path)))
    assert frame.tell(frame.coordinates(np.array([[1.5, -2.25, 3.0]]))[0]) == [
        "576001.500",
        "5187997.750",
        "203.000",
    ]
    assert frame.to_world(frame.coordinates(np.eye(3))) == pytest.approx(np.eye(3), abs=1e-6)


def test_area_on_the_plan_and_on_the_plane():
    """A roof of 10 m x 6 m, tilted by 30 degrees, at UTM coordinates."""
    tilt = np.radians(30)
    roof = np.array([[0, 0], [10, 0], [10, 6], [0, 6]])
    corners = np.column_stack([roof[:, 0], roof[:, 1] * np.cos(tilt), roof[:, 1] * np.sin(tilt)]) + [
        5e5,
        5e6,
        200,
    ]
    area = Area.of(corners)
    assert (area.on_plane, area.horizontal) == pytest.approx((60, 60 * np.cos(tilt)), rel=1e-6)
    assert (area.tilt, area.off, area.perimeter) == pytest.approx((30, 0, 32), abs=1e-4)
    l_shape = np.array([[0, 0, 0], [4, 0, 0], [4, 2, 0], [2, 2, 0], [2, 4, 0], [0, 4, 0.0]])
    assert Area.of(l_shape[::-1]).horizontal == pytest.approx(12)
    wall = np.array([[0, 0, 0], [5, 0, 0], [5, 0, 3], [0, 0, 3.0]])
    assert (Area.of(wall).horizontal, Area.of(wall).on_plane, Area.of(wall).tilt) == pytest.approx(
        (0, 15, 90)
    )
    with pytest.raises(InputError, match="crosses itself"):
        Area.of(l_shape[[0, 2, 1, 5]])
    with pytest.raises(InputError, match="three corners"):
        Area.of(l_shape[:2])


def test_lengths_along_a_line():
    line = Line.through(np.array([[0, 0, 0], [3, 4, 0], [3, 4, 12.0]]))
    assert (line.length, line.horizontal, line.height, line.direct) == pytest.approx((17, 5, 12, 13))


def surface() -> np.ndarray:
    """(N, 3) of the plane z = x / 10, every 0.1 m."""
    x, y = np.meshgrid(np.arange(0, 20, 0.1), np.arange(0, 10, 0.1))
    return np.column_stack([x.ravel(), y.ravel(), x.ravel() / 10])


def test_profile_has_exactly_the_points_within_its_half_width():
    cloud, corners = surface(), np.array([[2.03, 5.02, 9.0], [12.03, 5.02, 0.0]])
    profile = Profile.along_line(cloud, corners, 0.35)
    inside = (np.abs(cloud[:, 1] - 5.02) <= 0.35) & (cloud[:, 0] >= 2.03) & (cloud[:, 0] <= 12.03)
    assert sorted(profile.rows.tolist()) == np.flatnonzero(inside).tolist()
    assert (
        profile.along == pytest.approx(cloud[profile.rows, 0] - 2.03) and (np.diff(profile.along) >= 0).all()
    )
    assert profile.length == pytest.approx(10)
    table = profile.table(0.1)
    assert table[:, 4].sum() == len(profile.rows)
    assert table[:, 2] == pytest.approx((table[:, 0] + 2.03) / 10, abs=0.011)
    lines = profile.csv(0.1, "m").splitlines()
    assert lines[0] == "distance_m,lowest_m,median_m,highest_m,points" and len(lines) == 1 + len(table)


def test_profile_along_a_bent_line():
    cloud = surface()
    profile = Profile.along_line(cloud, np.array([[2, 2, 0], [10, 2, 0], [10, 8, 0.0]]), 0.25)
    x, y = cloud[profile.rows, 0], cloud[profile.rows, 1]
    first, second = (x <= 9.7) & (y < 2.3), (y > 2.3)
    assert profile.along[first] == pytest.approx(x[first] - 2) and profile.along[second] == pytest.approx(
        6 + y[second]
    )
    assert profile.length == pytest.approx(14) and (x >= 2).all() and (y <= 8 + 1e-9).all()


def test_profile_that_cannot_be():
    cloud, corners = surface(), np.array([[2.0, 5, 0], [12, 5, 0]])
    for line, width, reason in (
        (corners[:1], 1, "two points"),
        (corners, 0, "above 0"),
        (corners[[0, 0]], 1, "no length"),
        (corners + 100, 1, "half width"),
    ):
        with pytest.raises(InputError, match=reason):
            Profile.along_line(cloud, line, width)
