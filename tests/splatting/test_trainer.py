"""Training on scenes made of a few planes and spheres: quality, depth, determinism, resume, cap, odd inputs."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import torch

from sc3d.errors import InputError
from sc3d.geometry.cameras import look_at, pinhole_view
from sc3d.geometry.held_out import times_seen
from sc3d.geometry.shown import Witnesses
from sc3d.scene.depth_map import DepthMap
from sc3d.scene.held_out import mean_scores, write_held_out
from sc3d.settings.train import TrainSettings
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.evaluation import depth_map, held_out_scores
from sc3d.splatting.trainer import train
from sc3d.stages.train import write_log
from tests.splatting.scenes import SIZE, photographed, plane, ring, sphere, valley

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT = SIZE
SHORT = TrainSettings(iterations=60, sh_degree=0, max_gaussians=2000, coarse_until=0.2)


@pytest.fixture(scope="module")
def scene() -> tuple[TrainingData, np.ndarray]:
    return photographed(ring(), valley(), wave=3.0, noise=0.05)[:2]


@pytest.mark.parametrize(("plain", "tolerance"), [(True, 0.015), (False, 0.005)])
def test_training_recovers_color_and_depth(scene, plain, tolerance):
    data, depths = scene
    settings = TrainSettings(
        iterations=300, sh_degree=0, max_gaussians=5000, plain=plain, test_every=8, num_patches=1024
    )
    result = train(data, settings, progress=False)
    assert mean_scores(result.held_out)["psnr"] > 22 and result.log[-1]["psnr"] > 22
    errors = []
    for view, truth in zip(data.views, depths, strict=True):
        depth, alpha, normals = depth_map(result.gaussians, view)
        chosen = alpha > 0.9
        assert chosen.mean() > 0.9
        errors.append(np.abs(depth - truth)[chosen] / truth[chosen])
        lengths = np.linalg.norm(normals, axis=2)
        assert np.allclose(lengths[depth > 0], 1, atol=1e-5) and normals[..., 2][depth > 0].max() < 0.2
    assert np.median(np.concatenate(errors)) < tolerance


def depth_errors(data, depths, **options):
    """(V, H, W) relative depth errors after a short training, NaN where alpha is below 0.9."""
    settings = TrainSettings(
        **{"iterations": 200, "sh_degree": 0, "max_gaussians": 5000, "num_patches": 1024} | options
    )
    gaussians = train(data, settings, progress=False).gaussians
    maps = [depth_map(gaussians, view) for view in data.views]
    return np.stack(
        [
            np.where(alpha > 0.9, np.abs(depth - truth) / truth, np.nan)
            for (depth, alpha, _), truth in zip(maps, depths, strict=True)
        ]
    )


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
    errors = depth_errors(data, depths, iterations=270)
    for nearest, farthest in ((0, 35), (35, 70), (70, 130)):
        chosen = errors[(depths > nearest * unit) & (depths < farthest * unit)]
        assert np.isfinite(chosen).mean() > 0.7
        assert np.nanmedian(chosen) < 0.025


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
    result = train(replace(data, images=photos), replace(SHORT, iterations=160), progress=False)
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


def with_tracks(data):
    return replace(data, tracks=[np.unique(rows) for rows in data.sightings])


def test_both_hold_outs_of_one_training_are_judged(scene, tmp_path):
    data = with_tracks(scene[0])
    settings = replace(SHORT, test_every=3, test_sector=0.25)
    result, split = train(data, settings, progress=False), data.held_out(settings)
    assert [row.held_out for row in result.held_out] == ["every 3"] * 2 + ["sector"] * 2
    assert [row.photo for row in result.held_out] == [
        data.views[index].name for index in split.every_nth + split.sector
    ]
    assert not result.exposures[split.all].any()
    scores = mean_scores(result.held_out)
    assert scores["photos"] == scores["sector_photos"] == 2
    for row in result.held_out:
        assert 0.5 < row.seen <= 1 and row.seen_psnr > 15 and 0 <= row.seen_depth <= 1
    assert scores["sector_seen_depth"] == np.mean([row.seen_depth for row in result.held_out[2:]])
    write_held_out(tmp_path / "held_out.csv", result.held_out)
    with (tmp_path / "held_out.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["photo"] for row in rows] == [row.photo for row in result.held_out]
    assert [float(row["seen_psnr"]) for row in rows] == [row.seen_psnr for row in result.held_out]
    write_held_out(tmp_path / "held_out.csv", [])
    assert not list(tmp_path.iterdir())


def test_what_the_held_out_photos_show_leaves_no_trace(scene):
    """Neither the sector's photos nor the sparse points that only they have found may reach the Gaussians."""
    data = with_tracks(scene[0])
    settings = replace(SHORT, iterations=20, test_sector=0.25)
    split = data.held_out(settings)
    only = times_seen([data.tracks[index] for index in split.trained], len(data.points)) < 2
    assert 0 < only.mean() < 0.9
    images = [np.zeros_like(image) if row in split.sector else image for row, image in enumerate(data.images)]
    points = np.where(only[:, None], data.points + [0.1, 0.2, 0.1], data.points)
    # the sector is found from the cameras and points: nearly the same ones
    other = replace(data, images=images, points=points)
    assert other.held_out(settings) == split
    first, second = (train(each, settings, progress=False).gaussians.parameters() for each in (data, other))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_scores_are_of_the_pixels_that_the_training_can_know(scene):
    """Gaussians that are right wherever the training sees, and missing elsewhere, are right."""
    data = with_tracks(scene[0])
    settings = replace(SHORT, test_sector=0.25, exposure="none")
    good = train(data, SHORT, progress=False).gaussians
    index = data.held_out(settings).sector[0]
    whole = {row.photo: row for row in held_out_scores(good, data, settings)}[data.views[index].name]
    photo, found = data.image(index).copy(), known_pixels(data, settings, index)
    assert 0.3 < found.mean() < 0.98 and whole.seen == pytest.approx(found.mean())
    photo[~found] = 255 - photo[~found]
    images = [photo if row == index else image for row, image in enumerate(data.images)]
    spoiled = held_out_scores(good, replace(data, images=images), settings)[0]
    assert spoiled.psnr < whole.psnr - 0.5
    assert spoiled.seen_psnr == pytest.approx(whole.seen_psnr) and spoiled.seen_depth == whole.seen_depth
    assert spoiled.seen_ssim == pytest.approx(whole.seen_ssim, abs=0.05)


