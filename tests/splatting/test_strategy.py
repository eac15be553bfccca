"""Densification: rows of parameters, moments and statistics stay together; thresholds, cap, trim, reset."""

import math

import pytest
import torch

from sc3d.splatting import strategy as densify
from sc3d.splatting.optimizer import RowAdam
from sc3d.splatting.strategy import DensifyLimits, Statistics
from tests.splatting.test_gaussians import random_gaussians

RATES = {
    "means": 0.01,
    "log_scales": 0.01,
    "quats": 0.01,
    "opacity_logits": 0.01,
    "sh_dc": 0.01,
    "sh_rest": 0.01,
}


def tagged(count: int) -> tuple[RowAdam, Statistics]:
    """Row i of every tensor, moment and statistic holds the value i."""
    gaussians = random_gaussians(count, 1)
    tags = torch.arange(count, dtype=torch.float32)
    parameters = {
        name: torch.zeros_like(tensor) + tags.reshape(-1, *[1] * (tensor.dim() - 1))
        for name, tensor in gaussians.parameters().items()
    }
    optimizer = RowAdam({name: tensor.requires_grad_() for name, tensor in parameters.items()}, RATES)
    for moments in (optimizer.means, optimizer.squares):
        for name in moments:
            moments[name] = parameters[name].detach().clone()
    statistics = Statistics(*(tags.clone() for _ in range(6)))
    return optimizer, statistics


@pytest.mark.parametrize("seed", range(5))
def test_parameters_moments_and_statistics_permute_together(seed):
    generator = torch.Generator().manual_seed(seed)
    optimizer, statistics = tagged(40)
    source = torch.randint(40, (60,), generator=generator)
    fresh = torch.rand(60, generator=generator) < 0.3
    optimizer.take(source, fresh)
    statistics.take(source)
    for name, tensor in optimizer.parameters.items():
        assert tensor.is_leaf and tensor.requires_grad and tensor.is_contiguous()
        assert (tensor.detach().reshape(60, -1) == source[:, None]).all()
        for moments in (optimizer.means, optimizer.squares):
            assert (moments[name].reshape(60, -1) == torch.where(fresh, 0, source)[:, None]).all()
    assert all((values == source).all() for values in vars(statistics).values())


def test_adam_equals_torch():
    gaussians = random_gaussians(30, 1)
    ours = {name: tensor.clone().requires_grad_() for name, tensor in gaussians.parameters().items()}
    theirs = {name: tensor.clone().requires_grad_() for name, tensor in gaussians.parameters().items()}
    optimizer, reference = RowAdam(ours, RATES), torch.optim.Adam(theirs.values(), lr=0.01, eps=1e-15)
    generator = torch.Generator().manual_seed(1)
    for _ in range(20):
        for name in ours:
            gradient = torch.randn(ours[name].shape, generator=generator)
            ours[name].grad, theirs[name].grad = gradient.clone(), gradient.clone()
        optimizer.step()
        reference.step()
    for name in ours:
        assert torch.allclose(ours[name], theirs[name], atol=1e-5), name


def test_adam_leaves_other_rows_alone():
    values = torch.ones(4, 3, requires_grad=True)
    optimizer = RowAdam({"values": values}, {"values": [0.1, 0.1, 0.0]})
    values.grad = torch.ones(4, 3)
    optimizer.step(torch.tensor([True, False, True, False]))
    assert torch.allclose(
        values.detach(), torch.tensor([[0.9, 0.9, 1.0], [1, 1, 1], [0.9, 0.9, 1.0], [1, 1, 1]])
    )
    assert values.grad is None and not optimizer.means["values"][1].any()


def small_scene(count: int) -> tuple[RowAdam, Statistics]:
    gaussians = random_gaussians(count, 0)
    gaussians.log_scales.fill_(math.log(1e-4))
    gaussians.opacity_logits.zero_()
    optimizer = RowAdam(
        {name: tensor.requires_grad_() for name, tensor in gaussians.parameters().items()}, RATES
    )
    statistics = Statistics.zeros(count)
    statistics.count += 2
    return optimizer, statistics


