"""The labelled cloud as one PLY per class, or per object, with all its attributes."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import open3d as o3d

from sc3d.errors import InputError
from sc3d.exporters.projected_cloud import ProjectedCloud, chosen_classes, read_projected_cloud
from sc3d.io.atomic import atomic_path
from sc3d.io.clouds import write_geometry
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / "clouds"]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/clouds/<id>_<name>.ply` for each class that has points, unlabelled ones too; float64 positions
    in the CRS, points in their order.
    """
    projected = read_projected_cloud(scene, settings)
    table = scene.class_table()
    present = [
        label for label in sorted(chosen_classes(scene, settings)) if (projected.labels.label == label).any()
    ]
    if not present:
        raise InputError(f"no point has one of the classes {', '.join(settings.classes)}: nothing to write")
    parts = [
        (f"{label}_{file_name(table.name(label))}.ply", projected.labels.label == label) for label in present
    ]
    counts = write_parts(outputs(scene, settings)[0], projected, parts)
    names = [table.name(label) for label in present]
    return {**projected.projection.figures(), "points_by_class": dict(zip(names, counts, strict=True))}


def write_parts(path: Path, projected: ProjectedCloud, parts: Iterable[tuple[str, np.ndarray]]) -> list[int]:
    """A folder of clouds, by file name and the points (N,) bool of each; positions float64 in the CRS.
    Returns how many points each has.
    """
    cloud, counts = projected.cloud.clone(), []
    if "normals" in cloud.point:
        normals = projected.projection.directions_to_crs(
            cloud.point.positions.numpy().astype(np.float64), cloud.point.normals.numpy()
        )
        cloud.point.normals = o3d.core.Tensor(np.ascontiguousarray(normals))
    cloud.point.positions = o3d.core.Tensor(np.ascontiguousarray(projected.points))
    with atomic_path(path) as folder:
        folder.mkdir()
        for name, chosen in parts:
            part = cloud.select_by_mask(o3d.core.Tensor(chosen))
            write_geometry(folder / name, part)
            counts.append(len(part.point.positions))
    return counts


def file_name(name: str) -> str:
    """A class name that every file system takes."""
    return re.sub(r"[^\w-]+", "_", name).strip("_") or "class"
