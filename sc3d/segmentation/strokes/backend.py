"""Masks from a few strokes, without any model: a pixel classifier on color and texture, cleaned by an
edge-aware filter.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sc3d.errors import InputError, MissingPackageError
from sc3d.io.images import read_image, read_opaque, read_orientation
from sc3d.io.orientation import turned
from sc3d.scene.class_table import ClassTable
from sc3d.segmentation.segment import Segmentation
from sc3d.segmentation.strokes.features import pixel_features
from sc3d.segmentation.strokes.files import BACKGROUND, NOTHING, PhotoStrokes, read_strokes
from sc3d.segmentation.strokes.guided_filter import fit_lines
from sc3d.segmentation.strokes.novelty import Novelty, fit_novelty

logger = logging.getLogger(__name__)

_MIN_PROBABILITY = 1e-4  # smallest probability after filtering
_MIN_PIXELS = 60  # pixels of a stroke that are always learned from, if it has as many
_PIECE_SIDE = 128  # px of the reduced photo
_MAX_SIDE = 4096  # px; larger photos get masks of this size, enlarged


@dataclass(frozen=True)
class StrokesSettings:
    """Settings of the `strokes` backend."""

    max_size: int = 1024
    """Longest side at which photos are looked at, px; outlines follow the full photo all the same."""
    unsure: float = 0.5
    """Pixels whose class is less probable than this stay unlabelled."""
    radius: int = 16
    """Half width of the windows of the edge-aware filter, px at working size."""
    smoothing: float = 0.01
    """Variance of gray values (0 to 1) that counts as an edge; larger smooths more."""
    members: int = 4
    """Networks and forests, each blind to some of the strokes, by which the others' certainty is judged."""
    trees: int = 60
    """Trees of all forests together."""
    steps: int = 700
    """Steps of training per network."""
    pixels: int = 5000
    """Pixels per class and photo that are learned from, at most."""
    calibration_photos: int = 4
    """Photos on whose strokes the certainty is judged, at most; 0 = leave it as it is."""
    require_all: bool = True
    """Every class of the table needs strokes."""
    seed: int = 0
    """Seed of training."""


@dataclass(frozen=True)
class _TrainingPixels:
    """What one photo teaches. features: (N, F); codes: class ids (N,); strokes: (N,) number of the stroke;
    pixels: (N,) place in the reduced photo.
    """

    features: np.ndarray
    labels: np.ndarray
    strokes: np.ndarray
    pixels: np.ndarray


