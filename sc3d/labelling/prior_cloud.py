"""Classes that another program gave to a cloud, as one more voter: a point of the scene's cloud hears the
nearest classified point within a label voxel.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d

from sc3d.errors import InputError, examples
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.io.clouds import read_cloud
from sc3d.scene.channels import Channels
from sc3d.scene.class_table import ClassTable
from sc3d.scene.frame_check import Box, box_of, describe

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
    rows, distances = NeighborIndex(positions, positions.min(axis=0)).nearest_first(points)
    near = distances <= reach
    require_near(float(near.mean()), name, box_of(positions), box_of(points), reach, weight)
    label = np.where(near, ids[ids > 0][rows], 0).astype(np.uint8)
    return PriorVotes(channels.from_ids(label, name), weight)


def require_near(share: float, name: Path, classified: Box, cloud: Box, reach: float, weight: float) -> None:
    """Say on which share of a cloud another one votes; InputError if on none. classified, cloud: boxes around
    the classified points and those of the cloud, world; the rest as in `read_prior`
    """
    if not share:
        raise InputError(
            f"no classified point of {name} lies within {reach:.3g} of the cloud: its points are at"
            f" {describe(classified)}, the cloud at {describe(cloud)}"
        )
    logger.info(
        "%s votes on %.1f%% of the points, those within %.3g of a classified one, as %g photos would",
        name,
        100 * share,
        reach,
        weight,
    )


def classes_of(cloud: o3d.t.geometry.PointCloud, table: ClassTable, name: Path) -> np.ndarray:
    """(N,) uint8 ids that a cloud states, 0 = none; as `StatedClasses` has it."""
    column = codes_column(cloud.point, name)
    codes = cloud.point[column].numpy().ravel().astype(np.int64)
    present, counts = np.unique(codes, return_counts=True)
    counted = dict(zip(present.tolist(), counts.tolist(), strict=True))
    return StatedClasses.from_counts(column, counted, table, name).ids(codes)


def codes_column(names: Iterable[str], origin: Path) -> str:
    """Where a cloud with attributes of these names states classes: in its own `label`, else as ASPRS codes in
    `classification`; InputError if it does not.
    """
    for column in ("label", "classification"):
        if column in names:
            return column
    raise InputError(f"{origin} has no classes: a column `classification` (ASPRS codes) or `label` is needed")


@dataclass(frozen=True)
class StatedClasses:
    """known: which class of the scene each code stands for; others stand for none."""

    known: dict[int, int]

    @classmethod
    def from_counts(cls, column: str, counts: dict[int, int], table: ClassTable, name: Path) -> StatedClasses:
        """By the codes of a whole cloud and how many points have each. One line counts what is of no class of
        the table; InputError if all is. column: of `codes_column`; name: of the cloud
        """
        if column == "label":
            told, known = "class id", {entry.id: entry.id for entry in table if entry.surface}
            silent: tuple[int, ...] = (0,)
        else:
            told, known, silent = "ASPRS code", _by_code(table, set(counts), name), UNCLASSIFIED
        left = [
            f"{code} ({count} points)"
            for code, count in sorted(counts.items())
            if code not in known and code not in silent
        ]
        if left:
            logger.warning(
                "%s: points of no class of the scene do not vote: %s %s", name, told, examples(left)
            )
        if not any(known.get(code) for code in counts):
            raise InputError(
                f"{name} has no point of a class of the scene, by {told}: classes.json says which there are"
            )
        return cls(known)

    def ids(self, codes: np.ndarray) -> np.ndarray:
        """(N,) uint8 ids of codes (N,) int64, 0 = none."""
        result = np.zeros(len(codes), np.uint8)
        for code, label in self.known.items():
            result[codes == code] = label
        return result


def _by_code(table: ClassTable, present: set[int], name: Path) -> dict[int, int]:
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
