"""One pass per view over all points: projection, visibility, weights and votes, fused (slow twin:
tests/test_voting.py).

Points are sorted by cell once. A thread owns whole blocks of cells, so votes need no atomics; they are
integers, so no order matters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numba
import numpy as np

from sc3d.geometry.cameras import View, opencv_parameters, project
from sc3d.geometry.voxels import SIDES, VOXELS, LabelGrid, VoxelOrder, normal_sides, sort_by_voxel
from sc3d.labelling.density import voxel_shares
from sc3d.labelling.verification import Places, VoteLog, neighbor_blocks, verify
from sc3d.labelling.voting_kernels import (
    SCALE,
    CameraParameters,
    Observation,
    SortedCloud,
    VoteWeighting,
    cast_votes,
)

CHUNK = 500_000  # points projected by pycolmap at a time


class ViewVotes(NamedTuple):
    """What one view says about each cell: (K,) uint8 label with the most weight, 0 = nothing; (K,) uint16
    that weight, fixed point.
    """

    labels: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True)
class VoteAccumulator:
    """Votes of all views. Channel 0 of the votes counts views, because label 0 never votes.

    cloud: the points; order: (N,) rows of the sorted points in the given cloud; field_cells: (K,) int64 row
        of each cell in `LabelGrid.votes`
    block_keys: (B,) int64 packed positions of the blocks, rising
    votes, strict: (K, num_ids) int32, the second without mask edges, grazing views and doubtful depth
    overlay: (N,) uint8 label of the last view that saw a point, sorted; log: the votes view by view
    """

    cloud: SortedCloud
    order: np.ndarray
    field_cells: np.ndarray
    block_keys: np.ndarray
    votes: np.ndarray
    strict: np.ndarray
    overlay: np.ndarray
    log: VoteLog

    def cast(self, view: View, picture: Observation, rules: VoteWeighting) -> None:
        """Add one view: each cell gets the mean of its sightings."""
        said = ViewVotes(np.zeros(len(self.votes), np.uint8), np.zeros(len(self.votes), np.uint16))
        cast_votes(
            self.cloud,
            camera_parameters(view, self.cloud.points),
            picture,
            rules,
            self.votes,
            self.strict,
            self.overlay,
            *said,
        )
        self.log.append(*said)

    def verified(self, winner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Votes (K, num_ids) with each view's reliability, and which cells pass (K,) bool, as
        `verification.verify` has it; winner: (K,) uint8.
        """
        of_cell = np.repeat(np.arange(len(self.cloud.blocks) - 1), np.diff(self.cloud.blocks))
        votes = self.votes.copy()
        passed = verify(self.log, winner, Places(of_cell, neighbor_blocks(self.block_keys)), SCALE, votes)
        return votes, passed

    def to_points(self, values: np.ndarray) -> np.ndarray:
        """(N, ...) in the order of the given cloud, from (K, ...) per cell."""
        result = np.empty((len(self.order), *values.shape[1:]), values.dtype)
        result[self.order] = np.repeat(values, np.diff(self.cloud.cells), axis=0)
        return result


class Points(Protocol):
    """points: (N, 3) world; normals: (N, 3) float32 or None; density: (N,) float32 or None."""

    points: np.ndarray
    normals: np.ndarray | None
    density: np.ndarray | None


def open_accumulator(
    given: Points, origin: np.ndarray, voxel_size: float, num_ids: int
) -> tuple[VoteAccumulator, LabelGrid]:
    """Sort the points into cells of a grid with its zero at `origin` (3,) world; no votes yet."""
    points, normals, density = given.points, given.normals, given.density
    sorting = sort_by_voxel(points, voxel_size, origin)
    field = LabelGrid.from_voxels(sorting, num_ids)
    order, cells, field_cells, facing = _cells(sorting, normals, field)
    blocks = np.flatnonzero(np.diff(field_cells // (VOXELS * SIDES), prepend=-1))
    blocks = np.append(blocks, len(field_cells))
    centers, radii = np.empty((len(blocks) - 1, 3)), np.empty(len(blocks) - 1)
    ordered = np.ascontiguousarray(points[order], np.float64)
    _bound(ordered, cells, blocks, centers, radii)
    turned = (
        np.empty((0, 3), np.float32) if normals is None else np.ascontiguousarray(normals[order], np.float32)
    )
    votes = np.zeros((len(field_cells), num_ids), np.int32)
    weights = np.empty(0, np.uint16) if density is None else voxel_shares(density, sorting)[order]
    cloud = SortedCloud(ordered, turned, weights, cells, blocks, facing, centers, radii)
    return VoteAccumulator(
        cloud,
        order,
        field_cells,
        np.unique(sorting.keys // VOXELS),
        votes,
        np.zeros_like(votes),
        np.zeros(len(points), np.uint8),
        VoteLog(),
    ), field


def camera_parameters(view: View, points: np.ndarray) -> CameraParameters:
    """A view for kernels; `points` (N, 3) are projected here if the camera's model needs pycolmap."""
    parameters = opencv_parameters(view.camera)
    pixels = np.empty((0, 2))
    if parameters is None:
        parameters, pixels = (
            np.zeros(8),
            np.concatenate(
                [project(view, points[start : start + CHUNK])[0] for start in range(0, len(points), CHUNK)]
            ),
        )
    return CameraParameters(
        view.cam_from_world,
        view.center,
        view.cone_cosine,
        view.frustum,
        view.width,
        view.height,
        parameters,
        pixels,
    )


def _cells(
    sorting: VoxelOrder, normals: np.ndarray | None, field: LabelGrid
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Order of the points by cell, first point of each cell and, per cell, its row in the field's votes and
    whether its points must face the camera.
    """
    voxel_cells = field.find_keys(sorting.keys)
    if normals is None:
        return sorting.order, sorting.starts, voxel_cells, np.zeros(len(voxel_cells), bool)
    sides, flat = normal_sides(normals, sorting)
    sides = sides[sorting.order]
    order = np.empty_like(sorting.order)
    counts = np.empty((len(sorting.keys), SIDES), np.int64)
    _partition(sorting.order, sorting.starts, sides, order, counts)
    used = counts.ravel() > 0
    cells = np.append(0, np.cumsum(counts.ravel()[used]))
    return order, cells, (voxel_cells[:, None] + np.arange(SIDES)).ravel()[used], np.repeat(flat, SIDES)[used]


@numba.njit(parallel=True, cache=True)
def _partition(order, starts, sides, result, counts):
    """Within each voxel, points of side 0 before those of side 1."""
    for voxel in numba.prange(len(starts) - 1):
        at = starts[voxel]
        for side in range(SIDES):
            before = at
            for k in range(starts[voxel], starts[voxel + 1]):
                if sides[k] == side:
                    result[at] = order[k]
                    at += 1
            counts[voxel, side] = at - before


@numba.njit(parallel=True, cache=True)
def _bound(points, cells, blocks, centers, radii):
    """Arrays as in SortedCloud."""
    for block in numba.prange(len(blocks) - 1):
        first, last = cells[blocks[block]], cells[blocks[block + 1]]
        squared = 0.0
        for axis in range(3):
            low = high = points[first, axis]
            for k in range(first, last):
                low, high = min(low, points[k, axis]), max(high, points[k, axis])
            centers[block, axis] = (low + high) / 2
            squared += (high - low) ** 2 / 4
        radii[block] = np.sqrt(squared) * (1 + 1e-9)
