"""Clouds and meshes of other programs: frames, units, colors, normals, dialects; right, or refused in one line."""

from __future__ import annotations

import io
import json
import logging
import shutil
import struct

import laspy
import lazrs
import numpy as np
import open3d as o3d
import pyproj
import pytest

from sc3d.errors import InputError
from sc3d.exporters.projected_cloud import find_projection
from sc3d.georeferencing.georeference import crs_to_geodetic, projected_crs
from sc3d.importers.clouds import read_geometry, to_open3d
from sc3d.importers.frames import place_geometries
from sc3d.io.chunked_clouds import CloudFile
from sc3d.io.clouds import read_cloud, read_mesh, write_geometry
from sc3d.labelling.label import label_scene
from sc3d.labelling.normal_sides import Sides, judge_sides
from sc3d.scene.scene import Scene
from sc3d.settings.common import Resources
from sc3d.settings.labels import Label
from sc3d.settings.outputs import Export
from sc3d.settings.reconstruction import Import
from sc3d.stages import import_project, label
from sc3d.tiling.label import label_scene as label_scene_by_tiles
from sc3d.tiling.memory import memory_of
from tests.builders import ORIGIN, ground, views, write_bare_scene, write_model

RED, GREEN, BLUE = 68, 77, 72


# ---- builders


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """Cameras and masks in a world that is EPSG:32615 minus ORIGIN."""
    path = write_bare_scene(tmp_path_factory.mktemp("site") / "scene")
    shutil.rmtree(path / "sparse")
    write_model(path / "sparse" / "0", [view.shifted(ORIGIN) for view in views()])
    (path / "cloud.ply").unlink()
    (path / "georeference.json").write_text(json.dumps({"epsg": 32615, "offset": ORIGIN.tolist()}))
    return path


@pytest.fixture
def site(template, tmp_path):
    shutil.copytree(template, tmp_path / "site")
    return Scene(tmp_path / "site")


def write_las(path, points, crs=None, colors=None, extra=(), version="1.4", form=7):
    header = laspy.LasHeader(version=version, point_format=form)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(points.min(axis=0))
    for name, values in extra:
        header.add_extra_dim(laspy.ExtraBytesParams(name, values.dtype))
    if crs is not None:
        header.add_crs(crs)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    if colors is not None:
        las.red, las.green, las.blue = colors.T
    for name, values in extra:
        las[name] = values
    las.write(path)
    return path


def write_ply(path, points, columns, faces=(), form="binary_little_endian"):
    """columns: name -> (PLY type, numpy code, values)."""
    table = np.zeros(
        len(points), [(axis, "<f8") for axis in "xyz"] + [(n, c) for n, (_, c, _) in columns.items()]
    )
    for axis, column in zip("xyz", np.transpose(points), strict=True):
        table[axis] = column
    for name, (_, _, values) in columns.items():
        table[name] = values
    lines = ["ply", f"format {form} 1.0", f"element vertex {len(points)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += [f"property {kind} {name}" for name, (kind, _, _) in columns.items()]
    body = table.tobytes()
    if len(faces):
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        body += b"".join(b"\x03" + np.array(face, "<i4").tobytes() for face in faces)
    if form == "ascii":
        body = "".join(" ".join(map(str, row)) + "\n" for row in table.tolist()).encode()
        body += "".join(f"3 {a} {b} {c}\n" for a, b, c in faces).encode()
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + body)
    return path


def small(count=8):
    return np.random.default_rng(0).uniform(0, 10, (count, 3)).round(3)


# ---- colors: the same 68 77 72 in all of them

KINDS = {
    "bytes": ("uchar", "<u1", (RED, GREEN, BLUE)),
    "16 bits": ("ushort", "<u2", (RED * 256, GREEN * 256, BLUE * 256)),
    "16 bits, times 257": ("ushort", "<u2", (RED * 257, GREEN * 257, BLUE * 257)),
    "bytes in 16 bits": ("ushort", "<u2", (RED, GREEN, BLUE)),
    "bytes in 32 bits": ("int", "<i4", (RED, GREEN, BLUE)),
    "fractions": ("float", "<f4", (RED / 255, GREEN / 255, BLUE / 255)),
    "fractions as doubles": ("double", "<f8", (RED / 255, GREEN / 255, BLUE / 255)),
    "floats to 255": ("float", "<f4", (RED, GREEN, BLUE)),
    "floats to 65535": ("float", "<f4", (RED * 256, GREEN * 256, BLUE * 256)),
}
NAMES = ["red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b", "Red Green Blue"]


def colored(path, kind, names, **options):
    word, code, values = KINDS[kind]
    named = zip(names.split(), values, strict=True)
    return write_ply(path, small(), {name: (word, code, value) for name, value in named}, **options)


@pytest.mark.parametrize("form", ["binary_little_endian", "ascii"])
@pytest.mark.parametrize("kind", KINDS)
def test_colors_of_any_type_are_the_same_bytes(tmp_path, kind, form):
    for names in NAMES if form == "ascii" else NAMES[:1]:
        path = colored(tmp_path / "a.ply", kind, names, form=form)
        assert (read_geometry(path).colors == [RED, GREEN, BLUE]).all(), names
        assert (read_cloud(path).point.colors.numpy() == [RED, GREEN, BLUE]).all()


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("kind", KINDS)
def test_colors_are_the_same_when_read_in_chunks(tmp_path, kind, names):
    cloud = CloudFile.open(colored(tmp_path / "a.ply", kind, names))
    records = np.concatenate([records for _, records in cloud.chunks()])
    assert cloud.dtype["red"] == np.uint8
    assert (np.stack([records[name] for name in ("red", "green", "blue")], 1) == [RED, GREEN, BLUE]).all()


@pytest.mark.parametrize("kind", KINDS)
def test_colors_of_meshes_are_the_same(tmp_path, kind):
    path = colored(tmp_path / "a.ply", kind, NAMES[1 if kind == "16 bits" else 0], faces=[(0, 1, 2)])
    assert (read_geometry(path).colors == [RED, GREEN, BLUE]).all()
    np.testing.assert_allclose(
        read_mesh(path).vertex.colors.numpy(), np.tile([[RED, GREEN, BLUE]], (8, 1)) / 255, atol=1e-6
    )


