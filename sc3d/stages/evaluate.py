"""Labelled cloud + truth masks -> metrics.json; the given masks are judged on the same pixels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from sc3d.io import read_index_image, write_json
from sc3d.labelled import LabelledSurface, read_labelled
from sc3d.metrics import Confusion, depth_edge_band, total
from sc3d.scene import Scene
from sc3d.settings import Evaluate

def inputs(scene: Scene, settings: Evaluate) -> list[Path]:
    return [scene.sparse, scene.classes, scene.masks, scene.mesh, settings.truth or scene.truth, settings.labelled or scene.labelled]


def outputs(scene: Scene, settings: Evaluate) -> list[Path]:
    return [settings.output or scene.metrics]


def run(scene: Scene, settings: Evaluate) -> dict[str, object]:
    class_table = scene.class_table()
    scene.require(settings.truth or scene.truth, hint="pass --truth FOLDER with manual masks")
    truth_files = scene.mask_files(settings.truth or scene.truth, class_table)
    mask_files = scene.mask_files(scene.masks, class_table) if scene.masks.is_dir() else {}
    cloud, _ = read_labelled(settings.labelled or scene.labelled, "propagate")
    labelled = LabelledSurface.build(cloud, scene.model.views, scene.mesh)
    views = [view for view in scene.model.views if view.name in truth_files]
    parts: dict[str, list[Confusion]] = {"labels": [], "masks": [], "labels_near_edges": [], "labels_elsewhere": []}
    per_photo = {}
    for view in tqdm(views, desc="evaluating", unit="photo", disable=None):
        truth = read_index_image(truth_files[view.name])
        predicted, first = labelled.see(view, truth.shape[::-1], wanted=truth > 0)
        band = depth_edge_band(first.range, settings.band)
        parts["labels"].append(Confusion.of(truth, predicted, class_table.num_ids))
        parts["labels_near_edges"].append(Confusion.of(np.where(band, truth, 0), predicted, class_table.num_ids))
        parts["labels_elsewhere"].append(Confusion.of(np.where(band, 0, truth), predicted, class_table.num_ids))
        if view.name in mask_files:
            mask = cv2.resize(read_index_image(mask_files[view.name]), truth.shape[::-1], interpolation=cv2.INTER_NEAREST)
            parts["masks"].append(Confusion.of(truth, mask, class_table.num_ids))
        per_photo[view.name] = {key: confusions[-1].summary(class_table) for key, confusions in parts.items() if confusions}
    totals = {key: total(confusions, class_table.num_ids).summary(class_table) for key, confusions in parts.items() if confusions}
    metrics = {"photos": [view.name for view in views], "classes": [entry.name for entry in class_table]} | totals | {"per_photo": per_photo}
    write_json(settings.output or scene.metrics, metrics)
    return _summary(totals)


def _summary(totals: dict) -> dict[str, object]:
    rows = {}
    for key, figures in totals.items():
        classes = "  ".join(f"{name} {value:.1%}" for name, value in figures["iou"].items())
        rows[key] = f"OA {figures['oa']:.1%}  mIoU {figures['miou']:.1%}  ({classes})  coverage {figures['coverage']:.1%}"
    return rows
