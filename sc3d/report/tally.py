"""What a report counts of the points of a cloud, in memory or part by part."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sc3d.geometry.raster import Raster, highest_points, spacing_of_all
from sc3d.io.chunked_clouds import CloudFile, positions
from sc3d.scene.labelled_cloud import spacing_of

if TYPE_CHECKING:
    import open3d as o3d

_CELL = 2.0  # side of the cells that areas are counted in, point spacings
BINS = 20  # of the distribution of the confidence
FINE = 10_000  # bins in which the median of a cloud in parts is found


@dataclass(frozen=True)
class CloudTally:
    """size: points; labels, states: (256,) points of each, None without; areas: (256,) float64 area of each class
    seen from above, squared world units; sums: (256,) float64 confidence of the points of each class, in sum;
    distribution: (BINS,) points by their confidence, and its median
    """

    size: int
    labels: np.ndarray | None = None
    states: np.ndarray | None = None
    areas: np.ndarray | None = None
    sums: np.ndarray | None = None
    distribution: np.ndarray | None = None
    median: float = np.nan


def tally(cloud: o3d.t.geometry.PointCloud) -> CloudTally:
    """Of a cloud in memory."""
    points = cloud.point.positions.numpy().astype(np.float64)
    label, state, confidence = (
        cloud.point[name].numpy().reshape(-1) if name in cloud.point else None
        for name in ("label", "state", "confidence")
    )
    return CloudTally(
        len(points),
        None if label is None else _counts(label),
        None if state is None else _counts(state),
        None if label is None else class_areas(points, label.astype(np.uint8)),
        None if label is None or confidence is None else _sums(label, confidence),
        None if confidence is None else distribution(confidence, BINS),
        np.nan if confidence is None else float(np.nanmedian(confidence)),
    )


def tally_by_parts(file: CloudFile, some: np.ndarray) -> CloudTally:
    """Of a cloud on disk. some: (K, 3) of its points, evenly from all, which tell the size of the cells; the
    median of the confidence is right to 1 / FINE
    """
    names = set(file.names)
    labels, states, sums = np.zeros(256, np.int64), np.zeros(256, np.int64), np.zeros(256)
    bins, fine = np.zeros(BINS, np.int64), np.zeros(FINE, np.int64)
    for _, records in file.chunks():
        if "label" in names:
            labels += _counts(records["label"])
        if "state" in names:
            states += _counts(records["state"])
        if "confidence" in names:
            bins += distribution(records["confidence"], BINS)
            known = records["confidence"][~np.isnan(records["confidence"])]
            fine += distribution(known, FINE)
        if {"label", "confidence"} <= names:
            sums += _sums(records["label"], records["confidence"])
    spacing = spacing_of(some) * float(np.sqrt(len(some) / file.num_points))
    median = (np.searchsorted(np.cumsum(fine), fine.sum() / 2) + 0.5) / FINE if fine.any() else np.nan
    return CloudTally(
        file.num_points,
        labels if "label" in names else None,
        states if "state" in names else None,
        class_areas_by_parts(file, _CELL * spacing) if "label" in names else None,
        sums if {"label", "confidence"} <= names else None,
        bins if "confidence" in names else None,
        float(median),
    )


def _counts(values: np.ndarray) -> np.ndarray:
    return np.bincount(values.astype(np.uint8), minlength=256)


def _sums(label: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    return np.bincount(label.astype(np.uint8), np.nan_to_num(confidence), minlength=256)


def distribution(values: np.ndarray, bins: int) -> np.ndarray:
    """(bins,) how many of the (N,) values lie in equal parts of 0 to 1; others count as the nearest, NaN as 0."""
    return np.histogram(np.clip(np.nan_to_num(values), 0, 1), bins=bins, range=(0, 1))[0]


def class_areas(points: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(256,) float64 area of each class seen from above, squared world units: cells of the ground plane, by
    the label of their highest point.

    points: (N, 3) world, z up; labels: (N,) uint8
    """
    grid = Raster.around(points, _CELL * spacing_of_all(points))
    rows = highest_points(grid, points).ravel()
    return np.bincount(labels[rows[rows >= 0]], minlength=256) * grid.pixel**2


def class_areas_by_parts(file: CloudFile, cell: float) -> np.ndarray:
    """The same of a cloud on disk, in cells of a given side; of equally high points the one first read counts."""
    bounds = [(part.min(axis=0), part.max(axis=0)) for part, _ in _labelled_parts(file)]
    low, high = np.min([ends[0] for ends in bounds], axis=0), np.max([ends[1] for ends in bounds], axis=0)
    grid = Raster.around(np.stack([low, high]), cell)
    top, label = np.full(grid.height * grid.width, -np.inf), np.zeros(grid.height * grid.width, np.uint8)
    for points, labels in _labelled_parts(file):
        rows = highest_points(grid, points).ravel()
        cells = np.flatnonzero(rows >= 0)
        cells = cells[points[rows[cells], 2] > top[cells]]
        top[cells], label[cells] = points[rows[cells], 2], labels[rows[cells]]
    return np.bincount(label[np.isfinite(top)], minlength=256) * grid.pixel**2


def _labelled_parts(file: CloudFile) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for _, records in file.chunks():
        yield positions(records), records["label"].astype(np.uint8)