def test_colors_of_las_of_8_bits_are_the_same_in_chunks(tmp_path):
    path = write_las(tmp_path / "a.laz", small(), colors=np.tile(np.uint16([[RED, GREEN, BLUE]]), (8, 1)))
    for _, records in CloudFile.open(path).chunks():
        assert (records["red"] == RED).all()
    assert (read_geometry(path).colors == [RED, GREEN, BLUE]).all()


def test_pcd_with_separate_colors(tmp_path):
    (tmp_path / "a.pcd").write_text(
        "VERSION 0.7\nFIELDS x y z r g b\nSIZE 4 4 4 1 1 1\nTYPE F F F U U U\nCOUNT 1 1 1 1 1 1\nWIDTH 2\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n0 0 0 {RED} {GREEN} {BLUE}\n1 1 1 {RED} {GREEN} {BLUE}\n"
    )
    assert (read_geometry(tmp_path / "a.pcd").colors == [RED, GREEN, BLUE]).all()


# ---- text


POINTS = np.array(
    [[637000.25, 849000.5, 410.125], [637001.25, 849001.5, 411.125], [637002.25, 849002.5, 412.125]]
)


def lines(form, points=POINTS, rest=""):
    return "".join(form.format(*point) + rest + "\n" for point in points)


def commas(text):
    return text.replace(".", ",")


TEXT = {
    "blanks": lines("{} {} {}"),
    "commas": lines("{},{},{}"),
    "commas and blanks": lines("{}, {}, {}"),
    "semicolons": lines("{};{};{}"),
    "decimal commas": commas(lines("{} {} {}")),
    "decimal commas and semicolons": commas(lines("{};{};{}")),
    "decimal commas and tabs": "x\ty\tz\n" + commas(lines("{}\t{}\t{}")),
    "bars": lines("{}|{}|{}"),
    "separator at the end": lines("{};{};{};"),
    "count in front": "3\n" + lines("{} {} {}"),
    "byte order mark": "\ufeff" + lines("{} {} {}"),
    "byte order mark and header": "\ufeffX,Y,Z\n" + lines("{},{},{}"),
    "header of other order": "id;north;east;height\n"
    + "".join(f"{n};{y};{x};{z}\n" for n, (x, y, z) in enumerate(POINTS)),
    "CloudCompare": "//X Y Z\n3\n" + lines("{} {} {}"),
    "comments": "# made by hand\n! 1 2 3\n" + lines("{} {} {}") + "\n\n",
    "old Mac or Windows": lines("{} {} {}").replace("\n", "\r\n"),
    "header with quotes": '"x","y","z"\n' + lines("{},{},{}"),
    "unknown header": "a b c\n" + lines("{} {} {}"),
}


@pytest.mark.parametrize("name", TEXT)
def test_positions_of_text_in_all_dialects(tmp_path, name):
    for suffix in (".xyz", ".txt", ".csv", ".asc", ".pts"):
        path = tmp_path / f"a{suffix}"
        path.write_text(TEXT[name], encoding="utf-8", newline="")
        np.testing.assert_array_equal(read_geometry(path).positions, POINTS)


def test_text_of_utf_16(tmp_path):
    (tmp_path / "a.txt").write_text(lines("{} {} {}"), encoding="utf-16")
    np.testing.assert_array_equal(read_geometry(tmp_path / "a.txt").positions, POINTS)


TEXT_COLORS = {
    "bytes": ("", f" {RED} {GREEN} {BLUE}"),
    "16 bits": ("", f" {RED * 256} {GREEN * 256} {BLUE * 256}"),
    "fractions": ("", f" {RED / 255:.5f} {GREEN / 255:.5f} {BLUE / 255:.5f}"),
    "header": ("X Y Z Intensity R G B\n", f" 1200 {RED} {GREEN} {BLUE}"),
    "CloudCompare's fractions": (
        "//X Y Z Rf Gf Bf\n",
        f" {RED / 255:.5f} {GREEN / 255:.5f} {BLUE / 255:.5f}",
    ),
    "normals in front": ("", f" 0.6 0.0 0.8 {RED} {GREEN} {BLUE}"),
    "normals behind": ("", f" {RED} {GREEN} {BLUE} 0.6 0.0 0.8"),
}


@pytest.mark.parametrize("name", TEXT_COLORS)
def test_colors_of_text(tmp_path, name):
    head, rest = TEXT_COLORS[name]
    (tmp_path / "a.txt").write_text(head + lines("{} {} {}", rest=rest))
    found = read_geometry(tmp_path / "a.txt")
    assert (found.colors == [RED, GREEN, BLUE]).all()
    assert ("normals" in found.attributes) == name.startswith("normals")
    if "normals" in found.attributes:
        np.testing.assert_allclose(found.attributes["normals"], [[0.6, 0, 0.8]] * 3)


def test_pts_has_the_intensity_before_the_colors(tmp_path):
    (tmp_path / "a.pts").write_text("3\n" + lines("{} {} {}", rest=f" -1200 {RED} {GREEN} {BLUE}"))
    assert (read_geometry(tmp_path / "a.pts").colors == [RED, GREEN, BLUE]).all()


def test_columns_without_names_are_told(tmp_path, caplog):
    (tmp_path / "a.txt").write_text(lines("{} {} {}", rest=" -7.5 1200 3000.5"))
    with caplog.at_level(logging.WARNING):
        assert read_geometry(tmp_path / "a.txt").colors is None
    assert "3 of its 6 columns have no names" in caplog.text


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("637,000.25 849,000.5 410.1\n" * 3, "thousands"),
        ("1 2\n3 4\n", "save it as PLY or LAS"),
        ("1 2 3\n1 2 3 4\n", "3 and 4"),
        ("1 2 3\nNaN? 2 3\n", "line 2"),
    ],
)
def test_other_text_is_refused_with_what_to_do(tmp_path, text, match):
    (tmp_path / "a.xyz").write_text(text)
    with pytest.raises(InputError, match=match):
        read_geometry(tmp_path / "a.xyz")


