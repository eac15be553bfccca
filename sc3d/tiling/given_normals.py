"""The normals of a cloud in tiles: its own, or estimated."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sc3d.io.chunked_clouds import CloudFile, columns, positions
from sc3d.scene.labelled_cloud import unit_normals, usable_normals
from sc3d.tiling.store import TileStore, TileWithHalo

NORMALS = ("nx", "ny", "nz")

NormalsOf = Callable[[TileWithHalo], np.ndarray]
"""(N, 3) float32 unit normals of a tile and its margin; a function that can be sent to workers"""

logger = logging.getLogger(__name__)


def has_usable_normals(cloud: CloudFile) -> bool:
    """Whether all points have normals with a direction; a line if only some have, as
    `labelled_cloud.unit_normals` says it of a cloud in memory.
    """
    if not set(NORMALS) <= set(cloud.names):
        return False
    unusable = 0
    for _, records in cloud.chunks():
        normals = columns(records, NORMALS)
        unusable += 0 if normals is None else int((~usable_normals(normals)).sum())
    if unusable:
        logger.warning(
            "%s: %d of %d normals have no length or are not finite: all are estimated",
            cloud.path,
            unusable,
            cloud.num_points,
        )
    return not unusable


@dataclass(frozen=True)
class TileNormals:
    """`labelled_cloud.unit_normals` of a tile and its margin, of which the outermost points have others where
    they are estimated. centers: (M, 3) of the cameras; origin: (3,) as in `NeighborIndex`; given: whether to
    take those of the cloud
    """

    store: TileStore
    centers: np.ndarray
    origin: np.ndarray
    given: bool

    def __call__(self, halo: TileWithHalo) -> np.ndarray:
        records = halo.gather(self.store.records)
        given = columns(records, NORMALS) if self.given else None
        return unit_normals(given, positions(records), self.centers, self.origin)
