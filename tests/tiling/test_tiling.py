"""Tile by tile equals in one piece: labels, votes, propagated labels and judged pixels, here and on Dask
workers, whole and after a kill.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import open3d as o3d
import pytest

from sc3d.errors import InputError
from sc3d.exporters import orthophoto, projected_cloud
from sc3d.geometry.cameras import undistorted
from sc3d.geometry.voxel_patches import surface_patches
from sc3d.io.chunked_clouds import CloudFile
from sc3d.io.clouds import read_cloud, read_mesh, write_geometry
from sc3d.io.images import read_image
from sc3d.io.ply import write_records
from sc3d.report.tally import tally, tally_by_parts
from sc3d.scene.cloud_parts import read_thinned
from sc3d.scene.labelled_cloud import spacing_of, unit_normals
from sc3d.scene.scene import Scene
from sc3d.settings.common import Memory
from sc3d.settings.labels import Evaluate, Label, PaperMechanisms, Propagate
from sc3d.settings.outputs import Export
from sc3d.settings.synthesize import Synthesize
from sc3d.stages import evaluate, export, label, propagate
from sc3d.synthetic.generate import synthesize
from sc3d.tiling import label as tiled_label
from sc3d.tiling import memory as plan
from sc3d.tiling import propagate as tiled_propagate
from sc3d.tiling import seen_points, voxel_parts
from sc3d.tiling.executor import SerialExecutor
from sc3d.tiling.first_surfaces import MeshParts, RangeMaps, read_triangles, write_ranges
from sc3d.tiling.given_normals import TileNormals
from sc3d.tiling.memory import memory_of
from sc3d.tiling.store import CloudStatistics, TileStore
from sc3d.tiling.voxel_parts import split_voxels
from sc3d.tiling.work_folder import WorkFolder

POINTS = 60_000
TILES = 25_000  # points of a tile with its margin
NAMES = ("label", "confidence", "state", "num_views")


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site") / "scene"
    synthesize(folder, Synthesize(views=8, width=240, num_points=POINTS, seed=3))
    for name, target in (("cloud.ply", "truth.ply"), ("mesh.ply", "truth_mesh.ply")):
        shutil.copy(folder / target, folder / name)
    return folder


def make_tiles_small(patch: pytest.MonkeyPatch) -> None:
    """Room for TILES points only, whatever a point needs, where `max_memory` is 2G."""

    def room(resources, _):
        return TILES if resources.max_memory == "2G" else 10**9

    for module in (tiled_label, tiled_propagate, seen_points):
        patch.setattr(module, "max_points", room)
        patch.setattr(module, "fits", lambda _, resources: resources.max_memory != "2G")


@pytest.fixture
def small_tiles(monkeypatch):
    make_tiles_small(monkeypatch)


@pytest.fixture(scope="module")
def labels(site) -> dict[str, Path]:
    """The site's labels with the usual options, in one piece (`whole`) and by tile (`tiled`)."""
    with pytest.MonkeyPatch.context() as patch:
        make_tiles_small(patch)
        return label_both_ways(site, "usual")


@pytest.fixture(scope="module")
def bare(site, tmp_path_factory) -> dict[bool, tuple[Path, np.ndarray]]:
    """Copies of the site without meshes, by whether the cloud has its normals, each with the `num_views` that labels
    get where nothing hides.
    """
    found = {}
    for given in (True, False):
        folder = tmp_path_factory.mktemp("bare") / "scene"
        shutil.copytree(site, folder, ignore=shutil.ignore_patterns("*mesh.ply", ".*"))
        if not given:
            cloud = read_cloud(folder / "cloud.ply")
            del cloud.point["normals"]
            write_geometry(folder / "cloud.ply", cloud)
        found[given] = folder, run_label(folder, "open", depth_filter=False)["num_views"]
    return found


def columns(path: Path) -> dict[str, np.ndarray]:
    return {name: values.numpy() for name, values in read_cloud(path).point.items()}


