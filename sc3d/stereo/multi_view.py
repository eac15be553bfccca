"""Depth of all views of a scene, from coarse to fine.

A pass works on every view by itself and reads what the pass before found for it and its sources, so passes
run on any number of workers and an interrupted one goes on photo by photo. The first pass compares photos
only; in the others a source whose own depth contradicts adds to the cost (Xu and Tao, Multi-Scale Geometric
Consistency Guided Multi-View Stereo, 2019), which settles what little texture leaves open.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from sc3d.geometry.cameras import View, in_image, project, resample
from sc3d.io.atomic import atomic_path
from sc3d.io.images import write_image
from sc3d.scene.depth_map import DepthMap, depth_file, write_depth_map
from sc3d.scene.scene import Scene
from sc3d.stereo.agreement import count_agreements
from sc3d.stereo.completion import (
    Ground,
    continued_planes,
    find_sky,
    fit_ground,
    horizon,
    not_below,
    without_speckles,
)
from sc3d.stereo.given_sky import SKY, SURFACE, GivenSky
from sc3d.stereo.patch_match import WORST, Stereo, evaluate, sweep
from sc3d.stereo.pinhole_pairs import GrayView, smaller, stacked, transfers
from sc3d.tiling.executor import Executor

COARSEST = 200  # px, longest side of the first level is below twice that
NEAR, FARTHEST = 0.35, 10.0  # of the depths of the sparse points that a view sees: 1st and 99th percentile
NEAREST = 0.7  # of the median distance to the sources: closer, their patches are too different
BEYOND = 20.0  # times nearer than NEAR, however close the photos stand
MIN_SPARSE = 8
CELL = 8  # px, side of the cells that start at the depth of the nearest sparse point
MAX_COST = 0.6  # 1 - NCC; more is no match, whatever depths agree
LOOSE = 3.0  # times the disagreement allowed, where nothing better is known: leaves
SURE = 2  # other views that must confirm what goes on
GROUND_POINTS = 10_000  # per view, below its horizon
REACH = 5  # px, from how far a pixel takes planes
AROUND = 8  # sparse points through which a plane is laid
BEGIN = (0.4, 0.3, 0.3)  # shares of pixels that start on such a plane, at the nearest sparse point, anywhere


class Pass(NamedTuple):
    """size: longest side, px; spread: largest random change of the inverse depth, share of its range
    tilt: largest random slope, as tangent of the angle to the image plane
    trials: random changes per pixel and iteration; geometric: whether contradictions cost
    """

    size: int
    iterations: int
    trials: int
    spread: float
    tilt: float
    geometric: bool


def passes(longest: int) -> list[Pass]:
    """All of them, for maps with a longest side of `longest` px."""
    sizes = [longest]
    while sizes[0] >= 2 * COARSEST:
        sizes.insert(0, -(-sizes[0] // 2))
    found = [Pass(sizes[0], 8, 3, 0.5, 1.5, False), Pass(sizes[0], 4, 2, 0.1, 0.7, True)]
    for size in sizes[1:-1]:
        found += [Pass(size, 2, 2, 0.05, 0.5, True), Pass(size, 2, 2, 0.02, 0.3, True)]
    if len(sizes) > 1:
        found.append(Pass(sizes[-1], 2, 1, 0.01, 0.2, True))
    return found


@dataclass(frozen=True)
class StereoJob:
    """What every task needs.

    scene: folder; photo_views: cameras of its photos, by whose names they are found
    views: the same, undistorted
    sources: per view, rows of those it is compared with
    ranges: per view, farthest, usual nearest and nearest inverse depth; seeds: per view, (n, 3) column, row
        and inverse depth of the sparse points that it sees
    longest: side of the maps, px; up: (3,) unit, world
    work: folder of what passes leave; output: folder of the depth maps
    """

    scene: Path
    photo_views: list[View]
    views: list[View]
    sources: list[np.ndarray]
    ranges: list[tuple[float, float, float]]
    seeds: list[np.ndarray]
    longest: int
    up: np.ndarray
    work: Path
    output: Path

    def file(self, number: int, row: int) -> Path:
        """Planes and cost of a view after a pass: (H, W, 4) float32 q, a, b, cost."""
        return self.work / f"{number}-{row}.npy"

    def gray_file(self, row: int) -> Path:
        """The gray photo, (H, W) uint8, of the size of its view."""
        return self.work / f"gray-{row}.npy"

    def checked_file(self, row: int) -> Path:
        """(2, H, W) uint8, how many sources confirm a pixel of the last pass, and how many loosely."""
        return self.work / f"checked-{row}.npy"

    def sky_file(self, row: int) -> Path:
        """(H, W) uint8, what a mask says of the pixels of a view (`given_sky`), if there is one."""
        return self.work / f"sky-{row}.npy"

    def told(self, row: int, what: int) -> np.ndarray:
        """(H, W) bool: pixels of which a mask says so; none without a mask."""
        file, view = self.sky_file(row), self.views[row]
        return np.load(file) == what if file.exists() else np.zeros((view.height, view.width), bool)

    def gray(self, row: int) -> GrayView:
        return GrayView(self.views[row], np.load(self.gray_file(row)).astype(np.float32) / np.float32(255))

    def view(self, number: int, row: int) -> View:
        """The view as large as in a pass."""
        size = passes(self.longest)[number].size
        own = max(self.views[row].width, self.views[row].height)
        return smaller(self.views[row], max(1, round(own * size / self.longest)))


def sparse_seeds(view: View, points: np.ndarray) -> np.ndarray | None:
    """(n, 3) column, row and inverse depth of the (N, 3) points in a view; None for fewer than MIN_SPARSE."""
    pixels, depths = project(view, points)
    usable = in_image(view, pixels) & (depths > 0)
    if usable.sum() < MIN_SPARSE:
        return None
    return np.column_stack([pixels[usable], 1 / depths[usable]])


def inverse_range(seeds: np.ndarray, baseline: float) -> tuple[float, float, float]:
    """Farthest inverse depth to look at; nearest around the (n, 3) seeds; nearest at all: leaves and ground
    before the camera are nearer than what has sparse points. baseline: median distance to the sources, world
    units
    """
    far, near = np.quantile(seeds[:, 2], [0.01, 0.99]) / [FARTHEST, NEAR]
    nearest = min(1 / (NEAREST * baseline), BEYOND * near) if baseline > 0 else near
    return float(far), float(near), float(max(near, nearest))


def estimate_depths(job: StereoJob, tasks: Executor) -> list[tuple[float, float, float, float]]:
    """Write the depth map of every view; returns per view what `finish_view` does."""
    rows = range(len(job.views))
    tasks.run("photos", partial(write_gray, job), rows)
    several = passes(job.longest)
    for number, each in enumerate(several):
        tasks.run(
            f"pass {number + 1} of {len(several)}, {each.size} px", partial(run_pass, job, number), rows
        )
        for row in rows if number >= 2 else ():
            job.file(number - 2, row).unlink(missing_ok=True)
    points = tasks.run("confirming", partial(check_view, job), rows)
    ground = fit_ground(np.concatenate(points), np.array([view.center for view in job.views]), job.up)
    return tasks.run("completing", partial(finish_view, job, ground), rows)


def write_sky(job: StereoJob, masks: GivenSky) -> None:
    """What masks, by view name, say of the pixels of the views, unless it is already there."""
    for row, photo_view in enumerate(job.photo_views):
        if photo_view.name in masks and not job.sky_file(row).exists():
            told = masks[photo_view.name]()
            save(job.sky_file(row), resample(told, photo_view, job.views[row], labels=True))


def write_gray(job: StereoJob, row: int) -> None:
    """The photo as all passes need it, unless it is already there."""
    if not job.gray_file(row).exists():
        view = job.photo_views[row]
        image = resample(Scene(job.scene).read_photo(view.name), view, job.views[row])
        save(job.gray_file(row), cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def save(path: Path, array: np.ndarray) -> None:
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.save(file, array)


def run_pass(job: StereoJob, number: int, row: int) -> None:
    """One pass over one view, unless it is already there."""
    target, settings = job.file(number, row), passes(job.longest)[number]
    if target.exists() or job.file(number + 1, row).exists():
        return
    view = job.view(number, row)
    stereo = _problem(job, number, row, settings.geometric)
    if number == 0:
        planes = _start(
            stereo,
            job.seeds[row] * [view.width / job.views[row].width, view.height / job.views[row].height, 1],
        )
    else:
        planes = upsampled(np.load(job.file(number - 1, row))[..., :3], stereo.gray.shape)
    costs = np.empty(stereo.gray.shape, np.float32)
    evaluate(stereo, planes, costs)
    for half in range(2 * settings.iterations):
        done = half // 2
        sweep(
            stereo,
            planes,
            costs,
            half % 2,
            100 * number + half,
            settings.spread * 0.5**done,
            settings.tilt / view.focal * 0.7**done,
            settings.trials,
            REACH,
        )
    save(target, np.concatenate([planes, costs[..., None]], axis=2))


def _problem(job: StereoJob, number: int, row: int, geometric: bool) -> Stereo:
    """The arrays of one view and its sources as large as in a pass; geometric: with what the pass before
    found.
    """
    own, views = job.view(number, row), [job.view(number, source) for source in job.sources[row]]
    grays = [
        job.gray(source).at(max(view.width, view.height)).gray
        for source, view in zip(job.sources[row], views, strict=True)
    ]
    others = np.zeros((len(views), 0, 0, 3), np.float32)
    if geometric:
        before = [np.load(job.file(number - 1, source))[..., :3] for source in job.sources[row]]
        others = stacked([upsampled(planes, gray.shape) for planes, gray in zip(before, grays, strict=True)])
    reference = job.gray(row).at(max(own.width, own.height)).gray
    sources = [GrayView(view, gray) for view, gray in zip(views, grays, strict=True)]
    return _stereo(GrayView(own, reference), sources, job.ranges[row], others)


def _stereo(
    reference: GrayView, sources: list[GrayView], limits: tuple[float, float, float], others: np.ndarray
) -> Stereo:
    """limits: as `StereoJob.ranges`; others: as `Stereo.others`"""
    own, views, (far, near, nearest) = reference.view, [source.view for source in sources], limits
    return Stereo(
        np.ascontiguousarray(reference.gray),
        stacked([source.gray for source in sources]),
        np.array([source.gray.shape[::-1] for source in sources], np.int64),
        *transfers([own] * len(views), views),
        np.float32(far),
        np.float32(nearest),
        np.float32(near - far),
        others,
        *transfers(views, [own] * len(views)),
    )


def _start(stereo: Stereo, seeds: np.ndarray) -> np.ndarray:
    """(H, W, 3) planes: most through the sparse points around the pixel, or facing the camera at the depth of
    the nearest; the rest anywhere in the range.
    """
    height, width = stereo.gray.shape
    random = np.random.default_rng(0)
    columns, rows = np.meshgrid(np.arange(0, width, CELL) + CELL / 2, np.arange(0, height, CELL) + CELL / 2)
    cells = np.column_stack([columns.ravel(), rows.ravel()])
    fitted, nearest = (_spread(part, rows.shape)[:height, :width] for part in _planes_through(seeds, cells))
    x, y = np.meshgrid(np.arange(width) % CELL + 0.5 - CELL / 2, np.arange(height) % CELL + 0.5 - CELL / 2)
    fitted[..., 0] += fitted[..., 1] * x + fitted[..., 2] * y
    anywhere = np.zeros_like(fitted)
    usual = random.random((height, width)) < 0.5
    anywhere[..., 0] = stereo.farthest + random.random((height, width)) * np.where(
        usual, stereo.span, stereo.nearest - stereo.farthest
    )
    choice = random.choice(3, (height, width, 1), p=BEGIN)
    planes = np.choose(choice, [fitted, nearest, anywhere]).astype(np.float32)
    np.clip(planes[..., 0], stereo.farthest, stereo.nearest, planes[..., 0])
    return planes


def _planes_through(seeds: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(C, 3) least squares plane through the AROUND nearest seeds of each (C, 2) cell center, and (C, 3) that
    of the nearest seed, which faces the camera.
    """
    near = cKDTree(seeds[:, :2]).query(cells, k=min(AROUND, len(seeds)))[1]
    offsets = seeds[near, :2] - cells[:, None]
    matrix = np.concatenate([np.ones((*near.shape, 1)), offsets], axis=2)
    normal = matrix.transpose(0, 2, 1) @ matrix + np.diag(
        [0, 1.0, 1.0]
    )  # px^2: points in a line fix one slope only
    fitted = np.linalg.solve(normal, matrix.transpose(0, 2, 1) @ seeds[near, 2][..., None])[..., 0]
    facing = np.zeros_like(fitted)
    facing[:, 0] = seeds[near[:, 0], 2]
    return fitted, facing