def test_small_ones_are_cloned_and_large_ones_split():
    optimizer, statistics = small_scene(6)
    statistics.gradient[:4] = 2 * 3e-4
    with torch.no_grad():
        optimizer.parameters["log_scales"][2:] = math.log(0.01)
    before = densify.current(optimizer).detached()
    densify.densify(
        optimizer, statistics, DensifyLimits(extent=1.0, max_gaussians=100), torch.Generator().manual_seed(0)
    )
    after = densify.current(optimizer).detached()
    assert len(after) == 6 + 2 + 2  # 2 clones, and 2 Gaussians replaced by 4
    assert torch.equal(after.means[4:6], before.means[:2])
    assert torch.allclose(after.log_scales[6:], before.log_scales[2:4].repeat(2, 1) - math.log(1.6))
    assert ((after.means[6:] - before.means[2:4].repeat(2, 1)).norm(dim=1) < 0.06).all()
    assert not statistics.gradient.any() and len(statistics.count) == 10


def test_split_samples_have_the_covariance():
    optimizer, statistics = small_scene(1)
    with torch.no_grad():
        optimizer.parameters["log_scales"][:] = torch.tensor([[0.0, -1.0, -3.0]])
    optimizer.take(torch.zeros(20000, dtype=torch.int64), torch.zeros(20000, dtype=torch.bool))
    statistics.take(torch.zeros(20000, dtype=torch.int64))
    covariance, mean = (
        densify.current(optimizer).covariances[0].detach(),
        optimizer.parameters["means"][0].detach().clone(),
    )
    nothing = torch.zeros(20000, dtype=torch.bool)
    densify.clone_and_split(optimizer, statistics, nothing, ~nothing, torch.Generator().manual_seed(0))
    assert torch.allclose(torch.cov((optimizer.parameters["means"].detach() - mean).T), covariance, atol=0.02)


def test_cap_keeps_the_largest_gradients():
    optimizer, statistics = small_scene(50)
    statistics.gradient[:] = torch.linspace(1e-3, 5e-3, 50)
    clones, splits = densify.select(densify.current(optimizer), statistics, DensifyLimits(1.0, 60), 10)
    assert clones.nonzero()[:, 0].tolist() == list(range(40, 50)) and not splits.any()
    densify.densify(optimizer, statistics, DensifyLimits(1.0, 60), torch.Generator())
    assert len(densify.current(optimizer)) == 60
    densify.densify(optimizer, statistics, DensifyLimits(1.0, 45), torch.Generator())
    assert len(densify.current(optimizer)) == 45


def test_useless_ones_are_pruned():
    optimizer, statistics = small_scene(5)
    with torch.no_grad():
        optimizer.parameters["opacity_logits"][0] = -6
        optimizer.parameters["log_scales"][1, 2] = math.log(0.2)
        optimizer.parameters["means"][2, 0] = float("nan")
    kept = optimizer.parameters["means"][3:].detach().clone()
    densify.densify(optimizer, statistics, DensifyLimits(1.0, 100), torch.Generator())
    assert torch.equal(optimizer.parameters["means"].detach(), kept)


def test_trim_drops_what_is_hidden_or_floats():
    optimizer, statistics = small_scene(5)
    # seen by two of three; by one of three; by none; by the only one; by one of two
    for radius, transmittance in (
        ([3, 3, 3, 3, 3], [0.9, 0.9, 0.3, 0.9, 0.8]),
        ([3, 3, 3, 0, 3], [0.9, 0.2, 0.3, 0, 0.4]),
        ([3, 3, 3, 0, 0], [0] * 5),
    ):
        statistics.add(torch.zeros(5), torch.zeros(5), torch.tensor(radius), torch.tensor(transmittance))
    kept = optimizer.parameters["means"][[0, 3, 4]].detach().clone()
    densify.trim(optimizer, statistics)
    assert torch.equal(optimizer.parameters["means"].detach(), kept)
    statistics.start_pass()
    assert not statistics.seen.any() and not statistics.inside.any() and len(statistics.seen) == 3


def test_opacity_reset():
    optimizer, _ = small_scene(3)
    optimizer.means["opacity_logits"] += 1
    densify.reset_opacity(optimizer)
    assert torch.allclose(densify.current(optimizer).opacities, torch.full((3,), 0.01))
    assert (
        not optimizer.means["opacity_logits"].any() and optimizer.parameters["opacity_logits"].requires_grad
    )