def run_label(site: Path, name: str, **options) -> dict[str, np.ndarray]:
    label.run(Scene(site), Label(output=site / f"{name}.ply", **options))
    return columns(site / f"{name}.ply")


def label_both_ways(site: Path, name: str, **options) -> dict[str, Path]:
    files = {way: site / f"{name}_{way}.ply" for way in ("whole", "tiled")}
    for way, memory in (("whole", ""), ("tiled", "2G")):
        run_label(site, files[way].stem, max_memory=memory, **options)
    return files


def assert_same(
    first: dict[str, np.ndarray], second: dict[str, np.ndarray], but: tuple[str, ...] = ()
) -> None:
    assert first.keys() == second.keys()
    for name in first:
        if name not in but:
            np.testing.assert_array_equal(first[name], second[name], err_msg=name)


def blocks(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions and counts of a voxel field's blocks, sorted, as Open3D reads them."""
    grid = o3d.t.geometry.VoxelBlockGrid.load(str(path))
    rows = grid.hashmap().active_buf_indices().numpy()
    keys, votes = grid.hashmap().key_tensor().numpy()[rows], grid.attribute("votes").numpy()[rows]
    order = np.lexsort(keys.T)
    return keys[order], votes[order]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"mechanisms": PaperMechanisms(reproject=True, incidence=True, density=True)},
        {"method": "paper"},
        {"method": "direct"},
        {"depth_filter": False},
    ],
)
def test_labels_and_votes_by_tile_are_those_of_the_whole_to_the_bit(site, labels, small_tiles, options):
    files = label_both_ways(site, "other", **options) if options else labels
    assert_same(columns(files["whole"]), columns(files["tiled"]))
    fields = [blocks(files[way].with_suffix(".votes.npz")) for way in ("whole", "tiled")]
    for first, second in zip(*fields, strict=True):
        np.testing.assert_array_equal(first, second)
    assert not list(site.glob(".*.parts"))


def test_there_are_several_tiles_of_the_size_asked_for(site):
    cloud = CloudFile.open(site / "cloud.ply")
    grid = CloudStatistics.from_cloud(cloud).grid(TILES, 18.0)
    assert grid.shape[0] * grid.shape[1] >= 9
    points = read_cloud(site / "cloud.ply").point.positions.numpy()
    held = [grid.within(points, tile, 18.0).sum() for tile in range(grid.shape[0] * grid.shape[1])]
    assert max(held) <= 1.1 * TILES
    assert (np.bincount(grid.tile_of(points), minlength=len(held)) <= held).all()


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("surface", ["auto", "voxels", "surfels"])
def test_without_a_mesh_the_points_hide_by_tile_what_they_hide_as_a_whole(bare, small_tiles, surface, given):
    """Voxels, and surfels but for the last digit of a range, and so of a vote; with the cloud's own normals and with
    estimated ones.
    """
    folder, seen_openly = bare[given]
    whole = run_label(folder, "whole", surface=surface)
    tiled = run_label(folder, "tiled", surface=surface, max_memory="2G")
    weighed = [name for name in whole if name.startswith("votes") or name == "confidence"]
    assert_same(whole, tiled, but=tuple(weighed) if surface == "surfels" else ())
    for name in weighed:
        assert (whole[name] != tiled[name]).mean() <= 1e-3, name
        np.testing.assert_allclose(whole[name], tiled[name], atol=1e-3, err_msg=name)
    assert (whole["num_views"] != seen_openly).any()


