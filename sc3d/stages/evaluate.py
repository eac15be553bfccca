"""Labelled cloud + truth masks -> metrics.json; the given masks are judged on the same pixels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from sc3d.geometry.cameras import View
from sc3d.io.chunked_clouds import CloudFile
from sc3d.io.images import read_index_image
from sc3d.io.json_files import write_json
from sc3d.metrics import Confusion, EvaluationPixels, Reliability, depth_edge_band, total
from sc3d.scene.labelled_cloud import LabelledSurface, read_labelled
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Evaluate
from sc3d.tiling.evaluate import BYTES, TiledSurface, find_points_by_tiles, read_labels
from sc3d.tiling.executor import open_executor
from sc3d.tiling.memory import TRIANGLE, fits, mesh_triangles, num_points

SOURCES = ("labels", "masks", "labels_near_edges", "labels_elsewhere")  # order of the figures


def inputs(scene: Scene, settings: Evaluate) -> list[Path]:
    return [
        scene.sparse,
        scene.classes,
        scene.masks,
        scene.mesh,
        settings.truth or scene.truth,
        settings.labelled or scene.labelled,
    ]


def outputs(scene: Scene, settings: Evaluate) -> list[Path]:
    return [settings.output or scene.metrics]


def run(scene: Scene, settings: Evaluate) -> dict[str, object]:
    class_table = scene.class_table()
    scene.require(settings.truth or scene.truth, hint="pass --truth FOLDER with manual masks")
    truth_files = scene.mask_files(settings.truth or scene.truth, class_table)
    mask_files = scene.mask_files(scene.masks, class_table) if scene.masks.is_dir() else {}
    path = settings.labelled or scene.labelled
    count = num_points(path) if path.exists() else None
    if count is None or fits(count * BYTES + mesh_triangles(scene.mesh) * TRIANGLE, settings):
        cloud, labels = read_labelled(path, "propagate")
        surface = LabelledSurface.build(cloud, scene.model.views, scene.mesh)
    else:
        cloud = CloudFile.open(path)
        labels = read_labels(cloud)
        with open_executor(settings) as tasks:
            surface = find_points_by_tiles(scene, settings, cloud, tasks)
    views = [view for view in scene.model.views if view.name in truth_files]
    per_photo, beliefs = {}, []
    for view in tqdm(views, desc="evaluating", unit="photo", disable=None):
        truth = read_index_image(truth_files[view.name])
        mask = read_index_image(mask_files[view.name]) if view.name in mask_files else None
        pixels = _judged(surface, view, truth, settings.band)
        beliefs.append(pixels.reliability(labels.label, labels.confidence))
        per_photo[view.name] = _confusions(pixels, labels.label, class_table.num_ids) | _masks(
            truth, mask, class_table.num_ids
        )
    parts = {
        key: total((photo[key] for photo in per_photo.values() if key in photo), class_table.num_ids)
        for key in SOURCES
    }
    totals = {
        key: confusion.summary(class_table)
        for key, confusion in parts.items()
        if key != "masks" or mask_files
    }
    photos = {
        name: {key: confusion.summary(class_table) for key, confusion in confusions.items()}
        for name, confusions in per_photo.items()
    }
    believed = Reliability.merge(beliefs).summary() if beliefs else {}
    metrics = {
        "photos": [view.name for view in views],
        "classes": [entry.name for entry in class_table],
    } | totals
    write_json(settings.output or scene.metrics, metrics | {"reliability": believed, "per_photo": photos})
    if isinstance(surface, TiledSurface):
        surface.parts.remove()
    return _summary(totals) | ({"calibration_error": round(believed["ece"], 4)} if believed else {})


def _judged(
    surface: LabelledSurface | TiledSurface, view: View, truth: np.ndarray, band: float
) -> EvaluationPixels:
    """The pixels of a photo that have truth, and the cloud point that each shows."""
    rows, first = surface.rows(view, truth.shape[::-1], truth > 0)
    return EvaluationPixels.from_photo(truth, rows, depth_edge_band(first.range, band))


def _confusions(pixels: EvaluationPixels, label: np.ndarray, num_ids: int) -> dict[str, Confusion]:
    near, elsewhere = pixels.confusions(pixels.look_up(label), num_ids)
    return {"labels": near + elsewhere, "labels_near_edges": near, "labels_elsewhere": elsewhere}


def _masks(truth: np.ndarray, mask: np.ndarray | None, num_ids: int) -> dict[str, Confusion]:
    if mask is None:
        return {}
    return {
        "masks": Confusion.from_labels(
            truth, cv2.resize(mask, truth.shape[::-1], interpolation=cv2.INTER_NEAREST), num_ids
        )
    }


def _summary(totals: dict) -> dict[str, object]:
    rows = {}
    for key, figures in totals.items():
        classes = "  ".join(f"{name} {value:.1%}" for name, value in figures["iou"].items())
        rows[key] = (
            f"OA {figures['oa']:.1%}  mIoU {figures['miou']:.1%}  ({classes})  coverage {figures['coverage']:.1%}"
        )
    return rows