def _spread(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(C, 3) values of cells at their pixels."""
    return values.reshape(*shape, 3).repeat(CELL, axis=0).repeat(CELL, axis=1)


def upsampled(planes: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(H, W, 3) planes of a coarser map at the pixels of a finer one of the same view."""
    height, width = planes.shape[:2]
    if (height, width) == shape:
        return planes.copy()
    y, x = (np.arange(shape[0]) + 0.5) * height / shape[0], (np.arange(shape[1]) + 0.5) * width / shape[1]
    rows, columns = np.minimum(y.astype(int), height - 1), np.minimum(x.astype(int), width - 1)
    finer = planes[rows[:, None], columns[None]]
    dy, dx = (y - rows - 0.5).astype(np.float32), (x - columns - 0.5).astype(np.float32)
    finer[..., 0] += finer[..., 1] * dx + finer[..., 2] * dy[:, None]
    finer[..., 1] *= width / shape[1]
    finer[..., 2] *= height / shape[0]
    return finer


def check_view(job: StereoJob, row: int) -> np.ndarray:
    """Count the sources that confirm a view's depths; returns (n, 3) some of the confirmed points, world.

    Views can also agree on chance, as they have looked at each other's maps, so the photos must agree too,
    and a surface must be larger than a speckle.
    """
    last = len(passes(job.longest)) - 1
    planes, view, sources = np.load(job.file(last, row)), job.view(last, row), job.sources[row]
    inverse = np.ascontiguousarray(planes[..., 0])
    others = [_planes_in_photo(job, source) for source in sources]
    other_views = [job.view(last, source) for source in sources]
    counts = count_agreements(inverse, view, others, other_views)
    loose = count_agreements(inverse, view, others, other_views, LOOSE)
    costs = np.empty(inverse.shape, np.float32)
    evaluate(_problem(job, last, row, geometric=False), planes, costs)
    opaque = Scene(job.scene).opaque_pixels(job.photo_views[row], view)
    unsure = (costs > MAX_COST) | job.told(row, SKY) | (False if opaque is None else ~opaque)
    counts[unsure], loose[unsure] = 0, 0
    counts[~without_speckles(inverse, counts >= 1)] = 0
    counts[(counts > 1) & ~without_speckles(inverse, counts > 1)] = 1
    loose[~without_speckles(inverse, loose >= 1)] = 0
    save(job.checked_file(row), np.stack([counts, loose]))
    rows, columns = np.nonzero((counts >= min(SURE, len(sources))) & (horizon(view, job.up) < 0))
    chosen = np.random.default_rng(row).permutation(len(rows))[:GROUND_POINTS]
    rows, columns = rows[chosen], columns[chosen]
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1) @ np.linalg.inv(view.matrix).T
    points = rays / inverse[rows, columns, None]
    return (points - view.cam_from_world[:3, 3]) @ view.cam_from_world[:3, :3]


