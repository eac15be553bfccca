"""Everything in the scene -> report.html."""

from __future__ import annotations

from pathlib import Path

from sc3d.report import write_report
from sc3d.report.data import evaluated_truth, sidecar_files
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Report


def inputs(scene: Scene, settings: Report) -> list[Path]:
    return [
        scene.labelled,
        scene.seeds,
        scene.cloud,
        scene.metrics,
        scene.sparse,
        scene.masks,
        scene.classes,
        *scene.surface,
        scene.images,
        evaluated_truth(scene),
        scene.path / "train.jpg",
        *([scene.check] if scene.check.exists() else []),  # reports of before it are up to date without
        *sorted(scene.export.glob("*.geojson")),  # not the folder: the report may be written there
        *(file for file in sidecar_files(scene.path) if not file.name.endswith(".html.json")),  # not its own
    ]


def outputs(scene: Scene, settings: Report) -> list[Path]:
    return [settings.output or scene.report]


def run(scene: Scene, settings: Report) -> dict[str, object]:
    scene.require(scene.classes, hint="the report needs the class table")
    output = settings.output or scene.report
    write_report(scene, output, settings)
    return {"kilobytes": output.stat().st_size // 1024}
