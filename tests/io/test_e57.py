"""E57 as another program's library writes it: poses, colors, what is invalid, and damage."""

import json
import sys

import numpy as np
import pyproj
import pytest

from sc3d.errors import InputError, MissingPackageError
from sc3d.importers.clouds import read_geometry
from sc3d.io.clouds import read_cloud
from sc3d.io.e57 import read_e57
from tests.builders import write_bare_scene
from tests.importers.test_importers import fails, run

QUARTER = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])  # wxyz, 90 degrees about z


def points(count: int = 50, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    columns = {f"cartesian{axis}": rng.uniform(-5, 5, count) for axis in "XYZ"}
    columns |= {
        f"color{name}": rng.integers(0, 256, count).astype(np.uint8) for name in ("Red", "Green", "Blue")
    }
    return columns | {"intensity": rng.random(count).astype(np.float32)}


def xyz(columns) -> np.ndarray:
    return np.stack([columns[f"cartesian{axis}"] for axis in "XYZ"], axis=1)


def write(path, *scans, crs: str = ""):
    """scans: columns, rotation (wxyz) and translation of each; None and None = no pose"""
    library = pytest.importorskip("pye57", reason="E57 files need pye57: pip install 'sc3d[e57]'").libe57
    file = library.ImageFile(str(path), "w")
    file.extensionsAdd("", library.E57_V1_0_URI)
    for name, value in (
        ("formatName", "ASTM E57 3D Imaging Data File"),
        ("guid", "a"),
        ("coordinateMetadata", crs),
    ):
        file.root().set(name, library.StringNode(file, value))
    file.root().set("versionMajor", library.IntegerNode(file, 1))
    file.root().set("versionMinor", library.IntegerNode(file, 0))
    data = library.VectorNode(file, True)
    file.root().set("data3D", data)
    for columns, rotation, translation in scans:
        scan, kinds = library.StructureNode(file), library.StructureNode(file)
        for name, column in columns.items():
            whole = column.dtype.kind in "iu"
            node = library.IntegerNode(file, 0, 0, 65535) if whole else library.FloatNode(file, 0.0)
            kinds.set(name, node)
        if rotation is not None or translation is not None:
            scan.set("pose", pose(library, file, rotation, translation))
        points = library.CompressedVectorNode(file, kinds, library.VectorNode(file, True))
        scan.set("points", points)
        data.append(scan)
        buffers, stored = (
            library.VectorSourceDestBuffer(),
            {name: column.astype(float) for name, column in columns.items()},
        )
        for name, column in stored.items():
            buffers.append(library.SourceDestBuffer(file, name, column, len(column), True, True))
        writer = points.writer(buffers)
        writer.write(len(column))
        writer.close()
    file.close()
    return path


def pose(library, file, rotation, translation):
    found = library.StructureNode(file)
    for name, letters, values in (("rotation", "wxyz", rotation), ("translation", "xyz", translation)):
        part = library.StructureNode(file)
        for letter, value in zip(letters, () if values is None else values):
            part.set(letter, library.FloatNode(file, float(value)))
        if values is not None:
            found.set(name, part)
    return found


def test_scans_are_placed_by_their_poses_with_all_they_have(tmp_path):
    first, second = points(50), points(30, 1)
    offset = np.array([512345.0, 5187654.0, 210.0])
    path = write(
        tmp_path / "a.e57", (first, QUARTER, offset), (second, None, None), crs=pyproj.CRS(32632).to_wkt()
    )
    found = read_geometry(path)
    turned = xyz(first)[:, [1, 0, 2]] * [-1, 1, 1] + offset
    assert np.abs(found.positions - np.concatenate([turned, xyz(second)])).max() < 1e-9
    colors = [
        np.stack([scan[f"color{name}"] for name in ("Red", "Green", "Blue")], 1) for scan in (first, second)
    ]
    assert (found.colors == np.concatenate(colors)).all() and found.epsg == 32632
    assert (found.attributes["scan"] == np.repeat([0, 1], [50, 30])).all()
    assert (
        np.abs(
            found.attributes["intensity"] - np.concatenate([first["intensity"], second["intensity"]])
        ).max()
        < 1e-6
    )


def test_invalid_points_and_scans_without_colors_are_told(tmp_path, caplog):
    first, second = points(), points(10, 2)
    state = np.zeros(50, np.int8)
    state[3:7] = 2
    bare = {name: column for name, column in second.items() if "color" not in name}
    found = read_e57(
        write(tmp_path / "a.e57", (first | {"cartesianInvalidState": state}, None, None), (bare, None, None))
    )
    assert np.abs(found.positions - np.concatenate([xyz(first)[state == 0], xyz(second)])).max() < 1e-9
    assert (found.colors[-10:] == 128).all() and found.intensity is not None
    assert (
        "4 of 60 points are marked as invalid" in caplog.text and "1 of 2 scans have no colors" in caplog.text
    )


def test_spherical_coordinates(tmp_path):
    rng = np.random.default_rng(3)
    reach, azimuth, elevation = rng.uniform(1, 9, 20), rng.uniform(-3, 3, 20), rng.uniform(-1.5, 1.5, 20)
    columns = {"sphericalRange": reach, "sphericalAzimuth": azimuth, "sphericalElevation": elevation}
    found = read_e57(write(tmp_path / "a.e57", (columns, None, None)))
    assert np.abs(np.linalg.norm(found.positions, axis=1) - reach).max() < 1e-9 and found.colors is None
    assert np.abs(np.arctan2(found.positions[:, 1], found.positions[:, 0]) - azimuth).max() < 1e-9
    assert np.abs(found.positions[:, 2] - reach * np.sin(elevation)).max() < 1e-9


def test_a_cloud_is_imported_into_a_scene(tmp_path):
    scene = write_bare_scene(tmp_path / "scene")
    (scene / "georeference.json").write_text(json.dumps({"epsg": 32632, "offset": [0, 0, 0]}))
    (scene / "cloud.ply").unlink()
    offset = np.array([512345.0, 5187654.0, 210.0])
    run("import", write(tmp_path / "a.e57", (points(), None, offset), crs=pyproj.CRS(32632).to_wkt()), scene)
    cloud = read_cloud(scene / "cloud.ply")
    assert np.abs(cloud.point.positions.numpy() - xyz(points()) - offset).max() < 1e-6


def test_damaged_files_are_refused(capsys, tmp_path):
    whole = write(tmp_path / "a.e57", (points(), None, None)).read_bytes()
    rng, path = np.random.default_rng(4), tmp_path / "b.e57"
    for content in (bytes(64), whole[:-9], whole[: len(whole) // 2], b"ASTM-E57" + bytes(4000)):
        path.write_bytes(content)
        with pytest.raises(InputError, match="cannot read"):
            read_e57(path)
    for _ in range(40):
        content = bytearray(whole)
        content[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        path.write_bytes(bytes(content))
        try:
            read_e57(path)
        except InputError:
            continue
    path.write_bytes(whole[:99])
    assert "cannot read" in fails(capsys, "import", path, write_bare_scene(tmp_path / "scene"))


def test_without_the_package_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pye57", None)
    (tmp_path / "a.e57").write_bytes(bytes(64))
    with pytest.raises(MissingPackageError, match=r"pip install 'sc3d\[e57\]'"):
        read_geometry(tmp_path / "a.e57")