def test_patches_of_the_tiles_are_those_of_the_whole(site, tmp_path, monkeypatch):
    """Of all voxels, also of gaps that lie in tiles without points."""
    cloud = CloudFile.open(site / "cloud.ply")
    read, statistics = read_cloud(site / "cloud.ply").point, CloudStatistics.from_cloud(cloud)
    points, low = read.positions.numpy(), statistics.extent.low
    normals = unit_normals(read.normals.numpy(), points, np.zeros((1, 3)), low)
    size = 2.5 * spacing_of(points)
    whole, tables = surface_patches(points, normals, size), []
    for room in (TILES, 4_000):
        folder = tmp_path / str(room)
        store = TileStore.build(cloud, statistics.grid(room), folder / "tiles")
        assert len(store.tiles) >= 4
        (folder / "patches").mkdir()
        own = TileNormals(store, np.zeros((1, 3)), low, True)
        arguments = (low, spacing_of(points), folder / "patches", SerialExecutor())
        parts = split_voxels(store, own, *arguments, Memory())
        np.testing.assert_array_equal(parts.origin, whole.grid.origin)
        tables.append([np.load(parts.folder / name) for name in ("keys.npy", "shapes.npy")])
    for keys, shapes in tables:
        np.testing.assert_array_equal(keys, whole.keys)
        np.testing.assert_array_equal(shapes, whole.shapes)
    monkeypatch.setattr(voxel_parts, "PATCH", 10**5)
    with pytest.raises(InputError, match="million voxels needs about .*, or choose --surface surfels"):
        split_voxels(store, own, *arguments, Memory("1500M"))


def test_what_no_second_photo_confirms_hides_as_the_mesh_does_by_tile_and_as_a_whole(
    site, labels, small_tiles, tmp_path
):
    """The mesh cut in two files gives the labels of the one."""
    shutil.copytree(site, tmp_path / "cut", ignore=shutil.ignore_patterns(".*"))
    scene, mesh = Scene(tmp_path / "cut"), read_mesh(site / "mesh.ply")
    first = np.arange(len(mesh.triangle.indices)) % 3 > 0
    for path, chosen in zip(scene.surface, (first, ~first), strict=True):
        write_geometry(path, mesh.select_faces_by_mask(o3d.core.Tensor(chosen)))
    expected = columns(labels["whole"])
    for name, options in (("whole", {}), ("tiled", {"max_memory": "2G"})):
        assert_same(expected, run_label(scene.path, name, **options))
    scene.unconfirmed.unlink()
    assert (expected["num_views"] != run_label(scene.path, "whole")["num_views"]).any()


@pytest.mark.parametrize("options", [{}, {"rounds": 1, "color": False}, {"fill": True}])
def test_map_by_tile_is_that_of_the_whole(site, labels, small_tiles, options):
    seeds, results = labels["whole"], []
    for name, memory in (("whole", ""), ("tiled", "2G")):
        propagate.run(
            Scene(site), Propagate(seeds=seeds, output=site / f"{name}_map.ply", max_memory=memory, **options)
        )
        results.append(columns(site / f"{name}_map.ply"))
    whole, tiled = results
    assert (whole["label"] != tiled["label"]).mean() <= 1e-4 and (
        whole["state"] != tiled["state"]
    ).mean() <= 1e-4
    assert (np.abs(whole["confidence"] - tiled["confidence"]) > 1e-3).mean() <= 1e-3
    assert (whole["label"] > 0).mean() > 0.95
    assert_same(whole, tiled, but=("label", "state", "confidence"))


def test_votes_that_stand_on_the_ground_by_mistake_count_less_by_tile_as_in_the_whole(
    site, labels, small_tiles, tmp_path, caplog
):
    """Every view calls most of the road a building."""
    seeds, cloud = tmp_path / "seeds.ply", read_cloud(labels["whole"])
    told, votes = cloud.point["label"].numpy(), [cloud.point[f"votes_{id_}"].numpy() for id_ in (1, 3)]
    wrong = (told == 3) & (cloud.point.positions.numpy()[:, 1:2] % 10 < 8)
    votes[0][wrong], votes[1][wrong], told[wrong] = votes[1][wrong], votes[0][wrong], 1
    write_geometry(seeds, cloud)
    results = []
    for name, memory in (("whole", ""), ("tiled", "2G")):
        caplog.clear()
        propagate.run(Scene(site), Propagate(seeds=seeds, output=tmp_path / f"{name}.ply", max_memory=memory))
        assert "1 of 4 classes stand where the others that stand do not" in caplog.text
        results.append(columns(tmp_path / f"{name}.ply"))
    assert (results[0]["label"] != results[1]["label"]).mean() <= 1e-4
    assert (results[0]["state"] != results[1]["state"]).mean() <= 1e-4


