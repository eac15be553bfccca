"""Semantic confidence voting: one pass per view over all points, with projection, visibility, weights and
votes fused (slow twin: tests/labelling/test_voting.py).

Points are sorted by cell once; a cell is one side of a voxel that holds points. A thread owns whole blocks of cells,
so votes need no atomics; they are integers, so no order matters. What takes records of arrays is inlined: a call
would count references to every array for every point (3 times slower).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np

from sc3d.geometry.cameras import View, opencv_parameters, project
from sc3d.geometry.raycast import MIN_COSINE, RANGE_TOLERANCE
from sc3d.geometry.voxels import (
    SIDES,
    VOXELS,
    LabelGrid,
    VoxelOrder,
    normal_sides,
    sort_by_voxel,
    voxel_origin,
)
from sc3d.labelling.cloud import Cloud, CloudExtent
from sc3d.labelling.density import voxel_shares
from sc3d.labelling.observation import Observation
from sc3d.labelling.verification import VoteLog, verify
from sc3d.settings.labels import Label

SCALE = 4096  # one full vote in fixed point
MIN_WEIGHT = 0.05
GRAZING = float(np.cos(np.deg2rad(75.0)))
STRICT_EXCESS = 0.5  # reprojection halves the depth tolerance
CONE_MARGIN = 1e-6  # of the cosine, as in `cameras.project`
POINTS_AT_ONCE = 500_000  # projected by pycolmap


class SortedCloud(NamedTuple):
    """Points sorted by cell.

    points: (N, 3) float64 world; normals: (N, 3) float32, or (0, 3) if there are none
    density: (N,) uint16 weight of each point among those of its cell, or (0,) if all weigh the same
    cells: (K + 1,) int64 first point of each cell; rows: (K,) int64 row of each cell in the `LabelGrid`'s votes
    blocks: (B + 1,) int64 first cell of each block
    facing: (K,) bool, points of the cell must face the camera to be seen
    centers: (B, 3), radii: (B,) float64 spheres around the blocks' points, world
    """

    points: np.ndarray
    normals: np.ndarray
    density: np.ndarray
    cells: np.ndarray
    rows: np.ndarray
    blocks: np.ndarray
    facing: np.ndarray
    centers: np.ndarray
    radii: np.ndarray


class CameraParameters(NamedTuple):
    """A view for kernels.

    cam_from_world: (4, 4); center: (3,) world; cone, frustum: as in `View`; width, height: px
    parameters: (8,) as in `opencv_parameters`; unused if pixels: (N, 2) float64 holds the projections of all points,
        else (0, 2)
    """

    cam_from_world: np.ndarray
    center: np.ndarray
    cone: float
    frustum: np.ndarray
    width: int
    height: int
    parameters: np.ndarray
    pixels: np.ndarray

    @classmethod
    def from_view(cls, view: View, points: np.ndarray) -> CameraParameters:
        """points: (N, 3) world, which are projected here if the camera's model needs pycolmap."""
        parameters, pixels = opencv_parameters(view.camera), np.empty((0, 2))
        if parameters is None:
            starts = range(0, len(points), POINTS_AT_ONCE)
            pixels = np.concatenate(
                [project(view, points[start : start + POINTS_AT_ONCE])[0] for start in starts]
            )
            parameters = np.zeros(8)
        size = view.width, view.height
        return cls(
            view.cam_from_world, view.center, view.cone_cosine, view.frustum, *size, parameters, pixels
        )


class VoteWeighting(NamedTuple):
    """How a sighting is weighed: which factors count (the others are 1), and the depth at which the range factor is 1;
    `equal` = all weigh 1; `second` = strict sightings are also voted on apart; `none` = channel of the
    votes for none of the classes, 0 = there is none.
    """

    voxel_size: float
    reference_depth: float
    excess: bool
    incidence: bool
    range: bool
    equal: bool
    second: bool
    none: int = 0

    @classmethod
    def from_settings(
        cls, settings: Label, extent: CloudExtent, views: list[View], none: int = 0
    ) -> VoteWeighting:
        """The range factor is 1 at the median distance between the cameras and the middle of the cloud."""
        distances = [np.linalg.norm(view.center - extent.median) for view in views]
        reference, factors = float(np.median(distances)) if views else 1.0, settings.mechanisms
        equal = settings.method in ("direct", "majority")
        switches = factors.depth_excess, factors.incidence, factors.range, equal, factors.reproject
        return cls(settings.voxel_size, reference, *switches, none)


