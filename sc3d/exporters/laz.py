"""The labelled cloud as LAZ 1.4: ASPRS class codes, colors, CRS as WKT, and what sc3d knows of each point as
extra dimensions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np

import sc3d
from sc3d.errors import InputError
from sc3d.exporters.projected_cloud import MapProjection, ProjectedCloud, chosen_classes, projected_chunks
from sc3d.instances.terrain import require_ground
from sc3d.io.atomic import atomic_path
from sc3d.scene.class_table import ClassTable
from sc3d.scene.labelled_cloud import INSTANCE, instances_of, is_confirmed
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export

POINTS_AT_ONCE = 1_000_000  # points written at a time
SCALE = 0.001  # of the stored whole numbers, units of the CRS
OFFSET_STEP = 1000.0  # offsets are multiples of this, so that neighboring files share theirs
UNASSIGNED, BARE_GROUND = 1, 2  # ASPRS codes: points without a label; ground
COLORS, PLAIN = 7, 6  # point formats
DIMENSIONS = (
    ("confidence", np.float32, "0 to 1"),
    ("state", np.uint8, "how the label was found"),
    ("num_views", np.uint16, "photos that saw the point"),
    ("label", np.uint8, "class id of sc3d, 0 = none"),
    (INSTANCE, np.uint32, "object of a point, 0 = none"),
)


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / "labelled.laz"]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/labelled.laz`: point format 7 (6 without colors); positions to 1 mm in the CRS, or in the
    scene's frame without one.
    """
    found = survey(scene, settings)
    with (
        atomic_path(outputs(scene, settings)[0]) as temporary,
        laspy.open(str(temporary), mode="w", header=found.header) as writer,
    ):
        for record in records(scene, settings, found):
            writer.write_points(record)
    return found.figures()


@dataclass(frozen=True)
class Survey:
    """What is known of the points to write before the first is written.

    low, high: (3,) of them in the CRS; counts: (256,) by ASPRS code; codes: (256,) uint8 ASPRS code of each
        class id; classes: ids of the classes to write
    """

    low: np.ndarray
    high: np.ndarray
    counts: np.ndarray
    codes: np.ndarray
    classes: list[int]
    projection: MapProjection
    header: laspy.LasHeader

    @property
    def num_points(self) -> int:
        return int(self.counts.sum())

    def whole_box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest position (3,) as whole numbers, as they are stored."""
        low, high = ((end - self.header.offsets) / self.header.scales for end in (self.low, self.high))
        return np.rint(low).astype(np.int64), np.rint(high).astype(np.int64)

    def figures(self) -> dict[str, object]:
        """What the summary says."""
        used = {str(code): int(self.counts[code]) for code in np.flatnonzero(self.counts)}
        return {"points": self.num_points, **self.projection.figures(), "points_by_asprs_code": used}


def survey(scene: Scene, settings: Export) -> Survey:
    """Look at all points; InputError if none has one of the classes to write."""
    ids, codes = (
        sorted(chosen_classes(scene, settings)),
        asprs_codes(scene.class_table(), settings.ground_as_2),
    )
    low, high, counts = np.full(3, np.inf), np.full(3, -np.inf), np.zeros(256, np.int64)
    projected: ProjectedCloud | None = None
    for projected in projected_chunks(scene, settings):
        rows = np.flatnonzero(np.isin(projected.labels.label, ids))
        if len(rows):
            low = np.minimum(low, projected.points[rows].min(axis=0))
            high = np.maximum(high, projected.points[rows].max(axis=0))
        counts += np.bincount(codes[projected.labels.label[rows]], minlength=256)
    if projected is None or not counts.any():
        raise InputError(f"no point has one of the classes {', '.join(settings.classes)}: nothing to write")
    header = make_header(low, high, projected)
    return Survey(low, high, counts, codes, ids, projected.projection, header)


def records(scene: Scene, settings: Export, found: Survey) -> Iterator[laspy.ScaleAwarePointRecord]:
    """All points to write, up to POINTS_AT_ONCE at a time, in their order."""
    for projected in projected_chunks(scene, settings):
        rows = np.flatnonzero(np.isin(projected.labels.label, found.classes))
        for start in range(0, len(rows), POINTS_AT_ONCE):
            yield point_record(projected, rows[start : start + POINTS_AT_ONCE], found.header, found.codes)


def asprs_codes(table: ClassTable, ground_as_2: bool = False) -> np.ndarray:
    """(256,) uint8 ASPRS code of each class id; unlabelled points are unassigned. ground_as_2: what is
    ground-like becomes ground; InputError if nothing is.
    """
    codes = np.full(256, UNASSIGNED, np.uint8)
    for entry in table:
        codes[entry.id] = entry.asprs
    if ground_as_2:
        codes[require_ground(table)] = BARE_GROUND
    return codes


def make_header(low: np.ndarray, high: np.ndarray, projected: ProjectedCloud) -> laspy.LasHeader:
    """LAS 1.4 header of points between low and high (3,), CRS; InputError if they span more than whole
    millimeters in 32 bits can hold.

    placed: some of them, for what all have
    """
    offsets = np.floor(low / OFFSET_STEP) * OFFSET_STEP
    if ((high - offsets) / SCALE >= 2**31).any():
        raise InputError(
            f"the cloud spans {(high - low).max():.0f} units, too much for LAZ at 1 mm: remove stray points first"
        )
    header = laspy.LasHeader(version="1.4", point_format=PLAIN if projected.colors is None else COLORS)
    header.scales, header.offsets = np.full(3, SCALE), offsets
    header.generating_software = f"sc3d {sc3d.__version__}"
    header.add_extra_dims([laspy.ExtraBytesParams(name, dtype, text) for name, dtype, text in DIMENSIONS])
    crs = projected.projection.crs
    header.global_encoding.wkt = True  # point formats 6 and up know no other
    if crs is not None:
        # LAS 1.4 asks for WKT 1
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(crs.to_wkt("WKT1_GDAL")))
    return header


def point_record(
    projected: ProjectedCloud, rows: np.ndarray, header: laspy.LasHeader, codes: np.ndarray
) -> laspy.ScaleAwarePointRecord:
    """The points `rows` (K,) as LAS points; codes: (256,) uint8 ASPRS code of each class id."""
    record = laspy.ScaleAwarePointRecord.zeros(len(rows), header=header)
    record.x, record.y, record.z = projected.points[rows].T
    labels = projected.labels
    record.classification = codes[labels.label[rows]]
    record.synthetic = ~is_confirmed(projected.cloud)[rows]
    record.return_number = record.number_of_returns = np.ones(len(rows), np.uint8)
    if projected.colors is not None:
        # 255 becomes 65535
        record.red, record.green, record.blue = projected.colors[rows].T.astype(np.uint16) * 257
    record.confidence, record.state, record.label = (
        labels.confidence[rows],
        labels.state[rows],
        labels.label[rows],
    )
    instance = instances_of(projected.cloud, Path("labelled.ply"))
    record.instance = np.zeros(len(rows), np.uint32) if instance is None else instance[rows]
    record.num_views = np.minimum(labels.num_views[rows], np.iinfo(np.uint16).max).astype(np.uint16)
    return record