@pytest.mark.parametrize("method", ["geometry", "knn"])
def test_other_methods_by_tile_differ_in_few_points(site, labels, small_tiles, method):
    seeds, results = labels["whole"], []
    for name, memory in (("whole", ""), ("tiled", "2G")):
        propagate.run(
            Scene(site),
            Propagate(method=method, seeds=seeds, output=site / f"{name}_{method}.ply", max_memory=memory),
        )
        results.append(columns(site / f"{name}_{method}.ply")["label"])
    assert (results[0] != results[1]).mean() < 0.002


def test_points_that_hang_on_a_seed_only_through_other_tiles_are_reached(site, small_tiles, tmp_path):
    """A band of ground around an empty middle, with seeds at one end only, and an island without any."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 60, (60_000, 3)) * [1, 1, 0]
    points = points[(np.abs(points[:, :2] - 30) > 12).any(axis=1)]
    island = rng.uniform(24, 36, (3_000, 3)) * [1, 1, 0]
    points = np.concatenate([points, island])
    votes = np.zeros((len(points), 3), np.float32)
    seeded = points[:, 0] < 1
    votes[seeded, 0], votes[seeded, 1] = 2, 2
    cloud = o3d.t.geometry.PointCloud(points)
    cloud.point.normals = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    attributes = {
        "label": seeded.astype(np.uint8),
        "confidence": seeded.astype(np.float32),
        "state": seeded.astype(np.uint8),
        "num_views": (2 * seeded).astype(np.int32),
    }
    attributes |= {f"votes_{number}": votes[:, number] for number in range(3)}
    for name, values in attributes.items():
        cloud.point[name] = o3d.core.Tensor(values[:, None].copy())
    write_geometry(tmp_path / "seeds.ply", cloud)
    found = []
    for name, memory in (("whole", ""), ("tiled", "2G")):
        propagate.run(
            Scene(tmp_path), Propagate(appearance=False, output=tmp_path / f"{name}.ply", max_memory=memory)
        )
        found.append(columns(tmp_path / f"{name}.ply")["label"].ravel() > 0)
    for labelled in found:
        assert labelled[: -len(island)].all() and not labelled[-len(island) :].any()


def test_votes_without_those_of_some_class_are_refused(site, labels, small_tiles, tmp_path):
    seeds = read_cloud(labels["whole"])
    del seeds.point["votes_1"]
    write_geometry(tmp_path / "seeds.ply", seeds)
    with pytest.raises(InputError, match="votes_1"):
        propagate.run(
            Scene(site),
            Propagate(seeds=tmp_path / "seeds.ply", output=tmp_path / "some.ply", max_memory="2G"),
        )


def test_evaluation_by_tile_judges_the_same_pixels(site, labels, small_tiles):
    figures = []
    for memory in ("", "2G"):
        settings = Evaluate(
            labelled=labels["whole"], output=site / f"metrics{memory}.json", max_memory=memory
        )
        evaluate.run(Scene(site), settings)
        figures.append(json.loads(settings.output.read_text()))
    for part in ("labels", "masks", "labels_near_edges"):
        assert figures[0][part]["oa"] == pytest.approx(figures[1][part]["oa"], abs=1e-5)
        assert figures[0][part]["coverage"] == pytest.approx(figures[1][part]["coverage"], abs=1e-5)


def test_ranges_over_parts_of_a_mesh_are_those_of_the_whole(site, tmp_path):
    from sc3d.geometry.cameras import local_origin
    from sc3d.geometry.raycast import Surface, first_surface

    views = Scene(site).model.views
    origin, triangles = local_origin(views), np.concatenate(list(read_triangles(site / "mesh.ply")))
    grid = CloudStatistics.from_cloud(CloudFile.open(site / "mesh.ply")).grid(2_000)
    parts = MeshParts.split([triangles[:5000], triangles[5000:]], grid, tmp_path, origin)
    assert len(parts.boxes) > 4
    maps = RangeMaps(tmp_path, {view.name: number for number, view in enumerate(views)})
    write_ranges(parts, views, maps)
    whole = Surface.from_mesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), origin)
    for view in views:
        np.testing.assert_array_equal(first_surface(maps, view).range, first_surface(whole, view).range)


@pytest.fixture
def command(site):
    """Runs `label` in a process of its own with room for few points, on `workers` workers."""
    program = (
        f"from sc3d.tiling import label\nlabel.max_points = lambda *_: {TILES}\n"
        "from sc3d.cli import main\nif __name__ == '__main__':\n    main()\n"
    )
    script = site.parent / "few_points.py"
    script.write_text(program)

    def start(workers: int, output: Path) -> subprocess.Popen:
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
            "OMP_NUM_THREADS": "1",
            "NUMBA_NUM_THREADS": "1",
        }
        options = ["--workers", str(workers), "--max-memory", "12G", "--output", str(output)]
        return subprocess.Popen(
            [sys.executable, str(script), "label", str(site), *options],
            env=environment,
            stderr=subprocess.PIPE,
            text=True,
        )

    return start


def test_workers_give_the_same_bytes_also_if_one_is_killed(site, command, labels):
    here = labels["tiled"]
    for workers, killed in ((1, False), (2, True)):
        output = site / f"workers{workers}.ply"
        process = command(workers, output)
        if killed:
            assert kill_a_worker(process.pid, site)
        _, said = process.communicate(timeout=240)
        assert process.returncode == 0, said
        assert output.read_bytes() == here.read_bytes()
        assert output.with_suffix(".votes.npz").read_bytes() == here.with_suffix(".votes.npz").read_bytes()


def kill_a_worker(parent: int, site: Path, seconds: float = 120) -> bool:
    """SIGKILL one worker as soon as the first tile has its labels; whether one was killed."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if any(site.glob(".workers2.ply.*.parts/results/label.*.npy")):
            for folder in Path("/proc").iterdir():
                if (
                    folder.name.isdigit()
                    and "spawn_main" in _said_by(folder, "cmdline")
                    and f"PPid:\t{parent}\n" in _said_by(folder, "status")
                ):
                    os.kill(int(folder.name), signal.SIGKILL)
                    return True
        time.sleep(0.02)
    return False


