"""Objects that a segmenter found in a photo: duplicates, one label per pixel, and their file (COCO JSON)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sc3d.errors import InputError
from sc3d.io.json_files import read_json, write_json
from sc3d.scene.class_table import ClassTable
from sc3d.scene.object_image import ObjectImage
from sc3d.segmentation.mask_formats.coco import decompress
from sc3d.segmentation.mask_formats.outlines import OutlineError
from sc3d.segmentation.rle import Window, area, bounds, encode_runs, fill_runs, iou, move_runs

SAME_OBJECT = 0.5  # two masks of one class with a larger intersection over union are one object


@dataclass(frozen=True, eq=False)
class Instance:
    """One object that a segmenter found in a photo.

    runs: (K, 2) int64 runs of the mask (`sc3d.segmentation.rle`)
    size: (height, width) of the photo, px
    class_id: 1 to 255
    box_score, mask_score: 0 to 1, how sure the detector is of the class and the segmenter of the outline
    prompt: text that found it
    """

    runs: np.ndarray
    size: tuple[int, int]
    class_id: int
    box_score: float
    mask_score: float
    prompt: str = ""

    @cached_property
    def score(self) -> float:
        """Box score x mask score; mask scores are regressed and may leave 0 to 1 a little, so both are
        clipped.
        """
        return float(np.clip(self.box_score, 0, 1) * np.clip(self.mask_score, 0, 1))

    @cached_property
    def area(self) -> int:
        """Number of pixels."""
        return area(self.runs)

    @cached_property
    def window(self) -> Window:
        """Smallest window that holds the mask; the mask is not empty."""
        return bounds(self.runs, self.size[0])

    @cached_property
    def rank(self) -> tuple[float, int, int]:
        """Larger is better: higher score, then smaller mask, then lower class id."""
        return self.score, -self.area, -self.class_id


class Areas(NamedTuple):
    """What a model says of every pixel, without telling objects apart: (H, W) uint8 class id; (H, W) uint8
    confidence; both 0 where it says nothing.
    """

    labels: np.ndarray
    confidence: np.ndarray


def useful(instances: list[Instance]) -> list[Instance]:
    """Those with a pixel and a score above 0 (not NaN), the best first."""
    kept = [instance for instance in instances if instance.score > 0 and len(instance.runs)]
    return sorted(
        kept,
        key=lambda instance: (*(-value for value in instance.rank), instance.prompt, instance.runs[0, 0]),
    )


def drop_duplicates(instances: list[Instance]) -> list[Instance]:
    """One instance per object, the best first: an instance goes if a better one of its class has more than
    half of their union in common with it.
    """
    ranked = useful(instances)
    better: dict[int, list[int]] = {}
    for first, second in candidates(ranked, ranked):
        if first < second:
            better.setdefault(second, []).append(first)
    kept: set[int] = set()
    for number, instance in enumerate(ranked):
        rivals = (ranked[other] for other in better.get(number, ()) if other in kept)
        if not any(iou(rival.runs, instance.runs, instance.size[0]) > SAME_OBJECT for rival in rivals):
            kept.add(number)
    return [ranked[number] for number in sorted(kept)]


def candidates(first: list[Instance], second: list[Instance]) -> list[tuple[int, int]]:
    """Numbers of the pairs of instances that are of one class and whose windows overlap, in order."""
    one, other = (
        np.array([(*instance.window, instance.class_id) for instance in part], np.int64).reshape(-1, 5)
        for part in (first, second)
    )
    one, other = one[:, None], other[None]
    pairs = (np.maximum(one[..., :2], other[..., :2]) < np.minimum(one[..., 2:4], other[..., 2:4])).all(
        axis=-1
    ) & (one[..., 4] == other[..., 4])
    return [(int(row), int(column)) for row, column in np.argwhere(pairs)]


def move(instance: Instance, window: Window, size: tuple[int, int]) -> Instance:
    """An instance of a window of a photo as an instance of the photo, of `size` (height, width)."""
    return replace(
        instance, runs=move_runs(instance.runs, instance.size[0], size[0], window.top, window.left), size=size
    )


def merge_instances(
    instances: list[Instance] | tuple[Instance, ...], shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Give every pixel the class of its best instance, whatever the order of the instances.

    instances: those with a score of 0 or NaN are ignored
    shape: (H, W) px
    returns: (H, W) uint8 class id, 0 where there is no instance; (H, W) uint8 confidence, 1 to 255 = score 1,
        0 where unlabelled
    source: highest box score x mask score wins; ties go to the smaller mask, then to the lower class id
    """
    labels, confidence = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    for instance in reversed(useful(list(instances))):  # painted over by better ones
        if tuple(instance.size) != tuple(shape):
            raise InputError(
                f"a mask is {tuple(instance.size)} (rows, columns), but its photo is {tuple(shape)}"
            )
        mask, window = fill_runs(instance.runs, shape[0])
        place = slice(window.top, window.bottom), slice(window.left, window.right)
        labels[place][mask] = instance.class_id
        # at least 1, so that 0 always means unlabelled
        confidence[place][mask] = max(1, round(255 * instance.score))
    return labels, confidence


