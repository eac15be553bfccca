"""What a view says: its mask at the size at which it votes, how much each pixel weighs, and the first surface that
each pixel sees.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numba
import numpy as np

from sc3d.geometry.cameras import View
from sc3d.geometry.raycast import RayTarget, first_surface
from sc3d.labelling.threads import kernels_may_overlap
from sc3d.settings.labels import Label

DISTANCE_STEPS = 16  # of a pixel

Mask = tuple[np.ndarray, np.ndarray | None]  # (h, w) uint8 labels; (h, w) uint8 confidence or None
ReadMask = Callable[[View], Mask]  # mask of a view, any size of the photo's aspect


class Observation(NamedTuple):
    """What a view says, one value per pixel, (H, W).

    labels: uint8, 0 = does not vote; weights: float32 in [0, 1]; strict: bool, may take part in the second vote
    ranges: float32 first surface; (0, 0) = no occlusion test
    """

    labels: np.ndarray
    weights: np.ndarray
    strict: np.ndarray
    ranges: np.ndarray


def observe(
    mask: np.ndarray, confidence: np.ndarray | None, ranges: np.ndarray, edge_width: float
) -> Observation:
    """Weight of each mask pixel: confidence x distance to the mask's edges.

    mask: (H, W) uint8; confidence: (H, W) uint8 or None; ranges: (H, W) float32 or (0, 0); edge_width: px, 0 = off
    """
    edge = edge_distance(mask)
    weights = np.ones(mask.shape, np.float32) if confidence is None else confidence * np.float32(1 / 255)
    if edge_width > 0:
        weigh_distance(edge, distance_weights(edge_width), weights)
    return Observation(mask, weights, edge >= edge_width, ranges)


def observations(
    views: list[View], read_mask: ReadMask, surface: RayTarget | None, settings: Label
) -> Iterator[tuple[View, Observation]]:
    """Views in the order of their names, at the size of their masks, with what they say; the next one is prepared
    meanwhile.
    """
    ordered = sorted(views, key=lambda view: view.name)

    def prepare(view: View) -> tuple[View, Observation]:
        mask, confidence = read_mask(view)
        sized = view.resized(mask.shape[1], mask.shape[0])
        ranges = np.empty((0, 0), np.float32) if surface is None else first_surface(surface, sized).range
        return sized, observe(
            mask, confidence if settings.use_confidence else None, ranges, settings.edge_width
        )

    if not kernels_may_overlap():
        yield from map(prepare, ordered)
        return
    with ThreadPoolExecutor(
        1
    ) as worker:  # what runs on one core only overlaps with the votes of the view before
        pending = [worker.submit(prepare, view) for view in ordered[:1]]
        for following in [*ordered[1:], None]:
            ready = pending.pop().result() if pending else None
            if following is not None:
                pending.append(worker.submit(prepare, following))
            if ready is not None:
                yield ready


def edge_distance(mask: np.ndarray) -> np.ndarray:
    """(H, W) float32 distance of each pixel to the nearest pixel of another label, px; large where there is only one
    label.
    """
    differs = np.zeros(mask.shape, bool)
    differs[:, 1:] |= mask[:, 1:] != mask[:, :-1]
    differs[:, :-1] |= differs[:, 1:]
    vertical = mask[1:] != mask[:-1]
    differs[1:] |= vertical
    differs[:-1] |= vertical
    if not differs.any():
        return np.full(mask.shape, np.float32(sum(mask.shape)))
    return cv2.distanceTransform((~differs).astype(np.uint8), cv2.DIST_L2, 5) + np.float32(0.5)


def distance_weights(width: float) -> np.ndarray:
    """(T,) float32 table of 1 - exp(-distance / width), distance in steps of 1 / DISTANCE_STEPS px; the last entry,
    1, holds from there on.
    """
    steps = np.arange(int(12 * width * DISTANCE_STEPS) + 2)
    table = -np.expm1(-steps / (width * DISTANCE_STEPS)).astype(np.float32)
    table[-1] = 1
    return table


@numba.njit(parallel=True, cache=True)
def weigh_distance(distance, table, weights):
    """Multiply weights (H, W) float32 by the table's entry for each distance (H, W) float32, px; exponentials of all
    pixels would cost 5 times as much.
    """
    for row in numba.prange(distance.shape[0]):
        for column in range(distance.shape[1]):
            step = int(
                min(distance[row, column] * DISTANCE_STEPS + np.float32(0.5), np.float32(len(table) - 1))
            )
            weights[row, column] *= table[step]
