"""Labels for what no edge connects to a seed, by `propagate --fill`: those of the nearest labelled points, in
whatever tile these are.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from sc3d.io.chunked_clouds import positions
from sc3d.propagation.propagate import FILLED
from sc3d.tiling.executor import Executor
from sc3d.tiling.nearest import AT_ONCE, NearestLabels
from sc3d.tiling.tile_graph import PropagateJob

NAME = "filled"  # of the arrays that come out
ROUNDING = 1e-3  # of a distance, which is float32

Boxes = dict[
    int, np.ndarray
]  # (2, 3) around the labelled points of a tile, world; tiles without any are left out


def fill_tiles(
    job: PropagateJob, executor: Executor, source: str, reached: dict[int, np.ndarray] | None
) -> str:
    """As `propagation.propagate.fill_from_nearest`; returns how the arrays are named.

    source: of the labels so far; reached: as of `connections.reached_groups`, None = all
    """
    tiles = job.store.tiles
    found = executor.run("labelled", partial(_labelled_task, job, source, reached), tiles)
    boxes = {tile: box for tile, box in zip(tiles, found, strict=True) if box is not None}
    executor.run("filling", partial(_fill_task, job, boxes), tiles)
    return NAME


def _labelled_task(
    job: PropagateJob, source: str, reached: dict[int, np.ndarray] | None, tile: int
) -> np.ndarray | None:
    """The box around the labelled points of a tile; leaves its array `spread`, labels of what is reached."""
    label = job.results.read(tile, f"{source}_label")
    if reached is not None:
        label = np.where(reached[tile][job.results.read(tile, "group")], label, 0).astype(np.uint8)
    confidence = np.where(label > 0, job.results.read(tile, f"{source}_confidence"), 0).astype(np.float32)
    job.results.write(tile, spread_label=label, spread_confidence=confidence)
    points = positions(job.store.records(tile)[label > 0])
    return np.stack([points.min(axis=0), points.max(axis=0)]) if len(points) else None


def _fill_task(job: PropagateJob, boxes: Boxes, tile: int) -> None:
    label, confidence = (job.results.read(tile, f"spread_{name}") for name in ("label", "confidence"))
    empty = np.flatnonzero(label == 0)
    if len(empty) and boxes:
        label[empty] = _nearest_labels(job, boxes, tile, positions(job.store.records(tile)[empty]))
        confidence[empty] = FILLED
    job.results.write(tile, **{f"{NAME}_label": label, f"{NAME}_confidence": confidence})


def _nearest_labels(job: PropagateJob, boxes: Boxes, tile: int, points: np.ndarray) -> np.ndarray:
    """(K,) uint8 labels of the labelled points nearest to points (K, 3) of a tile; of equally near ones, that
    of the lowest row in the cloud.
    """
    found = NearestLabels.of_points(points, job.extent.low)
    low, high = points.min(axis=0), points.max(axis=0)
    apart = {
        other: float(np.linalg.norm(np.maximum(np.maximum(box[0] - high, low - box[1]), 0)))
        for other, box in boxes.items()
    }
    for other in sorted(apart, key=lambda other: (apart[other], other != tile, other)):
        if apart[other] > (1 + ROUNDING) * float(found.distance.max()):
            break
        for part in _labelled_points(job, other):
            found.add(*part)
    return found.label


def _labelled_points(job: PropagateJob, tile: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Positions (K, 3), labels (K,) and rows (K,) of the labelled points of a tile, in parts."""
    label = job.results.read(tile, "spread_label")
    chosen = np.flatnonzero(label)
    for start in range(0, len(chosen), AT_ONCE):
        part = chosen[start : start + AT_ONCE]
        yield positions(job.store.records(tile)[part]), label[part], job.store.rows(tile)[part]
