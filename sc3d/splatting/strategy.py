"""The densification strategy: where Gaussians are added and removed during training, under a cap.

The optimizer is torch's Adam with one named group per tensor of the Gaussians. Every change of the set is one
`gather`: rows of parameters, of Adam's moments and of the statistics move together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch.optim import Adam

from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.rendered_view import Rendering

MOMENTS = ("exp_avg", "exp_avg_sq")


@dataclass
class Statistics:
    """What the views seen since the last densification say about each of N Gaussians.

    gradient: (N,) sum of the loss' gradient norms by the image position, NDC units
    absolute_gradient: (N,) the same of absolute values
    count: (N,) views in which it was visible; radius: (N,) largest radius, px
    seen: (N,) views since the last pass over all views began in which it was hit with transmittance above 0.5
    inside: (N,) views since then in which it was visible at all
    """

    gradient: torch.Tensor
    absolute_gradient: torch.Tensor
    count: torch.Tensor
    radius: torch.Tensor
    seen: torch.Tensor
    inside: torch.Tensor

    @classmethod
    def zeros(cls, size: int, device: torch.device | str = "cpu") -> Statistics:
        """Statistics of `size` Gaussians that no view has seen."""
        return cls(*(torch.zeros(size, device=device) for _ in fields(cls)))

    def add(self, rendering: Rendering) -> None:
        """Add one view after its backward pass; radius 0 = not visible."""
        visible, view = rendering.radii > 0, rendering.statistics
        self.gradient += torch.where(visible, view.gradient, 0)
        self.absolute_gradient += torch.where(visible, view.absolute_gradient, 0)
        self.count += visible
        self.radius = torch.maximum(self.radius, rendering.radii)
        self.seen += view.max_transmittance > 0.5
        self.inside += visible

    def start_pass(self) -> None:
        """All views were seen: count `seen` and `inside` anew."""
        self.seen.zero_()
        self.inside.zero_()

    def restart(self) -> None:
        """Forget gradients and radii; `seen` and `inside` live until the end of the pass over all views."""
        for values in (self.gradient, self.absolute_gradient, self.count, self.radius):
            values.zero_()


@dataclass(frozen=True)
class DensifyLimits:
    """Thresholds of densification; `extent` is E in world units, everything else is relative or in pixels."""

    extent: float
    max_gaussians: int
    gradient: float = 2e-4
    absolute_gradient: float = 8e-4
    clone_scale: float = 0.001
    """clone at most this large, split above; fraction of E"""
    split_radius: float = 20.0
    """px in the image a Gaussian must cover for the absolute gradient to split it"""
    min_opacity: float = 0.005
    max_scale: float = 0.1
    """prune above; fraction of E"""


def adam(gaussians: Gaussians, rates: dict[str, float]) -> Adam:
    """The optimizer of Gaussians, whose tensors become leaves of the autograd graph. rates: per tensor"""
    groups = [
        {"name": name, "params": [tensor.requires_grad_()], "lr": rates[name]}
        for name, tensor in gaussians.parameters().items()
    ]
    return Adam(groups, eps=1e-15, fused=True)


def current_gaussians(optimizer: Adam) -> Gaussians:
    """The Gaussians whose tensors the optimizer holds."""
    return Gaussians(**{group["name"]: group["params"][0] for group in optimizer.param_groups})


def gather(
    optimizer: Adam, statistics: Statistics, source: torch.Tensor, fresh: torch.Tensor | None = None
) -> None:
    """Rebuild the set from rows of the present one: new[i] = old[source[i]].

    source: (M,) int64; fresh: (M,) bool, rows that start without momentum; None = none
    The optimizer gets new leaves.
    """
    for group in optimizer.param_groups:
        (tensor,) = group["params"]
        state = optimizer.state.pop(tensor, {})
        for name in MOMENTS if state else ():
            state[name] = state[name][source]
            if fresh is not None:
                state[name][fresh] = 0
        group["params"] = [tensor.detach()[source].requires_grad_()]
        optimizer.state[group["params"][0]] = state
    for field in fields(statistics):
        setattr(statistics, field.name, getattr(statistics, field.name)[source])


def prune(optimizer: Adam, statistics: Statistics, mask: torch.Tensor) -> None:
    """Take the Gaussians of an (N,) bool mask away."""
    kept = torch.nonzero(~mask)[:, 0]
    if len(kept) < len(mask):
        gather(optimizer, statistics, kept)


@torch.no_grad()
def prune_mask(gaussians: Gaussians, limits: DensifyLimits) -> torch.Tensor:
    """(N,) bool: transparent, larger than any surface needs, or not a number."""
    largest = gaussians.log_scales.amax(1).exp()
    finite = torch.isfinite(gaussians.means).all(1) & torch.isfinite(largest)
    too_large = largest > limits.max_scale * limits.extent
    return (gaussians.opacities < limits.min_opacity) | too_large | ~finite


@torch.no_grad()
def densify_masks(
    gaussians: Gaussians, statistics: Statistics, limits: DensifyLimits, room: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Which Gaussians to clone and which to split, at most `room` together: the largest gradients (relative
    to their thresholds) first.

    returns: two (N,) bool, disjoint. Clone: mean gradient over the threshold and small; split: the same and
        large, or mean absolute gradient over its threshold and a large radius in the image.
    """
    views = statistics.count.clamp_min(1)
    plain = statistics.gradient / views / limits.gradient
    absolute = statistics.absolute_gradient / views / limits.absolute_gradient
    large = gaussians.log_scales.amax(1).exp() > limits.clone_scale * limits.extent
    clones = (plain >= 1) & ~large
    splits = ((plain >= 1) & large) | ((absolute >= 1) & (statistics.radius > limits.split_radius) & ~clones)
    chosen = clones | splits
    if int(chosen.sum()) > room:
        urgency = torch.where(chosen, torch.maximum(plain, absolute * splits), torch.full_like(plain, -1))
        within = torch.zeros_like(chosen)
        within[torch.argsort(urgency, descending=True, stable=True)[: max(room, 0)]] = True
        clones, splits = clones & within, splits & within
    return clones, splits


