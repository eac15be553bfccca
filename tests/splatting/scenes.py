"""Training data of scenes made of a few planes and spheres, with their exact depth."""

import numpy as np

from sc3d.geometry.cameras import look_at, pinhole_view, rays
from sc3d.splatting.dataset import TrainingData

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
