"""The median depth: analytic truths, the dense twin, finite differences; and where the option leads."""

import numba
import numpy as np
import pytest
import torch

from sc3d.geometry.cameras import pinhole_view, rays
from sc3d.settings.train import TrainSettings
from sc3d.splatting.evaluation import depth_map
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.rendering import render, surface_depth
from sc3d.splatting.trainer import Trainer
from tests.reference.splatting import median_depth_reference
from tests.splatting.scenes import RED_POINT, flat_ground, photographed, ring, valley, view_of
from tests.splatting.test_rendering import (
    NAMES,
    images,
    make_gaussians,
    make_view,
    weighted_sum,
    with_gradients,
)


@pytest.fixture
def photos():
    return photographed([view.resized(48, 32) for view in ring()], valley(), 3.0, 0.05, 300)[0]


def sheets(depths, opacities, size=40.0):
    """Large discs across the z axis, one at each depth."""
    count = len(depths)
    means = torch.zeros(count, 3)
    means[:, 2] = torch.tensor(depths)
    scales, quats = torch.tensor([[size, size, 1e-3]]).log().repeat(count, 1), torch.zeros(count, 4)
    quats[:, 0] = 1
    return Gaussians(means, scales, quats, torch.logit(torch.tensor(opacities)), torch.zeros(count, 3))


def straight_view(focal=50.0):
    return pinhole_view("straight", (8, 6), (focal, focal, 4.0, 3.0), np.eye(4))


def median(gaussians, view=None):
    return render(gaussians, view or straight_view(), depth_mode="median").median_depth


def assert_close_to_reference(gaussians, view):
    fast, slow = with_gradients(gaussians), with_gradients(gaussians, torch.float64)
    found, (expected, smooth) = median(fast, view), median_depth_reference(slow, view)
    either = (found > 0) | (expected > 0)
    assert ((found > 0) == (expected > 0)).double().mean() > 0.999
    both = (found > 0) & (expected > 0)
    assert either.double().mean() > 0.3
    focal = view.matrix[0, 0]
    gap = ((found - expected).abs() / expected.clamp_min(1e-6))[both].detach() * focal
    assert gap.quantile(0.99) < 0.01 and gap.max() < 0.1  # footprints
    smooth &= both
    assert smooth.sum() > 100
    weight = torch.randn(found.shape, generator=torch.Generator().manual_seed(3)) * smooth
    (found * weight).sum().backward()
    (expected * weight).sum().backward()
    for name in NAMES[:4]:
        gradient, truth = getattr(fast, name).grad, getattr(slow, name).grad
        assert truth.norm() > 0
        assert (gradient - truth).norm() <= 1e-3 * truth.norm(), name
    assert (fast.sh_dc.grad == 0).all()


@pytest.mark.parametrize(("seed", "size"), [(1, -1.2), (2, -1.4), (3, -0.8)])
def test_depth_and_gradients_equal_the_dense_twin(seed, size):
    gaussians = make_gaussians(150, 1, seed=seed, size=size)
    gaussians.log_scales[:, 2] = size - 3
    gaussians.opacity_logits += 1
    assert_close_to_reference(gaussians, make_view())


@pytest.mark.parametrize("opacity", [0.55, 0.8, 0.95])
def test_one_sheet_is_seen_where_it_is(opacity):
    """Half of the light is gone within the footprint of its depth, z / f, at half its weight at the latest."""
    depth = median(sheets([5.0], [opacity]))
    assert torch.allclose(depth, torch.tensor(5 * (1 + (0.5 / opacity - 0.5) / 50)), rtol=1e-5)


@pytest.mark.parametrize(
    ("opacities", "expected"),
    [([0.3, 0.9], 6.0), ([0.7, 0.9], 3.0), ([0.49, 0.9], 6.0), ([0.51, 0.9], 3.0)],
)
def test_a_veil_does_not_move_the_surface_behind_it(opacities, expected):
    gaussians, view = sheets([3.0, 6.0], opacities), straight_view(500.0)
    rendering = render(gaussians, view, depth_mode="median")
    assert torch.allclose(surface_depth(rendering, view), torch.tensor(expected), rtol=2e-3)
    blended = surface_depth(render(gaussians, view), view)
    assert ((blended > 3.3) & (blended < 5.7)).all()


@pytest.mark.parametrize("opacities", [[0.4], [0.25, 0.25], []])
def test_no_depth_where_half_of_the_light_gets_through(opacities):
    assert not median(sheets([4.0, 5.0][: len(opacities)], opacities)).any()