def _said_by(folder: Path, name: str) -> str:
    try:
        return (folder / name).read_text().replace("\0", " ")
    except OSError:
        return ""


def test_a_killed_run_keeps_its_finished_tiles(site, labels, small_tiles, monkeypatch):
    expected = columns(labels["tiled"])
    original, done = tiled_label.label_tile, []

    def stops(job, tile):
        if len(done) == 3:
            raise KeyboardInterrupt
        original(job, tile)
        done.append(tile)

    monkeypatch.setattr(tiled_label, "label_tile", stops)
    with pytest.raises(KeyboardInterrupt):
        run_label(site, "resumed", max_memory="2G")
    assert not (site / "resumed.ply").exists()
    fused = []
    monkeypatch.setattr(tiled_label, "label_tile", original)
    monkeypatch.setattr(
        tiled_label, "fuse", lambda *given, fuse=tiled_label.fuse: (fused.append(1), fuse(*given))[1]
    )
    assert_same(expected, run_label(site, "resumed", max_memory="2G"))
    number = len(CloudFileTiles.of(site))
    assert len(fused) == number - 3


class CloudFileTiles:
    """Tiles that hold points, as `label` makes them."""

    @staticmethod
    def of(site: Path) -> list[int]:
        cloud = CloudFile.open(site / "cloud.ply")
        statistics = CloudStatistics.from_cloud(cloud)
        grid = statistics.grid(
            TILES, tiled_label.BLOCKS * tiled_label.BLOCK * tiled_label.VOXEL * statistics.spacing
        )
        return np.unique(grid.tile_of(read_cloud(site / "cloud.ply").point.positions.numpy())).tolist()


