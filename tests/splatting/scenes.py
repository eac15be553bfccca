"""Scenes made of a few planes and spheres: training data with exact depth, and Gaussians."""

import numpy as np
import torch

from sc3d.geometry.cameras import look_at, pinhole_view, rays
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.gaussians import SH_C0, Gaussians

SIZE = (96, 64)


def plane(normal, offset):
    """Distances along rays from an origin to normal . x = offset; inf where it is not ahead."""
    normal = np.asarray(normal, float)

    def distances(origin, directions):
        along = (offset - origin @ normal) / (directions @ normal)
        return np.where(along > 0, along, np.inf)

    return distances


def sphere(center, radius):
    """Distances along unit rays from an origin outside to a sphere; inf where it is missed."""

    def distances(origin, directions):
        towards = directions @ (np.asarray(center, float) - origin)
        inside = towards**2 - np.sum((np.asarray(center, float) - origin) ** 2) + radius**2
        return np.where((inside > 0) & (towards > 0), towards - np.sqrt(np.maximum(inside, 0)), np.inf)

    return distances


def color(points, wave):
    """(N, 3) in [0, 1]: smooth waves about `wave` long, in all directions."""
    x, y, z = points.T * (2 * np.pi / wave)
    waves = [
        np.sin(x + 0.3 * y + 0.5 * z),
        np.sin(0.6 * y - 0.4 * x + z),
        np.sin(0.8 * x - 0.5 * y + 0.7 * z),
    ]
    return 0.5 + 0.25 * np.stack(waves, 1) + 0.12 * (np.sin(1.9 * x + z) * np.sin(2.1 * y + z))[:, None]


def photographed(views, shapes, wave, noise, num_points=1500):
    """Training data with sparse points (noise in world units) that the views see; (V, H, W) true depth and
    index of the shape that is seen.
    """
    random, photos, depths, indices, points = np.random.default_rng(0), [], [], [], []
    for view in views:
        directions, along = rays(view)
        distances = np.stack([shape(view.center, directions) for shape in shapes])
        hits = view.center + distances.min(0)[:, None] * directions
        photos.append(
            (np.clip(color(hits, wave), 0, 1) * 255 + 0.5)
            .astype(np.uint8)
            .reshape(view.height, view.width, 3)
        )
        depths.append((distances.min(0) * along).reshape(view.height, view.width))
        indices.append(distances.argmin(0).reshape(view.height, view.width))
        points.append(hits[random.choice(len(hits), num_points // len(views), replace=False)])
    points = np.concatenate(points)
    colors = (np.clip(color(points, wave), 0, 1) * 255).astype(np.uint8)
    return (
        TrainingData(views, photos, points + random.normal(0, noise, points.shape), colors),
        np.stack(depths),
        np.stack(indices),
    )


def ring(calibration=(90.0, 90.0, 50.0, 31.0)):
    """8 views of the origin from about 9 units above."""
    angles = np.arange(8) * np.pi / 4
    centers = [np.array([4 * np.cos(a), 3 * np.sin(a), 9 + np.cos(3 * a)]) for a in angles]
    return [
        pinhole_view(f"{row}.png", SIZE, calibration, look_at(center, center * [0.2, 0, 0]))
        for row, center in enumerate(centers)
    ]


def valley():
    """z = 0.3 |x|, so that the space above both planes is convex."""
    return [plane([-0.3, 0, 1], 0.0), plane([0.3, 0, 1], 0.0)]


RED_POINT = np.array([1.3, 0.8, 0.3])  # a lone red Gaussian above the ground; local frame
GREEN, RED, UP = (60, 140, 50), (230, 20, 20), (128, 128, 255)


def flat_ground(half: float = 4.0) -> Gaussians:
    """A flat green ground, 2 `half` m wide, and one red Gaussian; both opaque."""
    x, y = np.meshgrid(*[np.arange(-half, half + 0.01, 0.2)] * 2)
    points = np.concatenate([np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1), RED_POINT[None]])
    colors = np.tile(np.float32(GREEN) / 255, (len(points), 1))
    colors[-1] = np.float32(RED) / 255
    scales = np.tile(np.float32([0.15, 0.15, 0.002]), (len(points), 1))
    scales[-1] = (0.08, 0.08, 0.002)
    quats = np.tile(np.float32([1, 0, 0, 0]), (len(points), 1))
    sh = ((colors - 0.5) / SH_C0).astype(np.float32)
    parts = [points.astype(np.float32), np.log(scales), quats, np.full(len(points), 6, np.float32), sh]
    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(part)) for part in parts))


def view_of(center: tuple[float, float, float], size: tuple[int, int] = (120, 90)):
    """A view whose principal point is not the middle, image top towards the north-east."""
    calibration = (110, 114, size[0] / 2 + 5, size[1] / 2 - 3)
    return pinhole_view(
        "some photo.jpg",
        size,
        calibration,
        look_at(np.array(center, float), np.array([0.3, 0.2, 0]), (0.4, 1, 0.3)),
    )


def center_of_red(image: np.ndarray) -> np.ndarray:
    """(2,) pixel coordinates of what is red in (H, W, 3) uint8 RGB."""
    weight = np.maximum(image[..., 0].astype(float) - 1.2 * image[..., 1] - 60, 0)
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()