@pytest.mark.parametrize("suffix", [".ptx", ".stl", ".glb"])
def test_other_formats_are_refused_with_what_to_save(site, tmp_path, suffix):
    (tmp_path / f"a{suffix}").write_bytes(bytes(64))
    settings = Import(project=tmp_path / f"a{suffix}")
    assert import_project.is_geometry(settings.project, settings)
    with pytest.raises(InputError, match="save it as LAS"):
        label.run(site, Label(cloud=tmp_path / f"a{suffix}"))


def test_float32_at_utm_size_is_told(tmp_path, caplog):
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(ground(1.0).astype(np.float32)))
    o3d.t.io.write_point_cloud(str(tmp_path / "a.ply"), cloud)
    with caplog.at_level(logging.WARNING):
        read_cloud(tmp_path / "a.ply")
    assert "steps of 0.5" in caplog.text


def read_text(folder, text, suffix=".txt"):
    (folder / f"a{suffix}").write_text(text, encoding="utf-8")
    return read_geometry(folder / f"a{suffix}")


NUMBERED = "".join(f"{-9 - n},{x},{y},{z}\n" for n, (x, y, z) in enumerate(POINTS))
HEADERS = {
    "blank in a name": "Point ID,X,Y,Z\n" + NUMBERED,
    "blank in a quoted name": '"Point ID","X","Y","Z"\n' + NUMBERED,
    "blank in a name, semicolons": commas("Point ID;X;Y;Z\n" + NUMBERED.replace(",", ";")),
    "blank in a name, tabs": "Point ID\tX\tY\tZ\n" + NUMBERED.replace(",", "\t"),
    "blank in a name, bars": "Point ID | X | Y | Z\n" + NUMBERED.replace(",", " | "),
    "units in brackets": "No [-],X [m],Y [m],Z [m]\n" + NUMBERED,
    "units below": "No,X,Y,Z\n-,m,m,m\n" + NUMBERED,
    "German": "Nr;Hochwert;Rechtswert;H\u00f6he\n"
    + commas("".join(f"{n};{y};{x};{z}\n" for n, (x, y, z) in enumerate(POINTS))),
    "French": "No,Nord,Est,Altitude\n" + "".join(f"{n},{y},{x},{z}\n" for n, (x, y, z) in enumerate(POINTS)),
    "ArcGIS": "OID_,POINT_X,POINT_Y,POINT_Z\n" + NUMBERED,
    "empty lines of a spreadsheet": "No;X;Y;Z\n" + NUMBERED.replace(",", ";") + ";;;\n;;;\n",
    "an empty column": "No,Code,X,Y,Z\n" + "".join(f"1,,{x},{y},{z}\n" for x, y, z in POINTS),
    "own coordinates beside those of a CRS": "x_utm,y_utm,z_utm,x,y,z\n" + lines("1,2,3,{},{},{}"),
    "decimal commas with a comma and a blank between": commas(lines("{}; {}; {}")).replace(";", ","),
    "decimal commas in quotes": commas(lines('"{}";"{}";"{}"')).replace(";", ","),
    "all in quotes": lines('"{}","{}","{}"'),
    "thousandths behind semicolons": commas(lines("{:.3f};{:.3f};{:.3f}")),
}


@pytest.mark.parametrize("name", HEADERS)
def test_columns_are_found_by_their_header(tmp_path, name):
    np.testing.assert_array_equal(read_text(tmp_path, HEADERS[name], ".csv").positions, POINTS)


def test_a_header_in_a_western_encoding(tmp_path):
    (tmp_path / "a.csv").write_bytes(HEADERS["German"].encode("cp1252"))
    np.testing.assert_array_equal(read_geometry(tmp_path / "a.csv").positions, POINTS)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("1.234,5;2.345,6;100,1\n1.235,5;2.346,6;100,1\n", "between thousands"),
        ("1.234,5 2.345,6 100,1\n1.235,5 2.346,6 100,1\n", "between thousands"),
        ('"1,234.5","2,345.6","100.1"\n', "between thousands"),
        ("1.234 2.345 100,1\n", "with commas .* and numbers with points"),
        ("1,2,3;4,5,6;7,8,9\n", "is no number"),
        ("ncols 3\nnrows 2\nxllcorner 5\nyllcorner 5\ncellsize 1\n1 2 3\n4 5 6\n", "gdal_translate"),
        ("DSAA\n3 2\n0 2\n0 1\n1 6\n1 2 3\n4 5 6\n", "gdal_translate"),
        ("north: 2\nsouth: 0\neast: 3\nwest: 0\nrows: 2\ncols: 3\n1 2 3\n4 5 6\n", "gdal_translate"),
        ("latitude,longitude,altitude\n48.1,11.5,500\n", "degrees: convert"),
        ("Punkt,Lage1,Lage2,Lage3\n1,2,3,4\n", "name those columns x y z"),
        ("Hochwert,Lage,Tiefe\n1,2,3\n", "name those columns x y z"),
        ("id,x,y,z\n1,2,3,4,5\n", "4 columns .* have 5"),
        ("id,x,y,z,label\nP1,1,2,3,4\n", "column 'id': .* 'P1'"),
        ("x,y,z,class\n1,2,3,building\n", "line 2, column 'class'"),
        ("time;x;y;z\n12:00:01;1;2;3\n", "column 'time'"),
        ("1_0 2 3\n4 5 6\n", "line 1, column 1"),
    ],
)
def test_text_that_may_be_misread_is_refused(tmp_path, text, match):
    with pytest.raises(InputError, match=match):
        read_text(tmp_path, text)


def test_a_header_that_is_not_used_is_told(tmp_path, caplog):
    read_text(tmp_path, "x y z of the roof\n" + lines("{} {} {}"))
    assert "is no header of 3 columns" in caplog.text


def test_pts_with_fewer_points_than_announced_is_told(tmp_path, caplog):
    read_text(tmp_path, "5\n" + lines("{} {} {} 1 2 3 4"), ".pts")
    assert "announces 5 points, 3 are there" in caplog.text


def test_empty_fields_are_nan(tmp_path):
    found = read_text(tmp_path, "x,y,z,intensity\n1,2,3,\n4,5,6,7\n", ".csv")
    np.testing.assert_array_equal(found.attributes["intensity"], [np.nan, 7])


