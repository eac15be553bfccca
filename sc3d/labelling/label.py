"""`label` in memory: what a scene gives is read, fused and written. By tiles, with the same signature: `tiling.label`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sc3d.geometry.cameras import local_origin
from sc3d.io.atomic import atomic_path
from sc3d.io.clouds import write_geometry
from sc3d.labelling.cloud import Cloud
from sc3d.labelling.fusion import fuse
from sc3d.labelling.inputs import Masks, best_confidence, default_voxel_size, point_density, read_given_cloud
from sc3d.scene.labelled_cloud import Votes, point_arrays, read_surface, with_labels
from sc3d.scene.labels import STATE_NAMES
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Label


@dataclass(frozen=True)
class LabelSummary:
    """Of a labelled cloud. counts: (states,) int64 points in each state; voxel_size: of the label field, world units"""

    counts: np.ndarray
    voxel_size: float
    num_views: int

    def figures(self) -> dict[str, object]:
        """What the stage reports."""
        shares = self.counts / self.counts.sum()
        states = {
            name: f"{share:.1%}"
            for name, share in zip(STATE_NAMES, shares, strict=True)
            if name != "propagated"
        }
        size = round(self.voxel_size, 5)
        return {"points": int(self.counts.sum()), "views": self.num_views, "voxel_size": size, **states}


def label_scene(scene: Scene, settings: Label) -> LabelSummary:
    """Fuse the masks of a scene on its cloud (or `settings.cloud`) and write seeds and votes."""
    settings = settings.resolved
    masks = Masks.load(scene, best_confidence(scene) if settings.use_confidence else None)
    given = read_given_cloud(scene, settings.cloud)
    points, normals = point_arrays(given, np.array([view.center for view in masks.views]))
    masks.tell_of_left_out(points.min(axis=0), points.max(axis=0))
    if not settings.voxel_size:
        settings = replace(settings, voxel_size=default_voxel_size(points, masks))
    surface, density = None, None
    if settings.depth_filter:
        surface = read_surface(scene.mesh, points, normals, local_origin(masks.views), settings.surface)
    if settings.mechanisms.density:
        density = point_density(scene, points, settings.voxel_size)
    channels = masks.channels
    fusion = fuse(Cloud(points, normals, density), masks.views, masks.read, surface, channels.count, settings)
    with atomic_path(scene.votes_of(settings.output)) as temporary:
        fusion.grid.save(temporary, channels.ids)
    labels = replace(fusion.labels, label=channels.to_ids(fusion.labels.label))
    seeds = with_labels(given, normals, labels, Votes(fusion.votes, channels))
    write_geometry(settings.output or scene.seeds, seeds)
    counts = np.bincount(labels.state, minlength=len(STATE_NAMES))
    return LabelSummary(counts, settings.voxel_size, len(masks.views))