def test_parts_of_other_inputs_are_not_taken(tmp_path):
    source = tmp_path / "cloud.ply"
    source.write_text("one")
    first = WorkFolder(tmp_path / "out.ply", "label", [source], Label())
    first.subfolder("tiles")
    assert (
        WorkFolder(
            tmp_path / "out.ply", "label", [source], replace(Label(), workers=3, max_memory="9G")
        ).folder
        == first.folder
    )
    assert WorkFolder(tmp_path / "out.ply", "label", [source], Label(consensus=0.9)).folder != first.folder
    assert not first.folder.exists()  # of no use any more
    source.write_text("other")
    assert WorkFolder(tmp_path / "out.ply", "label", [source], Label()).folder != first.folder


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_is_read_in_chunks(tmp_path, monkeypatch, suffix):
    monkeypatch.setattr("sc3d.io.chunked_clouds.RECORDS_AT_ONCE", 700)
    points = np.random.default_rng(0).uniform(0, 100, (3000, 3)) + [5e5, 5e6, 0]
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.offsets, header.scales = np.floor(points.min(axis=0)), [1e-3] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.red = las.green = las.blue = np.full(3000, 77 << 8, np.uint16)
    las.write(tmp_path / f"cloud{suffix}")
    cloud = CloudFile.open(tmp_path / f"cloud{suffix}")
    chunks = list(cloud.chunks())
    assert [start for start, _ in chunks] == [0, 700, 1400, 2100, 2800] and cloud.num_points == 3000
    read = np.concatenate([records for _, records in chunks])
    np.testing.assert_allclose(np.stack([read[axis] for axis in "xyz"], axis=1), points, atol=5.1e-4)
    assert (read["red"] == 77).all()


def test_a_store_gives_back_every_point_once_and_the_margin(site, tmp_path):
    cloud = CloudFile.open(site / "cloud.ply")
    points = read_cloud(site / "cloud.ply").point.positions.numpy()
    store = TileStore.build(cloud, CloudStatistics.from_cloud(cloud).grid(TILES, 18.0), tmp_path)
    np.testing.assert_array_equal(
        np.sort(np.concatenate([store.rows(tile) for tile in store.tiles])), np.arange(POINTS)
    )
    for tile in store.tiles:
        halo = store.with_halo(tile, 2.0)
        np.testing.assert_array_equal(halo.rows, np.flatnonzero(store.grid.within(points, tile, 2.0)))
        np.testing.assert_array_equal(
            halo.rows[halo.core], np.flatnonzero(store.grid.tile_of(points) == tile)
        )
        np.testing.assert_array_equal(halo.gather(store.records)["x"], points[halo.rows, 0])


def test_ply_in_chunks_is_what_open3d_reads(tmp_path):
    dtype = np.dtype([("x", "f8"), ("y", "f8"), ("z", "f8"), ("label", "u1")])
    records = np.zeros(10, dtype)
    records["x"], records["label"] = np.arange(10) + 5e5 + 1e-3, np.arange(10)
    write_records(tmp_path / "made.ply", [records[:4], records[4:]], dtype, 10)
    read = read_cloud(tmp_path / "made.ply")
    np.testing.assert_array_equal(read.point.positions.numpy()[:, 0], records["x"])
    np.testing.assert_array_equal(read.point.label.numpy().ravel(), records["label"])
    with pytest.raises(ValueError, match="instead of"):
        write_records(tmp_path / "made.ply", [records], dtype, 11)


@pytest.mark.parametrize(
    ("text", "amount"), [("6G", 6 << 30), ("1500M", 1500 << 20), ("2.5 GiB", 5 << 29), ("", None)]
)
def test_amounts_of_memory(text, amount):
    assert memory_of(Label(max_memory=text)) == (amount or memory_of(Label()))