def test_oblique_ground_is_found_within_half_a_footprint():
    view = view_of((-3.0, -2.0, 2.5))
    depth = median(flat_ground(), view).double()
    directions, along = rays(view)
    expected = torch.from_numpy((-view.center[2] / directions[:, 2] * along).reshape(depth.shape))
    points = view.center + (expected.numpy().ravel() / along)[:, None] * directions
    inner = (np.abs(points[:, :2]) < 3.5).all(1) & (np.hypot(*(points - RED_POINT)[:, :2].T) > 1.5)
    inner = torch.from_numpy(inner.reshape(depth.shape)) & (expected > 0)
    assert inner.double().mean() > 0.3
    assert ((depth - expected).abs() / expected * view.focal)[inner].max() < 0.51


def test_gradients_are_those_of_finite_differences():
    """Three sheets within a footprint: each logit and depth moves the median."""
    depths, opacities, step = [5.0, 5.03, 5.06], [0.3, 0.4, 0.8], 1e-2
    gaussians = with_gradients(sheets(depths, opacities))
    median(gaussians).mean().backward()
    for name, place in [(name, row) for name in ("opacity_logits", "means") for row in range(3)]:
        index = (place, 2) if name == "means" else (place,)
        size = 1e-3 if name == "means" else step
        found = []
        for sign in (-1, 1):
            moved = sheets(depths, opacities)
            getattr(moved, name)[index] += sign * size
            found.append(float(median(moved).double().mean()))
        slope = float(getattr(gaussians, name).grad[index])
        assert slope == pytest.approx((found[1] - found[0]) / (2 * size), rel=0.02, abs=2e-4), (name, place)
    assert (gaussians.opacity_logits.grad < 0).all()  # more opaque: nearer


def test_asking_for_it_changes_nothing_else():
    view, found = make_view(), []
    for mode in ("blended", "median"):
        gaussians = with_gradients(make_gaussians(200, 4, seed=5))
        rendering = render(gaussians, view, depth_mode=mode)
        weighted_sum(images(rendering)).backward()
        found.append([*images(rendering), *(getattr(gaussians, name).grad for name in NAMES)])
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))
    assert render(make_gaussians(9, 1), view, geometry=False, depth_mode="median").median_depth is None


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one processor")
def test_threads_do_not_change_a_bit():
    before, results = numba.get_num_threads(), []
    for threads in (1, 2):
        numba.set_num_threads(threads)
        gaussians = with_gradients(make_gaussians(2000, 1, seed=11, size=-2.5))
        depth = median(gaussians, make_view(150, 110, (120.0, 120.0, 70.0, 50.0)))
        depth.sum().backward()
        results.append([depth, *(getattr(gaussians, name).grad for name in NAMES)])
    numba.set_num_threads(before)
    assert all(torch.equal(first, second) for first, second in zip(*results, strict=True))


def test_extreme_parameters_stay_finite():
    gaussians = make_gaussians(64, 1, seed=13)
    gaussians.log_scales[:8], gaussians.log_scales[8:16] = 12.0, -30.0
    gaussians.opacity_logits[16:24], gaussians.opacity_logits[24:32] = 60.0, -60.0
    gaussians.means[40:48, 2], gaussians.means[48:56, 0] = -4.98, 1e6
    gaussians = with_gradients(gaussians)
    depth = median(gaussians, make_view())
    depth.sum().backward()
    assert torch.isfinite(depth).all() and (depth >= 0).all()
    assert all(torch.isfinite(getattr(gaussians, name).grad).all() for name in NAMES)


def test_training_on_it(photos):
    states = []
    for mode in ("blended", "median"):
        settings = TrainSettings(
            3, 300, sh_degree=0, num_patches=64, surface_from=0.0, coarse_until=0.0, depth_mode=mode
        )
        trainer = Trainer(photos, settings)
        for _ in range(3):
            trainer.step()
        states.append(trainer.gaussians.detached().means)
    assert torch.isfinite(states[1]).all()
    assert not torch.equal(*states) and (states[0] - states[1]).abs().median() < 0.1


def test_depth_map_of_either_mode():
    """A veil of alpha 0.3 before an opaque wall: only the blended depth shows it."""
    gaussians, view = sheets([3.0, 6.0], [0.3, 0.99]), straight_view(500.0)
    assert np.allclose(depth_map(gaussians, view, "median")[0], 6.0, rtol=2e-3)
    assert (depth_map(gaussians, view)[0] < 5.7).all()
