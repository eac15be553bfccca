"""Masks + cloud + cameras -> seeds and conflicts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from sc3d.fusion import STATE_NAMES, Cloud, Labels, fuse
from sc3d.geometry.cameras import local_origin
from sc3d.io import atomic_path, write_geometry
from sc3d.labelled import point_arrays, read_surface, with_labels
from sc3d.labelling import Masks, best_confidence, default_voxel_size, point_density, read_given_cloud
from sc3d.scene import Scene
from sc3d.settings import Label


def inputs(scene: Scene, settings: Label) -> list[Path]:
    return [scene.sparse, scene.classes, scene.masks, best_confidence(scene), scene.mesh, settings.cloud or scene.cloud, *([scene.gaussians] if settings.density else [])]


def outputs(scene: Scene, settings: Label) -> list[Path]:
    return [settings.output or scene.seeds, _votes_file(scene, settings)]


def run(scene: Scene, settings: Label) -> dict[str, object]:
    masks, cloud = Masks.of(scene, best_confidence(scene) if settings.use_confidence else None), read_given_cloud(scene, settings.cloud)
    views = masks.views
    points, normals = point_arrays(cloud, np.array([view.centre for view in views]))
    if not settings.voxel_size:
        settings = replace(settings, voxel_size=default_voxel_size(points, masks))
    surface = read_surface(scene.mesh, points, normals, local_origin(views)) if settings.depth_filter else None
    density = point_density(scene, points, settings.voxel_size) if settings.density else None
    fusion = fuse(Cloud(points, normals, density), views, masks.read, surface, scene.class_table().num_ids, settings)
    with atomic_path(_votes_file(scene, settings)) as temporary:
        fusion.field.save(temporary)
    write_geometry(settings.output or scene.seeds, with_labels(cloud, normals, fusion.labels, fusion.votes))
    return _summary(fusion.labels, settings.voxel_size, len(views))


def _votes_file(scene: Scene, settings: Label) -> Path:
    """votes.npz, or a name of its own beside --output."""
    return scene.votes if settings.output is None else settings.output.with_suffix(".votes.npz")


def _summary(labels: Labels, voxel_size: float, num_views: int) -> dict[str, object]:
    shares = np.bincount(labels.state, minlength=len(STATE_NAMES)) / len(labels.state)
    states = {name: f"{share:.1%}" for name, share in zip(STATE_NAMES, shares, strict=True) if name != "propagated"}
    return {"points": len(labels.label), "views": num_views, "voxel_size": round(voxel_size, 5)} | states
