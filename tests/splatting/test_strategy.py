"""Densification: rows of parameters, moments and statistics stay together; thresholds, cap, trim, reset."""

import math

import pytest
import torch
from torch.optim import Adam

from sc3d.splatting import strategy
from sc3d.splatting.rendered_view import Rendering, ViewStatistics
from sc3d.splatting.strategy import MOMENTS, DensifyLimits, Statistics, current_gaussians
from tests.splatting.test_gaussians import random_gaussians

RATES = {
    "means": 0.01,
    "log_scales": 0.01,
    "quats": 0.01,
    "opacity_logits": 0.01,
    "sh_dc": 0.01,
    "sh_rest": 0.01,
}


def tagged(count: int) -> tuple[Adam, Statistics]:
    """Row i of every tensor, moment and statistic holds the value i."""
    gaussians, tags = random_gaussians(count, 1), torch.arange(count, dtype=torch.float32)
    for tensor in gaussians.parameters().values():
        tensor[:] = tags.reshape(-1, *[1] * (tensor.dim() - 1))
    optimizer = strategy.adam(gaussians, RATES)
    for group in optimizer.param_groups:
        (tensor,) = group["params"]
        moments = {name: tensor.detach().clone() for name in MOMENTS}
        optimizer.state[tensor] = {"step": torch.tensor(1.0), **moments}
    return optimizer, Statistics(*(tags.clone() for _ in range(6)))


@pytest.mark.parametrize("seed", range(5))
def test_parameters_moments_and_statistics_permute_together(seed):
    generator = torch.Generator().manual_seed(seed)
    optimizer, statistics = tagged(40)
    source = torch.randint(40, (60,), generator=generator)
    fresh = torch.rand(60, generator=generator) < 0.3
    strategy.gather(optimizer, statistics, source, fresh)
    for group in optimizer.param_groups:
        (tensor,) = group["params"]
        assert tensor.is_leaf and tensor.requires_grad and tensor.is_contiguous()
        assert (tensor.detach().reshape(60, -1) == source[:, None]).all()
        for name in MOMENTS:
            moments = optimizer.state[tensor][name].reshape(60, -1)
            assert (moments == torch.where(fresh, 0, source)[:, None]).all()
    assert len(optimizer.state) == 6
    assert all((values == source).all() for values in vars(statistics).values())


def small_scene(count: int) -> tuple[Adam, Statistics]:
    gaussians = random_gaussians(count, 0)
    gaussians.log_scales.fill_(math.log(1e-4))
    gaussians.opacity_logits.zero_()
    optimizer = strategy.adam(gaussians, RATES)
    statistics = Statistics.zeros(count)
    statistics.count += 2
    return optimizer, statistics


def test_small_ones_are_cloned_and_large_ones_split():
    optimizer, statistics = small_scene(6)
    statistics.gradient[:4] = 2 * 3e-4
    with torch.no_grad():
        current_gaussians(optimizer).log_scales[2:] = math.log(0.01)
    before = current_gaussians(optimizer).detached()
    strategy.densify(
        optimizer, statistics, DensifyLimits(extent=1.0, max_gaussians=100), torch.Generator().manual_seed(0)
    )
    after = current_gaussians(optimizer).detached()
    assert len(after) == 6 + 2 + 2  # 2 clones, and 2 Gaussians replaced by 4
    assert torch.equal(after.means[4:6], before.means[:2])
    assert torch.allclose(after.log_scales[6:], before.log_scales[2:4].repeat(2, 1) - math.log(1.6))
    assert ((after.means[6:] - before.means[2:4].repeat(2, 1)).norm(dim=1) < 0.06).all()
    assert not statistics.gradient.any() and len(statistics.count) == 10


def test_split_samples_have_the_covariance():
    optimizer, statistics = small_scene(1)
    with torch.no_grad():
        current_gaussians(optimizer).log_scales[:] = torch.tensor([[0.0, -1.0, -3.0]])
    strategy.gather(optimizer, statistics, torch.zeros(20000, dtype=torch.int64))
    covariance, mean = (
        current_gaussians(optimizer).covariances[0].detach(),
        current_gaussians(optimizer).means[0].detach().clone(),
    )
    nothing = torch.zeros(20000, dtype=torch.bool)
    strategy.clone_and_split(optimizer, statistics, (nothing, ~nothing), torch.Generator().manual_seed(0))
    assert torch.allclose(
        torch.cov((current_gaussians(optimizer).means.detach() - mean).T), covariance, atol=0.02
    )