@pytest.mark.parametrize("text", ["lots", "6X", "200M", "-1G", "nan"])
def test_memory_that_is_none_or_too_little_is_refused(text):
    with pytest.raises(InputError, match="max-memory"):
        memory_of(Label(max_memory=text))
    assert plan.BASE < memory_of(Label(max_memory="2G", workers=1)) + 1


def test_a_cloud_that_cannot_be_read_in_parts_is_refused(tmp_path):
    (tmp_path / "text.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"
    )
    with pytest.raises(InputError, match="binary PLY"):
        CloudFile.open(tmp_path / "text.ply")
    with pytest.raises(InputError, match="PLY, LAS or LAZ"):
        CloudFile.open(tmp_path / "cloud.xyz")


def test_a_laz_cloud_is_labelled(site, labels, tmp_path):
    """Normals are estimated by tile; positions are rounded to a millimeter."""
    source = read_cloud(site / "cloud.ply")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [1e-3] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = source.point.positions.numpy().T
    las.write(tmp_path / "cloud.laz")
    label.run(Scene(site), Label(cloud=tmp_path / "cloud.laz", output=tmp_path / "laz.ply"))
    found, expected = columns(tmp_path / "laz.ply"), columns(labels["whole"])
    both = (found["label"] > 0) & (expected["label"] > 0)
    assert both.mean() > 0.7 and (found["label"] == expected["label"])[both].mean() > 0.98
    np.testing.assert_allclose(found["positions"], source.point.positions.numpy(), atol=1e-3)


def labelled_site(site: Path) -> Scene:
    """The scene with its points and their true labels as labelled.ply."""
    cloud = read_cloud(site / "cloud.ply")
    label = np.where(cloud.point["label"].numpy() > 4, 0, cloud.point["label"].numpy()).astype(np.uint8)
    confidence = np.random.default_rng(0).random(label.shape, np.float32)
    named = {"label": label, "confidence": confidence, "state": label > 0, "num_views": 3 * (label > 0)}
    for name, kind in zip(NAMES, (np.uint8, np.float32, np.uint8, np.int32), strict=True):
        cloud.point[name] = o3d.core.Tensor(named[name].astype(kind))
    write_geometry(site / "labelled.ply", cloud)
    return Scene(site)


@pytest.mark.parametrize("has_mesh", [True, False])
def test_masks_by_tile_are_those_of_the_whole(site, small_tiles, tmp_path, has_mesh):
    """Without a mesh, the points themselves hide what is behind them."""
    scene, found = labelled_site(site), []
    if not has_mesh:
        ignored = shutil.ignore_patterns("*mesh.ply", ".*", "export")
        scene = Scene(shutil.copytree(site, tmp_path / "bare", ignore=ignored))
    for memory in ("", "2G"):
        export.run(scene, Export(format=("masks",), max_size=120, max_memory=memory))
        found.append([read_image(file) for file in sorted((scene.export / "masks").glob("*.png"))])
    assert len(found[0]) == 8 and (found[0][0] > 0).mean() > 0.5
    for whole, tiled in zip(*found, strict=True):
        np.testing.assert_array_equal(whole, tiled)
    assert not list(scene.export.glob(".*"))


def test_a_pinhole_photo_by_tile_shows_the_same_points(site, small_tiles):
    scene = labelled_site(site)
    views = [undistorted(view, 100) for view in scene.model.views]
    sizes = {view.name: (view.width, view.height) for view in views}
    found = []
    for memory in ("", "2G"):
        with seen_points.labelled_sight(
            scene, Memory(memory), scene.labelled, sizes, site / "seen", pinhole=100
        ) as seen:
            found.append([seen.surface.rows(view, sizes[view.name])[0] for view in views])
            points = np.concatenate([part for part, _ in seen.parts()])
    for whole, tiled in zip(*found, strict=True):
        np.testing.assert_array_equal(whole, tiled)
    np.testing.assert_array_equal(points, read_cloud(scene.labelled).point.positions.numpy())


