"""What a report is made of, read from the scene's files; missing files give None or nothing."""

from __future__ import annotations

import json
import logging
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.raster import Raster, highest_points, spacing_of_all
from sc3d.io.clouds import read_cloud, read_mesh
from sc3d.io.json_files import read_json
from sc3d.report.charts import number
from sc3d.runner import MAX_SIDECAR, sidecar
from sc3d.scene.class_table import ClassTable
from sc3d.scene.scene import Scene, find_masks

if TYPE_CHECKING:
    import open3d as o3d

    from sc3d.geometry.cameras import View

logger = logging.getLogger(__name__)

_CELL = 2.0  # side of the cells that areas are counted in, point spacings
_STAGES = (
    "synthesize",
    "map_photos",
    "reconstruct",
    "depth",
    "train",
    "extract",
    "segment",
    "label",
    "propagate",
    "evaluate",
    "export",
)


@dataclass(frozen=True)
class ReportData:
    """Everything a report may show.

    cloud: the labelled cloud, else the seeds, else the bare cloud; mesh: the surface
    views: cameras by name order; metrics, check: content of metrics.json and check.json; records: sidecars in the order of the
        stages
    """

    scene: Scene
    class_table: ClassTable | None = None
    cloud: o3d.t.geometry.PointCloud | None = None
    mesh: o3d.t.geometry.TriangleMesh | None = None
    views: list[View] = field(default_factory=list)
    metrics: dict = field(default_factory=dict)
    check: dict = field(default_factory=dict)
    records: list[dict] = field(default_factory=list)

    def values(self, name: str) -> np.ndarray | None:
        """(N,) values of an attribute of the cloud; None if it has none."""
        if self.cloud is None or name not in self.cloud.point:
            return None
        return self.cloud.point[name].numpy().reshape(-1)

    @cached_property
    def points(self) -> np.ndarray:
        """(N, 3) float64 world."""
        return (
            np.empty((0, 3)) if self.cloud is None else self.cloud.point.positions.numpy().astype(np.float64)
        )

    @cached_property
    def label_counts(self) -> np.ndarray | None:
        """(256,) points per id; None without labels."""
        labels = self.values("label")
        return None if labels is None else np.bincount(labels.astype(np.uint8), minlength=256)

    @cached_property
    def truth(self) -> Path:
        """The folder of truth masks that was evaluated against, else the scene's own."""
        return evaluated_truth(self.scene)

    @cached_property
    def zero_margin(self) -> float | None:
        """How 0 in truth masks was read, as in `Scene.read_truth`."""
        used = _evaluate_settings(self.scene)
        return number(used.get("margin")) if used.get("truth_zero") == "other" else None

    @cached_property
    def truth_files(self) -> dict[str, Path]:
        """Truth masks by photo name."""
        return find_masks(self.truth, self.scene.photo_names, strict=False)

    @cached_property
    def mask_files(self) -> dict[str, Path]:
        """Given masks by photo name."""
        return find_masks(self.scene.masks, self.scene.photo_names, strict=False)

    @property
    def contact_sheet_file(self) -> Path:
        """The contact sheet that training writes; may not exist."""
        return self.scene.path / "train.jpg"

    def figures(self, source: str) -> dict:
        """Figures of "labels" or "masks" in metrics.json; empty if there are none."""
        found = self.metrics.get(source)
        return found if isinstance(found, dict) else {}


def load_report_data(scene: Scene) -> ReportData:
    """Read whatever of a scene exists; InputError for files that exist and are broken."""
    metrics, check = (read_json(file) if file.exists() else {} for file in (scene.metrics, scene.check))
    if not isinstance(metrics, dict):
        raise InputError(f"{scene.metrics} must hold an object: run `sc3d evaluate {scene.path} --overwrite`")
    if not isinstance(check, dict):
        raise InputError(f"{scene.check} must hold an object: run `sc3d check {scene.path}`")
    return ReportData(
        scene=scene,
        class_table=scene.class_table() if scene.classes.exists() else None,
        cloud=None if scene.best_cloud is None else read_cloud(scene.best_cloud),
        mesh=read_mesh(scene.mesh) if scene.mesh.exists() else None,
        views=scene.model.views if scene.sparse.is_dir() else [],
        metrics=metrics,
        check=check,
        records=_read_sidecars(scene.path),
    )


def evaluated_truth(scene: Scene) -> Path:
    """The folder of truth masks that metrics.json was made with, else the scene's own."""
    told = _evaluate_settings(scene).get("truth")
    return scene.path / told if isinstance(told, str) and (scene.path / told).is_dir() else scene.truth


def _evaluate_settings(scene: Scene) -> dict[str, Any]:
    """What metrics.json was made with; empty if that is not known."""
    with suppress(InputError):
        record: Any = read_json(sidecar(scene.metrics), MAX_SIDECAR)
        used = record.get("settings") if isinstance(record, dict) else None
        return used if isinstance(used, dict) else {}
    return {}


def sidecar_files(folder: Path) -> list[Path]:
    """JSON files of a scene folder that may be records of the stages."""
    return sorted([*folder.glob("*.json"), *folder.glob("sparse/*.json")])


def _read_sidecars(folder: Path) -> list[dict]:
    """Records of the stages; outputs of one run count once."""
    records: dict[str, dict] = {}
    for file in sidecar_files(folder):
        try:
            record = read_json(file, MAX_SIDECAR)
        except InputError:
            logger.warning("%s is not valid JSON and is left out of the report", file)
            continue
        if isinstance(record, dict) and isinstance(record.get("stage"), str):
            key = json.dumps([record["stage"], record.get("settings"), record.get("seconds")], sort_keys=True)
            records.setdefault(key, record | {"outputs": []})["outputs"].append(
                str(file.relative_to(folder))[: -len(".json")]
            )
    order = {stage: position for position, stage in enumerate(_STAGES)}
    return sorted(
        records.values(),
        key=lambda record: (order.get(record["stage"], len(order)), record["stage"], record["outputs"]),
    )


def class_areas(points: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(256,) float64 area of each class seen from above, squared world units: cells of the ground plane, by
    the label of their highest point.

    points: (N, 3) world, z up; labels: (N,) uint8
    """
    grid = Raster.around(points, _CELL * spacing_of_all(points))
    rows = highest_points(grid, points).ravel()
    return np.bincount(labels[rows[rows >= 0]], minlength=256) * grid.pixel**2


def read_features(file: Path) -> list[dict] | None:
    """Properties of the features of a GeoJSON file; None if it does not exist or is another kind of file."""
    try:
        content: Any = read_json(file)
        features = content["features"]
        return [feature["properties"] for feature in features if isinstance(feature["properties"], dict)]
    except (InputError, KeyError, TypeError):
        return None
