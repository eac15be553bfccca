"""Masks + cloud + cameras -> seeds and conflicts."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from sc3d.density import GaussianField, gaussian_density, kernel_density
from sc3d.errors import InputError
from sc3d.fusion import STATE_NAMES, Cloud, Labels, Mask, fuse
from sc3d.geometry.cameras import View, local_origin
from sc3d.io import atomic_path, image_size, read_cloud, read_index_image, write_geometry
from sc3d.labelled import point_arrays, read_surface, spacing_of, with_labels
from sc3d.scene import Scene
from sc3d.settings import Label

logger = logging.getLogger(__name__)


def inputs(scene: Scene, settings: Label) -> list[Path]:
    return [scene.sparse, scene.classes, scene.masks, scene.confidence, scene.mesh, settings.cloud or scene.cloud, *([scene.gaussians] if settings.density else [])]


def outputs(scene: Scene, settings: Label) -> list[Path]:
    return [settings.output or scene.seeds, _votes_file(scene, settings)]


def run(scene: Scene, settings: Label) -> dict[str, object]:
    cloud, masks, confidences, num_ids = _read(scene, settings)
    views = [view for view in scene.model.views if view.name in masks]

    def read_mask(view: View) -> Mask:
        mask, confidence = read_index_image(masks[view.name]), confidences.get(view.name)
        return mask, None if confidence is None else read_index_image(confidence)

    points, normals = point_arrays(cloud, np.array([view.centre for view in views]))
    if not settings.voxel_size:
        settings = replace(settings, voxel_size=default_voxel_size(points, views, masks))
    surface = read_surface(scene.mesh, points, normals, local_origin(views)) if settings.depth_filter else None
    density = point_density(scene, points, settings.voxel_size) if settings.density else None
    fusion = fuse(Cloud(points, normals, density), views, read_mask, surface, num_ids, settings)
    with atomic_path(_votes_file(scene, settings)) as temporary:
        fusion.field.save(temporary)
    write_geometry(settings.output or scene.seeds, with_labels(cloud, normals, fusion.labels, fusion.votes))
    return _summary(fusion.labels, settings.voxel_size, len(views))


def _votes_file(scene: Scene, settings: Label) -> Path:
    """votes.npz, or a name of its own beside --output."""
    return scene.votes if settings.output is None else settings.output.with_suffix(".votes.npz")


def _read(scene: Scene, settings: Label) -> tuple:
    """The cloud, the mask and confidence file per view name, and the number of ids; all checked before any work."""
    source = settings.cloud or scene.cloud
    scene.require(scene.classes, hint="pass --classes FILE to `sc3d run`, or copy data/classes.json of the sc3d repository there and edit it")
    scene.require(scene.masks, hint="run `sc3d segment SCENE --masks FOLDER` first")
    class_table = scene.class_table()
    masks = scene.mask_files(scene.masks, class_table)
    confidences = scene.mask_files(scene.confidence) if settings.use_confidence and scene.confidence.is_dir() else {}
    different = next((name for name, path in confidences.items() if name in masks and image_size(path) != image_size(masks[name])), None)
    if different:
        raise InputError(f"{confidences[different]} has another size than its mask: both must be the same")
    if settings.cloud is None and not source.exists():
        source = scene.mesh
    if not source.exists():
        raise InputError(f"{scene.path} has neither cloud.ply nor mesh.ply: run `sc3d extract SCENE`, or pass --cloud FILE")
    return read_cloud(source), masks, confidences, class_table.num_ids


def point_density(scene: Scene, points: np.ndarray, voxel_size: float) -> np.ndarray:
    """(N,) density of the Gaussians at the points, or of the points themselves where there are none."""
    if not scene.gaussians.exists():
        return kernel_density(points, voxel_size)
    from sc3d.splatting.pictures import load_gaussians  # loads torch

    gaussians, origin = load_gaussians(scene)
    rotations, scales, opacities = (values.numpy() for values in (gaussians.rotations, gaussians.scales, gaussians.opacities))
    return gaussian_density(points, GaussianField(gaussians.means.numpy().astype(np.float64) + origin, rotations, scales, opacities), voxel_size)


def default_voxel_size(points: np.ndarray, views: list[View], masks: dict[str, Path]) -> float:
    """2 point spacings, at least 1.5 times the median size of a mask pixel on the cloud."""
    sample = points[:: max(1, len(points) // 1000)]
    footprints = []
    for view in views:
        focal = view.focal * image_size(masks[view.name])[0] / view.width
        footprints.append(np.median(np.linalg.norm(sample - view.centre, axis=1)) / focal)
    return max(2 * spacing_of(points), 1.5 * float(np.median(footprints)))


def _summary(labels: Labels, voxel_size: float, num_views: int) -> dict[str, object]:
    shares = np.bincount(labels.state, minlength=len(STATE_NAMES)) / len(labels.state)
    states = {name: f"{share:.1%}" for name, share in zip(STATE_NAMES, shares, strict=True) if name != "propagated"}
    return {"points": len(labels.label), "views": num_views, "voxel_size": round(voxel_size, 5)} | states