def test_the_report_counts_a_cloud_on_disk_as_in_memory(site):
    scene = labelled_site(site)
    cloud = read_cloud(scene.labelled)
    whole = tally(cloud)
    parts = tally_by_parts(CloudFile.open(scene.labelled), cloud.point.positions.numpy()[::3])
    assert parts.size == whole.size == POINTS
    for name in ("labels", "states", "distribution"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
    np.testing.assert_allclose(parts.sums, whole.sums, rtol=1e-6)
    assert abs(parts.median - whole.median) < 2e-4
    shares = [found.areas / found.areas.sum() for found in (whole, parts)]
    np.testing.assert_allclose(shares[1], shares[0], atol=0.01)


def test_a_thinned_cloud_is_even_and_has_all_attributes(site):
    scene = labelled_site(site)
    cloud, some = read_cloud(scene.labelled), read_thinned(scene.labelled, 6000)
    assert set(some.point) == set(cloud.point) and abs(len(some.point.positions) - 6000) < 400
    for name in some.point:
        assert some.point[name].dtype == cloud.point[name].dtype, name
    middle = np.median(cloud.point.positions.numpy(), axis=0)
    assert (some.point.positions.numpy() < middle).mean(axis=0) == pytest.approx([0.5] * 3, abs=0.03)


@pytest.mark.parametrize("has_mesh", [True, False])
def test_an_orthophoto_in_strips_is_that_of_the_whole(site, tmp_path, monkeypatch, has_mesh):
    rasterio = pytest.importorskip("rasterio")
    folder = tmp_path / "scene"
    labelled_site(site)
    for name in ("classes.json", "labelled.ply", *(["mesh.ply"] if has_mesh else [])):
        folder.mkdir(exist_ok=True)
        shutil.copy(site / name, folder / name)
    monkeypatch.setattr(orthophoto, "TILE", 64)
    for module in (orthophoto, projected_cloud):
        monkeypatch.setattr(module, "fits", lambda _, resources: resources.max_memory != "2G")
    monkeypatch.setattr(orthophoto, "memory_of", lambda _: orthophoto.BASE + (10 << 20))
    found = []
    for memory in ("", "2G"):
        settings = Export(format=("orthophoto",), pixel_size=0.5, max_memory=memory)
        strips = orthophoto.strips_of(Scene(folder), settings)
        export.run(Scene(folder), settings)
        images = []
        for name in (orthophoto.COLOR, orthophoto.CLASSES, orthophoto.HEIGHT):
            with rasterio.open(folder / "export" / name) as file:
                images.append(file.read())
        found.append((strips._size, images))
    assert found[0][0] >= found[0][1][0].shape[1] > found[1][0]  # one strip, several
    whole, parts = found[0][1], found[1][1]
    assert (whole[1] > 0).mean() > 0.8 and (whole[1] == parts[1]).mean() > 0.998
    assert (whole[0] == parts[0]).all(axis=0).mean() > 0.998
    np.testing.assert_allclose(parts[2], whole[2], atol=1e-3)


def test_clouds_in_parts_are_those_of_the_whole(site, monkeypatch):
    scene, found = labelled_site(site), []
    monkeypatch.setattr(projected_cloud, "fits", lambda _, resources: resources.max_memory != "2G")
    monkeypatch.setattr("sc3d.io.chunked_clouds.RECORDS_AT_ONCE", 7000)
    for memory in ("", "2G"):
        figures = export.run(scene, Export(format=("clouds",), max_memory=memory))
        files = sorted((scene.export / "clouds").glob("*.ply"))
        found.append((figures, {file.name: columns(file) for file in files}))
    assert found[0][0] == found[1][0] and found[0][1].keys() == found[1][1].keys() and len(found[0][1]) == 5
    for name, whole in found[0][1].items():
        assert_same(whole, found[1][1][name])
