"""Evidence from Gaussians: their rendered depth, checked between the views, after what stereo confirmed."""

from __future__ import annotations

import logging

import cv2
import numba
import numpy as np

from sc3d.errors import Sc3dError, left_out
from sc3d.extraction.evidence import DepthViews, EvidenceStore, ViewEvidence
from sc3d.io.progress import progress
from sc3d.settings.common import DepthMode
from sc3d.splatting.consistency import consistent
from sc3d.splatting.evaluation import facing_depth
from sc3d.splatting.gaussians import Gaussians
from sc3d.stereo.multi_view import patch_costs, planes_of
from sc3d.stereo.pinhole_pairs import GrayView

MAX_ANGLE = 80.0  # degrees between ray and normal
NUM_NEIGHBORS = 6
MAX_COST = 0.8  # 1 - NCC of the photos; with more they support no depth
LOOSE = 4.0  # px; how far two views may disagree where nothing better is known
COHERENT = 0.03  # of the depth, from pixel to pixel of one surface

logger = logging.getLogger(__name__)


def write_rendered(
    gaussians: Gaussians, data: DepthViews, store: EvidenceStore, min_views: int, mode: DepthMode
) -> float:
    """Write the evidence of all views, after that of stereo if the store holds some; returns the median size
    of a pixel on the surface, world units.
    """
    footprint = _render(gaussians, data, store, mode)
    for row in progress(range(len(data.views)), "confirming", "view"):
        store.write(row, _evidence(data, store, row, min_views))
    return footprint


def _render(gaussians: Gaussians, data: DepthViews, store: EvidenceStore, mode: DepthMode) -> float:
    footprints, empty = [], list[str]()
    for row, view in enumerate(progress(data.views, "depth", "view")):
        (depth, normals), (nearest, farthest) = (
            facing_depth(gaussians, view, MAX_ANGLE, mode),
            data.depth_range,
        )
        depth[(depth <= nearest) | (depth >= farthest)] = 0
        store.save(row, "gray", cv2.cvtColor(data.image(row), cv2.COLOR_RGB2GRAY))
        opaque = data.opaque(row)
        if opaque is not None:
            depth[~opaque] = 0
        store.save(row, "rendered", depth)
        store.save(row, "rendered-normals", np.round(127 * normals).astype(np.int8))
        if not (depth > 0).any():
            empty.append(view.name)
        else:
            footprints.append(float(np.median(depth[depth > 0])) / view.focal)
    if empty and footprints:
        logger.warning(left_out(empty, len(data.views), "photos show no surface of the Gaussians"))
    if not footprints:
        raise Sc3dError("no view shows a surface: train longer, or check the cameras")
    return float(np.median(footprints))


def _evidence(data: DepthViews, store: EvidenceStore, row: int, min_views: int) -> ViewEvidence:
    rendered, normals = store.read(row, "rendered"), store.read(row, "rendered-normals")
    neighbors = data.neighbors[row][:NUM_NEIGHBORS]
    others = [(store.read(other, "rendered"), data.views[other]) for other in neighbors]
    strictly, loosely = consistent(rendered, data.views[row], others, 1.0, LOOSE)
    enough, loosely = strictly >= min(min_views, len(neighbors)), loosely >= 1
    confirmed = np.where(enough, rendered, 0).astype(np.float32)
    sky, continued, towards = np.zeros(rendered.shape, bool), np.zeros_like(rendered), normals
    if store.has(row, "sky"):
        given, continued, sky = (store.read(row, name) for name in ("confirmed", "continued", "sky"))
        towards = store.read(row, "normals")
        confirmed = np.where(sky, 0, np.where(given > 0, given, confirmed))
    costs = patch_costs(*_photos(data, store, row), planes_of(data.views[row], rendered, normals))
    store.save(row, "supported", np.where((costs < MAX_COST) | (confirmed != rendered), confirmed, 0))
    goes_on = (loosely | reached(rendered, confirmed > 0)) & (rendered > 0) & ~sky
    return ViewEvidence(
        confirmed,
        np.where(goes_on, rendered, continued).astype(np.float32),
        np.where(goes_on[..., None], normals, towards),
        sky,
    )


def _photos(data: DepthViews, store: EvidenceStore, row: int) -> tuple[GrayView, list[GrayView]]:
    """The gray photo of a view, and those of its neighbors."""
    several = [
        GrayView(data.views[each], store.read(each, "gray").astype(np.float32) / np.float32(255))
        for each in (row, *data.neighbors[row][:NUM_NEIGHBORS])
    ]
    return several[0], several[1:]


@numba.njit(cache=True)
def reached(depth, known):
    """(H, W) bool: pixels that a known one reaches over pixels whose depths differ by less than COHERENT.

    depth: (H, W) float32, 0 = none; known: (H, W) bool. Raster scans forth and back, twice.
    """
    height, width = depth.shape
    found = known.copy()
    for scan in range(4):
        sign = 1 if scan % 2 == 0 else -1
        for i in range(height):
            row = i if sign == 1 else height - 1 - i
            for j in range(width):
                column = j if sign == 1 else width - 1 - j
                if found[row, column] or depth[row, column] <= 0:
                    continue
                for r, c in ((row - sign, column), (row, column - sign)):
                    if 0 <= r < height and 0 <= c < width and found[r, c] and depth[r, c] > 0:
                        if abs(depth[r, c] / depth[row, column] - 1) < COHERENT:
                            found[row, column] = True
    return found
