"""Whether what came from outside lies where the cameras are: files say where their points are, seldom in
which frame.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from sc3d.geometry.cameras import View

logger = logging.getLogger(__name__)

BODY = (0.01, 0.99)  # shares of the points between which a box lies: strays do not count
REACH = 1.0  # extents of cameras and sparse points that a scene may go on around them
FAR = 20.0  # the same, in extents of the cameras, where there are no sparse points
ALONE = 50.0  # taken for the extent of a camera alone, world units
NEAR, LEAST_NEAR = 0.05, 0.25  # of the spread of the sparse points; share of them that have something so near
FEW, PROBES = 50, 2000  # points that tell a scale; sparse points that are asked
SMALLER = 20.0  # times the spread of the cameras is larger than that of points of another scale
SAMPLE = 100_000  # points that a box is measured from

Box = tuple[np.ndarray, np.ndarray]  # (3,) low, (3,) high


def box_of(points: np.ndarray) -> Box:
    """Box around the (N, 3) points without strays."""
    sample = np.asarray(points[:: max(1, len(points) // SAMPLE)], np.float64)
    low, high = np.quantile(sample, BODY, axis=0)
    return low, high


def scene_box(views: list[View], points: np.ndarray) -> Box:
    """Box within which something of the scene must lie. points: (P, 3) sparse points, perhaps none."""
    centers = np.array([view.center for view in views])
    low, high = centers.min(axis=0), centers.max(axis=0)
    extent, reach = max(float(np.linalg.norm(high - low)), 1.0 if len(views) > 1 else ALONE), FAR
    if len(points):
        body = box_of(points)
        low, high = np.minimum(low, body[0]), np.maximum(high, body[1])
        extent, reach = float(np.linalg.norm(high - low)), REACH
    return low - reach * extent, high + reach * extent


def apart(box: Box, scene: Box) -> bool:
    """Whether two boxes have nothing in common."""
    return bool((box[0] > scene[1]).any() or (box[1] < scene[0]).any())


def describe(box: Box) -> str:
    """As "x 0.0 to 9.5, y ...": one line for messages."""
    return ", ".join(f"{axis} {low:.1f} to {high:.1f}" for axis, low, high in zip("xyz", *box, strict=True))


def check_frame(path: Path, points: np.ndarray, views: list[View], sparse_points: np.ndarray) -> bool:
    """Whether (N, 3) world points of a file may lie where the scene is; else a warning with both boxes."""
    box = box_of(points)
    if not views or not apart(box, scene_box(views, sparse_points)):
        return True
    logger.warning(
        "%s lies elsewhere than the cameras, so it seems to be in another frame: its points are at %s;"
        " the cameras at %s",
        path,
        describe(box),
        describe(box_of(np.array([view.center for view in views]))),
    )
    return False


def check_scale(path: Path, points: np.ndarray, views: list[View], sparse_points: np.ndarray) -> None:
    """A warning if (N, 3) world points of a file do not lie on the sparse points of its scene (P, 3), as those
    of another scale or direction do not; without sparse points, if they are far smaller than the cameras.
    """
    sizes = f"they spread {_spread(points):.3g} around their middle"
    if len(sparse_points) >= FEW:
        spread = _spread(sparse_points)
        nearest = cKDTree(points[:: max(1, len(points) // SAMPLE)])
        some = sparse_points[:: max(1, len(sparse_points) // PROBES)]
        near = float((nearest.query(some)[0] <= NEAR * spread).mean())
        if near >= LEAST_NEAR:
            return
        told = f"{near:.0%} of the sparse points have one of them within {NEAR * spread:.3g}; {sizes}, the sparse points {spread:.3g}"
    else:
        spread = _spread(np.array([view.center for view in views]))
        if len(views) < 3 or len(points) < FEW or _spread(points) * SMALLER >= spread:
            return
        told = f"{sizes}, the cameras {spread:.3g}"
    logger.warning(
        "%s seems to be in another scale or frame than the cameras: %s. Programs such as nerfstudio normalize: export"
        " the cameras of that training beside it, or train with the frame of the cameras kept",
        path,
        told,
    )


def _spread(points: np.ndarray) -> float:
    """Median distance from the middle of (N, 3) points."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def check_together(path: Path, points: np.ndarray, others: np.ndarray) -> None:
    """A warning with both boxes if a file's points (N, 3) lie elsewhere than those of its scene (M, 3)."""
    box, other = box_of(points), box_of(others)
    extent = REACH * float(np.linalg.norm(other[1] - other[0]))
    if apart(box, (other[0] - extent, other[1] + extent)):
        logger.warning(
            "%s lies elsewhere than the cloud, so it seems to be in another frame: its points are at %s; the cloud at %s",
            path,
            describe(box),
            describe(other),
        )
