"""Overlapping instances of one photo to one label and one confidence per pixel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sc3d.errors import InputError
from sc3d.segmentation.instances import Instance, useful
from sc3d.segmentation.rle import Window, fill_runs


class Areas(NamedTuple):
    """What a model says of every pixel, without telling objects apart: (H, W) uint8 class id; (H, W) uint8
    confidence; both 0 where it says nothing.
    """

    labels: np.ndarray
    confidence: np.ndarray


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


def paint(areas: Areas, class_id: int, confidence: np.ndarray, place: Window) -> None:
    """Give pixels of a window a class where its confidence is higher than theirs; at equal confidence the
    lower id stays. Changes `areas`.

    confidence: (h, w) uint8 of that class, 0 where it is not present
    """
    window = slice(place.top, place.bottom), slice(place.left, place.right)
    _keep_better(
        areas.labels[window], areas.confidence[window], np.full_like(confidence, class_id), confidence
    )


def paint_areas(areas: Areas, others: Areas, place: Window) -> None:
    """The same with the areas of a window of the photo, such as a tile."""
    window = slice(place.top, place.bottom), slice(place.left, place.right)
    _keep_better(areas.labels[window], areas.confidence[window], *others)


def _keep_better(
    labels: np.ndarray, confidence: np.ndarray, new_labels: np.ndarray, new_confidence: np.ndarray
) -> None:
    better = (new_confidence > confidence) | (new_confidence == confidence) & (new_confidence > 0) & (
        new_labels < labels
    )
    labels[better], confidence[better] = new_labels[better], new_confidence[better]
