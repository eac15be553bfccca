"""The tables of the paper: every row is one way to label a cloud, judged on the same pixels. Finished rows
are kept, so that a run can go on.
"""

from __future__ import annotations

import ast
import hashlib
import json
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import groupby
from pathlib import Path

import sc3d
from sc3d.errors import InputError
from sc3d.io.atomic import require_writable
from sc3d.io.json_files import write_json
from sc3d.io.provenance import digest, peak_memory_mb, reset_peak_memory, versions
from sc3d.labelling.cloud import Cloud
from sc3d.labelling.fusion import Fusion, fuse
from sc3d.labelling.inputs import Masks, default_voxel_size
from sc3d.metrics import Confusion
from sc3d.propagation.labelled_points import LabelledPoints
from sc3d.propagation.propagate import propagate
from sc3d.scene.labels import Labels
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Label, Propagate
from sc3d.settings.synthesize import Synthesize
from sc3d.synthetic.masks import without_other
from tools.benchmark.publish import publish
from tools.benchmark.settings import BenchmarkTables
from tools.benchmark.table_page import MASKS, markdown
from tools.benchmark.table_rows import Row, tables
from tools.benchmark.table_scenes import (
    Place,
    judge_masks,
    load_place,
    synthetic_scene,
    with_density,
    with_masks,
)

logger = logging.getLogger(__name__)

# the rows


@dataclass(frozen=True)
class Variant:
    """A scene with masks. group: what its figures are averaged with; seed: None = a scene given by path."""

    group: str
    seed: int | None
    scene: Scene

    @cached_property
    def digest(self) -> str:
        """Hash of all that rows are made from: rows of other inputs are not mixed in."""
        scene = self.scene
        inputs = (
            scene.sparse,
            scene.classes,
            scene.masks,
            scene.confidence,
            scene.truth,
            scene.cloud,
            scene.mesh,
            scene.gaussians,
        )
        return hashlib.sha256(" ".join(digest(path) for path in inputs).encode()).hexdigest()[:12]


def run_tables(command: BenchmarkTables) -> None:
    """Compute what is missing, write tables.json and tables.md."""
    _check(command)
    record = compute_tables(command)
    publish(record, markdown(record), (command.output or command.workdir) / "tables.json")


def compute_tables(command: BenchmarkTables) -> dict[str, object]:
    """All rows on all scenes: the record that `table_page.markdown` reads."""
    results = []
    for scene, variants in _scenes(command):
        if all(_kept(command, variant, row) for variant in variants for row in [None, *unique_rows()]):
            logger.info("%s: all rows are there", scene.path.name)
            place = None
        else:
            place = load_place(scene, command.every)
        classes = [entry.name for entry in scene.class_table()]
        for variant in variants:
            rows = _run_variant(place, variant, command)
            results.append(
                {
                    "scene": variant.scene.path.name,
                    "group": variant.group,
                    "seed": variant.seed,
                    "classes": classes,
                    "rows": rows,
                }
            )
    layout = {
        title: [
            {"name": row.name, "key": row.key} | ({"base": row.base.key} if row.base else {}) for row in rows
        ]
        for title, rows in tables().items()
    }
    settings = {name: getattr(command, name) for name in ("views", "points", "width", "every")}
    return {
        "benchmark": "tables",
        "settings": settings,
        "versions": versions(),
        "code": code_digest(),
        "layout": layout,
        "results": results,
    }


def unique_rows() -> list[Row]:
    """All rows, each settings once, those with the same label settings next to one another."""
    rows: dict[str, Row] = {}
    for row in (row for rows in tables().values() for row in rows):
        rows.setdefault(row.key, row)
    order = {label: number for number, label in enumerate(dict.fromkeys(row.label for row in rows.values()))}
    return sorted(rows.values(), key=lambda row: order[row.label])