class ViewVotes(NamedTuple):
    """What one view says about each cell: (K,) uint8 label with the most weight, 0 = nothing; (K,) uint16 that weight,
    fixed point.
    """

    labels: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True)
class VoteAccumulator:
    """Votes of all views. Channel 0 of the votes counts views, because label 0 never votes.

    cloud: the points; order: (N,) rows of the sorted points in the given cloud
    grid: the label field, to whose rows `cloud.rows` the votes are added
    strict: (K, num_channels) int32 votes without mask edges, grazing views and doubtful depth; (0, num_channels) if not wanted
    overlay: (N,) uint8 label of the last view that saw a point, sorted; log: the votes view by view
    looked: (K,) int32 views that saw a cell, whether they name a class or none
    """

    cloud: SortedCloud
    order: np.ndarray
    grid: LabelGrid
    strict: np.ndarray
    overlay: np.ndarray
    log: VoteLog
    looked: np.ndarray

    @classmethod
    def for_cloud(
        cls, cloud: Cloud, voxel_size: float, num_channels: int, second: bool = False
    ) -> VoteAccumulator:
        """No votes yet. num_channels: classes + 1; second: keep the strict votes too."""
        voxels = sort_by_voxel(cloud.points, voxel_size, voxel_origin(cloud.extent.low, voxel_size))
        grid = LabelGrid.from_voxels(voxels, num_channels)
        points, order = _sorted_cloud(cloud, voxels, grid)
        strict = np.zeros((len(points.rows) if second else 0, num_channels), np.int32)
        overlay, looked = np.zeros(len(order), np.uint8), np.zeros(len(points.rows), np.int32)
        return cls(points, order, grid, strict, overlay, VoteLog(), looked)

    def add_view(self, view: View, observation: Observation, weighting: VoteWeighting) -> None:
        """Add one view: each cell gets the mean of its sightings."""
        view_votes = ViewVotes(
            np.zeros(len(self.cloud.rows), np.uint8), np.zeros(len(self.cloud.rows), np.uint16)
        )
        camera = CameraParameters.from_view(view, self.cloud.points)
        votes = self.grid.votes
        counts = votes, self.strict, self.overlay, self.looked
        cast_votes(self.cloud, camera, observation, weighting, *counts, view_votes)
        self.log.append(*view_votes)

    def add_prior(self, label: np.ndarray, weight: float) -> None:
        """Add what another program says of each point, as so many views that agree would: label (N,) uint8 channels in
        the order of the given cloud, 0 = nothing.
        """
        cell = np.repeat(np.arange(len(self.cloud.rows)), np.diff(self.cloud.cells))
        said, channels = label[self.order], self.grid.votes.shape[1]
        flat = np.bincount(cell * channels + said, minlength=len(self.cloud.rows) * channels)
        counts = flat.reshape(-1, channels)
        counts[:, 0] = 0
        total = counts.sum(axis=1)
        shares = int(weight * SCALE + 0.5) * counts // np.maximum(total, 1)[:, None]
        heard, views = total > 0, max(1, round(weight))
        self.grid.votes[self.cloud.rows[heard]] += shares[heard].astype(np.int32)
        self.grid.votes[self.cloud.rows[heard], 0] += views
        self.looked[heard] += views
        self.log.append(shares.argmax(axis=1).astype(np.uint8), shares.max(axis=1).astype(np.uint16))

    @property
    def votes(self) -> np.ndarray:
        """(K, num_channels) int32 copy of the votes of all cells."""
        return self.grid.votes[self.cloud.rows]

    def verify(self, winner: np.ndarray, reweigh: bool, none: int = 0) -> np.ndarray:
        """(K,) bool, which cells pass the two-way verification; see `verification.verify`. winner: (K,)
        uint8; none: as in `VoteWeighting`; these votes keep their share.
        """
        if not none:
            return verify(self.log, winner, self.grid, self.cloud.rows, SCALE, reweigh)
        votes, rows = self.grid.votes, self.cloud.rows
        silent, before = votes[rows, none].astype(np.int64), votes[rows, 1:none].sum(axis=1, dtype=np.int64)
        passed = verify(self.log, winner, self.grid, rows, SCALE, reweigh)
        after = votes[rows, 1:none].sum(axis=1, dtype=np.int64)
        votes[rows, none] = np.where(before > 0, silent * after // np.maximum(before, 1), silent)
        return passed

    def to_points(self, values: np.ndarray) -> np.ndarray:
        """(N, ...) in the order of the given cloud, from (K, ...) per cell."""
        result = np.empty((len(self.order), *values.shape[1:]), values.dtype)
        result[self.order] = np.repeat(values, np.diff(self.cloud.cells), axis=0)
        return result


def _sorted_cloud(cloud: Cloud, voxels: VoxelOrder, grid: LabelGrid) -> tuple[SortedCloud, np.ndarray]:
    """The points by cell, and (N,) which points of the given cloud these are."""
    order, cells, rows, facing = _cells(cloud.normals, voxels, grid)
    blocks = np.append(np.flatnonzero(np.diff(rows // (VOXELS * SIDES), prepend=-1)), len(rows))
    centers, radii = np.empty((len(blocks) - 1, 3)), np.empty(len(blocks) - 1)
    points = np.ascontiguousarray(cloud.points[order], np.float64)
    _bound(points, cells, blocks, centers, radii)
    normals, weights = np.empty((0, 3), np.float32), np.empty(0, np.uint16)
    if cloud.normals is not None:
        normals = np.ascontiguousarray(cloud.normals[order], np.float32)
    if cloud.density is not None:
        weights = voxel_shares(cloud.density, voxels)[order]
    return SortedCloud(points, normals, weights, cells, rows, blocks, facing, centers, radii), order


def _cells(normals: np.ndarray | None, voxels: VoxelOrder, grid: LabelGrid) -> tuple[np.ndarray, ...]:
    """Order of the points by cell, first point of each cell and, per cell, its row in the grid's votes and whether its
    points must face the camera.
    """
    rows = grid.find_voxels(voxels.keys) * SIDES
    if normals is None:
        return voxels.order, voxels.starts, rows, np.zeros(len(rows), bool)
    sides, flat = normal_sides(normals, voxels)
    sides, order = sides[voxels.order], np.empty_like(voxels.order)
    counts = np.empty((len(voxels.keys), SIDES), np.int64)
    _partition(voxels.order, voxels.starts, sides, order, counts)
    used = counts.ravel() > 0
    cells = np.append(0, np.cumsum(counts.ravel()[used]))
    return order, cells, (rows[:, None] + np.arange(SIDES)).ravel()[used], np.repeat(flat, SIDES)[used]


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


@numba.njit(cache=True, error_model="numpy", inline="always")
def to_camera(camera, x, y, z):
    """Camera frame of a world position."""
    pose = camera.cam_from_world
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3],
    )


@numba.njit(cache=True, error_model="numpy", inline="always")
def to_pixel(parameters, x, y, z):
    """Pixel of a position in the camera frame, z > 0, by COLMAP's OPENCV model."""
    u, v = x / z, y / z
    k1, k2, p1, p2 = parameters[4], parameters[5], parameters[6], parameters[7]
    squared = u * u + v * v
    radial = squared * (k1 + k2 * squared)
    du = u * radial + 2 * p1 * u * v + p2 * (squared + 2 * u * u)
    dv = v * radial + 2 * p2 * u * v + p1 * (squared + 2 * v * v)
    return parameters[0] * (u + du) + parameters[2], parameters[1] * (v + dv) + parameters[3]


@numba.njit(cache=True, error_model="numpy", inline="always")
def _in_frustum(camera, center, radius):
    """Whether a sphere may reach into the pyramid that holds the image."""
    x, y, z = to_camera(camera, center[0], center[1], center[2])
    inside = True
    for side in range(4):
        inside &= camera.frustum[side, 0] * x + camera.frustum[side, 1] * y + camera.frustum[
            side, 2
        ] * z <= radius + 1e-9 * abs(z)
    return inside


@numba.njit(cache=True, error_model="numpy", inline="always")
def _visibility(cloud, camera, observation, weighting, cell, point):
    """Row (-1 = not seen), column, weight and whether the sighting is strict, of one point."""
    nothing = -1, -1, 0.0, False
    x, y, z = cloud.points[point, 0], cloud.points[point, 1], cloud.points[point, 2]
    left, top, depth = to_camera(camera, x, y, z)
    distance = np.sqrt(left * left + top * top + depth * depth)
    if not (distance > 0 and depth >= (camera.cone - CONE_MARGIN) * distance):
        return nothing
    occluding, cosine = observation.ranges.size > 0, 1.0
    if cloud.normals.shape[0]:
        nx, ny, nz = cloud.normals[point, 0], cloud.normals[point, 1], cloud.normals[point, 2]
        cosine = (
            nx * (camera.center[0] - x) + ny * (camera.center[1] - y) + nz * (camera.center[2] - z)
        ) / distance
        if occluding and cosine <= 0 and cloud.facing[cell]:
            return nothing
        cosine = abs(cosine)
    if camera.pixels.shape[0]:
        u, v = camera.pixels[point, 0], camera.pixels[point, 1]
    else:
        u, v = to_pixel(camera.parameters, left, top, depth)
    if not (u >= 0 and v >= 0 and u < camera.width and v < camera.height):
        return nothing
    row, column, excess = int(v), int(u), 0.0
    if occluding:
        tolerance = max(weighting.voxel_size, RANGE_TOLERANCE * distance) / max(cosine, MIN_COSINE)
        excess = max(distance - observation.ranges[row, column], 0.0) / tolerance
        if excess > 1:
            return nothing
    weight = 1.0
    if not weighting.equal:
        weight = np.float64(observation.weights[row, column])
        weight *= np.exp(-excess) if weighting.excess and excess > 0 else 1.0
        weight *= cosine if weighting.incidence else 1.0
        weight *= min(weighting.reference_depth / depth, 1.0) if weighting.range else 1.0
        weight = min(max(weight, MIN_WEIGHT), 1.0)
    return (
        row,
        column,
        weight,
        weighting.second
        and observation.strict[row, column]
        and excess <= STRICT_EXCESS
        and cosine >= GRAZING,
    )


@numba.njit(parallel=True, cache=True, error_model="numpy")
def cast_votes(cloud, camera, observation, weighting, votes, strict, overlay, looked, view_votes):
    """Add a view to votes (rows, num_channels) int32 of the grid, and to strict, overlay and looked as in
    `VoteAccumulator`; fill view_votes.
    """
    num_channels, labels, weights = votes.shape[1], view_votes.labels, view_votes.weights
    for block in numba.prange(len(cloud.blocks) - 1):
        if not _in_frustum(camera, cloud.centers[block], cloud.radii[block]):
            continue
        sums = np.zeros((2, num_channels), np.int64)  # row 1: strict sightings only
        for cell in range(cloud.blocks[block], cloud.blocks[block + 1]):
            count = strict_count = silent = silent_count = 0
            for point in range(cloud.cells[cell], cloud.cells[cell + 1]):
                row, column, weight, is_strict = _visibility(
                    cloud, camera, observation, weighting, cell, point
                )
                label = observation.labels[row, column] if row >= 0 else 0
                if label == 0:
                    continue
                share = np.int64(cloud.density[point]) if cloud.density.shape[0] else 1
                fixed = np.int64(weight * SCALE + 0.5) * share
                if label == weighting.none:
                    silent += fixed
                    silent_count += share
                    continue
                overlay[point] = label
                sums[0, label] += fixed
                count += share
                if is_strict:
                    sums[1, label] += fixed
                    strict_count += share
            if silent_count:
                votes[cloud.rows[cell], weighting.none] += silent // (silent_count + count)
            if silent_count + count:
                looked[cell] += 1
            if strict_count:
                _add_mean(sums, 1, strict_count, strict, cell)
            if count:
                labels[cell], weights[cell] = _add_mean(sums, 0, count, votes, cloud.rows[cell])


@numba.njit(cache=True, error_model="numpy", inline="always")
def _add_mean(sums, which, count, votes, target):
    """Add a view's mean sighting, row `which` of the sums, to row `target` of votes and clear it;
    returns the label with the most weight, and that weight. (A slice for the row would count references.)
    """
    votes[target, 0] += 1
    best = most = 0
    for label in range(1, sums.shape[1]):
        total = sums[which, label]
        if total > 0:
            mean = total // count
            votes[target, label] += mean
            sums[which, label] = 0
            if mean > most or best == 0:
                best, most = label, mean
    return best, most
