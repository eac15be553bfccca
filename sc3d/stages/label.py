"""Masks + cloud + cameras -> seeds and conflicts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from sc3d.geometry.cameras import local_origin
from sc3d.io.atomic import atomic_path
from sc3d.io.chunked_clouds import CloudFile
from sc3d.io.clouds import write_geometry
from sc3d.labelling.fusion import Cloud, fuse
from sc3d.labelling.inputs import Masks, best_confidence, default_voxel_size, point_density, read_given_cloud
from sc3d.scene.labelled_cloud import point_arrays, read_surface, with_labels
from sc3d.scene.labels import STATE_NAMES
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Label
from sc3d.tiling.executor import open_executor
from sc3d.tiling.label import BYTES, label_tiles
from sc3d.tiling.memory import TRIANGLE, fits, mesh_triangles, num_points


def inputs(scene: Scene, settings: Label) -> list[Path]:
    return [
        scene.sparse,
        scene.classes,
        scene.masks,
        best_confidence(scene),
        scene.mesh,
        settings.cloud or scene.cloud,
        *([scene.gaussians] if settings.density else []),
    ]


def outputs(scene: Scene, settings: Label) -> list[Path]:
    return [settings.output or scene.seeds, scene.votes_of(settings.output)]


def run(scene: Scene, settings: Label) -> dict[str, object]:
    source = settings.cloud or scene.cloud
    if not _fits(scene, source, settings):
        with open_executor(settings) as tasks:
            counts, settings, num_views = label_tiles(scene, settings, CloudFile.open(source), tasks)
        return _summary(counts, settings.voxel_size, num_views)
    masks, cloud = (
        Masks.load(scene, best_confidence(scene) if settings.use_confidence else None),
        read_given_cloud(scene, settings.cloud),
    )
    views = masks.views
    points, normals = point_arrays(cloud, np.array([view.center for view in views]))
    if not settings.voxel_size:
        settings = replace(settings, voxel_size=default_voxel_size(points, masks))
    surface = (
        read_surface(scene.mesh, points, normals, local_origin(views), settings.surface)
        if settings.depth_filter
        else None
    )
    density = point_density(scene, points, settings.voxel_size) if settings.density else None
    fusion = fuse(
        Cloud(points, normals, density), views, masks.read, surface, scene.class_table().num_ids, settings
    )
    with atomic_path(scene.votes_of(settings.output)) as temporary:
        fusion.field.save(temporary)
    write_geometry(settings.output or scene.seeds, with_labels(cloud, normals, fusion.labels, fusion.votes))
    return _summary(
        np.bincount(fusion.labels.state, minlength=len(STATE_NAMES)), settings.voxel_size, len(views)
    )


def _fits(scene: Scene, source: Path, settings: Label) -> bool:
    """Whether cloud and mesh fit into memory as a whole, and nobody asked for workers. LAS and LAZ are read
    in parts in any case.
    """
    count, triangles = num_points(source), mesh_triangles(scene.mesh)
    if count is None or not source.exists():
        return True  # cannot be read in parts
    return source.suffix.lower() == ".ply" and fits(count * BYTES + triangles * TRIANGLE, settings)


def _summary(counts: np.ndarray, voxel_size: float, num_views: int) -> dict[str, object]:
    """counts: points in each state."""
    shares = counts[: len(STATE_NAMES)] / counts.sum()
    states = {
        name: f"{share:.1%}" for name, share in zip(STATE_NAMES, shares, strict=True) if name != "propagated"
    }
    return {"points": int(counts.sum()), "views": num_views, "voxel_size": round(voxel_size, 5)} | states
