"""Broken and malicious geometry files: one clear line within a second and without much memory, and never the
end of the process.
"""

from __future__ import annotations

import struct

import numpy as np
import pytest

from sc3d.errors import InputError
from sc3d.io import record_walk as kernels
from sc3d.io.clouds import read_cloud, read_mesh
from sc3d.io.las import check_las
from sc3d.io.splats import read_splat_ply
from sc3d.scene.labelled_cloud import read_labelled, read_votes
from tests.robustness.hostile_files import (
    LITTLE,
    XYZ,
    labelled_ply,
    mesh_ply,
    patch,
    ply,
    refused,
    splats_ply,
)


@pytest.fixture(scope="module", autouse=True)
def warm(tmp_path_factory):
    """Kernels are loaded once, outside of what is timed."""
    folder = tmp_path_factory.mktemp("warm")
    (folder / "mesh.ply").write_bytes(mesh_ply())
    (folder / "text.ply").write_bytes(mesh_ply("ascii"))
    read_mesh(folder / "mesh.ply"), read_mesh(folder / "text.ply")


# ---- PLY

FACE = ["element face 1", "property list uchar int vertex_indices"]
HOSTILE_PLY = {
    "a million million points": (ply(LITTLE, ["element vertex 1000000000000", *XYZ], bytes(12)), "truncated"),
    "the same in text": (ply("ascii", ["element vertex 1000000000000", *XYZ], b"0 0 0\n"), "truncated"),
    "rows without properties": (
        ply(LITTLE, ["element vertex 1", *XYZ, "element x 999999999999"], bytes(12)),
        "no properties",
    ),
    "count of 300 digits": (ply(LITTLE, ["element vertex " + "9" * 300, *XYZ], bytes(12)), "too long"),
    "negative count": (ply(LITTLE, ["element vertex -1", *XYZ], bytes(12)), "header"),
    "name that overflows RPly": (
        ply(LITTLE, ["element vertex 1", *XYZ, "property float " + "a" * 5000], bytes(16)),
        "too long",
    ),
    "element that overflows RPly": (
        ply(LITTLE, ["element " + "b" * 3000 + " 0", "element vertex 1", *XYZ], bytes(12)),
        "too long",
    ),
    "endless header": (b"ply\n" + b"comment x\n" * 100_000, "header is missing or cut off"),
    "list of 2^31 - 1": (
        ply(
            LITTLE,
            ["element vertex 1", *XYZ, "element face 1", "property list int int vertex_indices"],
            bytes(12) + b"\xff\xff\xff\x7f",
        ),
        "more than 255",
    ),
    "negative list": (
        ply(
            LITTLE,
            ["element vertex 1", *XYZ, "element face 1", "property list int int vertex_indices"],
            bytes(12) + b"\xff" * 4,
        ),
        "negative",
    ),
    "points without x": (ply(LITTLE, ["element vertex 1", *XYZ[1:]], bytes(8)), "x, y, z"),
    "two types": (ply(LITTLE, ["element vertex 1", "property double x", *XYZ[1:]], bytes(16)), "one type"),
    "half a normal": (ply(LITTLE, ["element vertex 1", *XYZ, "property float nx"], bytes(16)), "nx, ny, nz"),
    "x twice": (ply(LITTLE, ["element vertex 1", *XYZ, XYZ[0]], bytes(16)), "twice"),
    "vertices twice": (ply(LITTLE, ["element vertex 1", *XYZ, "element vertex 1", *XYZ], bytes(24)), "twice"),
    "two formats": (ply(LITTLE, ["format ascii 1.0", "element vertex 1", *XYZ], bytes(12)), "one format"),
    "count too small": (
        ply(LITTLE, ["element vertex 1", *XYZ], bytes(24) + b"x" * 100),
        "more than its header announces",
    ),
    "words that are no numbers": (
        ply("ascii", ["element vertex 2", *XYZ], b"0 0 0\nabc 1 2\n"),
        "not numbers",
    ),
    "a number too few": (
        ply("ascii", ["element vertex 2", *XYZ], b"0.00 0.00 0.00\n0.00 0.00\n"),
        "truncated",
    ),
    "a number too many": (ply("ascii", ["element vertex 1", *XYZ], b"0 0 0 0\n"), "more than its header"),
    "uchar 300": (
        ply("ascii", ["element vertex 1", *XYZ, "property uchar label"], b"0 0 0 300\n"),
        "cannot hold",
    ),
    "not a number": (ply("ascii", ["element vertex 1", *XYZ], b"nan 0 0\n"), "not finite"),
    "infinite": (ply(LITTLE, ["element vertex 1", *XYZ], struct.pack("<fff", 0, np.inf, 0)), "not finite"),
    "beyond the moon": (
        ply(LITTLE, ["element vertex 1", *XYZ], struct.pack("<fff", 0, 1e30, 0)),
        "from the origin",
    ),
}
HOSTILE_MESH = {
    "vertex that is not there": (
        ply(LITTLE, ["element vertex 3", *XYZ, *FACE], bytes(36) + b"\x03" + struct.pack("<iii", 0, 1, 3)),
        "does not exist",
    ),
    "vertex -1": (
        ply(LITTLE, ["element vertex 3", *XYZ, *FACE], bytes(36) + b"\x03" + struct.pack("<iii", 0, 1, -1)),
        "does not exist",
    ),
    "vertex 1.5": (
        ply("ascii", ["element vertex 3", *XYZ, *FACE], b"0 0 0\n1 0 0\n0 1 0\n3 0 1 1.5\n"),
        "does not exist",
    ),
    "face without corners": (
        ply(LITTLE, ["element vertex 3", *XYZ, *FACE], bytes(36) + b"\0"),
        "fewer than a face has",
    ),
    "face of two": (
        ply(LITTLE, ["element vertex 3", *XYZ, *FACE], bytes(36) + b"\x02" + struct.pack("<ii", 0, 1)),
        "fewer than a face has",
    ),
    "faces without vertices": (
        ply(LITTLE, ["element vertex 0", *XYZ, *FACE], b"\x03" + bytes(12)),
        "no vertices",
    ),
    "corners as floats": (
        ply(
            LITTLE,
            ["element vertex 3", *XYZ, "element face 1", "property list uchar float vertex_indices"],
            bytes(36) + b"\x03" + bytes(12),
        ),
        "whole numbers",
    ),
    "counts as floats": (
        ply(
            LITTLE,
            ["element vertex 3", *XYZ, "element face 1", "property list float int vertex_indices"],
            bytes(52),
        ),
        "header",
    ),
}


