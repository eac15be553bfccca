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
from sc3d.io.chunked_clouds import CloudFile
from sc3d.io.clouds import read_cloud
from sc3d.io.json_files import read_json
from sc3d.io.ply import num_triangles
from sc3d.report.charts import number
from sc3d.report.tally import CloudTally, tally, tally_by_parts
from sc3d.runner import MAX_SIDECAR, sidecar
from sc3d.scene.class_table import ClassTable
from sc3d.scene.cloud_parts import read_thinned
from sc3d.scene.scene import Scene, find_masks
from sc3d.settings.common import Memory
from sc3d.tiling.memory import fits, max_points, num_points, surface_bytes

if TYPE_CHECKING:
    import open3d as o3d

    from sc3d.geometry.cameras import View

logger = logging.getLogger(__name__)

BYTES = 230  # of a point of a cloud that is reported as a whole
DRAWN = 1_500_000  # points in pictures
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

    cloud: the labelled cloud, else the seeds, else the bare cloud, or some of its points if it does not fit into
        memory; tally: of all of them; mesh: file of the surface, where that fits too; settings: of the stage
    views: cameras by name order; metrics, check: content of metrics.json and check.json; records: sidecars in the order of the
        stages
    """

    scene: Scene
    class_table: ClassTable | None = None
    cloud: o3d.t.geometry.PointCloud | None = None
    mesh: Path | None = None
    views: list[View] = field(default_factory=list)
    metrics: dict = field(default_factory=dict)
    check: dict = field(default_factory=dict)
    records: list[dict] = field(default_factory=list)
    tally: CloudTally | None = None
    settings: Memory = Memory()

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

    @property
    def num_points(self) -> int:
        """Of the whole cloud."""
        return 0 if self.tally is None else self.tally.size

    @property
    def label_counts(self) -> np.ndarray | None:
        """(256,) points per id; None without labels."""
        return None if self.tally is None else self.tally.labels

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


def load_report_data(scene: Scene, settings: Memory = Memory()) -> ReportData:
    """Read whatever of a scene exists; InputError for files that exist and are broken."""
    metrics, check = (read_json(file) if file.exists() else {} for file in (scene.metrics, scene.check))
    if not isinstance(metrics, dict):
        raise InputError(f"{scene.metrics} must hold an object: run `sc3d evaluate {scene.path} --overwrite`")
    if not isinstance(check, dict):
        raise InputError(f"{scene.check} must hold an object: run `sc3d check {scene.path}`")
    cloud, tally = _read_cloud(scene, settings)
    has_mesh, held = scene.mesh.exists(), 0 if cloud is None else len(cloud.point.positions) * BYTES
    if has_mesh and not fits(held + surface_bytes([scene.mesh]), settings):
        logger.warning(
            "the report has no picture of the mesh: its %.1f million triangles do not fit into --max-memory",
            num_triangles([scene.mesh]) / 1e6,
        )
        has_mesh = False
    return ReportData(
        scene=scene,
        class_table=scene.class_table() if scene.classes.exists() else None,
        cloud=cloud,
        mesh=scene.mesh if has_mesh else None,
        views=scene.model.views if scene.sparse.is_dir() else [],
        metrics=metrics,
        check=check,
        records=_read_sidecars(scene.path),
        tally=tally,
        settings=settings,
    )


def _read_cloud(scene: Scene, settings: Memory) -> tuple[o3d.t.geometry.PointCloud | None, CloudTally | None]:
    """The cloud, or what is drawn of it, and the tally of all of it."""
    path = scene.best_cloud
    if path is None:
        return None, None
    count = num_points(path)
    if count is None or fits(count * BYTES + surface_bytes(scene.surface), settings):
        cloud = read_cloud(path)
        return cloud, tally(cloud)
    some = read_thinned(path, min(DRAWN, max_points(settings, BYTES)))
    logger.info(
        "%s is counted from disk; pictures show %.1f of its %.1f million points (--max-memory)",
        path,
        len(some.point.positions) / 1e6,
        count / 1e6,
    )
    return some, tally_by_parts(CloudFile.open(path), some.point.positions.numpy())


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


def read_features(file: Path) -> list[dict] | None:
    """Properties of the features of a GeoJSON file; None if it does not exist or is another kind of file."""
    try:
        content: Any = read_json(file)
        features = content["features"]
        return [feature["properties"] for feature in features if isinstance(feature["properties"], dict)]
    except (InputError, KeyError, TypeError):
        return None