def _planes_in_photo(job: StereoJob, row: int) -> np.ndarray:
    """(H, W, 3) planes that a view ends with, 0 where its photo shows nothing, or sky that it was told of."""
    last = len(passes(job.longest)) - 1
    planes = np.load(job.file(last, row))[..., :3] * ~job.told(row, SKY)[..., None]
    opaque = Scene(job.scene).opaque_pixels(job.photo_views[row], job.view(last, row))
    if opaque is not None:
        planes[~opaque] = 0
    return planes


def finish_view(job: StereoJob, ground: Ground | None, row: int) -> tuple[float, float, float, float]:
    """Complete a view and write its depth map; returns the shares of its pixels that one and that two other
    views confirm, that have a depth, and of sky.
    """
    last = len(passes(job.longest)) - 1
    planes, view = np.load(job.file(last, row)), job.view(last, row)
    counts, loose = np.load(job.checked_file(row))
    scene, photo_view = Scene(job.scene), job.photo_views[row]
    image, opaque = (
        resample(scene.read_photo(view.name), photo_view, view),
        scene.opaque_pixels(photo_view, view),
    )
    if ground is not None:
        below = ~not_below(view, planes, loose >= 1, ground)
        counts[below], loose[below] = 0, 0
    sky = find_sky(image, counts >= 1, horizon(view, job.up)) & ~job.told(row, SURFACE) | job.told(row, SKY)
    if opaque is not None:
        sky &= opaque
    counts[sky] = 0
    sure = counts >= min(SURE, len(job.sources[row]))
    complete = continued_planes(view, planes, sure, image, ground)
    complete[loose >= 1] = planes[loose >= 1, :3]
    complete[sky | (False if opaque is None else ~opaque)] = 0
    inverse, file = complete[..., 0], depth_file(job.output, view.name)
    depth = np.where(inverse > 0, 1 / np.maximum(inverse, 1e-30), 0).astype(np.float32)
    write_depth_map(file, DepthMap(depth, plane_normals(view, complete), counts, sky))
    write_image(file.with_suffix(".png"), preview(inverse))
    return (
        float((counts >= 1).mean()),
        float((counts >= 2).mean()),
        float((depth > 0).mean()),
        float(sky.mean()),
    )


