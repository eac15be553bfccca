"""What a scene gives to be labelled: its masks and its cloud, checked, and the rules for what depends on
both.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import open3d as o3d

from sc3d.errors import InputError, examples, left_out
from sc3d.geometry.cameras import View, may_see
from sc3d.io.clouds import read_cloud
from sc3d.io.readable_photos import tell_of_transparent
from sc3d.labelling.density import GaussianField, gaussian_density, kernel_density
from sc3d.labelling.observation import Mask
from sc3d.scene.channels import Channels
from sc3d.scene.class_table import MAKE_CLASSES, ClassTable
from sc3d.scene.frame_check import Box, box_of, check_frame, describe
from sc3d.scene.labelled_cloud import spacing_of
from sc3d.scene.scene import Scene
from sc3d.scene.splats import read_scene_splats

FOOTPRINT_SAMPLE = 1000

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Masks:
    """The masks of a scene: files by view name, confidence maps where there are any, the views that have a mask,
    and the classes; without: names of the photos that have a camera and no mask; none: unlabelled pixels are
    evidence of none of the classes.
    """

    files: dict[str, Path]
    confidences: dict[str, Path]
    views: list[View]
    scene: Scene
    table: ClassTable
    without: tuple[str, ...] = ()
    none: bool = False

    @property
    def channels(self) -> Channels:
        """Of the classes that points can be of, and of none of them where unlabelled pixels are evidence."""
        return replace(self.table.channels, none=self.none)

    @classmethod
    def load(
        cls,
        scene: Scene,
        confidence: Path | None,
        unlabelled: Literal["evidence", "ignore"] = "ignore",
        *,
        needed: bool = True,
    ) -> Masks:
        """Masks of a scene, and confidence maps in a folder if it exists, all checked; InputError for what
        does not fit. unlabelled: as `Label.unlabelled`; needed: without a folder of masks, nothing votes
        """
        scene.require(scene.classes, hint=MAKE_CLASSES)
        if not needed and not scene.masks.exists():
            names = tuple(view.name for view in scene.model.views)
            return cls({}, {}, [], scene, scene.class_table(), names)
        scene.require(scene.masks, hint="run `sc3d segment SCENE` first, with --masks if you have some")
        table = scene.class_table()
        files = scene.mask_files(scene.masks, table)
        confidences = scene.mask_files(confidence) if confidence is not None and confidence.is_dir() else {}
        for name, path in confidences.items():
            if name in files and scene.mask_size(path, name) != scene.mask_size(files[name], name):
                raise InputError(f"{path} has another size than its mask: both must be the same")
        views = scene.model.views
        masked = [view for view in views if view.name in files]
        without = tuple(view.name for view in views if view.name not in files)
        evidence = unlabelled == "evidence" and table.rest is None
        return cls(files, confidences, masked, scene, table, without, evidence)

    def tell_of_left_out(self, low: np.ndarray, high: np.ndarray) -> None:
        """One line for each reason why photos do not vote, or not as others do. low, high: (3,) box of the
        cloud, world.
        """
        count = len(self.views) + len(self.without)
        away = [view.name for view in self.views if not may_see(view, low, high)]
        sure = [view.name for view in self.views if view.name not in self.confidences]
        tell_of_transparent({view.name: self.scene.photo(view.name) for view in self.views}, "do not vote")
        if self.table.without_surface:
            names = examples([entry.name for entry in self.table.without_surface])
            logger.info("mask pixels of classes without surface do not vote: %s", names)
        if self.without:
            logger.info(left_out(self.without, count, "photos have no mask and do not vote"))
        if away:
            logger.warning(left_out(away, count, "photos do not see the cloud and do not vote"))
        if self.confidences and sure:
            logger.warning(left_out(sure, count, "photos have no confidence map; their masks count as sure"))

    def read(self, view: View) -> Mask:
        """As `fuse` wants it: channels, not ids. A pixel without a class, or of one that has no surface, says
        nothing, or that there is none of the classes where it was looked at: where its confidence is not 0.
        """
        confidence = self.confidences.get(view.name)
        sure = None if confidence is None else self.scene.read_confidence(confidence, view.name)
        file = self.files[view.name]
        labels = self.scene.read_mask(file, view.name)
        if self.table.without_surface:
            labels = np.where(self.table.shows_no_surface(labels), np.uint8(0), labels)
        if self.none or self.table.rest is not None:
            looked = self.scene.opaque_pixels_of(labels.shape, view.name) if sure is None else sure > 0
            if self.table.rest is not None:
                labels = np.where(looked & (labels == 0), np.uint8(self.table.rest.id), labels)
            return self.channels.with_none(self.channels.from_ids(labels, file), looked), sure
        return self.channels.from_ids(labels, file), sure

    def size(self, view: View) -> tuple[int, int]:
        """(width, height) px of the mask of a view."""
        return self.scene.mask_size(self.files[view.name], view.name)


def best_confidence(scene: Scene) -> Path:
    """The confidence maps that `segment --refine` made, or else those that came with the masks."""
    return scene.confidence_refined if scene.confidence_refined.is_dir() else scene.confidence


def given_cloud_path(scene: Scene, file: Path | None) -> Path:
    """`file`, or the cloud of the scene, or its mesh, whose vertices do as well."""
    source = file or scene.cloud
    if file is None and not source.exists():
        source = scene.mesh
    if not source.exists():
        raise InputError(
            f"{scene.path} has neither cloud.ply nor mesh.ply: run `sc3d extract SCENE`, or pass --cloud FILE"
        )
    return source


def read_given_cloud(scene: Scene, file: Path | None) -> o3d.t.geometry.PointCloud:
    """The cloud of `given_cloud_path`."""
    return read_cloud(given_cloud_path(scene, file))


def require_in_view(path: Path, box: Box, masks: Masks, sparse_points: np.ndarray) -> None:
    """InputError if there are masks, but no photo with one looks at the box around a cloud; a warning if the cloud
    lies elsewhere than the scene.

    box: world; sparse_points: (P, 3) world
    """
    if not masks.files or any(may_see(view, *box) for view in masks.views):
        check_frame(path, np.array(box), masks.views, sparse_points)
        return
    cameras = box_of(np.array([view.center for view in masks.views]))
    raise InputError(
        f"no photo with a mask looks at {path}: its points are at {describe(box)}, the cameras at {describe(cameras)}."
        " Is it in another frame? `sc3d import FILE SCENE --epsg` says which CRS it is in"
    )


def default_voxel_size(points: np.ndarray, masks: Masks) -> float:
    """`voxel_size_for` a whole cloud (N, 3)."""
    return voxel_size_for(spacing_of(points), points[:: max(1, len(points) // FOOTPRINT_SAMPLE)], masks)


def voxel_size_for(spacing: float, sample: np.ndarray, masks: Masks) -> float:
    """2 point spacings, at least 1.5 times the median size of a mask pixel, if there are any, on the cloud, of which `sample`
    (S, 3) are some points.
    """
    footprints = []
    for view in masks.views:
        focal = view.focal * masks.size(view)[0] / view.width
        footprints.append(np.median(np.linalg.norm(sample - view.center, axis=1)) / focal)
    return max(2 * spacing, 1.5 * float(np.median(footprints)) if footprints else 0.0)


def point_density(
    scene: Scene, points: np.ndarray, voxel_size: float, origin: np.ndarray | None = None
) -> np.ndarray:
    """(N,) density of the Gaussians at the points, or of the points themselves where there are none; origin:
    (3,) of the label voxels, None = the points' own.
    """
    if not scene.gaussians.exists():
        return kernel_density(points, voxel_size, origin)
    return gaussian_density(points, GaussianField.from_arrays(*read_scene_splats(scene)), voxel_size)
