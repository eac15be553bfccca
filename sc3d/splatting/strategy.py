"""Where Gaussians are added and removed during training: clone, split, prune, opacity reset, multi-view trim,
under a cap.

Every change of the set is one gather, `RowAdam.take`: rows of parameters, of Adam's moments and of the
statistics move together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch

from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.optimizer import RowAdam


@dataclass
class Statistics:
    """What the views seen since the last densification say about each of N Gaussians.

    gradient: (N,) sum of the loss' gradient norms by the image position, NDC units; absolute_gradient: (N,)
        the same of absolute values
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

    def add(
        self,
        gradient: torch.Tensor,
        absolute_gradient: torch.Tensor,
        radius: torch.Tensor,
        max_transmittance: torch.Tensor,
    ) -> None:
        """Add one view's (N,) values; radius 0 = not visible."""
        visible = radius > 0
        self.gradient += torch.where(visible, gradient, 0)
        self.absolute_gradient += torch.where(visible, absolute_gradient, 0)
        self.count += visible
        self.radius = torch.maximum(self.radius, radius.float())
        self.seen += max_transmittance > 0.5
        self.inside += visible

    def take(self, source: torch.Tensor) -> None:
        """Rows `source` (M,) of the present ones."""
        for field in fields(self):
            setattr(self, field.name, getattr(self, field.name)[source])

    def start_pass(self) -> None:
        """All views were seen: count `seen` and `inside` anew."""
        self.seen.zero_()
        self.inside.zero_()

    def restart(self) -> None:
        """Forget the gradients and radii; `seen` and `inside` live until the end of the pass over all views."""
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


def current(optimizer: RowAdam) -> Gaussians:
    """The Gaussians whose tensors the optimizer holds."""
    return Gaussians(**optimizer.parameters)


def prune(optimizer: RowAdam, statistics: Statistics, removed: torch.Tensor) -> None:
    """Take the Gaussians with `removed` (N,) bool away."""
    kept = torch.nonzero(~removed)[:, 0]
    if len(kept) < len(removed):
        optimizer.take(kept, torch.zeros(len(kept), dtype=torch.bool))
        statistics.take(kept)


def useless(gaussians: Gaussians, limits: DensifyLimits) -> torch.Tensor:
    """(N,) bool: transparent, larger than any surface needs, or not a number."""
    with torch.no_grad():
        largest = gaussians.log_scales.amax(1).exp()
        finite = torch.isfinite(gaussians.means).all(1) & torch.isfinite(largest)
        return (
            (gaussians.opacities < limits.min_opacity)
            | (largest > limits.max_scale * limits.extent)
            | ~finite
        )


def select(
    gaussians: Gaussians, statistics: Statistics, limits: DensifyLimits, room: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Which Gaussians to clone and which to split, at most `room` together: the largest gradients (relative
    to their thresholds) first.

    returns: two (N,) bool, disjoint. Clone: mean gradient over the threshold and small; split: the same and
        large, or mean absolute gradient
        over its threshold and a large radius in the image.
    """
    views = statistics.count.clamp_min(1)
    plain = statistics.gradient / views / limits.gradient
    absolute = statistics.absolute_gradient / views / limits.absolute_gradient
    large = gaussians.log_scales.detach().amax(1).exp() > limits.clone_scale * limits.extent
    clones = (plain >= 1) & ~large
    splits = ((plain >= 1) & large) | ((absolute >= 1) & (statistics.radius > limits.split_radius) & ~clones)
    chosen = clones | splits
    if int(chosen.sum()) > room:
        urgency = torch.where(chosen, torch.maximum(plain, absolute * splits), torch.full_like(plain, -1))
        best = torch.argsort(urgency, descending=True, stable=True)[: max(room, 0)]
        within = torch.zeros_like(chosen)
        within[best] = True
        clones, splits = clones & within, splits & within
    return clones, splits


def clone_and_split(
    optimizer: RowAdam,
    statistics: Statistics,
    clones: torch.Tensor,
    splits: torch.Tensor,
    generator: torch.Generator,
) -> None:
    """Add a copy of each of `clones`; replace each of `splits` by two samples of itself with 1 / 1.6 of its
    scales.

    clones, splits: (N,) bool, disjoint. New Gaussians start without momentum.
    """
    size = len(clones)
    cloned, split = torch.nonzero(clones)[:, 0], torch.nonzero(splits)[:, 0]
    source = torch.cat([torch.nonzero(~splits)[:, 0], cloned, split, split])
    fresh = torch.arange(len(source)) >= size - len(split)
    optimizer.take(source, fresh)
    statistics.take(source)
    first = size - len(split) + len(cloned)
    if not len(split):
        return
    with torch.no_grad():
        gaussians = current(optimizer)
        parts = gaussians[first:]
        offsets = parts.scales * torch.randn(len(parts), 3, generator=generator).to(parts.scales)
        gaussians.means[first:] += (parts.rotations @ offsets[..., None])[..., 0]
        gaussians.log_scales[first:] -= math.log(1.6)


def densify(
    optimizer: RowAdam, statistics: Statistics, limits: DensifyLimits, generator: torch.Generator
) -> None:
    """One round: prune, then clone and split what the statistics ask for as far as the cap leaves room;
    statistics start again.
    """
    prune(optimizer, statistics, useless(current(optimizer), limits))
    gaussians = current(optimizer)
    room = limits.max_gaussians - len(gaussians)
    if room < 0:
        prune(optimizer, statistics, _faintest(gaussians.opacities, -room))
    elif room > 0:
        clones, splits = select(gaussians, statistics, limits, room)
        clone_and_split(optimizer, statistics, clones, splits, generator)
    statistics.restart()


def trim(optimizer: RowAdam, statistics: Statistics) -> None:
    """Drop Gaussians that no view, or one of more than two that could, saw unoccluded during the last pass:
    hidden or floating ones.

    What only one or two photos contain, at the border of a flight, stays.
    """
    prune(optimizer, statistics, (statistics.seen == 0) | ((statistics.seen < 2) & (statistics.inside > 2)))


def reset_opacity(optimizer: RowAdam, ceiling: float = 0.01) -> None:
    """Lower all opacities to at most `ceiling` and forget their momentum: what no view needs does not come
    back.
    """
    logits = optimizer.parameters["opacity_logits"]
    with torch.no_grad():
        logits.clamp_(max=math.log(ceiling / (1 - ceiling)))
    optimizer.means["opacity_logits"].zero_()
    optimizer.squares["opacity_logits"].zero_()


def _faintest(opacities: torch.Tensor, count: int) -> torch.Tensor:
    removed = torch.zeros_like(opacities, dtype=torch.bool)
    removed[torch.argsort(opacities.detach(), stable=True)[:count]] = True
    return removed