@pytest.mark.parametrize("shading", [True, False])
@pytest.mark.parametrize("first", [True, False])
def test_intensity_before_or_behind_colors(tmp_path, caplog, first, shading):
    """Colors go together, an intensity goes its own way; where it does not, the reading is told."""
    rng = np.random.default_rng(0)
    gray = rng.integers(20, 200, 400)
    rgb = np.stack([gray + 30, gray + 10, gray], axis=1) + rng.integers(0, 8, (400, 3))
    intensity = rng.integers(0, 200, 400) if shading else gray + 1
    rest = np.column_stack([intensity, rgb] if first else [rgb, intensity])
    rows = np.column_stack([rng.uniform(0, 9, (400, 3)).round(2), rest])
    text = "".join(" ".join(f"{value:g}" for value in row) + "\n" for row in rows)
    colors = read_text(tmp_path, text).colors
    if shading:
        np.testing.assert_array_equal(colors, rgb)
    assert ("may be r g b and another one" in caplog.text) == (not shading or first)


def test_normals_of_xyzn_are_no_colors(tmp_path):
    found = read_text(tmp_path, "1 2 3 0 0 1\n4 5 6 0 0 2.5\n7 8 9 0 0 0\n", ".xyzn")
    assert found.colors is None
    np.testing.assert_allclose(found.attributes["normals"], [[0, 0, 1], [0, 0, 1], [0, 0, 0]])


def test_classes_that_are_none_are_counted(tmp_path, caplog):
    text = "x,y,z,classification\n" + "".join(f"1,2,3,{value}\n" for value in (300, -1, "nan", 2.6, 5))
    assert read_text(tmp_path, text).attributes["classification"].tolist() == [0, 0, 0, 0, 5]
    assert "4 of 5 points have a classification" in caplog.text and "300" in caplog.text


# ---- colors by most of the points


@pytest.mark.parametrize("name", ["text", "LAS", "LAS in parts", "PLY of floats", "PLY of fractions", "PCD"])
def test_one_bright_point_makes_no_others_black(tmp_path, caplog, name):
    rgb = np.full((8, 3), (RED, GREEN, BLUE), np.float64)
    rgb[0, 0] = 65535
    if name == "text":
        text = "".join(f"{x} {y} {z} {r:g} {g:g} {b:g}\n" for (x, y, z), (r, g, b) in zip(small(), rgb))
        colors = read_text(tmp_path, "x y z r g b\n" + text).colors
    elif name == "PCD":
        head = "FIELDS x y z r g b\nSIZE 4 4 4 2 2 2\nTYPE F F F U U U\nCOUNT 1 1 1 1 1 1\nWIDTH 8\nHEIGHT 1\nDATA ascii\n"
        rows = "".join(f"1 2 3 {r:g} {g:g} {b:g}\n" for r, g, b in rgb)
        (tmp_path / "a.pcd").write_text("VERSION 0.7\n" + head + rows)
        colors = read_geometry(tmp_path / "a.pcd").colors
    elif name.startswith("LAS"):
        path = write_las(tmp_path / "a.las", small(), colors=rgb.astype(np.uint16))
        (_, records), *_ = CloudFile.open(path).chunks()
        parts = np.stack([records[axis] for axis in ("red", "green", "blue")], 1)
        colors = parts if "parts" in name else read_geometry(path).colors
    else:
        if "fractions" in name:
            rgb /= 255
            rgb[0, 0] = 30.0
        columns = {n: ("float", "<f4", rgb[:, k]) for k, n in enumerate(("red", "green", "blue"))}
        colors = read_geometry(write_ply(tmp_path / "a.ply", small(), columns)).colors
    assert (colors[1:] == (RED, GREEN, BLUE)).all() and colors[0, 0] == 255
    assert "1 of 8 points have colors beyond" in caplog.text


@pytest.mark.parametrize("top", [255.6, 256.0])
def test_colors_a_little_beyond_a_byte(tmp_path, top):
    rgb = np.tile([top, GREEN, BLUE], (8, 1))
    columns = {n: ("float", "<f4", rgb[:, k]) for k, n in enumerate(("red", "green", "blue"))}
    assert (read_geometry(write_ply(tmp_path / "a.ply", small(), columns)).colors == (255, GREEN, BLUE)).all()
    text = "x y z r g b\n" + f"1 2 3 {top} {GREEN} {BLUE}\n" * 3
    assert (read_text(tmp_path, text).colors == (255, GREEN, BLUE)).all()


# ---- PCD


def write_pcd(path, fields, sizes, types, counts, body, points, kind="ascii"):
    head = f"FIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\nWIDTH {points}\nHEIGHT 1\nDATA {kind}\n"
    path.write_bytes(f"VERSION 0.7\n{head}".encode() + body)
    return path


PLAIN = ("x y z", "4 4 4", "F F F", "1 1 1")


@pytest.mark.parametrize(
    ("body", "match"),
    [
        ("10.25 20.5 30.125\n" * 2, "9 numbers|3 points of 3 numbers are announced, 6"),
        ("10.25 20.5 30.125\n" * 2 + "10.25 20", "are announced, 8"),
        ("10.25 20.5 30.125\n" * 4, "are announced, 12"),
        ("1,5 2,5 3\n" * 3, "not numbers with a point"),
    ],
)
def test_pcd_of_other_words_is_refused(tmp_path, body, match):
    path = write_pcd(tmp_path / "a.pcd", *PLAIN, body.encode(), 3)
    with pytest.raises(InputError, match=match):
        read_geometry(path)


