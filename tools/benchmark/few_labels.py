"""What a few photos labelled by hand are worth: the truth masks of some photos are all the masks that there
are, and others are judged, beside the given masks of all photos.
"""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.images import write_image
from sc3d.io.json_files import read_json
from sc3d.io.provenance import versions
from sc3d.metrics import Confusion
from sc3d.scene.class_table import ClassTable
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Evaluate, Label, Propagate
from sc3d.stages import evaluate, label, propagate
from tools.benchmark.publish import check_output, publish
from tools.benchmark.settings import BenchmarkFewLabels

LINKED = (
    "images", "sparse", "cloud.ply", "mesh.ply", "unconfirmed.ply", "classes.json", "georeference.json"
)  # fmt: skip
HAND, PLAIN, GIVEN = "by hand", "by hand, --no-appearance", "given masks"


@dataclass(frozen=True)
class Fold:
    """Names of the photos that are labelled, and of those that are judged."""

    labelled: tuple[str, ...]
    judged: tuple[str, ...]


def folds_of(names: list[str], labelled: int, judged: int, folds: int) -> list[Fold]:
    """So many photos of each kind, spread evenly over the names; other ones are judged in each fold.
    InputError if there are too few.
    """
    if labelled + judged > len(names):
        raise InputError(
            f"{len(names)} photos have truth, too few for {labelled} to label and {judged} to judge:"
            " ask for less"
        )
    result = []
    for fold in range(folds):
        place = (np.arange(judged) + (fold + 0.5) / folds) * len(names) / judged
        chosen = set(np.floor(place).astype(int).tolist())
        rest = [name for row, name in enumerate(names) if row not in chosen]
        rows = np.floor((np.arange(labelled) + 0.5) * len(rest) / labelled).astype(int)
        result.append(Fold(tuple(rest[row] for row in rows), tuple(names[row] for row in sorted(chosen))))
    return result


def measure(scene: Scene, command: BenchmarkFewLabels) -> dict[str, Confusion]:
    """Pixels of the judged photos of all folds, by what the labels were made from."""
    truth, table = command.truth or scene.truth, scene.class_table()
    files = scene.mask_files(truth, table, truth=True)
    result: dict[str, Confusion] = {}
    for fold in folds_of(sorted(files), command.labelled, command.judged, command.folds):
        with tempfile.TemporaryDirectory(prefix="few_labels_") as folder:
            drawn, given = (Scene(Path(folder) / name) for name in ("drawn", "given"))
            for copy in (drawn, given):
                _link(scene, copy, LINKED)
                for name in fold.judged:
                    target = scene.photo_names.path(copy.truth, name, files[name].suffix)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(files[name], target)
            for name in fold.labelled:
                known = _ids(scene.read_truth(files[name], name), table)
                write_image(scene.photo_names.path(drawn.masks, name), known)
            found = {HAND: run(drawn, Propagate()), PLAIN: run(drawn, Propagate(appearance=False))}
            if scene.masks.is_dir():
                _link(scene, given, ("masks", "confidence"))
                found[GIVEN] = run(given, Propagate())
        result = {name: part + result[name] if name in result else part for name, part in found.items()}
    return result


def _link(scene: Scene, copy: Scene, names: tuple[str, ...]) -> None:
    """The files and folders of a scene that exist, in another."""
    copy.path.mkdir(exist_ok=True)
    for name in names:
        if (scene.path / name).exists():
            (copy.path / name).symlink_to((scene.path / name).resolve())


def _ids(drawn: np.ndarray, table: ClassTable) -> np.ndarray:
    """Truth as masks have it: ids of the table, and 0."""
    return np.where(np.isin(drawn, [entry.id for entry in table]), drawn, 0).astype(np.uint8)


def run(scene: Scene, settings: Propagate) -> Confusion:
    """Label, propagate and judge; the seeds are made once."""
    if not scene.seeds.exists():
        label.run(scene, Label())
    propagate.run(scene, settings)
    evaluate.run(scene, Evaluate())
    metrics = read_json(scene.metrics)
    if not isinstance(metrics, dict):
        raise InputError(f"{scene.metrics} holds no figures")
    counts = np.array(metrics["labels"]["confusion"], np.int64)
    return Confusion(np.concatenate([np.zeros_like(counts[:1]), counts]))


def run_few_labels(command: BenchmarkFewLabels) -> None:
    """Measure every scene, show the table, write it if wanted."""
    check_output(command.output)
    figures = {}
    for path in command.scenes:
        scene = Scene(path)
        scene.require(scene.cloud, scene.classes, command.truth or scene.truth, hint="see --help")
        table = scene.class_table()
        found = measure(scene, command)
        figures[path.name] = {name: row.summary(table) for name, row in found.items()}
    record = {
        "benchmark": "few-labels",
        "labelled": command.labelled,
        "judged": command.judged,
        "folds": command.folds,
        "versions": versions(),
        "figures": figures,
    }
    publish(record, page(figures), command.output)


def page(figures: dict[str, dict[str, dict]]) -> str:
    """A Markdown table: per cent, over the pixels of the judged photos."""
    names = list(
        dict.fromkeys(name for rows in figures.values() for row in rows.values() for name in row["iou"])
    )
    lines = [f"| site | masks | OA | mIoU | {' | '.join(names)} |", f"|{'---|' * (len(names) + 4)}"]
    for site, rows in figures.items():
        for source, row in rows.items():
            shares = [row["oa"], row["miou"], *(row["iou"].get(name) for name in names)]
            cells = " | ".join("–" if share is None else f"{100 * share:.1f}" for share in shares)
            lines.append(f"| {site} | {source} | {cells} |")
    return "\n".join(lines) + "\n"
