"""Overall accuracy, IoU per class and mIoU against truth masks, through the first surface (paper section
4.2); precision and recall of the classes where the truth also tells what is none of them.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from sc3d.errors import InputError, left_out
from sc3d.geometry.cameras import View
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.geometry.raycast import FirstSurface
from sc3d.io.clouds import read_cloud
from sc3d.io.json_files import write_json
from sc3d.io.ply import read_header
from sc3d.io.progress import progress
from sc3d.panoptic import Segments, panoptic_quality, summarize
from sc3d.scene.class_table import OTHER, ClassTable
from sc3d.scene.labelled_cloud import INSTANCE, LabelledSurface, instances_of, read_labelled
from sc3d.scene.labels import Labels
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Evaluate

logger = logging.getLogger(__name__)

LEAST_NEAR = 0.5  # of the true cloud's points with a labelled one nearby: below, the two are not of one place


@dataclass(frozen=True)
class Confusion:
    """counts: (C, C) int64 pixels, row = truth, column = prediction, indexed by class id; row 0 = other, none
    of the classes, column 0 = no prediction. OA, IoU and coverage are those of the other rows alone.
    """

    counts: np.ndarray

    @classmethod
    def from_labels(cls, truth: np.ndarray, predicted: np.ndarray, num_ids: int) -> Confusion:
        """Count the pixels whose truth is not 0; it may be `OTHER`. truth, predicted: uint8, of one shape."""
        judged = truth > 0
        flat = _rows(truth[judged], num_ids) * num_ids + predicted[judged]
        return cls(np.bincount(flat, minlength=num_ids**2).reshape(num_ids, num_ids))

    def __add__(self, other: Confusion) -> Confusion:
        return Confusion(self.counts + other.counts)

    @property
    def closed(self) -> np.ndarray:
        """(C, C) counts without the pixels of other: row 0 is empty."""
        return np.concatenate([np.zeros_like(self.counts[:1]), self.counts[1:]])

    @property
    def present(self) -> np.ndarray:
        """Ids of the classes that the truth has."""
        return np.flatnonzero(self.closed.sum(axis=1))

    @property
    def accuracy(self) -> float:
        """OA: share of the classes' pixels that are right; no prediction counts as wrong (eq. 10)."""
        total = self.closed.sum()
        return float(np.trace(self.closed) / total) if total else float("nan")

    @property
    def iou(self) -> np.ndarray:
        """(C,) intersection over union per class id; NaN where the truth has none."""
        closed = self.closed
        right = np.diag(closed).astype(np.float64)
        union = closed.sum(axis=0) + closed.sum(axis=1) - right
        return np.where(closed.sum(axis=1) > 0, right / np.maximum(union, 1), np.nan)

    @property
    def mean_iou(self) -> float:
        """mIoU over the classes present (eq. 11 without its off-by-one)."""
        return float(self.iou[self.present].mean()) if len(self.present) else float("nan")

    @property
    def coverage(self) -> float:
        """Share of the classes' pixels that have a prediction."""
        total = self.closed.sum()
        return float(1 - self.closed[:, 0].sum() / total) if total else float("nan")

    @property
    def precision(self) -> np.ndarray:
        """(C,) share of the pixels predicted as a class, also on other, that are of it; NaN without any."""
        predicted = self.counts.sum(axis=0)
        return np.where(predicted > 0, np.diag(self.counts) / np.maximum(predicted, 1), np.nan)

    @property
    def recall(self) -> np.ndarray:
        """(C,) share of the pixels of a class that are predicted as it; NaN where the truth has none."""
        true = self.counts.sum(axis=1)
        return np.where(true > 0, np.diag(self.counts) / np.maximum(true, 1), np.nan)

    def other(self, class_table: ClassTable) -> dict[str, object]:
        """JSON-ready: pixels of other, share of them that is given a class (None without any), by class."""
        pixels = int(self.counts[0].sum())
        given = {
            class_table.name(int(label)): float(self.counts[0, label] / pixels)
            for label in np.flatnonzero(self.counts[0, 1:]) + 1
        }
        share = float(1 - self.counts[0, 0] / pixels) if pixels else None
        return {"pixels": pixels, "given_class": share, "given": given}

    def summary(self, class_table: ClassTable) -> dict[str, object]:
        """JSON-ready figures; fractions, not per cent. Precision and recall count all judged pixels."""
        iou, open_set = self.iou, {"precision": self.precision, "recall": self.recall}
        figures = {
            key: {class_table.name(label): float(found[label]) for label in _ids(found)}
            for key, found in open_set.items()
        }
        return {
            "oa": self.accuracy,
            "miou": self.mean_iou,
            "iou": {class_table.name(label): float(iou[label]) for label in self.present},
            "coverage": self.coverage,
            "pixels": int(self.closed.sum()),
            "confusion": self.counts[1:].tolist(),
            **figures,
            "other": self.other(class_table),
        }


