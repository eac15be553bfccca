"""`sc3d benchmark tables`, `fusion-speed` and `surface` on tiny scenes: the same figures as the stages, rows
kept, rows for every switch.
"""

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import get_type_hints

import numpy as np
import open3d as o3d
import pytest
import torch

from sc3d.cli import main as sc3d
from sc3d.errors import InputError
from sc3d.geometry.cameras import local_origin, pinhole_view
from sc3d.io.clouds import read_cloud, write_geometry
from sc3d.io.colmap import build_model, write_model
from sc3d.io.images import write_image
from sc3d.io.json_files import write_json
from sc3d.io.mask_images import read_index_image
from sc3d.io.splats import write_splat_ply
from sc3d.labelling.cloud import Cloud
from sc3d.scene.class_table import OTHER
from sc3d.scene.depth_map import depth_file
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Label, Propagate
from sc3d.splatting.gaussians import Gaussians
from sc3d.synthetic.generate import CLASSES
from tests.builders import ground, truth_mask, views, write_bare_scene
from tests.test_cli import fails as command_fails
from tools.benchmark import fusion_rivals, surface, tables
from tools.benchmark.__main__ import main
from tools.benchmark.fusion_page import markdown as fusion_markdown
from tools.benchmark.settings import BenchmarkTables
from tools.benchmark.surface_page import page, voxel_size_of
from tools.benchmark.table_page import BOUND, DIFFERENCES, MASKS, markdown, spread
from tools.benchmark.table_rows import DEFAULT, OURS, ablation, turned
from tools.make_manual import helps


def fails(capsys, *arguments) -> str:
    return command_fails(capsys, *arguments, command=main)


def run_stage(*arguments) -> None:
    sc3d([str(argument) for argument in arguments])


