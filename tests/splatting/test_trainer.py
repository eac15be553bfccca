"""Training on a small analytic scene: quality, determinism, resume, cap, odd inputs."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sc3d.errors import InputError
from sc3d.geometry.cameras import look_at, pinhole_view, rays
from sc3d.geometry.view_selection import neighbor_views
from sc3d.settings.train import TrainSettings
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.evaluation import depth_map
from sc3d.splatting.initialization import plane_sweep_points
from sc3d.splatting.trainer import train
from sc3d.stages.train import write_log

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT = 96, 64
SHORT = TrainSettings(iterations=60, sh_degree=0, max_gaussians=2000, coarse_until=0.2)


def surface_color(points: np.ndarray) -> np.ndarray:
    """A smooth texture whose waves are longer than a few pixels, (N, 3) in [0, 1]."""
    x, y, z = points.T
    waves = [np.sin(2.1 * x + 0.7 * y + z), np.sin(1.3 * y - 0.9 * x + 2 * z), np.sin(1.7 * x - 1.1 * y)]
    fine = 0.12 * np.sin(4.0 * x) * np.sin(4.4 * y)
    return 0.5 + 0.25 * np.stack(waves, 1) + fine[:, None]


def trace(view) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) uint8 photo and (H, W) depth of two planes that form a valley: z = 0.3 |x|."""
    directions, along = rays(view)
    hits = []
    for side in (1, -1):
        normal = np.array([-0.3 * side, 0, 1.0])
        distance = -(view.center @ normal) / (directions @ normal)
        hits.append(np.where(distance > 0, distance, np.inf))
    distance = np.minimum(*hits)  # the space above both planes is convex
    color = surface_color(view.center + distance[:, None] * directions)
    return (color * 255 + 0.5).astype(np.uint8).reshape(HEIGHT, WIDTH, 3), (distance * along).reshape(
        HEIGHT, WIDTH
    )


@pytest.fixture(scope="module")
def scene() -> tuple[TrainingData, list[np.ndarray]]:
    centers = [(4 * np.cos(a), 3 * np.sin(a), 9 + np.cos(3 * a)) for a in np.arange(8) * np.pi / 4]
    views = [
        pinhole_view(
            f"{i}.png",
            (WIDTH, HEIGHT),
            (90, 90, WIDTH / 2 + 2, HEIGHT / 2 - 1),
            look_at(np.array(c), np.array([0.2 * c[0], 0, 0])),
        )
        for i, c in enumerate(centers)
    ]
    photos, depths = zip(*map(trace, views), strict=True)
    random = np.random.default_rng(0)
    points = np.concatenate([random.uniform(-8, 8, (1500, 2)), np.zeros((1500, 1))], 1)
    points[:, 2] = 0.3 * np.abs(points[:, 0])
    colors = (surface_color(points) * 255).astype(np.uint8)
    return TrainingData(views, list(photos), points + random.normal(0, 0.05, points.shape), colors), list(
        depths
    )


@pytest.mark.parametrize(("plain", "tolerance"), [(True, 0.015), (False, 0.008)])
def test_training_recovers_color_and_depth(scene, plain, tolerance):
    data, depths = scene
    result = train(
        data,
        TrainSettings(
            iterations=350, sh_degree=0, max_gaussians=6000, plain=plain, test_every=8, num_patches=1024
        ),
        progress=False,
    )
    assert result.metrics["psnr"] > 22 and result.log[-1]["psnr"] > 22
    errors = []
    for view, truth in zip(data.views, depths, strict=True):
        depth, alpha, normals = depth_map(result.gaussians, view)
        chosen = alpha > 0.9
        assert chosen.mean() > 0.9
        errors.append(np.abs(depth - truth)[chosen] / truth[chosen])
        lengths = np.linalg.norm(normals, axis=2)
        assert np.allclose(lengths[depth > 0], 1, atol=1e-5) and normals[..., 2][depth > 0].max() < 0.2
    assert np.median(np.concatenate(errors)) < tolerance


def test_empty_parts_are_filled_at_the_right_depth(scene):
    data, _ = scene
    sparse = data.points[:, 0] < -1  # the right half has no sparse points
    data = replace(data, points=data.points[sparse], colors=data.colors[sparse])
    neighbors = neighbor_views(None, data.points, np.stack([view.center for view in data.views]))
    points, colors = plane_sweep_points(data, neighbors, 3000)
    right = points[points[:, 0] > 0.5]
    assert len(right) > 150
    height = right[:, 2] - 0.3 * np.abs(right[:, 0])
    assert np.median(np.abs(height)) < 0.15 and np.abs(np.median(height)) < 0.1  # at 9 units distance
    expected = surface_color(points) * 255
    assert np.median(np.abs(colors - expected)) < 15
    masked = replace(data, masks=lambda index: np.zeros((HEIGHT, WIDTH), bool))
    assert len(plane_sweep_points(masked, neighbors, 3000)[0]) == 0