class Strokes:
    """Segmenter that has learned from strokes."""

    def __init__(
        self, classifier, novelty: Novelty | None, label_of_code: np.ndarray, settings: StrokesSettings
    ) -> None:
        """classifier: of codes; novelty: of pixels unlike all strokes; label_of_code: (C,) uint8 class id of
        each code, 0 = background
        """
        self.classifier = classifier
        self.novelty = novelty
        self.label_of_code = label_of_code
        self.settings = settings
        self.temperature = 1.0  # below 1 sharpens probabilities, above 1 blunts them

    @classmethod
    def fit(
        cls,
        folder: Path,
        photos_folder: Path,
        class_table: ClassTable,
        settings: StrokesSettings = StrokesSettings(),
    ) -> Strokes:
        """Learn from all strokes in a folder (see `sc3d.segmentation.strokes.files`) on photos of another.

        Raises InputError if there are none, if one belongs to no photo or class, or if a class has none.
        """
        _check_packages()
        from sc3d.segmentation.strokes.pixel_classifier import Samples, train

        strokes_of = read_strokes(folder, photos_folder, class_table)
        marked = [(photo, _paint(photo, settings.max_size)) for photo in strokes_of]
        marked = [(photo, paint) for photo, paint in marked if (paint[0] != NOTHING).any()]
        drawn, painted = [photo for photo, _ in marked], [paint for _, paint in marked]
        _check_classes([labels for labels, _ in painted], class_table, folder, settings.require_all)
        training = [
            _training_pixels(photo, *paint, photos_folder, settings)
            for photo, paint in zip(drawn, painted, strict=True)
        ]
        labels = np.concatenate([part.labels for part in training])
        label_of_code, codes = np.unique(labels, return_inverse=True)
        strokes = np.concatenate([part.strokes + (index << 40) for index, part in enumerate(training)])
        folds = assign_folds(strokes, codes, settings.members)
        samples = Samples(np.concatenate([part.features for part in training]), codes, folds)
        classifier = train(samples, settings.members, settings.trees, settings.steps, settings.seed)
        learned = cls(
            classifier, fit_novelty(samples.features, folds), label_of_code.astype(np.uint8), settings
        )
        learned.temperature = learned._calibrate(drawn, training, codes, folds, photos_folder)
        logger.info(
            "learned from %d strokes on %d photos; temperature %.2f",
            sum(int(marks.max()) for _, marks in painted),
            len(drawn),
            learned.temperature,
        )
        return learned

    def segment(self, image: np.ndarray) -> Segmentation:
        """Segment a photo.

        image: (H, W, 3) uint8 RGB
        returns: (H, W) uint8 class id, 0 = background or unsure; (H, W) uint8 confidence, probability of the
            class or the background x 255, 0 where unsure or unlike all strokes
        """
        height, width = image.shape[:2]
        small, fine = shrink(image, self.settings.max_size), shrink(image, _MAX_SIDE)
        guide = fine.astype(np.float32) / 255
        best, total = np.zeros(guide.shape[:2], np.float32), np.zeros(guide.shape[:2], np.float32)
        labels, known = np.zeros(guide.shape[:2], np.uint8), np.zeros(guide.shape[:2], bool)
        lines = fit_lines(
            small.astype(np.float32) / 255,
            self._planes(pixel_features(small)),
            self.settings.radius,
            self.settings.smoothing,
        )
        unlike = len(self.label_of_code)
        for code, (label, line) in enumerate(zip([*self.label_of_code, 0], lines, strict=True)):
            weight = self._sharpened(line.apply(guide))
            labels[weight > best], known[weight > best] = label, code < unlike
            total += weight
            np.maximum(best, weight, out=best)
        sure = best / total
        unsure = sure < self.settings.unsure
        labels[unsure] = 0
        confidence = np.where(known & ~unsure, np.clip(np.rint(255 * sure), 1, 255), 0).astype(np.uint8)
        return Segmentation(
            *(
                cv2.resize(values, (width, height), interpolation=cv2.INTER_NEAREST)
                for values in (labels, confidence)
            )
        )

    def _planes(self, features: np.ndarray) -> np.ndarray:
        """(H, W, C + 1) float32 probabilities of the codes, and of none of them."""
        probabilities = self.classifier.probabilities(features)
        unknown = (
            np.zeros(features.shape[:2], np.float32) if self.novelty is None else self.novelty.share(features)
        )
        return np.concatenate([probabilities * (1 - unknown)[..., None], unknown[..., None]], axis=-1)

    def _sharpened(self, plane: np.ndarray) -> np.ndarray:
        return np.clip(plane, _MIN_PROBABILITY, 1) ** np.float32(1 / self.temperature)

    def _calibrate(
        self,
        drawn: list[PhotoStrokes],
        training: list[_TrainingPixels],
        codes: np.ndarray,
        folds: np.ndarray,
        photos_folder: Path,
    ) -> float:
        """The temperature that suits strokes as members see them that did not learn from them, after the
        filter.
        """
        from sc3d.segmentation.strokes.pixel_classifier import best_temperature

        ends = np.cumsum([0, *(len(part.labels) for part in training)])
        found, truth = [np.zeros((0, len(self.label_of_code)), np.float32)], [codes[:0]]
        for index in sorted(range(len(drawn)), key=lambda index: -len(training[index].labels))[
            : self.settings.calibration_photos
        ]:
            part = slice(ends[index], ends[index + 1])
            small = shrink(read_image(drawn[index].photo, photos_folder, shown=True), self.settings.max_size)
            features, guide = pixel_features(small), small.astype(np.float32) / 255
            for member in np.unique(folds[part][folds[part] >= 0]):
                pixels = training[index].pixels[folds[part] == member]
                lines = fit_lines(
                    guide,
                    self.classifier.probabilities(features, int(member)),
                    self.settings.radius,
                    self.settings.smoothing,
                )
                found.append(
                    np.stack(
                        [np.clip(line.apply(guide).ravel()[pixels], _MIN_PROBABILITY, 1) for line in lines],
                        axis=1,
                    )
                )
                truth.append(codes[part][folds[part] == member])
        return best_temperature(np.concatenate(found), np.concatenate(truth))


def assign_folds(strokes: np.ndarray, codes: np.ndarray, num_parts: int) -> np.ndarray:
    """Deal strokes out to parts of about equal size within each class, largest first.

    strokes: (N,) int number of each pixel's stroke; codes: (N,) int of its class
    returns: (N,) int part of each pixel; -1 for classes with a single stroke, which no member can do without
    """
    folds = np.full(len(strokes), -1, np.int64)
    for code in np.unique(codes):
        names, sizes = np.unique(strokes[codes == code], return_counts=True)
        filled = np.zeros(num_parts, np.int64)
        # else the columns of a grid would go to one part each
        shuffled = np.random.default_rng(0).permutation(len(names))
        for index in shuffled[np.argsort(-sizes[shuffled], kind="stable")] if len(names) > 1 else ():
            part = int(filled.argmin())
            filled[part] += sizes[index]
            folds[(codes == code) & (strokes == names[index])] = part
    return folds