def _ids(values: np.ndarray) -> np.ndarray:
    """Class ids whose value is a number."""
    return np.flatnonzero(np.isfinite(values[1:])) + 1


def _rows(truth: np.ndarray, num_ids: int) -> np.ndarray:
    """int64 row of `Confusion.counts` of each judged pixel: 0 for `OTHER`, unless classes have such ids."""
    return np.where((truth == OTHER) & (num_ids <= OTHER), 0, truth).astype(np.int64)


def total(parts: Iterable[Confusion], num_ids: int) -> Confusion:
    """Sum of confusion matrices; empty sum = zeros."""
    return sum(parts, Confusion(np.zeros((num_ids, num_ids), np.int64)))


@dataclass(frozen=True)
class EvaluationPixels:
    """The P pixels that have truth, and the cloud point that each of them shows: found once, then every
    labelling of the cloud is judged by a look-up.

    truth: (P,) uint8 ids or `OTHER`, never 0; rows: (P,) int32 row of the cloud, -1 = no point there;
    band: (P,) bool near a depth edge
    """

    truth: np.ndarray
    rows: np.ndarray
    band: np.ndarray

    @classmethod
    def from_photo(cls, truth: np.ndarray, rows: np.ndarray, band: np.ndarray) -> EvaluationPixels:
        """One photo. truth: (H, W) uint8, 0 = not judged; rows: (H, W) int32 as `nearest_points` returns
        them; band: (H, W) bool.
        """
        judged = truth > 0
        return cls(truth[judged], rows[judged].astype(np.int32), band[judged])

    @classmethod
    def concatenate(cls, parts: list[EvaluationPixels]) -> EvaluationPixels:
        """All pixels of several photos, in order."""
        return cls(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in ("truth", "rows", "band"))
        )

    def look_up(self, values: np.ndarray) -> np.ndarray:
        """(P,) value of the point that each pixel shows, 0 where there is none. values: (N,) per point of the
        cloud.
        """
        return np.where(self.rows >= 0, values[self.rows], values.dtype.type(0))

    def confusions(self, predicted: np.ndarray, num_ids: int) -> tuple[Confusion, Confusion]:
        """Confusion of (P,) uint8 predictions inside and outside the band; the sum is that of all pixels."""
        flat = (self.band.astype(np.int64) * num_ids + _rows(self.truth, num_ids)) * num_ids + predicted
        inside, outside = np.bincount(flat, minlength=2 * num_ids**2).reshape(2, num_ids, num_ids)[::-1]
        return Confusion(inside), Confusion(outside)

    def reliability(
        self, label: np.ndarray, confidence: np.ndarray, num_ids: int, other: bool = False
    ) -> Reliability:
        """Confidence of the label at each pixel that has one, against being right; with `other` also where
        the truth is other and no label right. label: (N,) uint8, confidence: (N,) float32, of the cloud.
        """
        predicted = self.look_up(label)
        labelled = (predicted > 0) & (other | (_rows(self.truth, num_ids) > 0))
        return reliability(self.look_up(confidence)[labelled], (predicted == self.truth)[labelled])


def depth_edge_band(depth: np.ndarray, width: float) -> np.ndarray:
    """(H, W) bool: pixels within `width` px of a depth discontinuity (a step of more than 2 % of the depth,
    or the end of the surface).

    depth: (H, W) range or z, inf = nothing
    """
    finite = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(finite, kernel), cv2.dilate(finite, kernel)
    edges = high - low > 0.02 * high
    if not edges.any():
        return edges
    return cv2.distanceTransform((~edges).astype(np.uint8), cv2.DIST_L2, 5) <= width