def test_same_seed_same_result_and_resume_is_exact(scene, tmp_path):
    data, _ = scene
    settings = replace(SHORT, checkpoint_every=35, surface_from=0.3, num_patches=256)
    # leaves the checkpoint of iteration 35
    whole = train(data, settings, tmp_path / "checkpoint.pt", progress=False)
    resumed = train(data, settings, tmp_path / "checkpoint.pt", progress=False)
    fresh = train(data, settings, progress=False)
    for other in (resumed, fresh):
        assert [(row["iteration"], row["loss"], row["psnr"]) for row in other.log] == [
            (row["iteration"], row["loss"], row["psnr"]) for row in whole.log
        ]
        for name, tensor in whole.gaussians.parameters().items():
            assert torch.equal(tensor, other.gaussians.parameters()[name]), name
    assert not torch.equal(
        train(data, replace(settings, seed=1), progress=False).gaussians.means[:100],
        whole.gaussians.means[:100],
    )


def test_checkpoint_of_other_settings_is_not_used(scene, tmp_path, caplog):
    data, _ = scene
    train(data, replace(SHORT, checkpoint_every=30), tmp_path / "checkpoint.pt", progress=False)
    train(data, replace(SHORT, iterations=20), tmp_path / "checkpoint.pt", progress=False)
    assert "starting over" in caplog.text
    (tmp_path / "checkpoint.pt").write_bytes(b"nonsense")
    with pytest.raises(InputError, match="delete it"):
        train(data, SHORT, tmp_path / "checkpoint.pt", progress=False)


def test_cap_holds(scene):
    data, _ = scene
    result = train(
        data, replace(SHORT, max_gaussians=1600, gradient_threshold=1e-9, densify_from=0.0), progress=False
    )
    assert 1000 < len(result.gaussians) <= 1600
    few = train(data, replace(SHORT, max_gaussians=700), progress=False)
    assert len(few.gaussians) <= 700


def test_images_may_be_a_function_and_masked(scene):
    data, _ = scene
    spoiled = [photo.copy() for photo in data.images]
    for photo in spoiled:
        photo[:20, :20] = (255, 0, 255)
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:20, :20] = False
    masked = replace(data, images=lambda index: spoiled[index], masks=lambda index: mask)
    result = train(masked, replace(SHORT, iterations=100), progress=False)
    assert result.log[-1]["psnr"] > 18
    assert np.abs(result.exposures).max() < 0.2


def test_two_views_are_enough_and_one_is_not(scene):
    data, depths = scene
    two = replace(data, views=data.views[:2], images=data.images[:2])
    result = train(two, replace(SHORT, surface_from=0.5, num_patches=256), progress=False)
    assert len(result.gaussians) > 500
    with pytest.raises(InputError, match="at least 2"):
        train(replace(data, views=data.views[:1]), SHORT, progress=False)
    with pytest.raises(InputError, match="image of .* is 48x32, its view 96x64"):
        train(
            replace(data, images=[photo[::2, ::2] for photo in data.images]),
            replace(SHORT, test_every=0),
            progress=False,
        )


def test_exposure_of_photos_is_found(scene):
    data, _ = scene
    gains = np.where(np.arange(8) % 2, 1.2, 0.85)
    photos = [
        np.clip(photo * gain, 0, 255).astype(np.uint8) for photo, gain in zip(data.images, gains, strict=True)
    ]
    result = train(replace(data, images=photos), replace(SHORT, iterations=300), progress=False)
    brightness = np.exp(result.exposures[:, 0]) + 2 * result.exposures[:, 1]
    assert brightness[gains > 1].min() > brightness[gains < 1].max()


@pytest.mark.parametrize("iterations", [100, 1500, 7000, 30_000])
def test_schedules_scale_with_the_run(iterations):
    settings = TrainSettings(iterations=iterations, sh_degree=3)
    growing = [step for step in range(iterations + 1) if settings.densifies(step, 40)]
    assert growing and growing[0] >= 0.02 * iterations and growing[-1] <= 0.5 * iterations
    assert settings.densify_interval(40) >= min(40, iterations // 60)
    assert [settings.active_sh_degree(iterations * k // 30) for k in (0, 30)] == [0, 3]
    assert settings.position_rate(iterations, 10.0) == pytest.approx(0.01 * settings.position_rate(0, 10.0))
    assert (
        settings.allowed_gaussians(0, 1000) <= 1000
        and settings.allowed_gaussians(iterations, 1000) == settings.max_gaussians
    )
    assert any(settings.resets_opacity(step) for step in range(iterations)) == (iterations >= 7000)
    assert settings.shapes_surface(iterations // 2) and not settings.shapes_surface(iterations // 10)
    assert not TrainSettings(iterations=iterations, plain=True).shapes_surface(iterations - 1)


def test_log_is_a_table(scene, tmp_path):
    data, _ = scene
    result = train(data, SHORT, progress=False)
    write_log(result.log, tmp_path / "train.csv")
    lines = (tmp_path / "train.csv").read_text().splitlines()
    assert lines[0] == "iteration,loss,psnr,num_gaussians,seconds" and len(lines) == 3
    assert lines[-1].startswith("60,")
