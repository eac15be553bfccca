"""Masks back: the fused labels as each photo sees them, through its own camera model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tqdm import tqdm

from sc3d.geometry.cameras import View
from sc3d.io import atomic_path, write_image
from sc3d.labelled import LabelledSurface, read_labelled
from sc3d.scene import Scene
from sc3d.settings import Export


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / "masks", scene.export / "confidence"]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/masks/<photo stem>.png` and `export/confidence/<photo stem>.png` for every photo; usable as `segment --masks`, `--confidence`."""
    cloud, labels = read_labelled(settings.labelled or scene.labelled, "propagate")
    views = scene.model.views
    surface = LabelledSurface.build(cloud, views, scene.mesh)
    covered = []
    masks, confidences = outputs(scene, settings)
    with atomic_path(masks) as mask_folder, atomic_path(confidences) as confidence_folder:
        mask_folder.mkdir()
        confidence_folder.mkdir()
        for view in tqdm(views, desc="rendering masks", unit="photo", disable=None):
            mask, confidence = render_mask(surface, labels.confidence, view, settings.max_size)
            name = f"{Path(view.name).stem}.png"
            write_image(mask_folder / name, mask)
            write_image(confidence_folder / name, confidence)
            covered.append(float((mask > 0).mean()))
    return {"photos": len(views), "labelled_pixels": f"{np.mean(covered):.1%}"}


def render_mask(surface: LabelledSurface, confidence: np.ndarray, view: View, max_size: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Labels and confidence of one photo.

    confidence: (N,) float32 of the cloud's points, 0 to 1; max_size: longest side, px, 0 = the photo's
    returns: (H, W) uint8 ids, 0 = no label; (H, W) uint8, 255 = sure, at least 1 where there is a label
    """
    scale = min(1.0, max_size / max(view.width, view.height)) if max_size else 1.0
    rows, _ = surface.rows(view, (max(1, round(view.width * scale)), max(1, round(view.height * scale))))
    mask = np.where(rows >= 0, surface.label[rows], 0).astype(np.uint8)
    sure = np.clip(np.rint(confidence[rows] * 255), 1, 255)
    return mask, np.where(mask > 0, sure, 0).astype(np.uint8)