@cache
def code_digest() -> str:
    """Hash of the sources that decide a row, which are those that fuse, propagate and judge, with all that they import:
    rows of other code are not mixed in.
    """
    root, wanted, seen = Path(sc3d.__file__).parent.parent, [fuse, propagate, Confusion], set()
    names = [function.__module__ for function in wanted]
    while names:
        name = names.pop()
        file = root.joinpath(*name.split(".")).with_suffix(".py")
        if file in seen or not file.is_file():
            continue
        seen.add(file)
        nodes = [
            node for node in ast.walk(ast.parse(file.read_text("utf-8"))) if isinstance(node, ast.ImportFrom)
        ]
        names += [
            part for node in nodes for part in (node.module, *(f"{node.module}.{a.name}" for a in node.names))
        ]
    return hashlib.sha256(b"".join(file.read_bytes() for file in sorted(seen))).hexdigest()[:12]


def _check(command: BenchmarkTables) -> None:
    if command.every < 1 or not (command.kinds and command.seeds and command.noises) and not command.scenes:
        raise InputError("the tables need at least one scene, and --every of 1 or more")
    require_writable(command.workdir)
    require_writable(command.output or command.workdir)
    for path in command.scenes:
        scene = Scene(path)
        scene.require(
            scene.truth,
            scene.cloud,
            scene.masks,
            scene.classes,
            hint="the tables need cloud.ply, classes.json, masks/ and truth/",
        )


def _scenes(command: BenchmarkTables) -> Iterator[tuple[Scene, list[Variant]]]:
    """Each scene without masks, and its variants."""
    wanted = [(kind, seed) for kind in command.kinds for seed in command.seeds] if command.noises else []
    for kind, seed in wanted:
        settings = Synthesize(
            kind=kind, seed=seed, views=command.views, width=command.width, num_points=command.points
        )
        folder, group = (f"seed{seed}", "synthetic") if kind == "aerial" else (f"{kind}{seed}", kind)
        base, variants = synthetic_scene(command.workdir / folder, settings), []
        for noise in command.noises:
            scene = with_masks(
                base, command.workdir / f"{folder}_noise{noise:g}", replace(settings, mask_noise=noise)
            )
            variants.append(Variant(f"{group}, mask noise {noise:g}", seed, scene))
        yield variants[0].scene, variants
    for path in command.scenes:
        yield Scene(path), [Variant(path.resolve().name, None, Scene(path))]


def _run_variant(place: Place | None, variant: Variant, command: BenchmarkTables) -> dict[str, dict]:
    """Figures by key of the row; "masks" for the masks."""
    figures = {
        key: found
        for key, found in (
            (row.key if row else "masks", _kept(command, variant, row)) for row in [None, *unique_rows()]
        )
        if found
    }
    missing = [row for row in unique_rows() if row.key not in figures]
    if "masks" in figures and not missing:
        return figures
    masks = Masks.load(variant.scene, variant.scene.confidence, "ignore")  # as the paper and its rivals do
    if "masks" not in figures:
        table = variant.scene.class_table()
        figures["masks"] = {"name": MASKS} | _areas(judge_masks(place, masks), table)
        if place.truth is not None:
            figures["masks"]["bound"] = _areas(
                place.judged.confusions(without_other(place.judged.look_up(place.truth)), place.num_ids),
                table,
            )
        write_json(_file(command, variant, None), figures["masks"])
    _warm_up(place, masks)
    voxel_size = default_voxel_size(place.cloud.points, masks)
    for label, rows in groupby(missing, key=lambda row: row.label):
        seeds, cost = _seeds(
            place, masks, label if label.voxel_size else replace(label, voxel_size=voxel_size)
        )
        for row in rows:
            figures[row.key] = _run_row(place, (seeds, cost), row)
            write_json(_file(command, variant, row), figures[row.key])
            score, seconds = figures[row.key]["all"]["miou"], figures[row.key]["cpu_seconds"]
            logger.info(
                "%s: %s: mIoU %.1f %%, %.0f CPU s", variant.scene.path.name, row.name, 100 * score, seconds
            )
    return figures