@pytest.mark.parametrize("kind", ["ascii", "binary"])
def test_pcd_with_padding_and_fields_of_several_numbers(tmp_path, kind):
    """As PCL and ROS write them."""
    fields = ("x y z _ rgb normal_x normal_y normal_z hist _", "4 4 4 1 4 4 4 4 4 1", "F F F U U F F F F U")
    dtype = [(n, "<f4") for n in "xyz"] + [("a", "u1", 4), ("rgb", "<u4")]
    dtype += [("n", "<f4", 3), ("hist", "<f4", 3), ("b", "u1", 12)]
    table = np.zeros(2, dtype)
    table["x"], table["y"], table["z"] = np.float32(POINTS[:2].T % 1000)
    table["rgb"], table["n"], table["hist"] = (RED << 16) + (GREEN << 8) + BLUE, (0, 0, 1), (7, 8, 9)
    body = table.tobytes()
    if kind == "ascii":
        rows = [np.concatenate([np.atleast_1d(value) for value in row]) for row in table.tolist()]
        body = "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows).encode()
    path = write_pcd(tmp_path / "a.pcd", *fields, "1 1 1 4 1 1 1 1 3 12", body, 2, kind)
    found = read_geometry(path)
    np.testing.assert_allclose(found.positions, POINTS[:2] % 1000)
    assert (found.colors == (RED, GREEN, BLUE)).all() and (found.attributes["normals"] == (0, 0, 1)).all()
    assert (found.attributes["hist"] == (7, 8, 9)).all()
    write_geometry(tmp_path / "b.ply", to_open3d(found))
    assert (read_cloud(tmp_path / "b.ply").point["hist_2"].numpy() == 9).all()


def test_compressed_pcd_with_padding_is_refused(tmp_path):
    body = struct.pack("<II", 40, 32) + bytes(40)
    path = write_pcd(
        tmp_path / "a.pcd", "x y z _", "4 4 4 1", "F F F U", "1 1 1 4", body, 2, "binary_compressed"
    )
    with pytest.raises(InputError, match="without compression"):
        read_geometry(path)


def test_binary_pcd_with_more_points_than_announced_is_told(tmp_path, caplog):
    path = write_pcd(tmp_path / "a.pcd", *PLAIN, np.ones((5, 3), "<f4").tobytes(), 3, "binary")
    assert len(read_geometry(path).positions) == 3
    assert "announces 3 points, but there is room for 2 more" in caplog.text


# ---- PLY and OBJ dialects


def test_lists_of_points_are_told(tmp_path, caplog):
    head = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / "a.ply").write_text(head + "property list uchar int ids\nend_header\n1 2 3 2 7 8\n")
    assert len(read_geometry(tmp_path / "a.ply").positions) == 1
    assert "lists of its points are left out: ids" in caplog.text


def test_normals_named_as_pcl_does_turn_with_their_cloud(site, tmp_path):
    names = ("normal_x", "normal_y", "normal_z")
    columns = {name: ("float", "<f4", value) for name, value in zip(names, (0, 0, 1), strict=True)}
    path = write_ply(tmp_path / "a.ply", ground(1.0), columns)
    import_project.run(site, Import(project=path, cloud=(path,), epsg=32615))
    normals = read_cloud(site.cloud).point.normals.numpy()
    np.testing.assert_allclose(normals, np.tile([0, 0, 1], (len(normals), 1)), atol=1e-3)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_ply_with_capitals(tmp_path, form):
    path = write_ply(
        tmp_path / "a.ply", small(), {"Red": ("uchar", "u1", RED), "q": ("int", "<i4", 5)}, form=form
    )
    content = path.read_bytes()
    for axis in "xyz":
        content = content.replace(f"double {axis}\n".encode(), f"double {axis.upper()}\n".encode(), 1)
    path.write_bytes(content)
    found = read_geometry(path)
    np.testing.assert_array_equal(found.positions, small())
    assert (found.attributes["q"] == 5).all()


def test_mesh_with_capitals_is_refused(tmp_path):
    path = write_ply(tmp_path / "a.ply", small(), {}, faces=[(0, 1, 2)])
    for axis in b"xyz":
        path.write_bytes(path.read_bytes().replace(b"double %c\n" % axis, b"double %c\n" % (axis - 32)))
    with pytest.raises(InputError, match="as X Y Z"):
        read_geometry(path)


def test_ply_with_blanks_in_a_name_says_which_line(tmp_path):
    path = write_ply(tmp_path / "a.ply", small(), {"Original cloud index": ("float", "<f4", 1)})
    with pytest.raises(InputError, match="property float Original cloud index"):
        read_geometry(path)


def test_obj_with_tabs_comments_and_continued_lines(tmp_path):
    (tmp_path / "a.obj").write_text(
        "v\t0 0 0 # a corner\nv 1\t0 0\nv 1 1 0\nv 0 1 0\nf\t1//1 2//1 \\\n 3//1 4//1 # a face\n"
    )
    found = read_geometry(tmp_path / "a.obj")
    assert found.positions.shape == (4, 3) and found.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]


# ---- what a LAS header says


def patched(path, kind, offset, *values):
    content = bytearray(path.read_bytes())
    struct.pack_into(kind, content, offset, *values)
    path.write_bytes(content)
    return path


def test_las_with_more_points_than_it_counts_is_told(tmp_path, caplog):
    path = patched(write_las(tmp_path / "a.las", small(), form=3, version="1.2"), "<I", 107, 5)
    assert len(read_geometry(path).positions) == 5
    assert "counts 5 points" in caplog.text and "3 more" in caplog.text
    caplog.clear()
    CloudFile.open(path)
    assert "3 more" in caplog.text


@pytest.mark.parametrize(
    ("version", "kind", "offset", "values", "match"),
    [
        ("1.2", "<I", 107, (0,), "room for 8"),
        ("1.4", "<Q", 247, (0,), "counts 0 points in the header of version 1.4, but 8"),
        ("1.2", "<3d", 131, (0.0, 0.0, 0.0), "a scale of 0"),
        ("1.2", "<d", 155, (float("nan"),), "finite"),
    ],
)
def test_las_whose_header_cannot_be_right_is_refused(tmp_path, version, kind, offset, values, match):
    path = patched(write_las(tmp_path / "a.las", small(), form=3, version=version), "<I", 107, 8)
    path = patched(path, kind, offset, *values)
    with pytest.raises(InputError, match=match):
        read_geometry(path)


def test_all_dimensions_of_las_are_kept(tmp_path, caplog):
    kept = {
        "gps_time": 1e5,
        "user_data": 3,
        "point_source_id": 40000,
        "scan_angle": -500,
        "nir": 60000,
        "withheld": 1,
    }
    header = laspy.LasHeader(version="1.4", point_format=8)
    las = laspy.LasData(header)
    las.x, las.y, las.z = small().T
    for name, value in kept.items():
        las[name] = np.full(8, value)
    las.write(tmp_path / "a.laz")
    write_geometry(tmp_path / "b.ply", to_open3d(read_geometry(tmp_path / "a.laz")))
    cloud = read_cloud(tmp_path / "b.ply")
    for name, value in kept.items():
        assert (cloud.point[name].numpy() == value).all(), name
    assert "8 of 8 points are marked as withheld" in caplog.text