def run(*arguments) -> None:
    main([str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A working folder with finished tables of one tiny synthetic scene and one scene given by path."""
    path = tmp_path_factory.mktemp("work")
    run(*command(path))
    return path


def command(path: Path) -> list:
    scene = path / "given"
    if not scene.exists():
        write_bare_scene(scene)
    return [
        "tables",
        path,
        "--scenes",
        scene,
        "--kinds",
        "aerial",
        "--seeds",
        "0",
        "--noises",
        "1",
        "--views",
        "6",
        "--width",
        "160",
        "--points",
        "8000",
        "--every",
        "1",
    ]


@pytest.fixture(scope="module")
def record(folder) -> dict:
    return json.loads((folder / "tables.json").read_text())


def figures(record: dict, name: str, scene: int = 0) -> dict:
    key = next(row["key"] for rows in record["layout"].values() for row in rows if row["name"] == name)
    return record["results"][scene]["rows"][key]


@pytest.mark.parametrize(
    ("name", "method", "how"), [(DEFAULT, "conflict-lock", "map"), (OURS, "conflict-lock", "geometry")]
)
def test_rows_equal_the_stages(folder, record, tmp_path, name, method, how):
    scene = folder / "seed0_noise1"
    seeds = tmp_path / "seeds.ply"
    run_stage("label", scene, "--method", method, "--unlabelled", "ignore", "--output", seeds)
    run_stage(
        "propagate",
        scene,
        "--method",
        how,
        "--seeds",
        tmp_path / "seeds.ply",
        "--output",
        tmp_path / "full.ply",
    )
    run_stage("evaluate", scene, "--labelled", tmp_path / "full.ply", "--output", tmp_path / "metrics.json")
    metrics, found = json.loads((tmp_path / "metrics.json").read_text()), figures(record, name)
    for area, key in (
        ("all", "labels"),
        ("near_edges", "labels_near_edges"),
        ("elsewhere", "labels_elsewhere"),
    ):
        assert found[area] == metrics[key]
    masks = record["results"][0]["rows"]["masks"]
    assert masks["all"] == metrics["masks"] and masks["bound"]["all"]["oa"] > max(0.9, found["all"]["oa"])
    truth, label = (
        read_cloud(path).point["label"].numpy().ravel()
        for path in (folder / "seed0" / "truth.ply", tmp_path / "full.ply")
    )
    assert found["points"]["oa"] == pytest.approx((truth == label)[(truth > 0) & (truth != OTHER)].mean())
    believed = metrics["reliability"]
    assert found["reliability"] == believed
    assert 0 < believed["ece"] < 0.5 and sum(
        count for _, _, count in filter(None, believed["bins"])
    ) == round(metrics["labels"]["coverage"] * metrics["labels"]["pixels"])


def test_scene_by_path_and_costs(record):
    assert [result["group"] for result in record["results"]] == ["synthetic, mask noise 1", "given"]
    given = figures(record, DEFAULT, 1)
    assert (
        given["all"]["oa"] > 0.98 and "points" not in given and set(given["all"]["iou"]) == {"road", "grass"}
    )
    for result in record["results"]:
        for key, row in result["rows"].items():
            if key != "masks":
                assert row["cpu_seconds"] >= row["label_cpu_seconds"] > 0 and row["peak_memory_mb"] > 50


def test_both_kinds_of_site_are_scenes_of_their_own(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(
        tables, "synthetic_scene", lambda folder, settings: made.append((folder.name, settings.kind))
    )
    monkeypatch.setattr(tables, "with_masks", lambda base, folder, settings: Scene(folder))
    wanted = BenchmarkTables(tmp_path, seeds=(0, 7), noises=(1.0,))
    groups = [variant.group for _, variants in tables._scenes(wanted) for variant in variants]
    assert made == [("seed0", "aerial"), ("seed7", "aerial"), ("street0", "street"), ("street7", "street")]
    assert groups == ["synthetic, mask noise 1"] * 2 + ["street, mask noise 1"] * 2


def test_rows_are_kept_and_only_missing_ones_computed(folder, record, monkeypatch):
    monkeypatch.setattr(tables, "load_place", lambda *_: pytest.fail("nothing is missing"))
    page_before = (folder / "tables.md").read_text()
    run(*command(folder))
    monkeypatch.undo()
    assert (folder / "tables.md").read_text() == page_before
    files = {file: file.stat().st_mtime_ns for file in (folder / "rows").rglob("*.json")}
    lost = next(
        file
        for file in files
        if json.loads(file.read_text())["name"] == "conflict-lock + KNN" and "seed0" in file.parent.name
    )
    lost.unlink()
    calls, fuse = [], tables.fuse
    monkeypatch.setattr(tables, "fuse", lambda *arguments: calls.append(arguments[-1]) or fuse(*arguments))
    run(*command(folder))
    assert len(calls) == 2 and calls[-1].method == "conflict-lock"  # the warm-up and the row
    assert {file for file in files if file.stat().st_mtime_ns != files[file]} == {lost}
    again = figures(json.loads((folder / "tables.json").read_text()), "conflict-lock + KNN")
    assert again["all"] == figures(record, "conflict-lock + KNN")["all"]


def test_masks_of_strength_one_are_those_of_synthesize(folder):
    for name in ("masks", "confidence", "truth"):
        for file in (folder / "seed0" / name).iterdir():
            assert np.array_equal(
                read_index_image(file), read_index_image(folder / "seed0_noise1" / name / file.name)
            )


def test_every_switch_has_a_row_that_turns_it_alone():
    rows = ablation()
    for default in (Label(), Propagate()):
        stage, records = (
            type(default).__name__.lower(),
            [getattr(row, type(default).__name__.lower()) for row in rows],
        )
        changed = [
            [
                field.name
                for field in fields(default)
                if getattr(record, field.name) != getattr(default, field.name)
            ]
            for record in records
        ]
        assert all(len(set(names) - {"method"} or names) <= 1 for names in changed)
        flags = {name for name, hint in get_type_hints(type(default)).items() if hint is bool}
        zeros = {name for name, text in helps(type(default)).items() if "0 = off" in text}
        assert flags | zeros | {"method"} <= {name for names in changed for name in names}, stage
    assert len({row.key for row in rows}) == len(rows) and all(row.key != row.base.key for row in rows)
    assert {record.edge_width for _, record in turned(replace(Label(), edge_width=0.0))} == {
        0.0,
        1.0,
    }


def test_changed_inputs_are_other_rows(folder, tmp_path):
    scene = write_bare_scene(tmp_path / "scene")
    first = tables.Variant("a", None, Scene(scene)).digest
    assert tables.Variant("b", None, Scene(scene)).digest == first
    (scene / "masks" / "photo_0.png").unlink()
    assert tables.Variant("a", None, Scene(scene)).digest != first


def test_page_shows_means_spread_and_differences():
    def result(seed: int, ours: float, other: float) -> dict:
        def row(value: float) -> dict:
            area = {"oa": value + 0.1, "miou": value, "iou": {"road": value}, "coverage": 1.0}
            return {
                "all": area,
                "near_edges": area,
                "elsewhere": area,
                "cpu_seconds": 100 * value,
                "peak_memory_mb": 500,
            }

        keys = {row["key"] for rows in layout.values() for row in rows}
        found = {key: row(ours if key == "0" else other) for key in keys} | {
            "masks": {area: row(other)[area] for area in ("all", "near_edges", "elsewhere")}
        }
        return {
            "scene": f"seed{seed}",
            "group": "synthetic",
            "seed": seed,
            "classes": ["road"],
            "rows": found,
        }

    names = dict.fromkeys(name for _, _, *pair in DIFFERENCES for name in pair)
    layout = {
        "Table 1": [
            {"name": name, "key": "0" if name == OURS else str(row + 1)} for row, name in enumerate(names)
        ]
    }
    layout["Ablation"] = [
        layout["Table 1"][list(names).index(DEFAULT)],
        {"name": "label: --no-thing", "key": "0", "base": str(list(names).index(DEFAULT) + 1)},
    ]
    results = [result(0, 0.9, 0.7), result(1, 0.8, 0.5)]
    text = markdown({"settings": {"every": 4}, "code": "abc", "layout": layout, "results": results})
    assert "| ours - majority voting | +12.39 / +17.03 | +25.00 ± 7.07 / +25.00 ± 7.07 |" in text
    assert "| label: --no-thing | +25.00 ± 7.07 | +25.00 | +25.00 | +25 |" in text
    assert "| synthetic | +0.00 ± 0.00 |" in text
    assert f"| {OURS} | 95.0 ± 7.1 | 85.0 ± 7.1 | 85.0 ± 7.1 |" in text and "every 4th photo" in text
    assert spread([1.0]) == "1.0" and spread([np.nan]) == "–"


def test_page_shows_all_judged_pixels(record):
    text = markdown(record)
    lines = text.partition("### All judged pixels")[2].partition("\n## ")[0].strip().splitlines()
    heads, *rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in lines if "---" not in line
    ]
    assert heads[1:4] == ["other given a class", "building precision", "building recall"]
    found = {row[0]: row for row in rows}
    masks = record["results"][0]["rows"]["masks"]["all"]
    assert masks["other"]["pixels"] > 100
    assert found[MASKS][1] == f"{100 * masks['other']['given_class']:.1f}"
    assert found[MASKS][2] == f"{100 * masks['precision']['building']:.1f}"
    bound = record["results"][0]["rows"]["masks"]["bound"]["all"]
    assert bound["other"]["given_class"] < 0.5 < masks["other"]["given_class"]
    assert DEFAULT in found and found[BOUND][1] == f"{100 * bound['other']['given_class']:.1f}"


def test_bad_input(folder, tmp_path, capsys):
    with pytest.raises(InputError, match="not \\(6, 160, 999\\)|999"):
        tables.synthetic_scene(folder / "seed0", tables.Synthesize(views=6, width=160, num_points=999))
    assert "cloud.ply" in fails(capsys, "tables", tmp_path, "--scenes", folder / "rows")
    assert "at least one scene" in fails(capsys, "tables", tmp_path, "--every", "0")


def test_z_buffer_voter_and_scikit_learn_find_the_classes():
    cloud = Cloud(ground(), None)
    label = fusion_rivals.vote_with_z_buffer(cloud, views(), lambda view: (truth_mask(view), None), 4)
    expected = np.where(
        cloud.points[:, 0] < 512345.0 - 0.1, 1, np.where(cloud.points[:, 0] > 512345.0 + 0.2, 3, 0)
    )
    inner = (
        (expected > 0)
        & (np.abs(cloud.points[:, 1] - 5187654.0) < 3.5)
        & (np.abs(cloud.points[:, 0] - 512345.0) < 3.5)
    )
    assert (label == expected)[inner].mean() > 0.99
    filled = fusion_rivals.classify_neighbors(
        cloud.points - cloud.points[0], np.where(np.arange(len(label)) % 3, label, 0).astype(np.uint8)
    )
    assert (filled == expected)[inner].mean() > 0.98


def test_fusion_speed(folder, tmp_path):
    output = tmp_path / "speed.json"
    run(
        "fusion-speed",
        folder / "seed0_noise1",
        "--points",
        "3000",
        "6000",
        "--views",
        "4",
        "12",
        "--repeats",
        "1",
        "--output",
        output,
    )
    record = json.loads(output.read_text())
    assert record["rays"] == 6 * 160 * 107 and [row["views"] for row in record["growth_views"]] == [4, 12]
    assert [row["points"] for row in record["growth_points"]] == [3000, 6000]
    assert all(seconds > 0 for clocks in record["contenders"].values() for seconds in clocks.values())
    ratio = record["contenders"]["label"]["cpu_seconds"] / record["contenders"]["rays only"]["cpu_seconds"]
    assert output.with_suffix(".md").read_text() == fusion_markdown(
        record
    ) and f"| {ratio:.2f} |" in fusion_markdown(record)


def test_walls_in_the_sky_spikes_and_stored_depth_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(surface, "NUM_SAMPLES", 20_000)
    truth, scene = Scene(tmp_path / "truth"), Scene(tmp_path / "scene")
    view = pinhole_view("a.jpg", (40, 40), (40, 40, 20, 20), np.eye(4))
    for folder in (truth, scene):
        write_model(folder.sparse, build_model([view, replace(view, name="b.jpg")]))
    # a wall at depth 4 fills the lower half of the photos, the rest is sky; the mesh goes on into it, 1 m nearer
    wall = np.array([[-2.0, 0, 4], [-2, 2, 4], [2, 2, 4], [2, 0, 4]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    both = np.concatenate([wall, wall * [1, -1, 0] + [0, 0, 3]])
    for path, corners, triangles in (
        (truth.path / "truth_mesh.ply", wall, faces),
        (scene.mesh, both, np.concatenate([faces, faces + 4])),
    ):
        write_geometry(
            path, o3d.t.geometry.TriangleMesh(o3d.core.Tensor(corners), o3d.core.Tensor(triangles))
        )
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.array([[0.3, 0.5, 4], [0.4, 1.0, 4], [0, 1.5, 4]])))
    cloud.point.normals = o3d.core.Tensor(np.tile(np.float32([0, 0, -1]), (3, 1)))
    cloud.point.label = o3d.core.Tensor(np.array([[0], [1], [1]], np.uint8))
    write_geometry(truth.path / "truth.ply", cloud)
    write_json(truth.classes, CLASSES)
    exact = np.zeros((40, 40), np.float32)
    exact[20:] = 4.0
    found = np.zeros((20, 20), np.float32)
    found[10:] = 4.1  # half as large, 2.5 % too far
    (truth.path / "truth_depth").mkdir()
    for name in ("a", "b"):
        np.save(truth.path / "truth_depth" / f"{name}.npy", exact)
        label = (exact > 0).astype(np.uint8)
        label[39] = 2  # trees
        write_image(truth.truth / f"{name}.png", label)
        file = depth_file(scene.depth, f"{name}.jpg")
        file.parent.mkdir(exist_ok=True)
        normals, num_views = np.zeros((20, 20, 3), np.int8), np.full((20, 20), 2, np.uint8)
        np.savez(file, depth=found, normals=normals, num_views=num_views, sky=found == 0)
    figures = surface.surface_figures(scene, truth, 0.1)
    assert figures.depth_median == pytest.approx(0.025, rel=1e-4) and figures.opaque == 1
    assert figures.sky_hit == 1 and figures.complete == 1 and figures.completeness == {"building": 1}
    assert figures.accuracy == pytest.approx(0.5, abs=0.02) and figures.spikes == pytest.approx(0.5, abs=0.02)
    assert "| pixels of sky that see the mesh | 100.00% |" in page("a", figures)


def test_surface_of_the_truth_itself_is_perfect(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(surface, "NUM_SAMPLES", 5000)
    truth = Scene(folder / "seed0")
    scene = tmp_path / "scene"
    scene.mkdir()
    for name, target in {"mesh.ply": "truth_mesh.ply", "sparse": "sparse"}.items():
        (scene / name).symlink_to(truth.path / target)
    points = torch.tensor(
        read_cloud(truth.path / "truth.ply").point.positions.numpy() - local_origin(truth.model.views)
    ).float()
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(points), 1)
    scales, logits = torch.full_like(points, np.log(0.4)), torch.full((len(points),), 4.0)
    gaussians = Gaussians(points, scales, quats, logits, torch.zeros_like(points))
    write_splat_ply(scene / "gaussians.ply", gaussians.arrays())
    assert "--voxel-size" in fails(capsys, "surface", scene, truth.path)
    (scene / "mesh.ply.json").write_text(json.dumps({"summary": {"voxel_size": 0.25}}))
    assert voxel_size_of(Scene(scene)) == 0.25
    run("surface", scene, truth.path, "--output", tmp_path / "surface.json")
    found = json.loads((tmp_path / "surface.json").read_text())["figures"]
    assert (
        found["accuracy"] == 1
        and set(found["completeness"].values()) == {1.0}
        and found["voxel_size"] == 0.25
        and found["hit"] > 0.95
        and found["complete"] == 1
        and found["spikes"] == 0
        and found["sky_hit"] is None
    )
    assert (tmp_path / "surface.md").read_text() == page("scene", surface.SurfaceFigures(**found))
