"""Damaged and made-up files for every reader: what comes out is a result or an InputError, and valid files
are read as they were written.

`tools/fuzz_readers.py` does the same by hand, with many more cases, in processes of their own.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from sc3d.errors import InputError
from sc3d.georeferencing.georeference import read_georeference
from sc3d.io.clouds import read_cloud
from sc3d.io.ply import TYPES, check_ply
from sc3d.scene.class_table import ClassTable, parse_classes
from sc3d.scene.scene import Scene, match_masks
from tests.robustness.hostile_files import LITTLE, WORDS, damage, damage_json, ply
from tests.robustness.readers import READERS, TEXT

QUICK = settings(derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck))
# examples: what takes longer to read
SLOW = {"opensfm-place": 4, "control-points": 6, "splats": 8, "checkpoint": 8, "laz": 15, "photos": 15}
LEAVES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8), st.sampled_from(WORDS)
)
TREES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=6), inner, max_size=4)
    ),
    max_leaves=12,
)


@pytest.fixture(scope="module", autouse=True)
def quiet():
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """Folder of valid files per reader, made and read once."""
    made: dict[str, Path] = {}

    def get(name: str) -> Path:
        if name not in made:
            made[name] = tmp_path_factory.mktemp(name) / "files"
            READERS[name].build(made[name])
            READERS[name].read(made[name])
        return made[name]

    return get


def reads_or_refuses(read, *arguments) -> object:
    try:
        return read(*arguments)
    except InputError as error:
        assert "\n" not in str(error).strip() and 0 < len(str(error)) < 5000
        return None


@pytest.mark.parametrize("name", READERS)
def test_damaged_files(name, valid):
    reader, folder = READERS[name], valid(name)
    contents = {target: (folder / target).read_bytes() for target in reader.targets}

    @settings(QUICK, max_examples=SLOW.get(name, 25))
    @given(st.sampled_from(reader.targets), st.randoms(use_true_random=False), st.booleans())
    def check(target, rng, as_json):
        content = contents[target]
        tree = as_json and target.endswith(".json")
        (folder / target).write_bytes(
            damage_json(content, rng)
            if tree
            else damage(content, rng, Path(target).suffix in TEXT or b"ascii" in content[:20])
        )
        try:
            reads_or_refuses(reader.read, folder)
        finally:
            (folder / target).write_bytes(content)

    check()


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize(
    "content",
    [b"", b"\0", b"\xff" * 100, b"{}", b"[]", b"[null]", b"ply\n", b"LASF" + bytes(400), b"\n" * 500],
    ids=range(9),
)
def test_other_contents(name, content, valid):
    reader, folder = READERS[name], valid(name)
    for target in reader.targets:
        before = (folder / target).read_bytes()
        (folder / target).write_bytes(content)
        try:
            reads_or_refuses(reader.read, folder)
        finally:
            (folder / target).write_bytes(before)


ENTRY = st.fixed_dictionaries(
    {
        "id": st.one_of(st.integers(-1, 300), TREES),
        "name": st.one_of(st.text(max_size=5), TREES),
        "color": st.one_of(st.lists(st.integers(-1, 256), max_size=4), TREES),
    },
    optional={"prompts": TREES, "asprs": st.one_of(st.integers(-1, 256), TREES)},
)


@settings(QUICK, max_examples=100)
@given(st.one_of(TREES, st.lists(st.one_of(ENTRY, TREES), max_size=4)))
@example([{"id": True, "name": "a", "color": [1, 2, 3]}])
@example([{"id": 1.0, "name": "a", "color": [1, 2, 3]}])
def test_class_tables(entries):
    """What is accepted is a table that is the same when written and read again."""
    table = reads_or_refuses(parse_classes, entries, "test")
    if table is not None:
        assert isinstance(table, ClassTable) and all(
            1 <= entry.id <= 255 and type(entry.id) is int for entry in table
        )
        assert parse_classes(json.loads(json.dumps(table.as_json())), "test") == table
        json.dumps(table.as_json(), ensure_ascii=False).encode()


@settings(QUICK, max_examples=60)
@given(
    st.fixed_dictionaries(
        {},
        optional={
            "epsg": st.one_of(st.just(32615), st.integers(), TREES),
            "offset": st.one_of(st.lists(st.floats(), min_size=3, max_size=3), TREES),
            "origin": st.one_of(st.none(), st.lists(st.floats(-200, 200), min_size=3, max_size=3)),
            "local_from_world": TREES,
            "altitude_offset": TREES,
        },
    )
)
def test_georeferences(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("scene")
    (folder / "georeference.json").write_text(json.dumps(content))
    found = reads_or_refuses(read_georeference, Scene(folder))
    if found is not None and found.origin is None:
        assert np.isfinite(found.to_crs(np.zeros((1, 3)))).all()


NAMES = st.lists(st.text("abcdefgh_0123456789", min_size=1, max_size=12), max_size=4, unique=True).map(
    lambda names: [f"a_{name}" for name in names]
)
# types that Open3D keeps
OPEN3D = {"uchar", "uint8", "uint16", "int", "int32", "float", "float32", "double", "float64"}


@settings(QUICK, max_examples=80)
@given(
    st.sampled_from([LITTLE, "binary_big_endian"]),
    NAMES,
    st.lists(st.sampled_from(sorted(TYPES)), min_size=4, max_size=4),
    st.integers(1, 6),
    st.binary(min_size=300, max_size=300),
    st.sampled_from(["float", "double", "float32", "float64"]),
)
def test_clouds_are_read_as_numpy_reads_them(
    tmp_path_factory, form, names, types, count, content, position_type
):
    """Any properties of any types in both byte orders; a byte less is refused, and so is more."""
    order = "<" if form == LITTLE else ">"
    columns = [(axis, position_type) for axis in "xyz"] + list(zip(names, types))
    dtype = np.dtype([(name, order + TYPES[kind]) for name, kind in columns])
    table = np.frombuffer((content * 2)[: count * dtype.itemsize], dtype).copy()
    for row, axis in enumerate("xyz"):
        table[axis] = np.arange(count) * (row + 0.5)
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    whole = ply(
        form,
        [f"element vertex {count}", *(f"property {kind} {name}" for name, kind in columns)],
        table.tobytes(),
    )
    path.write_bytes(whole)
    cloud = read_cloud(path)
    np.testing.assert_array_equal(
        cloud.point.positions.numpy(),
        np.stack([table[axis] for axis in "xyz"], 1).astype(table["x"].dtype.newbyteorder("=")),
    )
    for name, kind in zip(names, types):
        if kind in OPEN3D:
            np.testing.assert_array_equal(
                cloud.point[name].numpy().ravel(), table[name].astype(table[name].dtype.newbyteorder("="))
            )
    for other in (whole[:-1], whole + b"x" * 5):
        path.write_bytes(other)
        with pytest.raises(InputError):
            check_ply(path)


@settings(QUICK, max_examples=60)
@given(
    st.integers(1, 5),
    st.lists(st.lists(st.integers(-1, 6), min_size=0, max_size=5), min_size=1, max_size=4),
    st.sampled_from(["uchar", "int", "ushort"]),
    st.sampled_from(["int", "uint", "short"]),
    st.booleans(),
)
def test_faces_are_accepted_if_they_have_corners_that_exist(
    tmp_path_factory, count, faces, length_type, index_type, text
):
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    lines = [
        f"element vertex {count}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(faces)}",
        f"property list {length_type} {index_type} vertex_indices",
    ]
    if text:
        body = (
            "\n".join(["0 0 0"] * count + [" ".join(map(str, [len(face), *face])) for face in faces]).encode()
            + b"\n"
        )
    else:
        body = bytes(12 * count) + b"".join(
            np.array(len(face), "<" + TYPES[length_type]).tobytes()
            + np.array(face, np.int64).astype("<" + TYPES[index_type]).tobytes()
            for face in faces
        )
    path.write_bytes(ply("ascii" if text else LITTLE, lines, body))
    right = all(len(face) >= 3 and 0 <= min(face) and max(face) < count for face in faces)
    try:
        check_ply(path)
        assert right
    except InputError:
        assert not right


@settings(QUICK, max_examples=40)
@given(st.integers(1, 40), st.integers(1, 40), st.randoms(use_true_random=False))
def test_masks_are_read_as_they_were_written(tmp_path_factory, width, height, rng):
    from sc3d.io.images import write_image
    from sc3d.io.mask_images import read_index_image

    folder = tmp_path_factory.mktemp("masks")
    mask = np.frombuffer(rng.randbytes(width * height), np.uint8).reshape(height, width)
    write_image(folder / "a.png", mask)
    np.testing.assert_array_equal(read_index_image(folder / "a.png"), mask)
    assert match_masks(folder, {"x/a.jpg": (3 * width, 3 * height)}, None) == {"x/a.jpg": folder / "a.png"}


def test_clouds_that_open3d_writes_are_read(tmp_path):
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.random.default_rng(0).normal(size=(50, 3))))
    cloud.point.normals = o3d.core.Tensor(np.zeros((50, 3)))  # in float32, Open3D cannot read its own PCD
    cloud.point["weight"] = o3d.core.Tensor(np.arange(50, dtype=np.float32)[:, None])
    for name, options in (
        ("a.ply", {}),
        ("b.ply", {"write_ascii": True}),
        ("c.pcd", {}),
        ("d.pcd", {"write_ascii": True}),
        ("e.pcd", {"compressed": True}),
    ):
        assert o3d.t.io.write_point_cloud(str(tmp_path / name), cloud, **options)
        np.testing.assert_allclose(
            read_cloud(tmp_path / name).point.positions.numpy(), cloud.point.positions.numpy(), atol=1e-5
        )
