"""What is fitted to the colors of each photo: casts of white balance stay out of the Gaussians."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sc3d.geometry.cameras import look_at, pinhole_view
from sc3d.settings.train import TrainSettings
from sc3d.splatting.rendering import render
from sc3d.splatting.trainer import train
from tests.splatting.scenes import SIZE, photographed, plane
from tests.splatting.test_trainer import SHORT

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT = SIZE


def cast(data, strength):
    """Training data whose photos have casts, each its own: gains, mixed channels and offsets."""
    random, count = np.random.default_rng(1), len(data.views)
    mixed = random.uniform(-strength, strength, (count, 3, 3)) * np.where(np.eye(3), 1, 0.3)
    offsets = random.uniform(-0.2, 0.2, (count, 3)) * strength
    photos = [
        (255 * np.clip(photo / 255 @ (np.eye(3) + change).T + offset, 0, 1) + 0.5).astype(np.uint8)
        for photo, change, offset in zip(data.images, mixed, offsets, strict=True)
    ]
    return replace(data, images=photos)


def areas(image):
    """(N, 3) mean colors of 8x8 pixels: casts, not details."""
    return image.reshape(HEIGHT // 8, 8, WIDTH // 8, 8, 3).mean((1, 3)).reshape(-1, 3)


def color_error(gaussians, data):
    """Root mean square of what tells the colors of areas from those of photos, up to one affine transform."""
    with torch.no_grad():
        shown = [render(gaussians, view, geometry=False).color.numpy() for view in data.views]
    found, truth = (
        np.concatenate([areas(np.ascontiguousarray(image)) for image in images])
        for images in (shown, [photo / 255 for photo in data.images])
    )
    found = np.hstack([found, np.ones((len(found), 1))])
    return np.sqrt(np.mean((found @ np.linalg.lstsq(found, truth, rcond=None)[0] - truth) ** 2))


@pytest.fixture(scope="module")
def strip():
    """12 photos along a line, of which four show each place: casts do not cancel out."""
    places = 1.6 * (np.arange(12) - 5.5)
    poses = [
        look_at(np.array([x, 0.8 * (-1) ** row, 9.0]), np.array([x, 0, 0])) for row, x in enumerate(places)
    ]
    views = [
        pinhole_view(f"{row}.png", SIZE, (90.0, 90.0, 50.0, 31.0), pose) for row, pose in enumerate(poses)
    ]
    return photographed(views, [plane([0, 0, 1], 0.0)], wave=6.0, noise=0.02)[0]


def test_affine_takes_casts_off_the_scene_and_costs_nothing_without(strip):
    settings = TrainSettings(iterations=480, max_gaussians=4000, fill=False, plain=True)
    errors = {
        (strength, exposure): color_error(
            train(cast(strip, strength), replace(settings, exposure=exposure), progress=False).gaussians,
            strip,
        )
        for strength in (0.0, 0.25)
        for exposure in ("gain", "affine")
    }
    assert errors[0.25, "affine"] < 0.015 < 0.03 < errors[0.25, "gain"], errors
    assert errors[0.0, "affine"] < errors[0.0, "gain"] + 0.5 / 255, errors  # half a gray level


def test_the_mean_photo_keeps_its_colors_and_what_is_held_out_has_none(strip):
    data, settings = cast(strip, 0.25), replace(SHORT, exposure="affine", test_every=4, fill=False)
    result = train(data, settings, progress=False)
    split = data.held_out(settings)
    assert result.exposures.shape == (12, 12) and not result.exposures[split.all].any()
    assert np.abs(result.exposures[split.trained]).min(axis=1).all()
    assert np.abs(result.exposures[split.trained].mean(axis=0)).max() < 1e-7


def test_affine_resumes_exactly_and_not_from_gain(strip, tmp_path, caplog):
    data, file = cast(strip, 0.25), tmp_path / "checkpoint.pt"
    settings = replace(SHORT, exposure="affine", checkpoint_every=35, plain=True, fill=False)
    whole, resumed = (train(data, settings, file, progress=False) for _ in range(2))
    assert np.array_equal(whole.exposures, resumed.exposures) and "starting over" not in caplog.text
    assert torch.equal(whole.gaussians.sh_dc, resumed.gaussians.sh_dc)
    train(data, replace(settings, exposure="gain", iterations=3), file, progress=False)
    assert "starting over" in caplog.text
