"""`label` in memory: what a scene gives is read, fused and written. By tiles, with the same signature:
`tiling.label`.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import open3d as o3d

from sc3d.geometry.cameras import View, local_origin
from sc3d.io.atomic import atomic_path
from sc3d.io.clouds import write_geometry
from sc3d.labelling.cloud import Cloud
from sc3d.labelling.fusion import fuse
from sc3d.labelling.inputs import (
    Masks,
    best_confidence,
    default_voxel_size,
    given_cloud_path,
    point_density,
    read_given_cloud,
    require_in_view,
)
from sc3d.labelling.normal_sides import judge_sides, sample_step, with_sides
from sc3d.labelling.prior_cloud import read_prior
from sc3d.scene.frame_check import Box, box_of, describe
from sc3d.scene.labelled_cloud import Votes, point_arrays, read_surface, usable_normals, with_labels
from sc3d.scene.labels import STATE_NAMES, UNSEEN
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Label

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class LabelSummary:
    """Of a labelled cloud. counts: (states,) int64 points in each state; voxel_size: of the label field,
    world units; num_turned: given normals that were turned around; num_none: points whose masks name none of
    the classes
    """

    counts: np.ndarray
    voxel_size: float
    num_views: int
    num_turned: int = 0
    num_none: int = 0

    def figures(self) -> dict[str, object]:
        """What the stage reports."""
        shares = self.counts / self.counts.sum()
        states = {
            name: f"{share:.1%}"
            for name, share in zip(STATE_NAMES, shares, strict=True)
            if name not in ("propagated", "corrected")
        }
        size = round(self.voxel_size, 5)
        turned = {"normals_turned": self.num_turned} if self.num_turned else {}
        points = int(self.counts.sum())
        none = {"of_no_class": f"{self.num_none / points:.1%}"} if self.num_none else {}
        return {"points": points, "views": self.num_views, "voxel_size": size, **turned, **states, **none}


def summarize(
    counts: np.ndarray,
    num_none: int,
    voxel_size: float,
    views: list[View],
    path: Path,
    box: Box,
    num_turned: int,
) -> LabelSummary:
    """The summary of a cloud; a warning with numbers if no point of it was seen with a class.

    num_none: points of none of the classes; box: around the cloud, world; num_turned: normals that were turned
    """
    if counts[np.arange(len(counts)) != UNSEEN].sum() == num_none:
        logger.warning(
            "no photo sees any of the %d points of %s with a label: the points are at %s, the %d cameras with masks at %s%s",
            counts.sum(),
            path,
            describe(box),
            len(views),
            describe(box_of(np.array([view.center for view in views]))),
            f"; at {num_none} that are seen, masks name none of the classes" if num_none else "",
        )
    return LabelSummary(counts, voxel_size, len(views), num_turned, num_none)


def label_scene(scene: Scene, settings: Label, prior_name: Path | None = None) -> LabelSummary:
    """Fuse the masks of a scene on its cloud (or `settings.cloud`) and write seeds and votes. prior_name: how
    the user calls `settings.prior`, which is in the world of the scene
    """
    settings = settings.resolved
    masks = Masks.load(
        scene,
        best_confidence(scene) if settings.use_confidence else None,
        settings.unlabelled,
        needed=settings.prior is None,
    )
    views = masks.views or scene.model.views  # without masks, all of them say where the outside is
    given = read_given_cloud(scene, settings.cloud)
    path, positions = given_cloud_path(scene, settings.cloud), given.point.positions.numpy()
    box = positions.min(axis=0), positions.max(axis=0)
    require_in_view(path, box, masks, scene.model.points)
    points, normals = point_arrays(given, np.array([view.center for view in views]))
    normals, num_turned = _on_the_right_side(given, points, normals, views, path)
    masks.tell_of_left_out(*box)
    if not settings.voxel_size:
        settings = replace(settings, voxel_size=default_voxel_size(points, masks))
    surface, density = None, None
    if settings.depth_filter:
        surface = read_surface(scene.surface, points, normals, local_origin(views), settings.surface)
    if settings.mechanisms.density:
        density = point_density(scene, points, settings.voxel_size)
    channels = masks.channels
    cloud = Cloud(points, normals, density)
    prior = None
    if settings.prior is not None:
        size, weight = settings.voxel_size, settings.prior_weight
        prior = read_prior(
            settings.prior, prior_name or settings.prior, masks.table, channels, points, size, weight
        )
    fusion = fuse(cloud, masks.views, masks.read, surface, channels.count, settings, channels.none, prior)
    with atomic_path(scene.votes_of(settings.output)) as temporary:
        fusion.grid.save(temporary, channels.ids)
    labels = replace(fusion.labels, label=channels.to_ids(fusion.labels.label))
    seeds = with_labels(given, normals, labels, Votes(fusion.votes, channels))
    write_geometry(settings.output or scene.seeds, seeds)
    counts = np.bincount(labels.state, minlength=len(STATE_NAMES))
    num_none = int(labels.of_no_class.sum())
    return summarize(counts, num_none, settings.voxel_size, masks.views, path, box, num_turned)


def _on_the_right_side(
    given: o3d.t.geometry.PointCloud, points: np.ndarray, normals: np.ndarray, views: list[View], path: Path
) -> tuple[np.ndarray, int]:
    """Normals (N, 3) of a cloud, turned if they are its own and of the wrong side; how many were."""
    if "normals" not in given.point or not usable_normals(given.point.normals.numpy()).all():
        return normals, 0
    step = sample_step(len(points))
    turned = with_sides(points, normals, views, judge_sides(points[::step], normals[::step], views, path))
    return turned, int((turned != normals).any(axis=1).sum())
