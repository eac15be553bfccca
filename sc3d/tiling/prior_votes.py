"""`labelling.prior_cloud` for clouds in tiles: what another program says of the points, when neither cloud
need fit into memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from sc3d.io.chunked_clouds import CloudFile, positions
from sc3d.labelling.inputs import Masks
from sc3d.labelling.prior_cloud import StatedClasses, codes_column, require_near
from sc3d.scene.channels import Channels
from sc3d.scene.frame_check import Box
from sc3d.settings.labels import Label
from sc3d.tiling.executor import Executor
from sc3d.tiling.nearest import AT_ONCE, NearestLabels
from sc3d.tiling.store import Results, TileStore

ROUNDING = 1.001  # of the reach: distances are float32


@dataclass(frozen=True)
class PriorJob:
    """What the task of a tile needs to know. store, results: of the cloud; prior: the classified cloud in the
    same tiles; column: of its codes; origin: (3,) as in `NeighborIndex`; reach: world units
    """

    store: TileStore
    results: Results
    prior: TileStore
    column: str
    classes: StatedClasses
    channels: Channels
    origin: np.ndarray
    reach: float

    def classified(self, tile: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Positions (K, 3), ids (K,) and rows (K,) of the classified points in a tile and around it, in
        parts.
        """
        margin = ROUNDING * self.reach
        for other in self.prior.grid.neighbors(tile, margin):
            for start in range(0, self.prior.counts.get(other, 0), AT_ONCE):
                part = slice(start, start + AT_ONCE)
                records = self.prior.records(other)[part]
                points, ids = positions(records), self.classes.ids(records[self.column].astype(np.int64))
                chosen = (ids > 0) & self.prior.grid.within(points, tile, margin)
                if chosen.any():
                    yield points[chosen], ids[chosen], self.prior.rows(other)[part][chosen]


def hear_prior(
    settings: Label, name: Path, cloud: Box, results: Results, folder: Path, executor: Executor, masks: Masks
) -> None:
    """As `prior_cloud.read_prior`; leaves an array `prior` of every tile.

    settings: with the voxel size; name: of the classified cloud, as the user knows it; cloud: box around the
        cloud of the scene, world; folder: for the classified cloud in tiles
    """
    if settings.prior is None:
        return
    file, store, reach = CloudFile.open(settings.prior), results.store, settings.voxel_size
    column = codes_column(file.names, name)
    counts, boxes = _census(file, column)
    classes = StatedClasses.from_counts(column, counts, masks.table, name)
    known = [boxes[code] for code in boxes if classes.known.get(code)]
    box = np.min([low for low, _ in known], axis=0), np.max([high for _, high in known], axis=0)
    prior = TileStore.build(file, store.grid, folder)
    job = PriorJob(store, results, prior, column, classes, masks.channels, box[0], reach)
    near = sum(executor.run("prior", partial(_hear_task, job), store.tiles))
    require_near(near / sum(store.counts.values()), name, box, cloud, reach, settings.prior_weight)


def _census(file: CloudFile, column: str) -> tuple[dict[int, int], dict[int, Box]]:
    """Points of each code, and the box around them."""
    counts, boxes = dict[int, int](), dict[int, Box]()
    for _, records in file.chunks():
        codes, points = records[column].astype(np.int64), positions(records)
        for code in np.unique(codes).tolist():
            mine = points[codes == code]
            low, high = boxes.get(code, (mine[0], mine[0]))
            counts[code] = counts.get(code, 0) + len(mine)
            boxes[code] = np.minimum(low, mine.min(axis=0)), np.maximum(high, mine.max(axis=0))
    return counts, boxes


def _hear_task(job: PriorJob, tile: int) -> int:
    """How many points of a tile hear something; leaves the channel that each one hears, 0 = none."""
    found = NearestLabels.of_points(positions(job.store.records(tile)), job.origin)
    for part in job.classified(tile):
        found.add(*part)
    near = found.distance <= job.reach
    label = np.where(near, found.label, 0).astype(np.uint8)
    job.results.write(tile, prior=job.channels.from_ids(label))
    return int(near.sum())