# ---- attributes of LAS and PLY

ODD_NAMES = [
    "Original cloud index",
    "C2C absolute distances",
    "positions",
    "normals",
    "colors",
    "x[t]",
    "H\u00f6he",
]
ODD_NAMES += ["nx", "red", "x", "label", "a" * 31, "%", "votes_1"]


@pytest.mark.parametrize("name", ODD_NAMES)
def test_clouds_with_odd_dimensions_can_be_read_again(tmp_path, name):
    values = np.arange(8, dtype=np.float32)
    form, extra = (7, [(name, values)]) if name not in ("red", "x") else (6, [(f"{name} ", values)])
    path = write_las(tmp_path / "a.las", small(), extra=extra, form=form)
    write_geometry(tmp_path / "cloud.ply", to_open3d(read_geometry(path)))
    cloud = read_cloud(tmp_path / "cloud.ply")
    np.testing.assert_allclose(cloud.point.positions.numpy(), small(), atol=1e-3)
    columns = [cloud.point[key].numpy().ravel() for key in cloud.point]
    assert any(column.shape == (8,) and (column == values).all() for column in columns)


@pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"])
def test_dimensions_of_any_type_are_kept(tmp_path, dtype):
    values = np.arange(8).astype(dtype) - (3 if dtype[0] in "if" else 0)
    path = write_las(tmp_path / "a.las", small(), extra=[("quality", values.astype(dtype))])
    write_geometry(tmp_path / "cloud.ply", to_open3d(read_geometry(path)))
    np.testing.assert_array_equal(read_cloud(tmp_path / "cloud.ply").point["quality"].numpy().ravel(), values)


def test_small_integers_of_a_ply_can_be_written_again(tmp_path):
    path = write_ply(tmp_path / "a.ply", small(), {"q": ("char", "<i1", -5), "r": ("short", "<i2", 300)})
    write_geometry(tmp_path / "b.ply", read_cloud(path))
    assert (read_cloud(tmp_path / "b.ply").point["q"].numpy() == -5).all()


def test_normals_in_extra_dimensions_are_normals(tmp_path):
    extra = [
        (name, np.full(8, value, np.float32))
        for name, value in zip(("NormalX", "NormalY", "NormalZ"), (0.6, 0, 0.8))
    ]
    found = read_geometry(write_las(tmp_path / "a.las", small(), extra=extra))
    np.testing.assert_allclose(found.attributes["normals"], [[0.6, 0, 0.8]] * 8, rtol=1e-6)


# ---- LAZ of the first LASzip


