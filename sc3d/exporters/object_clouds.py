"""One PLY per object, with all attributes of its points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d

from sc3d.errors import InputError
from sc3d.exporters.clouds import file_name, in_crs
from sc3d.exporters.objects import most_common
from sc3d.exporters.projected_cloud import BYTES, chosen_classes, read_projected_cloud, require_whole
from sc3d.io.atomic import atomic_path
from sc3d.io.clouds import write_geometry
from sc3d.scene.labelled_cloud import instances_of
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / "object_clouds"]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/object_clouds/<instance>_<class>.ply` for each object of the chosen classes; float64
    positions in the CRS, points in their order.
    """
    require_whole(scene, settings, BYTES)
    projected, path = read_projected_cloud(scene, settings), settings.labelled or scene.labelled
    instance = instances_of(projected.cloud, path)
    if instance is None:
        raise InputError(f"{path} does not tell objects apart: run `sc3d propagate {scene.path} --overwrite`")
    table, labels = scene.class_table(), projected.labels.label
    kept = np.where(np.isin(labels, sorted(chosen_classes(scene, settings))), instance, 0)
    numbers = [int(number) for number in np.unique(kept[kept > 0])]
    if not numbers:
        raise InputError(f"{path} has no object of the chosen classes: nothing to write")
    cloud, _ = in_crs(projected)
    with atomic_path(outputs(scene, settings)[0]) as folder:
        folder.mkdir()
        for number in numbers:
            own = kept == number
            name = f"{number}_{file_name(table.name(most_common(labels[own])))}.ply"
            write_geometry(folder / name, cloud.select_by_mask(o3d.core.Tensor(own)))
    figures = {"objects": len(numbers), "points": int((kept > 0).sum())}
    return {**projected.projection.figures(), **figures}
