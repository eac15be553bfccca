"""KML and CSV of the cameras: where PROJ says, looking where the photos look."""

import csv
import io
import json
from xml.etree import ElementTree

import numpy as np
import pycolmap
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from sc3d.cli import main
from sc3d.errors import InputError
from sc3d.exporters import camera_files
from sc3d.geometry.cameras import View, look_at
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export
from tests.builders import write_model
from tests.exporters.test_laz import ENU

KML = {"": "http://www.opengis.net/kml/2.2"}
BOTH = Export(format=("kml", "csv"))
EYES = np.array([[10.0, -20, 80], [0, 0, 50], [30, 5, 60], [-40, 9, 20]])
AIMS = np.array([[0.0, 0, 0], [0, 40, 50.0], [60, 5, 60], [-41, 9.5, -9]])


def scene_of(path, georeference=ENU) -> Scene:
    lens = pycolmap.Camera(model="PINHOLE", width=320, height=240, params=[400, 400, 160, 120], camera_id=1)
    views = [
        View(f"a & b/{row}.jpg", lens, look_at(eye, aim)) for row, (eye, aim) in enumerate(zip(EYES, AIMS))
    ]
    write_model(path / "sparse" / "0", views)
    if georeference is not None:
        (path / "georeference.json").write_text(json.dumps(georeference))
    return Scene(path)


def table(scene) -> list[dict]:
    return list(csv.DictReader(io.StringIO((scene.export / "cameras.csv").read_text())))


def numbers(row, *names) -> np.ndarray:
    return np.array([float(row[name]) for name in names])


def test_positions_and_directions_on_earth(tmp_path):
    scene = scene_of(tmp_path)
    figures = camera_files.write(scene, BOTH)
    assert figures["photos"] == 4 and figures["crs"] == "EPSG:32615"
    to_earth = pyproj.Transformer.from_crs(4979, 4978)
    for row, eye, aim in zip(table(scene), EYES, AIMS):
        latitude, longitude = numbers(row, "latitude", "longitude")
        east, north, height = numbers(row, "easting", "northing", "height")
        assert np.abs(np.array(pyproj.Proj("EPSG:32615")(longitude, latitude)) - [east, north]).max() < 2e-3
        assert row["crs"] == "EPSG:32615" and height == pytest.approx(198.6 + eye[2], abs=1e-3)
        heading, tilt, roll = np.radians(numbers(row, "heading", "tilt", "roll"))
        ahead = np.array([np.sin(heading) * np.sin(tilt), np.cos(heading) * np.sin(tilt), -np.cos(tilt)])
        # the scene is tens of meters large: up is the same everywhere
        assert np.abs(ahead - (aim - eye) / np.linalg.norm(aim - eye)).max() < 1e-4
        assert roll == pytest.approx(0, abs=1e-4)  # `look_at` keeps the horizon level
        assert np.isfinite(to_earth.transform(latitude, longitude, height)).all()


def test_angles_give_the_orientation_back(tmp_path):
    scene = scene_of(tmp_path)
    camera_files.write(scene, BOTH)
    east = np.array(
        pyproj.Proj("EPSG:32615").get_factors(ENU["origin"][1], ENU["origin"][0]).meridian_convergence
    )
    turn = Rotation.from_euler("z", float(east), degrees=True).as_matrix()  # grid north is not true north
    for row, view in zip(table(scene), scene.model.views):
        back = Rotation.from_euler("XYZ", numbers(row, "omega", "phi", "kappa"), degrees=True).as_matrix()
        expected = view.cam_from_world[:3, :3].T * [1, -1, -1]
        assert np.abs(back - turn @ expected).max() < 1e-4
        heading, tilt, roll = numbers(row, "heading", "tilt", "roll")
        on_earth = Rotation.from_euler("ZXZ", [-heading, tilt, -roll], degrees=True).as_matrix()
        assert np.abs(on_earth - expected).max() < 1e-4


def test_kml_is_well_formed_and_says_the_same(tmp_path):
    scene = scene_of(tmp_path)
    main(["export", str(scene.path), "--format", "kml", "csv"])
    root = ElementTree.parse(scene.export / "cameras.kml").getroot()
    marks, rows = root.findall(".//Placemark", KML), table(scene)
    assert [mark.findtext("name", None, KML) for mark in marks] == [row["photo"] for row in rows] and len(
        rows
    ) == 4
    for mark, row in zip(marks, rows):
        camera = mark.find("Camera", KML)
        found = [
            float(camera.findtext(name, None, KML))
            for name in ("longitude", "latitude", "heading", "tilt", "roll")
        ]
        assert found == pytest.approx(
            numbers(row, "longitude", "latitude", "heading", "tilt", "roll"), abs=1e-4
        )
        assert mark.findtext("Point/coordinates", None, KML).startswith(
            f"{row['longitude']},{row['latitude']},"
        )


def test_without_a_place(tmp_path):
    scene = scene_of(tmp_path, None)
    with pytest.raises(InputError, match="sc3d georeference"):
        camera_files.write(scene, Export(format=("kml",)))
    camera_files.write(scene, Export(format=("csv",)))
    rows = table(scene)
    assert np.abs([numbers(row, "x", "y", "z") for row in rows] - EYES).max() < 1e-3
    assert {row["crs"] for row in rows} == {"none"} and "latitude" not in rows[0]