@pytest.mark.parametrize("name", HOSTILE_PLY)
def test_hostile_cloud(tmp_path, name):
    content, match = HOSTILE_PLY[name]
    (tmp_path / "a.ply").write_bytes(content)
    refused(match, read_cloud, tmp_path / "a.ply")


@pytest.mark.parametrize("name", HOSTILE_MESH)
def test_hostile_mesh(tmp_path, name):
    content, match = HOSTILE_MESH[name]
    (tmp_path / "a.ply").write_bytes(content)
    refused(match, read_mesh, tmp_path / "a.ply")


@pytest.mark.parametrize("form", [LITTLE, "binary_big_endian", "ascii"])
def test_every_prefix_of_a_ply_is_refused_and_the_whole_is_read(tmp_path, form):
    for content, read in ((labelled_ply(form, 3), read_cloud), (mesh_ply(form), read_mesh)):
        (tmp_path / "a.ply").write_bytes(content)
        read(tmp_path / "a.ply")
        blank = len(content) - len(content.rstrip()) if form == "ascii" else 0
        digit = 1 if form == "ascii" else 0  # a last number that lost a digit is another number
        for length in range(0, len(content) - blank - digit, 2):
            (tmp_path / "a.ply").write_bytes(content[:length])
            with pytest.raises(InputError):
                read(tmp_path / "a.ply")
            if form == "ascii" and length > content.index(b"end_header") + 11:
                break  # the body is as in the next test


def test_text_without_its_last_number_is_refused(tmp_path):
    words = labelled_ply("ascii", 3).split()
    (tmp_path / "a.ply").write_bytes(labelled_ply("ascii", 3)[: -len(words[-1]) - 1])
    refused("truncated", read_cloud, tmp_path / "a.ply")


@pytest.mark.parametrize("ending", [b"\n", b"\r\n"])
def test_headers_of_all_systems_are_read(tmp_path, ending):
    lines = [
        b"ply",
        b"format binary_little_endian 1.0",
        b"comment end_header",
        b"obj_info made by hand",
        b"element vertex 2",
        *(line.encode() for line in XYZ),
        b"end_header",
        b"",
    ]
    points = np.arange(6, dtype="<f4")
    (tmp_path / "a.ply").write_bytes(ending.join(lines) + points.tobytes() + b"\n")
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply").point.positions.numpy().ravel(), points)