def fill_gaps(labels: np.ndarray, confidence: np.ndarray, areas: Areas) -> None:
    """Label the pixels that no instance claims by what the model says of every pixel; labels and confidence
    are changed in place.
    """
    empty = labels == 0
    labels[empty], confidence[empty] = areas.labels[empty], areas.confidence[empty]


def paint_areas(areas: Areas, others: Areas, place: Window) -> None:
    """Give pixels of a window what `others` say of them where that is surer; at equal confidence the lower id
    stays. Changes `areas`.

    others: of the window
    """
    window = slice(place.top, place.bottom), slice(place.left, place.right)
    labels, confidence = areas.labels[window], areas.confidence[window]
    better = (others.confidence > confidence) | (
        (others.confidence == confidence) & (confidence > 0) & (others.labels < labels)
    )
    labels[better], confidence[better] = others.labels[better], others.confidence[better]


def write_instances(
    path: Path, photo: str, size: tuple[int, int], instances: tuple[Instance, ...], class_table: ClassTable
) -> None:
    """Write the instances of one photo as a COCO data set of one image, readable by pycocotools, CVAT,
    FiftyOne and others.

    photo: name of the photo; size: (height, width) px
    Each annotation holds category_id (class id), segmentation (compressed RLE), bbox (left, top, width, height
    of the mask, px), area (px), score = box_score x mask_score, and the class name and prompt, which COCO does
    not ask for.
    """
    annotations = [
        _annotation(number, instance, class_table) for number, instance in enumerate(instances, start=1)
    ]
    write_json(
        path,
        {
            "images": [{"id": 1, "file_name": photo, "width": size[1], "height": size[0]}],
            "categories": [{"id": entry.id, "name": entry.name} for entry in class_table],
            "annotations": annotations,
        },
    )


def read_objects(path: Path) -> ObjectImage:
    """What `write_instances` wrote, in the frame of the photo as shown; InputError if it is damaged."""
    content: Any = read_json(path)
    try:
        image, entries = content["images"][0], content["annotations"]
        size = int(image["height"]), int(image["width"])
        ordered = sorted(entries, key=lambda entry: (entry["score"], -entry["area"], -entry["category_id"]))
        numbers = np.zeros(size[0] * size[1], np.int32)
        for number, entry in enumerate(ordered, start=1):  # better ones on top
            edges = np.cumsum(decompress(entry["segmentation"]["counts"]))
            if list(size) != entry["segmentation"]["size"] or edges[-1] != len(numbers):
                raise ValueError("another size")
            for start, end in zip(edges[:-1:2], edges[1::2], strict=False):
                numbers[start:end] = number
        ids = np.array([0, *(entry["category_id"] for entry in ordered)], np.uint8)
    except (KeyError, IndexError, TypeError, ValueError, OverflowError, OutlineError) as error:
        raise InputError(
            f"{path} is not what `sc3d segment` wrote ({error}): delete it, or run `sc3d segment` again"
        ) from None
    return ObjectImage(np.ascontiguousarray(numbers.reshape(size[::-1]).T), ids)


def _annotation(number: int, instance: Instance, class_table: ClassTable) -> dict[str, object]:
    window = instance.window
    return {
        "id": number,
        "image_id": 1,
        "category_id": instance.class_id,
        "name": class_table.name(instance.class_id),
        "prompt": instance.prompt,
        "score": round(instance.score, 6),
        "box_score": round(float(instance.box_score), 6),
        "mask_score": round(float(instance.mask_score), 6),
        "area": instance.area,
        "bbox": [window.left, window.top, window.right - window.left, window.bottom - window.top],
        "iscrowd": 0,
        "segmentation": {"size": list(instance.size), "counts": encode_runs(instance.runs, instance.size)},
    }
