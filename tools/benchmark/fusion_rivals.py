"""What label and propagate are timed against: bare ray casting, a plain numpy z-buffer voter, one neighbor
pass, scikit-learn.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import open3d as o3d

from sc3d.geometry.cameras import View, in_image, project, rays
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.geometry.raycast import Surface
from sc3d.labelling.cloud import Cloud
from sc3d.labelling.observation import Mask

NUM_NEIGHBORS = 16
DEPTH_TOLERANCE = 0.01  # of the depth


def ray_bundles(surface: Surface, views: list[View]) -> list[o3d.core.Tensor]:
    """The rays of all pixels of each view as `first_surface` casts them: (P, 6) float32 each, made beforehand
    so that only the cast is timed.
    """
    bundles = []
    for view in views:
        directions, _ = rays(view)
        bundle = np.empty((len(directions), 6), np.float32)
        bundle[:, :3], bundle[:, 3:] = view.center - surface.origin, np.nan_to_num(directions)
        bundles.append(o3d.core.Tensor(bundle))
    return bundles


def cast_only(surface: Surface, bundles: list[o3d.core.Tensor]) -> None:
    """(a) Cast the rays and nothing else."""
    for bundle in bundles:
        surface.scene.cast_rays(bundle)


def vote_with_z_buffer(
    cloud: Cloud, views: list[View], read_mask: Callable[[View], Mask], num_ids: int
) -> np.ndarray:
    """(b) Majority voting as one writes it first: project all points, keep those near the front of their
    pixel, count. Returns (N,) uint8.
    """
    votes = np.zeros((len(cloud.points), num_ids), np.int32)
    for view in views:
        mask, _ = read_mask(view)
        sized = view.resized(mask.shape[1], mask.shape[0])
        pixels, depth = project(sized, cloud.points)
        inside = np.flatnonzero(in_image(sized, pixels))
        columns, rows = pixels[inside].astype(np.int64).T
        front = np.full(mask.shape, np.inf)
        np.minimum.at(front, (rows, columns), depth[inside])
        visible = depth[inside] <= front[rows, columns] * (1 + DEPTH_TOLERANCE)
        label = mask[rows[visible], columns[visible]]
        np.add.at(votes, (inside[visible][label > 0], label[label > 0]), 1)
    return votes.argmax(axis=1).astype(np.uint8)


def find_neighbors(points: np.ndarray) -> None:
    """(c) One batched pass for the 16 nearest neighbors of all points, the tree included."""
    NeighborIndex(points).nearest(points, NUM_NEIGHBORS)


def classify_neighbors(points: np.ndarray, label: np.ndarray) -> np.ndarray | None:
    """(d) scikit-learn's KNeighborsClassifier, fitted on the labelled points, asked for those without label;
    None if it is not installed.
    """
    try:
        from sklearn.neighbors import KNeighborsClassifier
    except ImportError:
        return None
    known, result = label > 0, label.copy()
    if known.any() and not known.all():
        result[~known] = (
            KNeighborsClassifier(min(NUM_NEIGHBORS, int(known.sum())))
            .fit(points[known], label[known])
            .predict(points[~known])
        )
    return result