@dataclass(frozen=True)
class Reliability:
    """One entry per bin: confidence and accuracy (B,) float64, means over the bin, NaN where empty; count
    (B,) int64; ece: expected calibration error.

    ece = sum over bins of count / total x |confidence - accuracy|; NaN without any sample
    """

    confidence: np.ndarray
    accuracy: np.ndarray
    count: np.ndarray
    ece: float

    @classmethod
    def from_sums(cls, confidence: np.ndarray, right: np.ndarray, count: np.ndarray) -> Reliability:
        """From the sum of confidences, the number of right samples and of all samples in each bin (B,)."""
        some, total = np.where(count > 0, count, np.nan), count.sum()
        mean, accuracy = confidence / some, right / some
        ece = float(np.nansum(count * np.abs(mean - accuracy)) / total) if total else float("nan")
        return cls(mean, accuracy, count, ece)

    @classmethod
    def merge(cls, parts: list[Reliability]) -> Reliability:
        """Of all samples of several parts, one at least."""
        count = np.sum([part.count for part in parts], axis=0)
        confidence = np.sum([np.nan_to_num(part.confidence) * part.count for part in parts], axis=0)
        right = np.sum([np.nan_to_num(part.accuracy) * part.count for part in parts], axis=0)
        return cls.from_sums(confidence, right, count)

    def summary(self) -> dict[str, object]:
        """JSON-ready figures; None for an empty bin."""
        rows = [
            None if not count else [float(mean), float(share), int(count)]
            for mean, share, count in zip(self.confidence, self.accuracy, self.count, strict=True)
        ]
        return {"ece": self.ece, "bins": rows}


def reliability(confidence: np.ndarray, right: np.ndarray, bins: int = 10) -> Reliability:
    """confidence: (N,) in [0, 1]; right: (N,) bool, was the label right; bins of equal width, 1.0 in the
    last.
    """
    if len(confidence) and (np.min(confidence) < 0 or np.max(confidence) > 1):
        raise ValueError("confidences must lie in [0, 1]")
    row = np.minimum((np.asarray(confidence, np.float64) * bins).astype(np.int64), bins - 1)
    count = np.bincount(row, minlength=bins)
    return Reliability.from_sums(
        np.bincount(row, confidence, minlength=bins),
        np.bincount(row, np.asarray(right, np.float64), minlength=bins),
        count,
    )


SOURCES = ("labels", "masks", "labels_near_edges", "labels_elsewhere")  # order of the figures


class SeenCloud(Protocol):
    """What photos see of a labelled cloud: `LabelledSurface`, or by tiles `TiledSurface`."""

    def rows(self, view: View, size: tuple[int, int], wanted: np.ndarray) -> tuple[np.ndarray, FirstSurface]:
        """(H, W) int row of the cloud at each wanted pixel (H, W) bool, -1 = nothing; the first surface.
        size: (width, height).
        """


@dataclass(frozen=True)
class EvaluationSummary:
    """totals: figures by source (SOURCES); calibration_error: expected error of the confidence, on pixels of
    classes and on all judged ones, None = no photo
    empty: of the truth's pixels of classes without surface, by class, how many there are and how many hit
    nothing
    objects: panoptic quality, where the truth tells objects apart
    """

    totals: dict[str, dict]
    calibration_error: tuple[float, float] | None
    empty: dict[str, dict[str, int]] = field(default_factory=dict)
    objects: dict | None = None

    @property
    def has_other(self) -> bool:
        """Whether the truth marks other."""
        return self.totals["labels"]["other"]["pixels"] > 0

    def figures(self) -> dict[str, object]:
        """What the stage reports."""
        rows: dict[str, object] = {}
        for key, found in self.totals.items():
            head = f"OA {found['oa']:.1%}  mIoU {found['miou']:.1%}"
            rows[key] = f"{head}  ({_listed(found['iou'])})  coverage {found['coverage']:.1%}"
        for key in ("labels", "masks"):
            if key in self.totals and self.has_other:
                rows[f"{key}_with_other"] = _open_figures(self.totals[key])
        if self.calibration_error is not None:
            on_classes, everywhere = self.calibration_error
            rows["calibration_error"] = round(on_classes, 4)
            if self.has_other:
                rows["calibration_error_with_other"] = round(everywhere, 4)
        if self.objects is not None:
            rows["objects"] = _objects_row(self.objects)
        if self.empty:
            shares = [
                f"{name} {found['right'] / found['pixels']:.1%} of {found['pixels']} pixels"
                for name, found in self.empty.items()
            ]
            rows["without_surface"] = f"judged apart, nothing is hit: {'  '.join(shares)}"
        return rows