def plane_normals(view: View, planes: np.ndarray) -> np.ndarray:
    """(H, W, 3) int8, 127 times the normals towards the camera of (H, W, 3+) planes of a pinhole view.

    With x = (u - cx) / fx: q = A x + B y + C and n . (x, y, 1) = d q, so n is along (A, B, C).
    """
    matrix = view.matrix
    columns, rows = (
        np.arange(view.width) + 0.5 - matrix[0, 2],
        np.arange(view.height)[:, None] + 0.5 - matrix[1, 2],
    )
    q, a, b = np.moveaxis(planes[..., :3].astype(np.float64), 2, 0)
    away = np.stack([a * matrix[0, 0], b * matrix[1, 1], q - a * columns - b * rows], axis=2)
    length = np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-30)
    return np.round(-127 * away / length).astype(np.int8)


def planes_of(view: View, depth: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32 planes of a pinhole view, the inverse of `plane_normals`; 0 where there is no depth.

    depth: (H, W) z, 0 = none; normals: (H, W, 3) of any length, camera frame
    """
    matrix = view.matrix
    x = (np.arange(view.width) + 0.5 - matrix[0, 2]) / matrix[0, 0]
    y = (np.arange(view.height)[:, None] + 0.5 - matrix[1, 2]) / matrix[1, 1]
    n = normals.astype(np.float64)
    distance = depth * (n[..., 0] * x + n[..., 1] * y + n[..., 2])
    known = (depth > 0) & (np.abs(distance) > 1e-12)
    safe, z = np.where(known, distance, 1), np.where(known, depth, 1)
    planes = np.stack([1 / z, n[..., 0] / matrix[0, 0] / safe, n[..., 1] / matrix[1, 1] / safe], axis=2)
    return (planes * known[..., None]).astype(np.float32)


def patch_costs(reference: GrayView, sources: list[GrayView], planes: np.ndarray) -> np.ndarray:
    """(H, W) float32: 1 - NCC of the patches of each pixel and of the sources that its plane (H, W, 3) leads
    to, the two best averaged (`patch_match.evaluate`); WORST without sources.
    """
    costs = np.full(planes.shape[:2], WORST, np.float32)
    if sources:
        evaluate(
            _stereo(reference, sources, (0.0, 0.0, 0.0), np.zeros((len(sources), 0, 0, 3), np.float32)),
            planes,
            costs,
        )
    return costs


def preview(inverse: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 picture of inverse depths: red is near, blue far, black unknown (0)."""
    known = inverse > 0
    if not known.any():
        return np.zeros((*inverse.shape, 3), np.uint8)
    low, high = np.quantile(inverse[known], [0.01, 0.99])
    scaled = np.clip((inverse - low) / max(high - low, 1e-12), 0, 1) * 255
    colored = cv2.cvtColor(cv2.applyColorMap(scaled.astype(np.uint8), cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    return np.where(known[..., None], colored, 0).astype(np.uint8)
