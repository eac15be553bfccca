"""The labelled cloud as one PLY per class, or per object, with all its attributes."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import open3d as o3d

from sc3d.errors import InputError
from sc3d.exporters.projected_cloud import (
    MapProjection,
    ProjectedCloud,
    chosen_classes,
    fits_whole,
    projected_chunks,
)
from sc3d.io.atomic import atomic_path
from sc3d.io.clouds import write_geometry
from sc3d.io.ply import record_writer
from sc3d.scene.cloud_parts import records_of
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / "clouds"]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/clouds/<id>_<name>.ply` for each class that has points, unlabelled ones too; float64 positions
    in the CRS, points in their order.
    """
    wanted, table = sorted(chosen_classes(scene, settings)), scene.class_table()
    counts, projection, whole = np.zeros(256, np.int64), MapProjection(), None
    for projected in projected_chunks(scene, settings):
        counts += np.bincount(projected.labels.label, minlength=256)
        projection = projected.projection
        if fits_whole(settings.labelled or scene.labelled, settings):
            whole = projected
    present = [label for label in wanted if counts[label]]
    if not present:
        raise InputError(f"no point has one of the classes {', '.join(settings.classes)}: nothing to write")
    with atomic_path(outputs(scene, settings)[0]) as folder:
        folder.mkdir()
        files = {label: folder / f"{label}_{file_name(table.name(label))}.ply" for label in present}
        if whole is not None:
            cloud, labels = in_crs(whole)
            for label, file in files.items():
                write_geometry(file, cloud.select_by_mask(o3d.core.Tensor(labels == label)))
        else:
            _write_parts(scene, settings, files, counts)
    by_class = {table.name(label): int(counts[label]) for label in present}
    return {**projection.figures(), "points_by_class": by_class}


def in_crs(projected: ProjectedCloud) -> tuple[o3d.t.geometry.PointCloud, np.ndarray]:
    """A cloud with positions and normals in the CRS, and its labels (N,) uint8."""
    cloud = projected.cloud.clone()
    if "normals" in cloud.point:
        normals = projected.projection.directions_to_crs(
            cloud.point.positions.numpy().astype(np.float64), cloud.point.normals.numpy()
        )
        cloud.point.normals = o3d.core.Tensor(np.ascontiguousarray(normals))
    cloud.point.positions = o3d.core.Tensor(np.ascontiguousarray(projected.points))
    return cloud, projected.labels.label


def _write_parts(scene: Scene, settings: Export, files: dict[int, Path], counts: np.ndarray) -> None:
    """The same, part by part. counts: (256,) points of each class"""
    with ExitStack() as stack:
        append: dict[int, Callable[[np.ndarray], None]] = {}
        for projected in projected_chunks(scene, settings):
            cloud, labels = in_crs(projected)
            records = records_of(cloud)
            for label, file in files.items():
                if label not in append:
                    writer = record_writer(file, records.dtype, int(counts[label]))
                    append[label] = stack.enter_context(writer)
                append[label](records[labels == label])


def file_name(name: str) -> str:
    """A class name that every file system takes."""
    return re.sub(r"[^\w-]+", "_", name).strip("_") or "class"