def _open_figures(found: dict) -> str:
    other = found["other"]
    given = f"{other['given_class']:.1%} of {other['pixels']} px of other given a class"
    shares = [f"{name} ({_listed(found[name])})" for name in ("precision", "recall")]
    return "  ".join([f"{given} ({_listed(other['given'])})", *shares])


def _objects_row(found: dict) -> str:
    """PQ of what is counted, and of each of its classes with the number of objects."""
    parts = [
        f"{name} {entry['pq']:.1%} ({entry['matched']} of {entry['true']}, {entry['found']} found)"
        for name, entry in found["classes"].items()
    ]
    return f"PQ {found['pq']:.1%}  ({'  '.join(parts)})"


def _listed(shares: dict[str, float]) -> str:
    return "  ".join(f"{name} {value:.1%}" for name, value in shares.items())


def evaluate_scene(scene: Scene, settings: Evaluate) -> EvaluationSummary:
    """Judge the labelled cloud of a scene (or `settings.labelled`) by its truth masks and write the
    figures. By tiles, with the same signature: `tiling.evaluate`.
    """
    path = settings.labelled or scene.labelled
    cloud, labels = read_labelled(path, "propagate")
    surface = LabelledSurface.build(cloud, scene.model.views, scene.surface)
    found = None
    if knows_objects(scene):
        instance = instances_of(cloud, path)
        found = judge_objects(scene, surface.index, surface.reach, labels.label, instance)
    return judge(scene, settings, surface, labels, found)


def knows_objects(scene: Scene) -> bool:
    """Whether the scene has a true cloud that tells objects apart."""
    path = scene.truth_cloud
    vertex = read_header(path).element("vertex") if path.is_file() else None
    names = {entry.name for entry in vertex.properties} if vertex else set()
    return {"label", INSTANCE} <= names


def judge_objects(
    scene: Scene, index: NeighborIndex, reach: float, label: np.ndarray, instance: np.ndarray | None
) -> dict | None:
    """Panoptic quality at the points of the true cloud, by the nearest point of the labelled one; None
    where it cannot be told. label, instance: (N,) of the labelled cloud; reach: farther points are none,
    world units
    """
    path, table = scene.truth_cloud, scene.class_table()
    if instance is None:
        logger.warning(
            "the labelled cloud tells no objects apart, so that they are not judged: run `sc3d propagate`"
            " again"
        )
        return None
    truth = read_cloud(path)
    rows, distances = index.nearest(truth.point.positions.numpy(), 1)
    near = distances[:, 0] <= reach
    if near.mean() < LEAST_NEAR:
        logger.warning(
            "objects are not judged: %.0f%% of the points of %s have a labelled point nearby: it is in another"
            " frame, or of another place",
            100 * near.mean(),
            path,
        )
        return None
    true, found = (
        Segments(truth.point["label"].numpy().ravel(), truth.point[INSTANCE].numpy().ravel()),
        Segments(*(np.where(near, values[rows[:, 0]], 0) for values in (label, instance))),
    )
    return summarize(panoptic_quality(true, found, table), table)


