"""The kernels of `voting`: one pass per view over all sorted points, and the records that they read.

What takes records of arrays is inlined: a call would count references to every array for every point (3 times
slower).
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from sc3d.geometry.raycast import MIN_COSINE, RANGE_TOLERANCE

SCALE = 4096  # one full vote in fixed point
MIN_WEIGHT = 0.05
GRAZING = float(np.cos(np.deg2rad(75.0)))
STRICT_EXCESS = 0.5  # reprojection halves the depth tolerance
CONE_MARGIN = 1e-6  # of the cosine, as in `cameras.project`


class SortedCloud(NamedTuple):
    """Points sorted by cell; a cell is one side of a voxel that holds points.

    points: (N, 3) float64 world; normals: (N, 3) float32, or (0, 3) if there are none
    density: (N,) uint16 weight of each point among those of its cell, or (0,) if all weigh the same
    cells: (K + 1,) int64 first point of each cell; blocks: (B + 1,) int64 first cell of each block
    facing: (K,) bool, points of the cell must face the camera to be seen
    centers: (B, 3), radii: (B,) float64 spheres around the blocks' points, world
    """

    points: np.ndarray
    normals: np.ndarray
    density: np.ndarray
    cells: np.ndarray
    blocks: np.ndarray
    facing: np.ndarray
    centers: np.ndarray
    radii: np.ndarray


class CameraParameters(NamedTuple):
    """A view for kernels.

    cam_from_world: (4, 4); center: (3,) world; cone, frustum: as in `View`; width, height: px
    parameters: (8,) as in `opencv_parameters`; unused if pixels: (N, 2) float64 holds the projections of all
        points, else (0, 2)
    """

    cam_from_world: np.ndarray
    center: np.ndarray
    cone: float
    frustum: np.ndarray
    width: int
    height: int
    parameters: np.ndarray
    pixels: np.ndarray


class Observation(NamedTuple):
    """What a view says, one value per pixel, (H, W).

    labels: uint8, 0 = does not vote; weights: float32 in [0, 1]; strict: bool, may take part in the second
        vote
    ranges: float32 first surface; (0, 0) = no occlusion test
    """

    labels: np.ndarray
    weights: np.ndarray
    strict: np.ndarray
    ranges: np.ndarray


class VoteWeighting(NamedTuple):
    """How a sighting is weighed: which factors count (the others are 1), and the depth at which the range
    factor is 1; `equal` = all weigh 1;
    `second` = strict sightings are also voted on apart."""

    voxel_size: float
    reference_depth: float
    excess: bool
    incidence: bool
    range: bool
    equal: bool
    second: bool


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
def _visibility(cloud, camera, picture, rules, cell, point):
    """Row (-1 = not seen), column, weight and whether the sighting is strict, of one point."""
    nothing = -1, -1, 0.0, False
    x, y, z = cloud.points[point, 0], cloud.points[point, 1], cloud.points[point, 2]
    left, top, depth = to_camera(camera, x, y, z)
    distance = np.sqrt(left * left + top * top + depth * depth)
    if not (distance > 0 and depth >= (camera.cone - CONE_MARGIN) * distance):
        return nothing
    occluding, cosine = picture.ranges.size > 0, 1.0
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
        tolerance = max(rules.voxel_size, RANGE_TOLERANCE * distance) / max(cosine, MIN_COSINE)
        excess = max(distance - picture.ranges[row, column], 0.0) / tolerance
        if excess > 1:
            return nothing
    weight = 1.0
    if not rules.equal:
        weight = np.float64(picture.weights[row, column])
        weight *= np.exp(-excess) if rules.excess and excess > 0 else 1.0
        weight *= cosine if rules.incidence else 1.0
        weight *= min(rules.reference_depth / depth, 1.0) if rules.range else 1.0
        weight = min(max(weight, MIN_WEIGHT), 1.0)
    return (
        row,
        column,
        weight,
        rules.second and picture.strict[row, column] and excess <= STRICT_EXCESS and cosine >= GRAZING,
    )


@numba.njit(parallel=True, cache=True, error_model="numpy")
def cast_votes(cloud, camera, picture, rules, votes, strict, overlay, said_labels, said_weights):
    """Arrays as in Ballot."""
    num_ids = votes.shape[1]
    for block in numba.prange(len(cloud.blocks) - 1):
        if not _in_frustum(camera, cloud.centers[block], cloud.radii[block]):
            continue
        sums = np.zeros((2, num_ids), np.int64)  # row 1: strict sightings only
        for cell in range(cloud.blocks[block], cloud.blocks[block + 1]):
            count = strict_count = 0
            for point in range(cloud.cells[cell], cloud.cells[cell + 1]):
                row, column, weight, is_strict = _visibility(cloud, camera, picture, rules, cell, point)
                label = picture.labels[row, column] if row >= 0 else 0
                if label == 0:
                    continue
                overlay[point] = label
                share = np.int64(cloud.density[point]) if cloud.density.shape[0] else 1
                fixed = np.int64(weight * SCALE + 0.5) * share
                sums[0, label] += fixed
                count += share
                if is_strict:
                    sums[1, label] += fixed
                    strict_count += share
            if strict_count:
                _add_mean(sums, 1, strict_count, strict, cell)
            if count:
                said_labels[cell], said_weights[cell] = _add_mean(sums, 0, count, votes, cell)


@numba.njit(cache=True, error_model="numpy", inline="always")
def _add_mean(sums, which, count, votes, cell):
    """Add a view's mean sighting, row `which` of the sums, to a cell's votes and clear it; returns the label
    with the most weight, and that weight.
    """
    votes[cell, 0] += 1
    best = most = 0
    for label in range(1, sums.shape[1]):
        total = sums[which, label]
        if total > 0:
            mean = total // count
            votes[cell, label] += mean
            sums[which, label] = 0
            if mean > most or best == 0:
                best, most = label, mean
    return best, most