def clone_and_split(
    optimizer: Adam,
    statistics: Statistics,
    masks: tuple[torch.Tensor, torch.Tensor],
    generator: torch.Generator,
) -> None:
    """Add a copy of each of the first mask's Gaussians; replace each of the second's by two samples of itself
    with 1 / 1.6 of its scales. masks: (N,) bool, disjoint. New Gaussians start without momentum.
    """
    clones, splits = masks
    kept, cloned, split = (torch.nonzero(mask)[:, 0] for mask in (~splits, clones, splits))
    source = torch.cat([kept, cloned, split, split])
    gather(optimizer, statistics, source, torch.arange(len(source), device=source.device) >= len(kept))
    if not len(split):
        return
    with torch.no_grad():
        gaussians, first = current_gaussians(optimizer), len(kept) + len(cloned)
        parts = gaussians[first:]
        offsets = parts.scales * torch.randn(len(parts), 3, generator=generator).to(parts.scales)
        gaussians.means[first:] += (parts.rotations @ offsets[..., None])[..., 0]
        gaussians.log_scales[first:] -= math.log(1.6)


def densify(
    optimizer: Adam, statistics: Statistics, limits: DensifyLimits, generator: torch.Generator
) -> None:
    """One round: prune, then clone and split what the statistics ask for as far as the cap leaves room;
    statistics start again.
    """
    prune(optimizer, statistics, prune_mask(current_gaussians(optimizer), limits))
    gaussians = current_gaussians(optimizer)
    room = limits.max_gaussians - len(gaussians)
    if room < 0:
        faintest = torch.argsort(gaussians.opacities.detach(), stable=True)[:-room]
        mask = torch.zeros_like(gaussians.opacity_logits, dtype=torch.bool)
        mask[faintest] = True
        prune(optimizer, statistics, mask)
    elif room > 0:
        masks = densify_masks(gaussians, statistics, limits, room)
        clone_and_split(optimizer, statistics, masks, generator)
    statistics.restart()


def prune_unseen(optimizer: Adam, statistics: Statistics) -> None:
    """Drop Gaussians that no view, or one of more than two that could, saw unoccluded during the last pass:
    hidden or floating ones.

    What only one or two photos contain, at the border of a flight, stays.
    """
    prune(optimizer, statistics, (statistics.seen == 0) | ((statistics.seen < 2) & (statistics.inside > 2)))


@torch.no_grad()
def reset_opacity(optimizer: Adam, ceiling: float = 0.01) -> None:
    """Lower all opacities to at most `ceiling` and forget their momentum: what no view needs does not come
    back.
    """
    logits = current_gaussians(optimizer).opacity_logits
    logits.clamp_(max=math.log(ceiling / (1 - ceiling)))
    for name in MOMENTS if optimizer.state[logits] else ():
        optimizer.state[logits][name].zero_()