def _run_row(place: Place, given: tuple[LabelledPoints, dict[str, float]], row: Row) -> dict[str, object]:
    """given: what fusion left, and what it cost"""
    evidence, before = given
    labels, cost = evidence.seeds, dict.fromkeys(before, 0.0)
    if row.propagate is not None:
        labels, cost = _propagated(place, evidence, row.propagate)
    channels = place.scene.class_table().channels
    figures = judge(place, replace(labels, label=channels.to_ids(labels.label)))
    seconds = {
        f"{name}_{clock}": spent[clock]
        for name, spent in (("label", before), ("propagate", cost))
        for clock in ("cpu_seconds", "wall_seconds")
    }
    total = {clock: before[clock] + cost[clock] for clock in ("cpu_seconds", "wall_seconds")}
    return (
        {"name": row.name, "settings": row.settings}
        | figures
        | seconds
        | total
        | {"peak_memory_mb": max(before["peak_memory_mb"], cost["peak_memory_mb"])}
    )


def judge(place: Place, labels: Labels) -> dict[str, dict]:
    """Figures of a labelling: per pixel, all and by distance to depth edges, and per point where the truth is
    known.
    """
    table = place.scene.class_table()
    figures = _areas(place.judged.confusions(place.judged.look_up(labels.label), place.num_ids), table)
    if place.truth is not None:
        figures["points"] = Confusion.from_labels(place.truth, labels.label, place.num_ids).summary(table)
    return figures | {
        "reliability": place.judged.reliability(labels.label, labels.confidence, place.num_ids).summary()
    }


def _areas(confusions: tuple[Confusion, Confusion], table) -> dict[str, dict]:
    near, elsewhere = confusions
    parts = {"all": near + elsewhere, "near_edges": near, "elsewhere": elsewhere}
    return {name: confusion.summary(table) for name, confusion in parts.items()}


def _seeds(place: Place, masks: Masks, label: Label) -> tuple[LabelledPoints, dict[str, float]]:
    with _measured() as cost:
        fusion = _fused(place, masks, label)
    return LabelledPoints(place.cloud.points, fusion.labels, fusion.votes, place.colors), cost


def _fused(place: Place, masks: Masks, label: Label) -> Fusion:
    label = label.resolved
    cloud = with_density(place, label.voxel_size) if label.mechanisms.density else place.cloud
    surface = place.surface if label.depth_filter else None
    return fuse(cloud, masks.views, masks.read, surface, masks.channels.count, label)


def _propagated(
    place: Place, evidence: LabelledPoints, settings: Propagate
) -> tuple[Labels, dict[str, float]]:
    """As `sc3d propagate` does it."""
    with _measured() as cost:
        labels = propagate(evidence, place.cloud.normals, settings)
    return labels, cost


def _warm_up(place: Place, masks: Masks) -> None:
    """Compile and build what the first row would pay for."""
    few = slice(None, None, max(1, len(place.cloud.points) // 2000))
    cloud = Cloud(place.cloud.points[few], None if place.cloud.normals is None else place.cloud.normals[few])
    small = replace(place, cloud=cloud, colors=None if place.colors is None else place.colors[few])
    evidence, _ = _seeds(small, replace(masks, views=masks.views[:1]), Label(voxel_size=1.0))
    _propagated(small, evidence, Propagate())


@contextmanager
def _measured() -> Iterator[dict[str, float]]:
    """CPU seconds of the process, wall seconds and peak memory of the body; memory counts all that the
    process holds.
    """
    cost: dict[str, float] = {}
    reset_peak_memory()
    cpu, wall = time.process_time(), time.perf_counter()
    yield cost
    cost.update(
        cpu_seconds=time.process_time() - cpu,
        wall_seconds=time.perf_counter() - wall,
        peak_memory_mb=peak_memory_mb(),
    )


def _kept(command: BenchmarkTables, variant: Variant, row: Row | None) -> dict | None:
    try:
        return json.loads(_file(command, variant, row).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _file(command: BenchmarkTables, variant: Variant, row: Row | None) -> Path:
    name = f"{variant.scene.path.resolve().name}_{variant.digest}_every{command.every}"
    return command.workdir / "rows" / code_digest() / name / f"{row.key if row else 'masks'}.json"
