"""PLY as it is written: what Open3D reads, and what is refused."""

import numpy as np
import open3d as o3d
import pytest

from sc3d.errors import InputError
from sc3d.io.ply import (
    TYPES,
    Element,
    Property,
    check_ply,
    format_header,
    read_header,
    read_records,
    record_writer,
    write_records,
)

KINDS = sorted(set(TYPES.values()))


def records(count: int, kinds: list[str], order: str = "<") -> np.ndarray:
    """Positions and a column of each kind, over all its values."""
    dtype = [(name, f"{order}f8") for name in "xyz"] + [(f"of_{kind}", order + kind) for kind in kinds]
    made, random = np.zeros(count, dtype), np.random.default_rng(0)
    for name in made.dtype.names:
        made[name] = np.frombuffer(random.bytes(8 * count), "<u8").astype(made.dtype[name])
    return made


@pytest.mark.parametrize("order", ["<", ">"])
def test_records_come_back_as_they_were_in_any_type_and_byte_order(tmp_path, order):
    given = records(100, KINDS, order)
    write_records(tmp_path / "a.ply", given, comments=["one\ntwo", "end_header"])
    found, comments = read_records(tmp_path / "a.ply")
    assert found.dtype.names == given.dtype.names and comments == ("one", "two", "end_header")
    for name in given.dtype.names:
        np.testing.assert_array_equal(found[name], given[name].astype(found.dtype[name]))


def test_open3d_reads_every_type_that_it_has(tmp_path):
    given = records(50, ["u1", "i4", "f4", "f8"])  # it skips the others, and says so
    write_records(tmp_path / "a.ply", given)
    table = o3d.t.io.read_point_cloud(str(tmp_path / "a.ply")).point
    np.testing.assert_array_equal(
        table["positions"].numpy(), np.stack([given[axis] for axis in "xyz"], axis=1)
    )
    for name in given.dtype.names[3:]:
        np.testing.assert_array_equal(table[name].numpy().ravel(), given[name])


def test_chunks_make_the_same_file_as_the_whole(tmp_path):
    given = records(101, ["u1", "f4"])
    write_records(tmp_path / "whole.ply", given, comments=["sc3d"])
    write_records(tmp_path / "chunks.ply", np.array_split(given, 4), given.dtype, 101, ["sc3d"])
    with record_writer(tmp_path / "appended.ply", given.dtype, 101, ["sc3d"]) as append:
        for row in range(101):
            append(given[row : row + 1])
    whole = (tmp_path / "whole.ply").read_bytes()
    assert whole == (tmp_path / "chunks.ply").read_bytes() == (tmp_path / "appended.ply").read_bytes()


def test_gaps_between_fields_are_not_written(tmp_path):
    given = np.zeros(9, np.dtype([("x", "f8"), ("y", "f8"), ("z", "f8"), ("label", "u1")], align=True))
    given["label"] = np.arange(9)
    write_records(tmp_path / "a.ply", given)
    found, _ = read_records(tmp_path / "a.ply")
    assert found.dtype.itemsize == 25 < given.dtype.itemsize
    np.testing.assert_array_equal(found["label"], np.arange(9))


@pytest.mark.parametrize("count", [4, 6])
def test_another_number_of_records_leaves_no_file(tmp_path, count):
    given = records(5, [])
    with pytest.raises(ValueError, match=f"5 records instead of {count}"):
        write_records(tmp_path / "a.ply", [given], given.dtype, count)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "fields",
    [
        [("x", "c8")],
        [("x", "f8")],  # without y and z
        [("a b", "f4")],
        [("a" * 300, "f4")],
        [("positions", "f4")],  # what Open3D calls x, y, z
        [("points", "f4", 3)],
        [("when", "M8[s]")],
    ],
    ids=lambda fields: fields[0][0][:10],
)
def test_what_could_not_be_read_is_not_written(tmp_path, fields):
    with pytest.raises(ValueError):
        write_records(tmp_path / "a.ply", np.zeros(3, fields))
    assert not list(tmp_path.iterdir())


def test_records_of_other_fields_are_refused(tmp_path):
    with pytest.raises(ValueError, match="instead of"):
        write_records(tmp_path / "a.ply", [np.zeros(3, [("a", "f4")])], np.dtype([("b", "f4")]), 3)
    with pytest.raises(ValueError, match="dtype and a count"):
        write_records(tmp_path / "a.ply", [np.zeros(3, [("a", "f4")])])


@pytest.mark.parametrize("size", [0, 300, 512])
def test_a_header_of_a_given_size_for_counts_known_at_the_end(tmp_path, size):
    faces = Element("face", 2, (Property("vertex_indices", "u4", "u1"),))
    elements = (Element("vertex", 4, tuple(Property(axis, "f8") for axis in "xyz")), faces)
    header = format_header(elements, ["one", "two"], size)
    assert len(header) == size or not size
    corners = np.zeros(2, [("count", "u1"), ("corners", "<u4", 3)])
    corners["count"], corners["corners"] = 3, [[0, 1, 2], [1, 2, 3]]
    (tmp_path / "a.ply").write_bytes(header + np.eye(4, 3).tobytes() + corners.tobytes())
    found = check_ply(tmp_path / "a.ply")
    assert found.elements == elements and found.comments[0] == "one" and found.size == len(header)
    assert found.comments[1].rstrip(".") == "two"


def test_no_records_of_a_ply_in_text(tmp_path):
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float a\nend_header\n1\n"
    )
    assert read_header(tmp_path / "a.ply").record is None
    with pytest.raises(InputError, match="binary PLY"):
        read_records(tmp_path / "a.ply")
