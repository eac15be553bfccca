"""A second round for the masks: what contradicts the fused labels loses confidence, if photos that were left
out say that this helps.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, local_origin
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.georeferencing.up_direction import scene_up
from sc3d.io.atomic import atomic_path, discard
from sc3d.io.images import read_orientation, write_image
from sc3d.io.progress import progress
from sc3d.labelling.cloud import Cloud
from sc3d.labelling.fusion import fuse
from sc3d.labelling.inputs import Masks, default_voxel_size, read_given_cloud
from sc3d.labelling.observation import Mask
from sc3d.metrics import Confusion, total
from sc3d.propagation.labelled_points import LabelledPoints
from sc3d.propagation.propagate import propagate
from sc3d.scene.labelled_cloud import REACH, LabelledSurface, point_arrays, read_surface, spacing_of
from sc3d.scene.labels import Labels
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Label, Propagate, Segment

logger = logging.getLogger(__name__)

EVERY = 4  # every so many photos one is left out
FULL = 255  # confidence of a mask that has no confidence map

ReadMask = Callable[[View], Mask]


@dataclass(frozen=True)
class RefinementInputs:
    """A cloud with its surface, and the settings by which masks become labels.

    colors: (N, 3) uint8 or None; up: (3,) of the cameras, None = not known; seen: the surface, whatever
    labels it has; num_channels: classes + 1, as labels and masks here are channels; levels: as of `LabelledPoints`
    """

    cloud: Cloud
    colors: np.ndarray | None
    seen: LabelledSurface
    num_channels: int
    label: Label
    propagate: Propagate = Propagate()
    up: np.ndarray | None = None
    levels: np.ndarray | None = None

    def labels(self, views: list[View], read: ReadMask) -> Labels:
        """Labels of all points from the masks of some views."""
        fusion = fuse(self.cloud, views, read, self.seen.surface, self.num_channels, self.label)
        points, levels = self.cloud.points, self.levels
        known = LabelledPoints(points, fusion.labels, fusion.votes, self.colors, self.up, levels=levels)
        return propagate(known, self.cloud.normals, self.propagate)

    def render(self, labels: Labels, view: View, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """(H, W) uint8 labels and (H, W) float32 confidences, 0 to 1, as a photo of (width, height) sees
        them.
        """
        rows, _ = self.seen.rows(view, size)
        return np.where(rows >= 0, labels.label[rows], 0).astype(np.uint8), np.where(
            rows >= 0, labels.confidence[rows], 0
        ).astype(np.float32)


def load_refinement_inputs(scene: Scene, masks: Masks) -> RefinementInputs:
    """What refinement needs of a scene, with the default settings of `label` and `propagate`."""
    cloud = read_given_cloud(scene, None)
    points, normals = point_arrays(cloud, np.array([view.center for view in masks.views]))
    surface = read_surface(scene.surface, points, normals, local_origin(masks.views))
    seen = LabelledSurface(
        surface,
        NeighborIndex(points, points.min(axis=0)),
        np.zeros(len(points), np.uint8),
        REACH * spacing_of(points),
    )
    colors = cloud.point.colors.numpy() if "colors" in cloud.point else None
    return RefinementInputs(
        Cloud(points, normals),
        colors,
        seen,
        masks.channels.count,
        Label(voxel_size=default_voxel_size(points, masks)),
        up=scene_up(scene),
        levels=masks.table.levels(masks.channels),
    )


@dataclass(frozen=True)
class Refinement:
    """before, after: mIoU of fused labels against the masks of the photos left out, without and with one more
    round; labels: of all photos.
    """

    before: float
    after: float
    inputs: RefinementInputs
    labels: Labels

    @property
    def helps(self) -> bool:
        return self.after > self.before

    def figures(self) -> dict[str, object]:
        """What the summary and the sidecar say."""
        return {
            "agreement_before": f"{self.before:.2%}",
            "agreement_after": f"{self.after:.2%}",
            "kept": self.helps,
        }

    def confidence(self, view: View, read: ReadMask) -> np.ndarray:
        """(H, W) uint8 new confidence of a mask."""
        mask, confidence = read(view)
        seen = self.inputs.render(self.labels, view, mask.shape[::-1])
        return downweight_conflicts(mask, confidence, *seen)


def refine_scene(scene: Scene, settings: Segment) -> Refinement:
    """Lower the confidence of doubted masks, if that helps: writes `confidence_refined`, or removes it."""
    if settings.backend != "files" or settings.masks is not None:
        raise InputError(
            "--refine works on the masks that are in the scene: make them first, then run `sc3d segment SCENE --refine`"
        )
    masks = Masks.load(scene, scene.confidence)
    scene.warn_of_unplaced(scene.masks, scene.confidence)
    refinement = refine(load_refinement_inputs(scene, masks), masks.views, masks.read)
    if refinement.helps:
        with atomic_path(scene.confidence_refined) as folder:
            folder.mkdir()
            for view in progress(masks.views, "writing confidence", "photo"):
                file = scene.photo_names.path(folder, view.name)
                write_image(
                    file, refinement.confidence(view, masks.read), read_orientation(scene.photo(view.name))
                )
    else:
        discard(scene.confidence_refined)
    return refinement


def refine(inputs: RefinementInputs, views: list[View], read: ReadMask) -> Refinement:
    """Fuse, lower the confidence of what contradicts, fuse again: once without every 4th photo, to see
    whether it helps there, and once with all.
    """
    ordered = sorted(views, key=lambda view: view.name)
    asked = ordered[EVERY // 2 :: EVERY]
    kept = [view for view in ordered if view not in asked]
    first = inputs.labels(kept, read)
    second = inputs.labels(kept, lambda view: _doubted(inputs, first, view, read))
    before, after = (_agreement(inputs, labels, asked, read) for labels in (first, second))
    logger.info(
        "photos left out: mIoU of their masks with the fused labels %.2f %%, with doubted masks %.2f %%",
        100 * before,
        100 * after,
    )
    return Refinement(before, after, inputs, inputs.labels(ordered, read) if after > before else first)


def downweight_conflicts(
    mask: np.ndarray, confidence: np.ndarray | None, fused: np.ndarray, sure: np.ndarray
) -> np.ndarray:
    """(H, W) uint8 confidence c (1 - p) where the fused label is another than the mask's, c elsewhere.

    mask, fused: (H, W) uint8 ids, 0 = no label; confidence c: (H, W) uint8, None = full; sure: (H, W)
        probability p of the fused label, 0 to 1
    """
    given = np.full(mask.shape, FULL, np.uint8) if confidence is None else confidence
    contradicted = (mask > 0) & (fused > 0) & (mask != fused)
    return np.where(contradicted, np.rint(given * (1 - np.clip(sure, 0, 1))), given).astype(np.uint8)


def _doubted(inputs: RefinementInputs, labels: Labels, view: View, read: ReadMask) -> Mask:
    mask, confidence = read(view)
    return mask, downweight_conflicts(mask, confidence, *inputs.render(labels, view, mask.shape[::-1]))


def _agreement(inputs: RefinementInputs, labels: Labels, views: list[View], read: ReadMask) -> float:
    parts = []
    for view in progress(views, "photos left out", "photo"):
        mask = read(view)[0]
        parts.append(
            Confusion.from_labels(mask, inputs.render(labels, view, mask.shape[::-1])[0], inputs.num_channels)
        )
    return total(parts, inputs.num_channels).mean_iou
