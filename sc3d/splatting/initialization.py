"""Where training starts: Gaussians at the sparse points, and flat ones on the depth maps of stereo between them.

Sparse points leave parts of the photos empty (trees, lawn, asphalt), and optimization moves a Gaussian by little
per step, so a tree crown that starts on the ground stays there: starting depth matters.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from sc3d.geometry.cameras import View
from sc3d.geometry.plane_sweep import (
    Plane,
    SweepVolume,
    SweptView,
    interpolated_depth,
    one_per_cube,
    plane_depth,
    settled,
    sweep_planes,
)
from sc3d.io.progress import progress
from sc3d.settings.train import TrainSettings
from sc3d.splatting import losses
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.gaussians import Gaussians
from sc3d.stereo.starting_points import StartingPoints, points_on_maps

SWEEP_SIZE = 250  # px, longest side of the images compared: 7x7 patches must hold some texture
MAX_COST = 0.5  # mean 1 - NCC of the two best neighbors
AROUND = 5  # grid points whose costs are averaged

logger = logging.getLogger(__name__)


def initial_gaussians(
    data: TrainingData, neighbors: list[np.ndarray], settings: TrainSettings, generator: torch.Generator
) -> Gaussians:
    """Gaussians at the sparse points and, with `fill`, on the depth maps and where these know nothing; a random choice
    if they are too many.
    """
    found = StartingPoints.without_normals(data.points, data.colors)
    if settings.fill:
        known = points_on_maps(data.views, data.image, data.mask, data.depth_map, settings.max_gaussians // 4)
        rest = plane_sweep_points(without_known(data), neighbors, settings.max_gaussians // 4)
        found = StartingPoints.joined([found, known, StartingPoints.without_normals(*rest)])
    if len(found.points) > settings.max_gaussians:
        logger.info(
            "%d of %d points to start from are left out, by chance: --max-gaussians is %d",
            len(found.points) - settings.max_gaussians,
            len(found.points),
            settings.max_gaussians,
        )
        order = torch.randperm(len(found.points), generator=generator)
        chosen = order[: settings.max_gaussians].sort().values.numpy()
        found = found.chosen(chosen)
    return Gaussians.from_points(found.points, found.colors, settings.sh_degree, normals=found.normals)


def without_known(data: TrainingData) -> TrainingData:
    """The same without the pixels of which the depth maps know the surface, or that there is none."""

    def mask(index: int) -> np.ndarray | None:
        depth_map, own = data.depth_map(index), data.mask(index)
        if depth_map is None:
            return own
        unknown = (depth_map.depth == 0) & ~depth_map.sky
        return unknown if own is None else unknown & own

    return replace(data, masks=mask)


def plane_sweep_points(
    data: TrainingData, neighbors: list[np.ndarray], budget: int
) -> tuple[np.ndarray, np.ndarray]:
    """Points on a pixel grid of every photo, away from sparse points.

    neighbors: per view indices of other views, best first; budget: number of grid points over all photos;
        fewer remain, as photos overlap
    returns: (M, 3) float64 points, the views' world; (M, 3) uint8 colors. M = 0 where there is nothing to
        fill.
    Depth: where patches agree with the neighbors' (plane sweep); elsewhere interpolated from what the view
        knows around the pixel.
    """
    masks = map(data.mask, range(len(data.views)))
    num_pixels = sum(
        view.width * view.height if mask is None else int(mask.sum())
        for view, mask in zip(data.views, masks, strict=True)
    )
    step = max(4.0, np.sqrt(num_pixels / max(budget, 1)))
    grays = [_small_gray(data, index) for index in range(len(data.views))]
    points = np.asarray(data.points, np.float64)
    volume = SweepVolume.from_points(points, data.views)
    found, colors, sizes = [], [], []
    for index, view in enumerate(progress(data.views, "first Gaussians", "view")):
        seen = points if data.tracks is None else points[data.tracks[index]]
        reference = SweptView.between(view, seen, data.mask(index), step)
        if reference is None:
            continue
        planes = sweep_planes(reference, volume)
        swept, cost = _sweep(reference, planes, grays[index], [grays[other] for other in neighbors[index]])
        good = settled(reference.grid, swept, cost < MAX_COST, step)
        lowest = planes[0] if volume else (np.array([0.0, 0.0, -1.0]), 1.0)
        depth = np.where(good, swept, interpolated_depth(reference, swept, good, lowest))
        points_cam = reference.rays * depth[:, None]
        found.append((points_cam - view.cam_from_world[:3, 3]) @ view.cam_from_world[:3, :3])
        columns, rows = reference.grid.astype(int).T
        colors.append(data.image(index)[rows, columns])
        sizes.append(step * depth / view.focal)
    if not found:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    filled = np.concatenate(found)
    kept = one_per_cube(filled, float(np.median(np.concatenate(sizes))))
    return filled[kept], np.concatenate(colors)[kept]


def _small_gray(data: TrainingData, index: int) -> tuple[torch.Tensor, View]:
    view = data.views[index]
    scale = min(1.0, SWEEP_SIZE / max(view.width, view.height))
    small = view.resized(max(8, round(view.width * scale)), max(8, round(view.height * scale)))
    image = cv2.resize(data.image(index), (small.width, small.height), interpolation=cv2.INTER_AREA)
    return losses.to_gray(torch.from_numpy(image).float() / 255), small


def _sweep(
    reference: SweptView,
    planes: list[Plane],
    own: tuple[torch.Tensor, View],
    others: list[tuple[torch.Tensor, View]],
) -> tuple[np.ndarray, np.ndarray]:
    """(G,) depth of the plane whose patches agree best with the two best of the other views; (G,) that mean 1
    - NCC, 2 = none.
    """
    grid, rays = reference.grid, reference.rays
    pixels = torch.from_numpy((grid * (own[1].width / reference.view.width)).astype(np.int64))
    around = cKDTree(grid).query(grid, k=min(AROUND, len(grid)))[1].reshape(len(grid), -1)
    best_cost, best_depth = np.full(len(pixels), 2.0), np.ones(len(pixels))
    for plane in planes if others else []:
        normals = torch.from_numpy(plane[0].astype(np.float32)).expand(len(pixels), 3).contiguous()
        distances, costs = torch.full((len(pixels),), plane[1]), []
        for other in others:
            cost, inside = losses.patch_dissimilarity((normals, distances), pixels, own, other)
            costs.append(torch.where(inside, cost, 2.0))
        best_two = torch.stack(costs).sort(0).values[:2].mean(0).numpy()
        averaged = best_two[around].mean(axis=1)  # leaves in the wind: one patch says little
        better = averaged < best_cost
        best_cost[better], best_depth[better] = averaged[better], plane_depth(plane, rays)[better]
    return best_depth, best_cost