def stream_laz(path, count=1000):
    """All points in one stream without chunks, as LASzip 1 wrote them."""
    written = io.BytesIO()
    las = laspy.LasData(laspy.LasHeader(version="1.2", point_format=2))
    las.header.scales = np.full(3, 0.001)
    las.x, las.y, las.z = small(count).T
    las.red = las.green = las.blue = np.full(count, RED * 256, np.uint16)
    las.write(written, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
    content = bytearray(written.getvalue())
    record, offset = content.find(b"laszip encoded") + 52, struct.unpack_from("<I", content, 96)[0]
    table = struct.unpack_from("<q", content, offset)[0]
    struct.pack_into("<H", content, record, 1)
    struct.pack_into("<I", content, record + 12, 0)
    path.write_bytes(bytes(content[:offset]) + bytes(content[offset + 8 : table]))
    return path


def test_laz_without_chunks_is_read(tmp_path):
    found = read_geometry(stream_laz(tmp_path / "a.laz"))
    np.testing.assert_allclose(found.positions, small(1000), atol=1e-3)
    assert (found.colors == RED).all()
    records = np.concatenate([records for _, records in CloudFile.open(tmp_path / "a.laz").chunks()])
    np.testing.assert_allclose(records["x"], small(1000)[:, 0], atol=1e-3)


def test_a_damaged_stream_is_refused(tmp_path):
    content = stream_laz(tmp_path / "a.laz").read_bytes()
    (tmp_path / "a.laz").write_bytes(content[: len(content) // 2])
    for read in (read_geometry, lambda path: list(CloudFile.open(path).chunks())):
        with pytest.raises(InputError, match="cannot read"):
            read(tmp_path / "a.laz")
    assert lazrs


# ---- units and CRS


def heights(path):
    return np.ptp(read_geometry(path).positions[:, 2])


FEET = 0.3048006096


def hill():
    points = np.random.default_rng(0).uniform(-50, 50, (200, 3)) + [480000, 4980000, 200]
    points[:, 2] = 200 + np.linspace(0, 10, 200)
    return points


@pytest.mark.parametrize("code", ["EPSG:26915+6360", "EPSG:26915+5703", "EPSG:26915"])
def test_heights_of_a_compound_crs_have_their_own_unit(tmp_path, code):
    unit = FEET if code.endswith("6360") else 1.0
    path = write_las(tmp_path / "a.laz", hill() * [1, 1, 1 / unit], pyproj.CRS(code))
    found = read_geometry(path)
    assert found.epsg == 26915 and abs(heights(path) - 10) < 0.01
    z = np.concatenate([records["z"] for _, records in CloudFile.open(path).chunks()])
    np.testing.assert_allclose(z, found.positions[:, 2], atol=1e-9)


def test_meters_over_horizontal_feet(tmp_path):
    path = write_las(tmp_path / "a.laz", hill(), pyproj.CRS("EPSG:2263+5703"))
    assert abs(heights(path) - 10 / FEET) < 0.05 and read_geometry(path).epsg == 2263  # one unit: feet


def geo_keys(path, keys):
    """LAS 1.2 with GeoTIFF keys only."""
    header = laspy.LasHeader(version="1.2", point_format=2)
    header.scales, header.offsets = np.full(3, 0.001), [480000, 4980000, 0]
    data = struct.pack("<4H", 1, 1, 0, len(keys)) + b"".join(
        struct.pack("<4H", key, 0, 1, v) for key, v in keys
    )
    header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", data))
    las = laspy.LasData(header)
    las.x, las.y, las.z = (hill() * [1, 1, 1 / FEET]).T
    las.write(path)
    return path


@pytest.mark.parametrize("keys", [[(4099, 9003)], [(4096, 6360)]])
def test_unit_of_heights_in_geotiff_keys(tmp_path, keys):
    path = geo_keys(tmp_path / "a.las", [(1024, 1), (3072, 26915), *keys])
    assert read_geometry(path).epsg == 26915 and abs(heights(path) - 10) < 0.01


def test_towgs84_hides_no_crs(tmp_path):
    wkt = pyproj.CRS.from_epsg(32633).to_wkt("WKT1_GDAL")
    wkt = wkt.replace('AUTHORITY["EPSG","7030"]],', 'AUTHORITY["EPSG","7030"]],TOWGS84[0,0,0,0,0,0,0],')
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.global_encoding.wkt = True
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    las = laspy.LasData(header)
    las.x, las.y, las.z = small().T
    las.write(tmp_path / "a.las")
    assert pyproj.CRS(wkt).is_bound and read_geometry(tmp_path / "a.las").epsg == 32633


@pytest.mark.parametrize("code", ["EPSG:4326", "EPSG:4979", "EPSG:4326+5773"])
def test_degrees_are_refused(tmp_path, code):
    path = write_las(tmp_path / "a.laz", small(), pyproj.CRS(code))
    with pytest.raises(InputError, match="in degrees: convert"):
        read_geometry(path)


def test_a_crs_without_a_code_is_told(tmp_path, caplog):
    crs = pyproj.CRS("+proj=tmerc +lat_0=12 +lon_0=33 +k=0.9 +x_0=1 +y_0=2 +ellps=bessel")
    with caplog.at_level(logging.WARNING):
        assert read_geometry(write_las(tmp_path / "a.laz", small(), crs)).epsg is None
    assert "no EPSG code" in caplog.text


def test_epsg_of_a_compound_crs_is_refused_with_its_horizontal_part(site):
    with pytest.raises(InputError, match="EPSG:25832"):
        projected_crs(5972)
    with pytest.raises(InputError, match="heights too"):
        find_projection(site, Export(epsg=5972))


def test_export_far_from_the_area_of_a_crs_is_told(site, caplog):
    with caplog.at_level(logging.WARNING):
        find_projection(site, Export(epsg=2263))
    assert "lies outside" in caplog.text


def test_control_points_in_a_compound_crs_have_heights_in_its_unit():
    crs = pyproj.CRS("EPSG:26915+6360")
    assert crs_to_geodetic(np.array([[480000.0, 4980000.0, 100.0]]), crs)[0, 2] == pytest.approx(100 * FEET)


# ---- frames


def test_a_cloud_elsewhere_is_told_with_both_boxes(caplog):
    geometry = read_like(np.zeros((5, 3)) + [0, 0, 1])
    with caplog.at_level(logging.WARNING):
        place_geometries(geometry, None, views(), np.zeros((0, 3)), None)
    assert "elsewhere than the cameras" in caplog.text and "512344" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        place_geometries(read_like(ground()), None, views(), ground(), None)
    assert not caplog.text


def read_like(points):
    from pathlib import Path

    from sc3d.importers.clouds import Geometry

    return {Path("a.ply"): Geometry(points, None, {})}


def labelled(scene, cloud, **options):
    figures = label.run(scene, Label(cloud=cloud, **options))
    return read_cloud(scene.seeds), figures


@pytest.mark.parametrize("kind", ["crs", "none", "feet", "ply", "text"])
def test_a_cloud_in_the_crs_is_labelled_as_after_import(site, tmp_path, kind):
    points, code = ground(0.2), {"crs": "EPSG:32615", "feet": "EPSG:32615+6360"}.get(kind)
    if kind == "ply":
        path = write_ply(tmp_path / "a.ply", points, {})
    elif kind == "text":
        path = tmp_path / "a.xyz"
        np.savetxt(path, points, fmt="%.3f")
    else:
        stretched = points / [1, 1, FEET if kind == "feet" else 1]
        path = write_las(tmp_path / "a.laz", stretched, None if code is None else pyproj.CRS(code))
    seeds, figures = labelled(site, path)
    local = seeds.point.positions.numpy()
    np.testing.assert_allclose(local, points - ORIGIN, atol=2e-3)
    label_of = seeds.point["label"].numpy().ravel()
    assert (label_of > 0).mean() > 0.8
    sure = np.abs(local[:, 0]) > 0.5
    assert (label_of == np.where(local[:, 0] < 0, 1, 3))[sure & (label_of > 0)].all()
    assert not [file for file in site.path.iterdir() if file.name.startswith(".")]
    import_project.run(site, Import(project=path, cloud=(path,)))
    assert label.run(site, Label()) == figures


def test_a_cloud_in_the_crs_is_the_same_read_in_parts(site, tmp_path, monkeypatch):
    path = write_las(tmp_path / "a.laz", ground(0.2), pyproj.CRS("EPSG:32615"))
    seeds, _ = labelled(site, path)
    monkeypatch.setattr("sc3d.importers.given_cloud.fits", lambda *_: False)
    again, _ = labelled(site, path)
    np.testing.assert_array_equal(again.point.positions.numpy(), seeds.point.positions.numpy())
    np.testing.assert_array_equal(again.point["label"].numpy(), seeds.point["label"].numpy())


def test_normals_turn_with_their_cloud(site):
    """A georeference with a quarter turn: what is east in the CRS is north in the world."""
    turn = [[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    content = {"epsg": 32615, "offset": ORIGIN.tolist(), "local_from_world": turn}
    (site.path / "georeference.json").write_text(json.dumps(content))
    from pathlib import Path

    from sc3d.georeferencing.georeference import read_georeference
    from sc3d.importers.clouds import Geometry

    east = np.tile(np.float32([[1, 0, 0]]), (9, 1))
    geometry = {Path("a.ply"): Geometry(ground()[:9], None, {"normals": east}, epsg=32615)}
    placed, _ = place_geometries(geometry, read_georeference(site), site.model.views, np.zeros((0, 3)), None)[
        Path("a.ply")
    ]
    np.testing.assert_allclose(placed.attributes["normals"], np.tile([[0, 1, 0]], (9, 1)), atol=1e-6)


@pytest.mark.parametrize("label_it", [label_scene, label_scene_by_tiles])
def test_a_cloud_that_no_photo_sees_is_refused_with_numbers(site, tmp_path, label_it):
    up = np.tile(np.float32([0, 0, 1]), (6400, 1)).T
    normals = {name: ("float", "<f4", column) for name, column in zip(("nx", "ny", "nz"), up, strict=True)}
    path = write_ply(tmp_path / "a.ply", ground() - ORIGIN + [0, 0, 5e5], normals)
    with pytest.raises(InputError, match=r"no photo with a mask looks at .*z 500000.0 to"):
        label_it(site, Label(cloud=path, voxel_size=0.5, surface="surfels"))


@pytest.mark.parametrize("unlabelled, unseen", [("ignore", "100.0%"), ("evidence", "0.0%")])
def test_all_unseen_is_a_warning_with_numbers(site, tmp_path, caplog, unlabelled, unseen):
    """In the photos, but where the masks have no label."""
    path = write_ply(tmp_path / "a.ply", (ground() - ORIGIN) * [0.05, 0.05, 1] + [4.3, 0, 0], {})
    with caplog.at_level(logging.WARNING):
        _, figures = labelled(site, path, voxel_size=0.5, unlabelled=unlabelled)
    assert figures["unseen"] == unseen and figures.get("of_no_class", "100.0%") == "100.0%"
    assert "no photo sees any of the 6400 points" in caplog.text and "the 5 cameras" in caplog.text


@pytest.mark.parametrize("name", ["chunk table", "count", "vlr", "cut"])
def test_hostile_laz_is_refused_by_label_too(site, tmp_path, name):
    content = bytearray(write_las(tmp_path / "a.laz", ground(), pyproj.CRS("EPSG:32615")).read_bytes())
    offset, record = struct.unpack_from("<I", content, 96)[0], content.find(b"laszip encoded") + 52
    if name == "chunk table":
        struct.pack_into("<q", content, offset, 1 << 40)
    elif name == "count":
        struct.pack_into("<Q", content, 247, 0)
    elif name == "vlr":
        struct.pack_into("<H", content, record, 9)
    else:
        del content[-len(content) // 3 :]
    (tmp_path / "a.laz").write_bytes(content)
    with pytest.raises(InputError):
        label.run(site, Label(cloud=tmp_path / "a.laz"))


# ---- normals


def room(sides):
    """A floor with a box, and the normals times sides (N,)."""
    rng = np.random.default_rng(1)
    points = np.c_[rng.uniform(-4, 4, (3000, 2)), np.zeros(3000)]
    normals = np.tile(np.float32([0, 0, 1]), (3000, 1))
    return points, normals * sides(rng, 3000)[:, None]


SIDES = {
    "right": (lambda rng, count: np.ones(count, np.float32), Sides.KEEP),
    "inverted": (lambda rng, count: -np.ones(count, np.float32), Sides.INVERT),
    "mixed": (lambda rng, count: rng.choice([-1, 1], count).astype(np.float32), Sides.ORIENT),
    "mostly inverted": (lambda rng, count: np.where(rng.random(count) < 0.7, -1, 1), Sides.ORIENT),
}


@pytest.mark.parametrize("name", SIDES)
def test_the_cameras_tell_the_side_of_normals(site, tmp_path, name):
    sides, expected = SIDES[name]
    points, normals = room(sides)
    assert judge_sides(points, normals, site.model.views, tmp_path / "a.ply") is expected


@pytest.mark.parametrize("label_it", [label_scene, label_scene_by_tiles])
@pytest.mark.parametrize("name", [*SIDES, "some zero", "some nan", "not of unit length"])
def test_labels_do_not_depend_on_the_side_of_normals(site, tmp_path, caplog, name, label_it):
    sides = SIDES[name][0] if name in SIDES else SIDES["right"][0]
    points, normals = room(sides)
    if name == "some zero":
        normals[::7] = 0
    elif name == "some nan":
        normals[::7, 0] = np.nan
    elif name == "not of unit length":
        normals *= 17
    named = zip(("nx", "ny", "nz"), normals.T, strict=True)
    path = write_ply(tmp_path / "a.ply", points, {key: ("float", "<f4", column) for key, column in named})
    with caplog.at_level(logging.WARNING):
        figures = label_it(site, Label(cloud=path, voxel_size=0.5, surface="surfels")).figures()
    assert float(figures["unseen"].rstrip("%")) < 15
    found = read_cloud(site.seeds).point.normals.numpy()
    assert (found[:, 2] > 0.9).all()
    turned = int((normals[:, 2] < 0).sum())
    assert figures.get("normals_turned", 0) == turned
    assert ("away from them" in caplog.text) == (turned > 0)
    assert ("normals have no length" in caplog.text) == name.startswith("some")


@pytest.mark.parametrize("winding", ["right", "flipped", "mixed"])
def test_the_winding_of_a_mesh_does_not_matter(site, winding):
    half = 4.0
    x, y = np.meshgrid(np.linspace(-half, half, 40), np.linspace(-half, half, 40))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    corner = (np.arange(39)[:, None] * 40 + np.arange(39)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + 41], 1), np.stack([corner, corner + 41, corner + 40], 1)]
    )
    rows = {"right": slice(0, 0), "flipped": slice(None), "mixed": slice(None, None, 2)}[winding]
    faces[rows] = faces[rows][:, ::-1]
    mesh = o3d.t.geometry.TriangleMesh(o3d.core.Tensor(vertices), o3d.core.Tensor(faces.astype(np.int32)))
    mesh.compute_vertex_normals()
    write_geometry(site.mesh, mesh)
    figures = label.run(site, Label(voxel_size=0.5))
    assert float(str(figures["unseen"]).rstrip("%")) < 15


@pytest.mark.parametrize("amount", ["2500", "4", "3.5"])
def test_an_amount_of_memory_without_a_unit_is_refused(amount):
    with pytest.raises(InputError, match=f"the unit is missing, such as {amount}M"):
        memory_of(Resources(max_memory=amount))