def test_cap_keeps_the_largest_gradients():
    optimizer, statistics = small_scene(50)
    statistics.gradient[:] = torch.linspace(1e-3, 5e-3, 50)
    clones, splits = strategy.densify_masks(
        current_gaussians(optimizer), statistics, DensifyLimits(1.0, 60), 10
    )
    assert clones.nonzero()[:, 0].tolist() == list(range(40, 50)) and not splits.any()
    strategy.densify(optimizer, statistics, DensifyLimits(1.0, 60), torch.Generator())
    assert len(current_gaussians(optimizer)) == 60
    strategy.densify(optimizer, statistics, DensifyLimits(1.0, 45), torch.Generator())
    assert len(current_gaussians(optimizer)) == 45


def test_useless_ones_are_pruned():
    optimizer, statistics = small_scene(5)
    with torch.no_grad():
        current_gaussians(optimizer).opacity_logits[0] = -6
        current_gaussians(optimizer).log_scales[1, 2] = math.log(0.2)
        current_gaussians(optimizer).means[2, 0] = float("nan")
    kept = current_gaussians(optimizer).means[3:].detach().clone()
    strategy.densify(optimizer, statistics, DensifyLimits(1.0, 100), torch.Generator())
    assert torch.equal(current_gaussians(optimizer).means.detach(), kept)


def test_trim_drops_what_is_hidden_or_floats():
    optimizer, statistics = small_scene(5)
    # seen by two of three; by one of three; by none; by the only one; by one of two
    for radius, transmittance in (
        ([3, 3, 3, 3, 3], [0.9, 0.9, 0.3, 0.9, 0.8]),
        ([3, 3, 3, 0, 3], [0.9, 0.2, 0.3, 0, 0.4]),
        ([3, 3, 3, 0, 0], [0] * 5),
    ):
        view = ViewStatistics(*torch.zeros(4, 5))
        view.max_transmittance = torch.tensor(transmittance).float()
        statistics.add(Rendering(*[None] * 4, torch.tensor(radius).float(), view))
    kept = current_gaussians(optimizer).means[[0, 3, 4]].detach().clone()
    strategy.prune_unseen(optimizer, statistics)
    assert torch.equal(current_gaussians(optimizer).means.detach(), kept)
    statistics.start_pass()
    assert not statistics.seen.any() and not statistics.inside.any() and len(statistics.seen) == 3


def test_opacity_reset():
    optimizer, _ = small_scene(3)
    strategy.reset_opacity(optimizer)  # before the first step
    logits = current_gaussians(optimizer).opacity_logits
    optimizer.state[logits] = {"step": torch.tensor(1.0), **{name: torch.ones(3) for name in MOMENTS}}
    with torch.no_grad():
        logits += 1
    strategy.reset_opacity(optimizer)
    assert torch.allclose(current_gaussians(optimizer).opacities, torch.full((3,), 0.01))
    assert logits.requires_grad and not any(optimizer.state[logits][name].any() for name in MOMENTS)


def test_gathered_rows_go_on_as_if_alone():
    """Two of four rows, gathered after two steps, end where they would have without the others."""
    results = []
    for rows in (torch.arange(4), torch.tensor([3, 1])):
        gaussians = random_gaussians(4, 1, seed=3)
        optimizer = strategy.adam(gaussians if len(rows) == 4 else gaussians[rows], RATES)
        generator = torch.Generator().manual_seed(0)
        for step in range(4):
            if step == 2 and len(rows) == 4:
                strategy.gather(optimizer, Statistics.zeros(4), torch.tensor([3, 1]))
            for tensor in current_gaussians(optimizer).parameters().values():
                gradient = torch.randn(4, *tensor.shape[1:], generator=generator)
                tensor.grad = gradient if len(tensor) == 4 else gradient[[3, 1]]
            optimizer.step()
        results.append(current_gaussians(optimizer).parameters())
    for name, tensor in results[0].items():
        assert torch.equal(tensor, results[1][name]), name
