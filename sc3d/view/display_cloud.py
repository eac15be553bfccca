"""What a viewer shows of a cloud: positions near zero, in an order whose beginnings thin it evenly, and its
colors.
"""

from __future__ import annotations

import logging
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.graph import MORTON_BITS, morton_codes
from sc3d.io.clouds import read_cloud
from sc3d.scene.class_table import ClassTable
from sc3d.scene.cloud_parts import read_thinned
from sc3d.scene.labelled_cloud import INSTANCE, VOTES, confirmed_only, spacing_of
from sc3d.scene.scene import Scene
from sc3d.settings.common import Memory
from sc3d.tiling.memory import SHOWN_BYTES, fits, max_points, num_points
from sc3d.view.colors import COLORINGS, Coloring, can_color, color_points, shaded

if TYPE_CHECKING:
    import open3d as o3d

logger = logging.getLogger(__name__)

_CHUNKS = 16  # steps in which points come and go; each is a node per class
_SMALLEST_CHUNK = 20_000
_SAMPLE = 50_000  # points from which the spacing is found


@dataclass(frozen=True)
class DisplayCloud:
    """N points in the order in which they are shown.

    points: (N, 3) float32, world minus `origin` (3,) float64, so that UTM coordinates keep their millimeters
    rows: (N,) int64 rows of the points in `cloud`; label: (N,) uint8 ids, 0 without labels
    spacing: distance between neighbors of the whole cloud, world units
    """

    cloud: o3d.t.geometry.PointCloud
    origin: np.ndarray
    points: np.ndarray
    rows: np.ndarray
    label: np.ndarray
    spacing: float
    class_table: ClassTable | None = None
    _colors: dict[tuple[str, bool], np.ndarray] = field(default_factory=dict)

    @classmethod
    def from_cloud(
        cls, cloud: o3d.t.geometry.PointCloud, origin: np.ndarray, class_table: ClassTable | None
    ) -> DisplayCloud:
        """origin: (3,) world, near the cloud"""
        world = cloud.point.positions.cpu().numpy()
        rows = progressive_order(world)
        points = (world[rows].astype(np.float64) - origin).astype(np.float32)
        label = (
            cloud.point["label"].cpu().numpy().ravel().astype(np.uint8)[rows]
            if "label" in cloud.point
            else np.zeros(len(rows), np.uint8)
        )
        sample = points[:_SAMPLE]
        return cls(
            cloud,
            origin,
            points,
            rows,
            label,
            spacing_of(sample) * np.sqrt(len(sample) / len(points)),
            class_table,
        )

    def relabel(self, labelled: o3d.t.geometry.PointCloud) -> None:
        """Take the labels of the same points, or of more if only the confirmed ones are shown; InputError if
        they are others.
        """
        if len(labelled.point.positions) > len(self.cloud.point.positions):
            labelled = confirmed_only(labelled)
        positions, others = (one.point.positions.cpu().numpy() for one in (self.cloud, labelled))
        if positions.shape != others.shape or not np.array_equal(positions, others):
            raise InputError("the labels are of other points than those shown: open the page again")
        for name in ("label", "confidence", "state", INSTANCE):
            if name in labelled.point:
                self.cloud.point[name] = labelled.point[name]
        self.label[:] = labelled.point["label"].cpu().numpy().ravel()[self.rows]
        self._colors.clear()

    def rows_of_object(self, number: int) -> np.ndarray:
        """(K,) rows, in the order shown, of the points of an object."""
        if INSTANCE not in self.cloud.point:
            return np.zeros(0, np.int64)
        return np.flatnonzero(self.cloud.point[INSTANCE].cpu().numpy().ravel()[self.rows] == number)

    @property
    def colorings(self) -> tuple[Coloring, ...]:
        """What the cloud can be colored by."""
        return tuple(
            by
            for by in COLORINGS
            if can_color(self.cloud, by) and (by != "label" or self.class_table is not None)
        )

    @property
    def has_relief(self) -> bool:
        """Whether the cloud has normals, so that it can be shaded."""
        return "normals" in self.cloud.point

    def colors(self, by: Coloring, relief: bool = False) -> np.ndarray:
        """(N, 3) uint8 RGB; kept once made. relief: shaded by the normals, but for the colors of the photos,
        which have light and shade
        """
        if relief and (by == "photo" or not self.has_relief):
            return self.colors(by)
        if (by, relief) not in self._colors:
            if relief:
                self._colors[by, True] = shaded(
                    self.colors(by), self.cloud.point.normals.cpu().numpy()[self.rows]
                )
            else:
                self._colors[by, False] = color_points(self.cloud, by, self.class_table)[self.rows]
        return self._colors[by, relief]

    @property
    def middle(self) -> np.ndarray:
        """(3,) mean of the points, in their frame."""
        return self.points[:_SAMPLE].mean(axis=0, dtype=np.float64)

    @property
    def extent(self) -> float:
        """Diagonal of the box around most of the points, world units."""
        return float(np.linalg.norm(np.ptp(np.quantile(self.points[:_SAMPLE], [0.01, 0.99], axis=0), axis=0)))

    @property
    def class_counts(self) -> dict[int, int]:
        """Number of points by class id, of the classes that occur."""
        counts = np.bincount(self.label, minlength=256)
        return {int(label): int(counts[label]) for label in np.flatnonzero(counts)}

    @property
    def chunk(self) -> int:
        """Number of points that come and go together."""
        return min(len(self.points), max(_SMALLEST_CHUNK, -(-len(self.points) // _CHUNKS)))

    def spacing_at(self, count: int) -> float:
        """Distance between neighbors of the first `count` points, world units."""
        return self.spacing * float(np.sqrt(len(self.points) / max(count, 1)))


def class_ids(class_table: ClassTable | None, names: tuple[str, ...]) -> set[int] | None:
    """Ids of the named classes, "unlabelled" being 0; None without names, for all. InputError for a name that
    the table does not have.
    """
    if not names:
        return None
    if class_table is None:
        raise InputError("--classes needs the class table of the scene (classes.json)")
    ids = {entry.name: entry.id for entry in class_table} | {"unlabelled": 0}
    unknown = next((name for name in names if name not in ids), None)
    if unknown is not None:
        raise InputError(f"there is no class {unknown!r}: choose from {', '.join(ids)}")
    return {ids[name] for name in names}


def only_classes(cloud: o3d.t.geometry.PointCloud, ids: set[int] | None) -> o3d.t.geometry.PointCloud:
    """The points of some classes; InputError if there are none. ids: None = all"""
    if ids is None:
        return cloud
    if "label" not in cloud.point:
        raise InputError("--classes needs labels: run `sc3d label SCENE` and `sc3d propagate SCENE`")
    import open3d as o3d

    chosen = np.isin(cloud.point["label"].cpu().numpy().ravel(), sorted(ids))
    if not chosen.any():
        raise InputError("no point has one of the chosen classes: nothing to show")
    return cloud.select_by_mask(o3d.core.Tensor(chosen))


def load_cloud(
    scene: Scene,
    file: Path | None = None,
    votes: bool | None = False,
    unconfirmed: bool = True,
    memory: Memory = Memory(),
) -> o3d.t.geometry.PointCloud:
    """The cloud of a file, else the best of the scene; InputError if there is none. Of one that does not fit into
    memory, as many points as do, evenly, which is told.

    unconfirmed: of the scene, with what no second photo confirms
    votes: add those of seeds.ply to a cloud of the scene that has none; None = where that is possible
    """
    path = file or scene.best_cloud
    if path is None:
        raise InputError(f"{scene.path} has no cloud to show: run `sc3d extract SCENE`, or pass --file FILE")
    count = num_points(path)
    if count is not None and not fits(count * SHOWN_BYTES, memory):
        return _some_points(path, count, memory, unconfirmed or file is not None)
    cloud = read_cloud(path)
    if file is not None:
        return cloud
    if votes is not False and not can_color(cloud, "disagreement") and scene.seeds.exists():
        with nullcontext() if votes else suppress(InputError):
            cloud = with_votes(cloud, read_cloud(scene.seeds))
    return cloud if unconfirmed else confirmed_only(cloud)


def _some_points(path: Path, count: int, memory: Memory, unconfirmed: bool) -> o3d.t.geometry.PointCloud:
    cloud = read_thinned(path, max_points(memory, SHOWN_BYTES))
    logger.warning(
        "%s: %.2f of its %.2f million points are shown, evenly, as no more fit into %s",
        path,
        len(cloud.point.positions) / 1e6,
        count / 1e6,
        f"--max-memory {memory.max_memory}" if memory.max_memory else "half of this machine's memory",
    )
    return cloud if unconfirmed else confirmed_only(cloud)


def with_votes(
    cloud: o3d.t.geometry.PointCloud, seeds: o3d.t.geometry.PointCloud
) -> o3d.t.geometry.PointCloud:
    """The cloud with the votes that `label` left in the seeds it was made from; InputError if the seeds are
    other points.
    """
    positions, others = (one.point.positions.cpu().numpy() for one in (cloud, seeds))
    if positions.shape != others.shape or not np.array_equal(positions, others):
        raise InputError(
            "the labelled cloud and seeds.ply hold different points: run `sc3d propagate SCENE --overwrite`, or pass --file"
        )
    result = cloud.clone()
    for name in [name for name in seeds.point if name.startswith(VOTES)]:
        result.point[name] = seeds.point[name]
    return result


def progressive_order(points: np.ndarray) -> np.ndarray:
    """Rows of the points so that the first K of them, for any K, thin the cloud evenly and keep its relative
    densities.

    The points are sorted along a Z-order curve, which neighbors share, and then taken in the order of the van
    der Corput sequence, whose every beginning is spread evenly over the curve. Nothing is random, and copies
    of a cloud in another order give the same points.

    points: (N, 3) finite; returns: (N,) int64, a permutation
    """
    along_curve = np.argsort(curve_positions(points), kind="stable")
    return along_curve[_van_der_corput(len(points))]


def curve_positions(points: np.ndarray) -> np.ndarray:
    """(N,) uint64 position of (N, 3) points on the Z-order curve of the cube around them."""
    points = np.asarray(points, np.float64)
    if not len(points):
        return np.empty(0, np.uint64)
    low = points.min(axis=0)
    side = float((points.max(axis=0) - low).max()) or 1.0
    steps = 1 << MORTON_BITS
    return morton_codes(np.minimum((points - low) / side * steps, steps - 1).astype(np.uint64)[:, ::-1])


def _van_der_corput(count: int) -> np.ndarray:
    """(count,) int64: 0 to count - 1 by their bits read backwards."""
    bits = max(count - 1, 0).bit_length()
    numbers = np.arange(1 << bits, dtype=np.int64)
    backwards = np.zeros_like(numbers)
    for bit in range(bits):
        backwards |= (numbers >> bit & 1) << (bits - 1 - bit)
    return backwards[backwards < count]