def test_depth_is_judged_by_confirmed_depth_of_stereo_and_its_sky_is_not_seen(scene):
    depths = scene[1].astype(np.float32)
    sky, confirmed = np.zeros(depths.shape[1:], bool), np.ones(depths.shape[1:], np.uint8)
    sky[:20], confirmed[:, :30] = True, 0

    def stereo(index):
        return replace(DepthMap.nothing(sky.shape), depth=depths[index], num_views=confirmed, sky=sky)

    data, settings = replace(with_tracks(scene[0]), depth_maps=stereo), replace(SHORT, test_sector=0.2)
    good = train(scene[0], SHORT, progress=False).gaussians
    for row, index in zip(held_out_scores(good, data, settings), data.held_out(settings).sector, strict=True):
        found, seen = depth_map(good, data.views[index])[0], known_pixels(data, settings, index) & ~sky
        right = np.abs(found - depths[index]) < 0.01 * depths[index]
        assert row.seen == pytest.approx(seen.mean())
        assert row.seen_depth == pytest.approx(right[seen & (confirmed > 0)].mean(), abs=1e-3)


def known_pixels(data, settings, index):
    trained = data.held_out(settings).trained
    witnesses = Witnesses(
        [data.views[row] for row in trained], [data.tracks[row] for row in trained], data.points
    )
    return witnesses.pixels(data.views[index], data.tracks[index])


@pytest.mark.parametrize(
    "wrong", [{"test_every": -2}, {"test_sector": -0.1}, {"test_sector": 1.0}, {"test_sector": float("nan")}]
)
def test_hold_outs_that_say_nothing_are_refused(wrong):
    with pytest.raises(InputError, match="test_sector"):
        TrainSettings(**wrong)


@pytest.mark.parametrize(
    ("device", "photos", "steps"),
    [("cpu", 18, 1000), ("cpu", 100, 4000), ("cpu", 1000, 40_000), ("meta", 18, 1000)]
    + [("cuda", 18, 7000), ("cuda", 60, 18_000), ("cuda", 1000, 30_000)],
)
def test_numbers_follow_the_device_and_the_photos(device, photos, steps):
    found = TrainSettings().resolved(device, photos)
    amounts = (1_000_000, 1600) if device == "cuda" else (200_000, 800)
    assert (found.iterations, found.max_gaussians, found.max_size) == (steps, *amounts)
    assert found.resolved("cuda", 5) == found.resolved("cpu", 5) == found  # nothing is left to choose
    sized = TrainSettings().resolved(device)
    assert sized.iterations == 0 and sized.resolved(device, photos) == found
    assert replace(found, iterations=0, max_gaussians=0, max_size=0) == TrainSettings()
    assert [found.size(longest) for longest in (640, 4000)] == [640, amounts[1]]


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_numbers_that_are_given_hold_on_every_device(device):
    given = TrainSettings(iterations=7, max_gaussians=11, max_size=100)
    assert given.resolved(device, 100) == given


@pytest.mark.parametrize(
    "wrong", [{"iterations": -1}, {"max_gaussians": -1}, {"max_size": 15}, {"max_size": -1}]
)
def test_numbers_that_no_training_can_have_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        TrainSettings(**wrong)