def _paint(photo: PhotoStrokes, max_size: int) -> tuple[np.ndarray, np.ndarray]:
    width, height = _shrunk_size(*photo.size, max_size)
    labels, strokes = photo.paint(width, height)
    opaque = read_opaque(photo.photo)
    if opaque is not None:  # what is transparent teaches nothing
        shown = turned(opaque, read_orientation(photo.photo)).astype(np.uint8)
        seen = cv2.resize(shown, (width, height), interpolation=cv2.INTER_NEAREST) > 0
        labels, strokes = np.where(seen, labels, NOTHING).astype(np.int16), np.where(seen, strokes, 0)
    return labels, strokes


def _check_classes(
    painted: list[np.ndarray], class_table: ClassTable, folder: Path, require_all: bool
) -> None:
    """Raise InputError if too little is drawn; painted: per photo (H, W) int16 class ids."""
    present = {int(label) for labels in painted for label in np.unique(labels)} - {NOTHING}
    missing = [entry.name for entry in class_table if entry.id not in present]
    if missing and (require_all or not present):
        raise InputError(
            f"the strokes in {folder} show no {missing[0]!r}: draw some, or take the class out of the class table"
        )
    if len(present) < 2:
        raise InputError(
            f"the strokes in {folder} show one class only: draw others too, or {BACKGROUND} for what belongs to none"
        )


def _training_pixels(
    photo: PhotoStrokes, labels: np.ndarray, strokes: np.ndarray, folder: Path, settings: StrokesSettings
) -> _TrainingPixels:
    """Pixels under the strokes of a photo, a share of each stroke."""
    random = np.random.default_rng([settings.seed, *photo.photo.stem.encode()])
    rows = np.concatenate(
        [
            sample_pixels(strokes.ravel(), labels.ravel() == label, settings.pixels, random)
            for label in np.unique(labels[labels != NOTHING])
        ]
    )
    features = pixel_features(shrink(read_image(photo.photo, folder, shown=True), settings.max_size))
    return _TrainingPixels(
        features.reshape(-1, features.shape[-1])[rows], labels.ravel()[rows], _pieces(strokes, rows), rows
    )


def _pieces(strokes: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(N,) int64 names of the pieces that pixels belong to: large areas are cut along a grid, so that no
    member lacks all of one.

    strokes: (H, W) int32 numbers; pixels: (N,) places in it
    """
    rows, columns = np.divmod(pixels, strokes.shape[1])
    return (
        strokes.ravel()[pixels].astype(np.int64) << 20 | (rows // _PIECE_SIDE) << 10 | columns // _PIECE_SIDE
    )


def sample_pixels(
    strokes: np.ndarray, wanted: np.ndarray, most: int, random: np.random.Generator
) -> np.ndarray:
    """Places of at most about `most` wanted pixels, of each stroke its share, but at least `_MIN_PIXELS` of
    small ones: they correct large ones.

    strokes: (P,) int number of each pixel's stroke; wanted: (P,) bool
    returns: (N,) int places, ascending
    """
    places = random.permutation(np.flatnonzero(wanted))
    order = places[np.argsort(strokes[places], kind="stable")]
    _, starts, sizes = np.unique(strokes[order], return_index=True, return_counts=True)
    shares = np.minimum(sizes, np.maximum(_MIN_PIXELS, sizes * min(1.0, most / sizes.sum())).astype(np.int64))
    rank = np.arange(len(order)) - np.repeat(starts, sizes)
    return np.sort(order[rank < np.repeat(shares, sizes)])


def _shrunk_size(width: int, height: int, max_size: int) -> tuple[int, int]:
    scale = min(1.0, max_size / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def shrink(image: np.ndarray, max_size: int) -> np.ndarray:
    """(h, w, 3) uint8 photo whose longest side is at most `max_size` px."""
    height, width = image.shape[:2]
    size = _shrunk_size(width, height, max_size)
    return image if size == (width, height) else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _check_packages() -> None:
    try:
        import sklearn  # noqa: F401
    except ModuleNotFoundError:
        raise MissingPackageError(
            "the backend strokes needs scikit-learn: pip install scikit-learn"
        ) from None