def judge(
    scene: Scene, settings: Evaluate, surface: SeenCloud, labels: Labels, objects: dict | None = None
) -> EvaluationSummary:
    """Judge labels, and the scene's masks, at every pixel that has truth, and write `metrics.json`.
    objects: what `judge_objects` returns
    """
    table, truth_files = scene.class_table(), truth_masks(scene, settings)
    mask_files = scene.mask_files(scene.masks, table) if scene.masks.is_dir() else {}
    views = [view for view in scene.model.views if view.name in truth_files]
    _tell_of_left_out(scene, [view.name for view in views], mask_files)
    per_photo, reliabilities, with_other, empty = {}, [], [], list[np.ndarray]()
    for view in progress(views, "evaluating", "photo"):
        truth = scene.read_truth(truth_files[view.name], view.name, settings.zero_margin)
        rows, first = surface.rows(view, truth.shape[::-1], truth > 0)
        empty.append(_count_empty(truth, first.range, table))
        truth[table.shows_no_surface(truth)] = 0
        pixels = EvaluationPixels.from_photo(truth, rows, depth_edge_band(first.range, settings.band))
        near, elsewhere = pixels.confusions(pixels.look_up(labels.label), table.num_ids)
        found = {"labels": near + elsewhere, "labels_near_edges": near, "labels_elsewhere": elsewhere}
        if view.name in mask_files:
            mask = scene.read_mask(mask_files[view.name], view.name)
            mask = cv2.resize(mask, truth.shape[::-1], interpolation=cv2.INTER_NEAREST)
            found["masks"] = Confusion.from_labels(truth, mask, table.num_ids)
        per_photo[view.name] = found
        reliabilities.append(pixels.reliability(labels.label, labels.confidence, table.num_ids))
        with_other.append(pixels.reliability(labels.label, labels.confidence, table.num_ids, other=True))
    masked = any("masks" in photo for photo in per_photo.values())
    sources = SOURCES if masked else [key for key in SOURCES if key != "masks"]
    parts = {key: [photo[key] for photo in per_photo.values() if key in photo] for key in sources}
    totals = {key: total(found, table.num_ids).summary(table) for key, found in parts.items()}
    overall = [Reliability.merge(found) for found in (reliabilities, with_other) if found]
    photos = {
        name: {key: found[key].summary(table) for key in SOURCES if key in found}
        for name, found in per_photo.items()
    }
    nothing = _empty_figures(empty, table)
    metrics: dict[str, object] = {"photos": [view.name for view in views]}
    metrics["classes"] = [entry.name for entry in table]
    metrics |= totals | ({"without_surface": nothing} if nothing else {})
    metrics |= {"panoptic": objects} if objects else {}
    metrics |= {
        name: found.summary()
        for name, found in zip(("reliability", "reliability_with_other"), overall, strict=False)
    }
    write_json(settings.output or scene.metrics, {"reliability": {}} | metrics | {"per_photo": photos})
    errors = (overall[0].ece, overall[1].ece) if overall else None
    return EvaluationSummary(totals, errors, nothing, objects)


def _count_empty(truth: np.ndarray, ranges: np.ndarray, table: ClassTable) -> np.ndarray:
    """(2, C) int64 pixels of each class without surface in a truth mask, and those where nothing is hit.

    truth: (H, W) uint8 ids; ranges: (H, W) of the first surface, inf = nothing; the order is the table's
    """
    shown = [truth == entry.id for entry in table.without_surface]
    counts = [[pixels.sum(), (pixels & ~np.isfinite(ranges)).sum()] for pixels in shown]
    return np.array(counts, np.int64).reshape(-1, 2).T


def _empty_figures(counts: list[np.ndarray], table: ClassTable) -> dict[str, dict[str, int]]:
    """Sums of `_count_empty` by class, of those that the truth shows."""
    if not counts:
        return {}
    names = [entry.name for entry in table.without_surface]
    return {
        name: {"pixels": int(pixels), "right": int(right)}
        for name, pixels, right in zip(names, *np.sum(counts, axis=0), strict=True)
        if pixels
    }


def _tell_of_left_out(scene: Scene, judged: list[str], mask_files: dict[str, Path]) -> None:
    names = [view.name for view in scene.model.views]
    untold = sorted(set(names) - set(judged))
    bare = [name for name in judged if name not in mask_files]
    if untold:
        logger.info(left_out(untold, len(names), "photos have no truth and are not judged"))
    if mask_files and bare:
        logger.warning(
            left_out(bare, len(judged), "photos with truth have no mask; masks are judged without")
        )


def truth_masks(scene: Scene, settings: Evaluate) -> dict[str, Path]:
    """Truth mask of each view that has one; InputError if there are none, or if they judge no pixel."""
    folder, table = settings.truth or scene.truth, scene.class_table()
    scene.require(folder, hint="pass --truth FOLDER with manual masks")
    if settings.zero_margin is not None and not table.leaves_other:
        raise InputError(
            f"{scene.classes} has a class with id {OTHER} or above, so that truth cannot mark other: "
            "give it a smaller id"
        )
    files = scene.mask_files(folder, table, truth=True)
    if not any(scene.read_truth(file, name, settings.zero_margin).any() for name, file in files.items()):
        raise InputError(
            f"no pixel of the {len(files)} truth masks in {folder} is judged: they hold only 0 and 255; "
            "if 0 means that none of the classes is there, pass --truth-zero other"
        )
    return files
