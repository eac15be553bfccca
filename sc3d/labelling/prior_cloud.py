"""Classes that another program gave to a cloud, as one more voter: a point of the scene's cloud hears the
nearest classified point within a label voxel.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d

from sc3d.errors import InputError, examples
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.io.clouds import read_cloud
from sc3d.scene.channels import Channels
from sc3d.scene.class_table import ClassTable
from sc3d.scene.frame_check import box_of, describe

UNCLASSIFIED = (0, 1)  # ASPRS: never classified, unclassified

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class PriorVotes:
    """label: (N,) uint8 channel that each point hears, 0 = none; weight: what one is worth, in photos."""

    label: np.ndarray
    weight: float


def read_prior(
    path: Path,
    name: Path,
    table: ClassTable,
    channels: Channels,
    points: np.ndarray,
    reach: float,
    weight: float,
) -> PriorVotes:
    """What a classified cloud says of points (N, 3) float64 world.

    path: the cloud in the world of the scene; name: as the user knows it; reach: largest distance of a
        classified point, world units
    Raises InputError if the cloud has no classes of the table, or none of its points is near.
    """
    cloud = read_cloud(path)
    ids = classes_of(cloud, table, name)
    positions = cloud.point.positions.numpy().astype(np.float64)[ids > 0]
    rows, distances = NeighborIndex(positions, positions.min(axis=0)).nearest(points, 1)
    near = distances[:, 0] <= reach
    if not near.any():
        raise InputError(
            f"no classified point of {name} lies within {reach:.3g} of the cloud: its points are at"
            f" {describe(box_of(positions))}, the cloud at {describe(box_of(points))}"
        )
    label = np.where(near, ids[ids > 0][rows[:, 0]], 0).astype(np.uint8)
    logger.info(
        "%s votes on %.1f%% of the points, those within %.3g of a classified one, as %g photos would",
        name,
        100 * near.mean(),
        reach,
        weight,
    )
    return PriorVotes(channels.from_ids(label, name), weight)


def classes_of(cloud: o3d.t.geometry.PointCloud, table: ClassTable, name: Path) -> np.ndarray:
    """(N,) uint8 ids that a cloud states, 0 = none: its own column `label`, else the ASPRS codes of its
    column `classification`. One line counts what is of no class of the table.
    """
    if "label" in cloud.point:
        ids, told = cloud.point["label"].numpy().ravel().astype(np.int64), "class id"
        known = {entry.id: entry.id for entry in table if entry.surface}
        silent: tuple[int, ...] = (0,)
    elif "classification" in cloud.point:
        ids, told = cloud.point["classification"].numpy().ravel().astype(np.int64), "ASPRS code"
        known, silent = _by_code(table, np.unique(ids), name), UNCLASSIFIED
    else:
        raise InputError(
            f"{name} has no classes: a column `classification` (ASPRS codes) or `label` is needed"
        )
    present, counts = np.unique(ids, return_counts=True)
    left = [
        f"{code} ({count} points)"
        for code, count in zip(present.tolist(), counts, strict=True)
        if code not in known and code not in silent
    ]
    if left:
        logger.warning("%s: points of no class of the scene do not vote: %s %s", name, told, examples(left))
    result = np.zeros(len(ids), np.uint8)
    for code, label in known.items():
        result[ids == code] = label
    if not result.any():
        raise InputError(
            f"{name} has no point of a class of the scene, by {told}: classes.json says which there are"
        )
    return result


def _by_code(table: ClassTable, present: np.ndarray, name: Path) -> dict[int, int]:
    """Which class each ASPRS code stands for; InputError for one of the codes present that two classes have."""
    known: dict[int, int] = {}
    for entry in table:
        if not entry.surface or entry.asprs in UNCLASSIFIED:
            continue
        if entry.asprs in known and entry.asprs in present:
            raise InputError(
                f"{name} has ASPRS code {entry.asprs}, which {table.name(known[entry.asprs])!r} and {entry.name!r}"
                " of classes.json share: give the cloud a column `label` with class ids, or one of them another code"
            )
        known[entry.asprs] = entry.id
    return known
