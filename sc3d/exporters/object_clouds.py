"""One PLY per object, with all attributes of its points."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
import open3d as o3d

from sc3d.errors import InputError
from sc3d.exporters.clouds import file_name, in_crs
from sc3d.exporters.projected_cloud import (
    MapProjection,
    ProjectedCloud,
    chosen_classes,
    fits_whole,
    projected_chunks,
)
from sc3d.io.atomic import atomic_path
from sc3d.io.chunked_clouds import rows_at_once
from sc3d.io.clouds import write_geometry
from sc3d.io.ply import write_records
from sc3d.scene.cloud_parts import records_of
from sc3d.scene.labelled_cloud import instances_of
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / "object_clouds"]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/object_clouds/<instance>_<class>.ply` for each object of the chosen classes; float64
    positions in the CRS, points in their order.
    """
    path, classes = settings.labelled or scene.labelled, sorted(chosen_classes(scene, settings))
    table, counts, whole, projection = scene.class_table(), dict[int, np.ndarray](), None, MapProjection()
    for projected in projected_chunks(scene, settings):
        _count(projected.labels.label, _kept(projected, scene, settings, classes), counts)
        projection = projected.projection
        whole = projected if fits_whole(path, settings) else None
    if not counts:
        raise InputError(f"{path} has no object of the chosen classes: nothing to write")
    names = {number: file_name(table.name(int(found.argmax()))) for number, found in sorted(counts.items())}
    with atomic_path(outputs(scene, settings)[0]) as folder:
        folder.mkdir()
        files = {number: folder / f"{number}_{name}.ply" for number, name in names.items()}
        if whole is not None:
            cloud, kept = in_crs(whole)[0], _kept(whole, scene, settings, classes)
            for number, file in files.items():
                write_geometry(file, cloud.select_by_mask(o3d.core.Tensor(kept == number)))
        else:
            _write_parts(
                scene, settings, files, {number: int(found.sum()) for number, found in counts.items()}
            )
    figures = {"objects": len(files), "points": int(sum(found.sum() for found in counts.values()))}
    return {**projection.figures(), **figures}


def _kept(projected: ProjectedCloud, scene: Scene, settings: Export, classes: list[int]) -> np.ndarray:
    """(N,) object of each point of the chosen classes, 0 = none."""
    path = settings.labelled or scene.labelled
    instance = instances_of(projected.cloud, path)
    if instance is None:
        raise InputError(f"{path} does not tell objects apart: run `sc3d propagate {scene.path} --overwrite`")
    return np.where(np.isin(projected.labels.label, classes), instance, 0)


def _count(labels: np.ndarray, kept: np.ndarray, counts: dict[int, np.ndarray]) -> None:
    """Add the points of each class (256,) to those of each object."""
    pairs, found = np.unique(kept[kept > 0].astype(np.int64) * 256 + labels[kept > 0], return_counts=True)
    for pair, number in zip(pairs.tolist(), found.tolist(), strict=True):
        counts.setdefault(pair // 256, np.zeros(256, np.int64))[pair % 256] += number


def _write_parts(scene: Scene, settings: Export, files: dict[int, Path], counts: dict[int, int]) -> None:
    """The same, part by part: all records go to one file, object by object, and from there to their own.
    counts: points of each object
    """
    numbers, sizes = np.array(list(files)), np.array([counts[number] for number in files])
    ends = np.cumsum(sizes)
    with tempfile.TemporaryFile(dir=next(iter(files.values())).parent) as sorted_file:
        dtype = _sort(scene, settings, sorted_file, numbers, ends - sizes)
        for file, end, size in zip(files.values(), ends.tolist(), sizes.tolist(), strict=True):
            write_records(file, _read(sorted_file, dtype, end - size, end), dtype, size)


def _sort(
    scene: Scene, settings: Export, file: BinaryIO, numbers: np.ndarray, places: np.ndarray
) -> np.dtype:
    """Write the records of objects `numbers` (K,), rising, one object after the other, each in the order of
    the cloud; places: (K,) its first record.
    """
    classes, places, dtype = sorted(chosen_classes(scene, settings)), places.copy(), np.dtype([])
    for projected in projected_chunks(scene, settings):
        kept, records = _kept(projected, scene, settings, classes), records_of(in_crs(projected)[0])
        rows, dtype = np.flatnonzero(kept), records.dtype
        rows = rows[np.argsort(kept[rows], kind="stable")]
        found, starts, sizes = np.unique(kept[rows], return_index=True, return_counts=True)
        owners = np.searchsorted(numbers, found)
        for owner, start, size in zip(owners.tolist(), starts.tolist(), sizes.tolist(), strict=True):
            file.seek(int(places[owner]) * dtype.itemsize)
            file.write(records[rows[start : start + size]].data)
            places[owner] += size
    return dtype


def _read(file: BinaryIO, dtype: np.dtype, start: int, end: int) -> Iterator[np.ndarray]:
    """The records from `start` to `end`, so many at a time."""
    at_once = rows_at_once(dtype)
    for first in range(start, end, at_once):
        file.seek(first * dtype.itemsize)
        yield np.frombuffer(file.read(min(at_once, end - first) * dtype.itemsize), dtype)