def test_walk_equals_a_plain_loop():
    """Random records, whole and cut: the kernel ends where a loop in Python does."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        sizes = rng.integers(1, 5, 3)
        fields = np.array(
            [[0, sizes[0], 0, 0, 0], [rng.choice([1, 2, 4]), sizes[1], 0, 200, 0], [0, sizes[2], 0, 0, 0]]
        )
        parts = []
        for _ in range(int(rng.integers(0, 6))):
            count = int(rng.integers(0, 8))
            parts.append(
                rng.bytes(sizes[0])
                + count.to_bytes(int(fields[1, 0]), "big")
                + rng.bytes(count * sizes[1])
                + rng.bytes(sizes[2])
            )
        data = b"??" + b"".join(parts)
        assert kernels.walk_bytes(np.frombuffer(data, np.uint8), 2, len(parts), fields, True) == (
            len(data),
            len(parts),
        )
        if parts:
            cut = int(rng.integers(2, len(data)))
            whole = int(np.searchsorted(2 + np.cumsum([len(part) for part in parts]), cut, side="right"))
            assert kernels.walk_bytes(np.frombuffer(data[:cut], np.uint8), 2, len(parts), fields, True) == (
                kernels.CUT_OFF,
                whole,
            )


# ---- clouds with labels, splats, checkpoints


def _with_value(column: str, value: float) -> bytes:
    table = labelled_ply("ascii", 4).decode().splitlines()
    names = [line.split()[2] for line in table if line.startswith("property")]
    types = {
        "label": "float",
        "state": "float",
        "num_views": "float",
        "confidence": "float",
        "votes_1": "float",
    }
    table = [
        f"property {types[line.split()[2]]} {line.split()[2]}"
        if line.startswith("property") and line.split()[2] in types
        else line
        for line in table
    ]
    row = table[-1].split()
    row[names.index(column)] = str(value)
    return ("\n".join([*table[:-1], " ".join(row)]) + "\n").encode()


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("label", 256),
        ("label", -1),
        ("label", 1.5),
        ("label", "nan"),
        ("confidence", 1.01),
        ("confidence", "nan"),
        ("state", 6),
        ("num_views", -1),
        ("num_views", 1e12),
    ],
)
def test_labels_out_of_range(tmp_path, column, value):
    (tmp_path / "seeds.ply").write_bytes(_with_value(column, value))
    refused(column, read_labelled, tmp_path / "seeds.ply", "label")


def test_votes_that_are_none(tmp_path):
    (tmp_path / "seeds.ply").write_bytes(_with_value("votes_1", -3))
    refused("votes", read_votes, read_labelled(tmp_path / "seeds.ply", "label")[0])


@pytest.mark.parametrize(
    ("row", "column", "value"),
    [
        (0, 0, np.nan),
        (3, 2, np.inf),
        (1, 19, 100.0),
        (1, 20, -np.inf),
        (2, 22, np.nan),
        (2, 7, 1e30),
        (2, 18, np.nan),
    ],
)
def test_splats_that_cannot_be_rendered(tmp_path, row, column, value):
    content = splats_ply()
    start = content.index(b"end_header\n") + 11
    values = np.frombuffer(content[start:], "<f4").reshape(20, -1).copy()
    values[row, column] = value
    (tmp_path / "gaussians.ply").write_bytes(content[:start] + values.tobytes())
    refused("not finite, or beyond", read_splat_ply, tmp_path / "gaussians.ply")


# ---- LAS


def test_every_prefix_of_a_las_is_refused(tmp_path):
    from sc3d.importers.clouds import read_geometry
    from tests.importers.test_importers import surveyed, write_las

    for suffix in ("las", "laz"):
        path = write_las(tmp_path / f"a.{suffix}", surveyed(40))
        content = path.read_bytes()
        assert len(read_geometry(path).positions) == 40
        for length in range(0, len(content), 13):
            path.write_bytes(content[:length])
            with pytest.raises(InputError):
                check_las(path)
                read_geometry(path)
        for position, form, value in (
            (96, "<I", 2**32 - 1),
            (100, "<I", 2**32 - 1),
            (105, "<H", 65535),
            (235, "<Q", 2**60),
            (247, "<Q", 2**60),
            (247, "<Q", 41),
        ):
            path.write_bytes(content)
            patch(path, position, form, value)
            if (position, suffix) != (235, "las") and position != 235:
                refused("a.la", read_geometry, path)
        path.write_bytes(content)
        patch(path, 235, "<QI", 400, 2**32 - 1)
        refused("extended records", read_geometry, path)
