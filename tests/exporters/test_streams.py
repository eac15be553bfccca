"""COPC and 3D Tiles: every point once, in nodes that thin the cloud evenly, read back by other programs."""

import json
import os
import struct

import laspy
import numpy as np
import pyproj
import pytest

from sc3d.errors import InputError
from sc3d.exporters import copc, laz, octree, projected_cloud, tiles3d
from sc3d.exporters.octree import Node, Octree
from sc3d.io.atomic import temporary_name
from sc3d.runner import execute
from sc3d.settings.outputs import Export
from tests.builders import labelled_cloud, write_scene
from tests.exporters.test_laz import ENU, UTM


def site(count: int = 30_000, seed: int = 1) -> np.ndarray:
    """(N, 3) a hilly site of 90 m x 60 m, with a dense corner."""
    rng = np.random.default_rng(seed)
    plan = np.concatenate(
        [rng.uniform(0, [90, 60], (count - count // 5, 2)), rng.uniform(20, 24, (count // 5, 2))]
    )
    return np.column_stack([plan, 3 * np.sin(plan[:, 0] / 9) + rng.normal(0, 0.05, count)]) - [40, 30, 0]


@pytest.fixture
def small_nodes(monkeypatch):
    """Trees of many nodes and parts from few points."""
    monkeypatch.setattr(octree, "FEW", 400)
    monkeypatch.setattr(octree, "SIDE_BITS", 4)
    monkeypatch.setattr(octree, "SIDE", 16)
    monkeypatch.setattr(octree, "DEEPEST", 17)
    monkeypatch.setattr(copc, "LARGEST_PART", 3000)


def scene_of(path, points=None, georeference=UTM):
    points = site() if points is None else points
    return write_scene(
        path, labelled_cloud(points, np.random.default_rng(2).choice([0, 1, 2, 4], len(points))), georeference
    )


def as_rows(points) -> np.ndarray:
    """Stored records in an order of their own, to compare sets of points."""
    return np.sort(points.array if hasattr(points, "array") else points)


def test_copc_has_the_points_of_laz_with_all_they_have(tmp_path, small_nodes):
    scene = scene_of(tmp_path)
    laz.write(scene, Export())
    figures = copc.write(scene, Export())
    plain, streamed = (laspy.read(module.outputs(scene, Export())[0]) for module in (laz, copc))
    assert (as_rows(streamed.points) == as_rows(plain.points)).all() and figures["points"] == 30_000
    assert figures["levels"] >= 4 and figures["nodes"] > 50
    assert streamed.header.parse_crs().to_epsg() == 32615
    assert (streamed.header.mins == plain.header.mins).all() and (
        streamed.header.maxs == plain.header.maxs
    ).all()
    assert not list(scene.export.glob(".*"))


def test_copc_queries_by_bounds_and_level(tmp_path, small_nodes):
    scene = scene_of(tmp_path)
    copc.write(scene, Export())
    whole = laspy.read(copc.outputs(scene, Export())[0]).xyz
    with laspy.CopcReader.open(copc.outputs(scene, Export())[0]) as reader:
        rng = np.random.default_rng(3)
        for size in (1, 7, 40):
            low = np.round(rng.uniform(whole.min(axis=0), whole.max(axis=0)), 3)
            for ends in (slice(2), slice(3)):
                inside = (np.abs(whole[:, ends] - low[ends] - size / 2) < size / 2 + 5e-4).all(axis=1)
                found = reader.query(laspy.Bounds(low[ends], low[ends] + size))
                assert len(found) == np.count_nonzero(inside) and len(found) < len(whole)
        levels = [reader.query(level=level) for level in range(6)]
        coarse = levels[0]
        spacing = reader.copc_info.spacing
        covered = {
            tuple(cell) for cell in np.floor((np.stack([coarse.x, coarse.y], 1)) / (4 * spacing)).astype(int)
        }
        assert covered == {tuple(cell) for cell in np.floor(whole[:, :2] / (4 * spacing)).astype(int)}
        assert len(coarse) < len(levels[1]) and sum(map(len, levels)) <= len(whole)


def test_copc_in_another_reader(tmp_path, small_nodes):
    """copclib is a reader of its own, in C++."""
    copclib = pytest.importorskip("copclib")
    scene = scene_of(tmp_path)
    copc.write(scene, Export())
    reader = copclib.FileReader(str(copc.outputs(scene, Export())[0]))
    whole = laspy.read(copc.outputs(scene, Export())[0]).xyz
    nodes = reader.GetAllNodes()
    assert sum(node.point_count for node in nodes) == len(whole)
    assert reader.ValidateSpatialBounds()
    box = copclib.Box(whole[:, 0].mean(), whole[:, 1].mean(), whole[:, 0].max(), whole[:, 1].max())
    inside = ((whole[:, :2] >= [box.x_min, box.y_min]) & (whole[:, :2] <= [box.x_max, box.y_max])).all(axis=1)
    assert len(reader.GetPointsWithinBox(box)) == np.count_nonzero(inside)


def test_points_do_not_depend_on_parts(tmp_path, monkeypatch, small_nodes):
    scene, found = scene_of(tmp_path), []
    for most, needed in (
        (3000, 250),
        (10**6, 250),
        (3000, 1 << 40),
    ):  # bytes of a point: read as a whole, in parts
        monkeypatch.setattr(copc, "LARGEST_PART", most)
        monkeypatch.setattr(projected_cloud, "BYTES", needed)
        copc.write(scene, Export())
        found.append(as_rows(laspy.read(copc.outputs(scene, Export())[0]).points))
    assert (found[0] == found[1]).all() and (found[0] == found[2]).all()


def test_memory_decides_nothing(tmp_path):
    """A finished export stays so, and what a killed one left on disk goes."""
    scene = scene_of(tmp_path, site(500))
    left = scene.export / temporary_name("octree").replace(str(os.getpid()), "999999999")
    (left.with_name(f"{left.name}x1") / "part0").mkdir(parents=True)
    execute("export", scene, Export(format=("copc",)))
    first = copc.outputs(scene, Export())[0].stat().st_mtime_ns
    execute("export", scene, Export(format=("copc",), max_memory="2G"))
    assert copc.outputs(scene, Export())[0].stat().st_mtime_ns == first and not list(scene.export.glob(".*"))
    with pytest.raises(InputError, match="--max-memory 2X"):
        copc.write(scene, Export(format=("copc",), max_memory="2X"))


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.zeros((900, 3)), [[0, 0, 0], [5e5, 0, 0]]])
def test_copc_of_odd_clouds(tmp_path, small_nodes, points):
    scene = scene_of(tmp_path, np.array(points, np.float64))
    copc.write(scene, Export())
    with laspy.CopcReader.open(copc.outputs(scene, Export())[0]) as reader:
        assert len(reader.query()) == len(points)


def test_nodes_of_a_tree(tmp_path, small_nodes):
    """Each point once, inside its node; a node's parent is there too; a level thins its nodes evenly."""
    rng = np.random.default_rng(4)
    cloud = np.zeros(20_000, [("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("number", "<i4")])
    for axis, scale in zip("XYZ", (4000, 3000, 40)):
        cloud[axis] = rng.integers(-scale, scale, len(cloud))
    cloud["number"] = np.arange(len(cloud))
    low, high = (np.array([end(cloud[axis]) for axis in "XYZ"]) for end in (np.min, np.max))
    tree = Octree.around(low, high)
    found = dict(tree.nodes(lambda: iter(np.array_split(cloud, 7)), tmp_path, 2500))
    assert sorted(np.concatenate(list(found.values()))["number"].tolist()) == list(range(len(cloud)))
    for node, records in found.items():
        positions = np.stack([records[axis] for axis in "XYZ"], 1) - low
        assert (np.minimum((positions << node.level) // tree.side, (1 << node.level) - 1) == node[1:]).all()
        assert node.level == 0 or node.parent in found
        cells = (positions << node.level + 4) // tree.side
        assert len(records) <= 400 or len(np.unique(cells, axis=0)) == len(records)
    assert not list(tmp_path.iterdir()) and Node(2, 3, 1, 0).parent == Node(1, 1, 0, 0)


def tiles_of(folder) -> tuple[dict, dict[str, dict]]:
    """The tileset and, by name, what the specification says is in its files."""
    tileset, found, left = json.loads((folder / "tileset.json").read_text()), {}, []
    left.append((tileset["root"], None))
    while left:
        tile, parent = left.pop()
        found[tile["content"]["uri"]] = tile | read_pnts((folder / tile["content"]["uri"]).read_bytes())
        box = np.array(tile["boundingVolume"]["box"])
        low, high = box[:3] - box[[3, 7, 11]] - 1e-6, box[:3] + box[[3, 7, 11]] + 1e-6
        positions = found[tile["content"]["uri"]]["positions"]
        assert (positions >= low).all() and (positions <= high).all()
        if parent is not None:
            assert (low >= parent[0]).all() and (high <= parent[1]).all()
        left += [(child, (low - 1e-6, high + 1e-6)) for child in tile.get("children", [])]
        assert all(child["geometricError"] < tile["geometricError"] for child in tile.get("children", []))
    assert {path.name for path in folder.iterdir()} == {*found, "tileset.json"}
    return tileset, found


def read_pnts(content: bytes) -> dict:
    magic, version, length, *sizes = struct.unpack_from("<4s6I", content)
    assert (magic, version, length) == (b"pnts", 1, len(content)) and (28 + sizes[0]) % 8 == 0
    ends = 28 + np.cumsum([0, *sizes])
    features, body, batch, columns = (content[start:end] for start, end in zip(ends[:-1], ends[1:]))
    assert not (ends % 4).any() and ends[-1] == length
    features, batch = json.loads(features), json.loads(batch)
    count = features["POINTS_LENGTH"]
    offsets = np.frombuffer(body, "<f4", 3 * count, features["POSITION"]["byteOffset"]).reshape(-1, 3)
    kinds = {"FLOAT": "<f4", "UNSIGNED_SHORT": "<u2", "UNSIGNED_BYTE": "u1"}
    found = {
        name: np.frombuffer(columns, kinds[entry["componentType"]], count, entry["byteOffset"])
        for name, entry in batch.items()
    }
    colors = np.frombuffer(body, "u1", 3 * count, features["RGB"]["byteOffset"]).reshape(-1, 3)
    return found | {"positions": offsets.astype(float) + features["RTC_CENTER"], "colors": colors}


@pytest.mark.parametrize("georeference", [UTM, ENU, None])
def test_3d_tiles_lie_where_proj_says_with_all_they_have(tmp_path, small_nodes, georeference):
    scene = scene_of(tmp_path, site(6000), georeference)
    laz.write(scene, Export())
    figures = tiles3d.write(scene, Export())
    tileset, tiles = tiles_of(scene.export / "3dtiles")
    assert figures["points"] == 6000 and figures["tiles"] == len(tiles) > 20
    las = laspy.read(laz.outputs(scene, Export())[0])
    names = ("classification", "label", "state", "num_views", "confidence")
    whole = {
        name: np.concatenate([tile[name] for tile in tiles.values()])
        for name in (*names, "positions", "colors")
    }
    positions = whole["positions"]
    if georeference is not None:
        matrix = np.array(tileset["root"]["transform"]).reshape(4, 4).T
        positions = positions @ matrix[:3, :3].T + matrix[:3, 3]
        back = pyproj.Transformer.from_crs(4978, 4979, always_xy=True).transform(*positions.T)
        east, north = pyproj.Proj("EPSG:32615")(back[0], back[1])
        positions = np.column_stack([east, north, back[2]])
        up = matrix[:3, :3] @ [0, 0, 1]
        assert up @ matrix[:3, 3] > 0.99 * np.linalg.norm(matrix[:3, 3])
    else:
        assert "transform" not in tileset["root"]
    keys = ("confidence", "num_views", "label")
    ours, theirs = (np.lexsort([np.asarray(table[key]) for key in keys]) for table in (whole, las))
    assert np.abs(positions[ours] - las.xyz[theirs]).max() < 0.0025
    for name in names:
        assert (whole[name][ours] == np.asarray(las[name])[theirs]).all()
    assert (whole["colors"][ours] == np.stack([las.red, las.green, las.blue], 1)[theirs] // 257).all()


def test_3d_tiles_in_another_reader(tmp_path, small_nodes):
    py3dtiles = pytest.importorskip("py3dtiles.tileset")
    from py3dtiles.tileset.content import read_binary_tile_content

    scene = scene_of(tmp_path, site(6000), ENU)
    tiles3d.write(scene, Export())
    tileset = py3dtiles.TileSet.from_file(scene.export / "3dtiles" / "tileset.json")
    count, left = 0, [tileset.root_tile]
    while left:
        tile = left.pop()
        left += tile.children
        body = read_binary_tile_content(scene.export / "3dtiles" / str(tile.content_uri)).body
        count += body.feature_table.nb_points()
        assert len(body.batch_table.get_binary_property("classification")) == body.feature_table.nb_points()
    assert count == 6000
