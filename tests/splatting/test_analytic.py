"""Training on scenes made of a few planes and spheres: the depth that comes out is the depth that went in."""

import numpy as np
import pytest

from sc3d.geometry.cameras import look_at, pinhole_view, rays
from sc3d.settings.train import TrainSettings
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.evaluation import depth_map
from sc3d.splatting.trainer import train

pytestmark = pytest.mark.usefixtures("one_thread")

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


def depth_errors(data, depths, **options):
    """(V, H, W) relative depth errors after a short training, NaN where alpha is below 0.9."""
    settings = TrainSettings(
        **{"iterations": 300, "sh_degree": 0, "max_gaussians": 5000, "num_patches": 1024} | options
    )
    gaussians = train(data, settings, progress=False).gaussians
    maps = [depth_map(gaussians, view) for view in data.views]
    return np.stack(
        [
            np.where(alpha > 0.9, np.abs(depth - truth) / truth, np.nan)
            for (depth, alpha, _), truth in zip(maps, depths, strict=True)
        ]
    )


def valley():
    """z = 0.3 |x|, so that the space above both planes is convex."""
    return [plane([-0.3, 0, 1], 0.0), plane([0.3, 0, 1], 0.0)]


def test_two_planes_have_their_depth():
    data, depths, _ = photographed(ring(), valley(), wave=2.0, noise=0.05)
    errors = depth_errors(data, depths, iterations=350, max_gaussians=8000)
    assert np.isfinite(errors).mean() > 0.85
    assert np.nanmedian(errors) < 0.005


def test_principal_point_far_from_the_middle():
    data, depths, _ = photographed(ring((90.0, 90.0, 20.0, 54.0)), valley(), wave=3.0, noise=0.05)
    errors = depth_errors(data, depths)
    assert np.isfinite(errors).mean() > 0.75
    assert np.nanmedian(errors) < 0.01


def test_sphere_over_a_plane():
    shapes = [plane([0, 0, 1], 0.0), sphere([0, 0, 1.6], 1.3)]
    data, depths, indices = photographed(ring(), shapes, wave=3.0, noise=0.05)
    errors = depth_errors(data, depths)
    assert np.isfinite(errors).mean() > 0.85
    for index in (0, 1):
        assert np.nanmedian(errors[indices == index]) < 0.02


@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_deep_scene_keeps_its_depth_at_any_scale(unit):
    """Ground from 20 m in front of the cameras to a wall that is 120 m away, in meters and in units of 100 m."""
    centers = np.array([(-14, 0, 20), (-8, 3, 23), (-3, -3, 18), (3, 2, 22), (8, -2, 19), (14, 1, 21)], float)
    poses = [look_at(center * unit, np.array([0.3 * center[0], 50, 0]) * unit) for center in centers]
    views = [
        pinhole_view(f"{row}.png", SIZE, (60.0, 60.0, 48.0, 32.0), pose) for row, pose in enumerate(poses)
    ]
    data, depths, _ = photographed(
        views, [plane([0, 0, 1], 0.0), plane([0, 1, 0], 105 * unit)], wave=20 * unit, noise=0.4 * unit
    )
    assert depths.min() < 23 * unit and depths.max() > 119 * unit
    errors = depth_errors(data, depths)
    for nearest, farthest in ((0, 35), (35, 70), (70, 130)):
        chosen = errors[(depths > nearest * unit) & (depths < farthest * unit)]
        assert np.isfinite(chosen).mean() > 0.7
        assert np.nanmedian(chosen) < 0.025
