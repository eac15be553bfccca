"""One training run: its state, one step, checkpoints. `sc3d.splatting.train` is the usual way in."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch

from sc3d.errors import InputError
from sc3d.geometry.cameras import View
from sc3d.io import atomic_path
from sc3d.splatting import densify, losses
from sc3d.splatting.densify import DensifyLimits, Statistics
from sc3d.splatting.evaluation import depth_map, psnr, score_view
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.initialise import fill_points
from sc3d.splatting.multiview import Neighbour, multi_view_losses, single_view_normal_loss
from sc3d.splatting.neighbours import neighbour_views
from sc3d.splatting.optimiser import RowAdam
from sc3d.splatting.render import Rendering, render, unbiased_depth
from sc3d.splatting.settings import TrainSettings
from sc3d.splatting.ssim import image_loss

log = logging.getLogger(__name__)

LOG_EVERY = 50
CHECKPOINT_VERSION = 1


@dataclass(frozen=True)
class TrainingData:
    """What training starts from; positions in a local world frame that float32 can hold.

    views: V pinhole views at training size, V >= 2
    images: per view (H, W, 3) uint8 RGB, a sequence or a function of the view's index (then read anew each time)
    points, colors: (N, 3) sparse points; (N, 3) uint8 RGB
    tracks: per view the row indices of the sparse points it sees; None = unknown
    masks: per view (H, W) bool, False = ignored; sequence, function (may return None) or None
    """

    views: list[View]
    images: Sequence[np.ndarray] | Callable[[int], np.ndarray]
    points: np.ndarray
    colors: np.ndarray
    tracks: list[np.ndarray] | None = None
    masks: Sequence[np.ndarray] | Callable[[int], np.ndarray | None] | None = None


class Trainer:
    """The state of a run. `step` is one iteration; `train` is the usual way in."""

    def __init__(self, data: TrainingData, settings: TrainSettings) -> None:
        self.data, self.settings = data, settings
        num_views = len(data.views)
        held_out = set(range(settings.test_every - 1, num_views, settings.test_every)) if settings.test_every else set()
        self.test_views = sorted(held_out)
        self.train_views = [index for index in range(num_views) if index not in held_out]
        if len(self.train_views) < 2:
            raise InputError(f"{len(self.train_views)} photos to train on: at least 2 are needed (test_every holds {len(held_out)} out)")
        self.generator = torch.Generator().manual_seed(settings.seed)
        self.extent = scene_extent([data.views[index] for index in self.train_views], data.points)
        self.limits = DensifyLimits(self.extent, settings.max_gaussians, settings.gradient_threshold, settings.absolute_gradient_threshold)
        self.optimiser = RowAdam(*self._initial(data))
        self.exposure = RowAdam({"exposure": torch.zeros(num_views, 2, requires_grad=True)}, {"exposure": 1e-3})
        self.num_initial = len(self.gaussians)
        self.statistics = Statistics.zeros(self.num_initial)
        self.neighbours = self._find_neighbours()
        self.iteration, self.queue, self.depths = 0, [], {}
        self.log: list[dict[str, float]] = []
        self._recent: list[tuple[float, float]] = []
        self._seconds, self._started = 0.0, time.perf_counter()

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians as they are now; leaves of the autograd graph."""
        return densify.current(self.optimiser)

    @property
    def exposures(self) -> np.ndarray:
        """(V, 2) exposure a, b of every view."""
        return self.exposure.parameters["exposure"].detach().numpy().copy()

    def step(self) -> dict[str, float] | None:
        """One photo: render, compare, update, and densify when it is time. Returns a log row every 50 iterations."""
        index, iteration = self._next_view(), self.iteration
        view, target, mask = self._photo(index, self.settings.coarse(iteration))
        gaussians = self.gaussians
        # A different colour behind the surface each time: holes never pay off.
        background = torch.rand(3, generator=self.generator) if self.settings.random_background else None
        rendering = render(gaussians, view, self.settings.active_sh_degree(iteration), background, self.settings.shapes_surface(iteration))
        image = rendering.color
        if self.settings.exposure:
            image = losses.apply_exposure(image, self.exposure.parameters["exposure"][index])
        if mask is not None:
            image = torch.where(mask[..., None], image, target)
        loss = image_loss(image, target, self.settings.ssim_weight)
        if self.settings.flatten_weight:
            loss = loss + self.settings.flatten_weight * losses.flatten_loss(gaussians.log_scales, rendering.radii > 0, self.extent)
        if self.settings.shapes_surface(iteration):
            loss = loss + self._surface_terms(index, view, target, rendering)
        loss.backward()
        self._update(index, rendering)
        self.iteration += 1
        self._densify()
        return self._record(float(loss.detach()), psnr(image.detach(), target))

    def evaluate(self) -> dict[str, float]:
        """Mean PSNR (dB) and SSIM of the held-out views; their exposure is fitted to the photo if exposures are used."""
        if not self.test_views:
            return {}
        scores = [score_view(self.gaussians, *self._photo(index, False), self.settings.exposure) for index in self.test_views]
        means = np.mean(scores, axis=0)
        return {"psnr": float(means[0]), "ssim": float(means[1])}

    def save(self, path: Path) -> None:
        """Write everything the rest of the run depends on."""
        state = {
            "version": CHECKPOINT_VERSION, "settings": asdict(self.settings), "iteration": self.iteration, "queue": self.queue,
            "parameters": {name: tensor.detach() for name, tensor in self.optimiser.parameters.items()},
            "optimiser": self.optimiser.state(), "exposure": self.exposure.parameters["exposure"].detach(),
            "exposure_optimiser": self.exposure.state(), "statistics": vars(self.statistics), "depths": self.depths,
            "generator": self.generator.get_state(), "log": self.log, "recent": self._recent, "seconds": self._elapsed(),
        }
        with atomic_path(path) as temporary:
            torch.save(state, temporary)

    def resume(self, path: Path) -> bool:
        """Continue from `save`; False (and a warning) if the file belongs to other settings."""
        try:
            state = torch.load(path, weights_only=True)
            matches = state["version"] == CHECKPOINT_VERSION and state["settings"] == asdict(self.settings)
        except Exception as error:  # torch raises many types for broken files
            raise InputError(f"{path} is not a readable checkpoint ({type(error).__name__}): delete it to start over") from None
        if not matches:
            log.warning("%s was made with other settings: starting over", path)
            return False
        self.optimiser.parameters.update({name: tensor.requires_grad_() for name, tensor in state["parameters"].items()})
        self.optimiser.restore(state["optimiser"])
        self.exposure.parameters["exposure"] = state["exposure"].requires_grad_()
        self.exposure.restore(state["exposure_optimiser"])
        self.statistics = Statistics(**state["statistics"])
        self.iteration, self.queue, self.depths, self.log = state["iteration"], state["queue"], state["depths"], state["log"]
        self.generator.set_state(state["generator"])
        self._recent, self._seconds, self._started = state["recent"], state["seconds"], time.perf_counter()
        return True

    def _initial(self, data: TrainingData) -> tuple[dict[str, torch.Tensor], dict[str, float | np.ndarray]]:
        points, colors = np.asarray(data.points, np.float64), np.asarray(data.colors)
        if self.settings.fill:
            chosen, tracks = self.train_views, data.tracks
            views, seen = [data.views[index] for index in chosen], None if tracks is None else [tracks[index] for index in chosen]
            more = fill_points(views, lambda row: _item(data.images, chosen[row]), points, seen, self.settings.max_gaussians // 4)
            points, colors = np.concatenate([points, more[0]]), np.concatenate([colors, more[1]])
        if len(points) > self.settings.max_gaussians:
            chosen = torch.randperm(len(points), generator=self.generator)[: self.settings.max_gaussians].sort().values.numpy()
            points, colors = points[chosen], colors[chosen]
        gaussians = Gaussians.from_points(points, colors, self.settings.sh_degree)
        sh_rates = np.full(3 * gaussians.sh.shape[1], 1.25e-4)
        sh_rates[:3] = 2.5e-3
        rates = {"means": 0.0, "log_scales": 5e-3, "quats": 1e-3, "opacity_logits": 0.05, "sh": sh_rates}
        return {name: tensor.requires_grad_() for name, tensor in gaussians.parameters().items()}, rates

    def _find_neighbours(self) -> dict[int, np.ndarray]:
        chosen, data = np.array(self.train_views), self.data
        tracks = None if data.tracks is None else [data.tracks[index] for index in chosen]
        centres = np.stack([data.views[index].centre for index in chosen])
        found = neighbour_views(tracks, np.asarray(data.points, np.float64), centres, self.settings.num_neighbours)
        return {int(index): chosen[others] for index, others in zip(chosen, found, strict=True)}

    def _next_view(self) -> int:
        if not self.queue:
            order = torch.randperm(len(self.train_views), generator=self.generator)
            self.queue = [self.train_views[position] for position in order.tolist()]
        return self.queue.pop()

    def _photo(self, index: int, halved: bool) -> tuple[View, torch.Tensor, torch.Tensor | None]:
        """View, (H, W, 3) image in [0, 1] and (H, W) bool mask or None, at full or half size."""
        view, image, mask = self.data.views[index], _item(self.data.images, index), _item(self.data.masks, index)
        for array, what in ((image, "image"), (mask, "mask")):
            if array is not None and array.shape[:2] != (view.height, view.width):
                raise InputError(f"{what} of {view.name} is {array.shape[1]}x{array.shape[0]}, its view {view.width}x{view.height}")
        if halved:
            view = view.resized(max(1, view.width // 2), max(1, view.height // 2))
            image = cv2.resize(image, (view.width, view.height), interpolation=cv2.INTER_AREA)
            if mask is not None:
                mask = cv2.resize(mask.astype(np.uint8), (view.width, view.height), interpolation=cv2.INTER_NEAREST)
        target = (torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))).float() / 255).permute(1, 2, 0)  # as `render` stores it
        return view, target, None if mask is None else torch.from_numpy(mask.astype(bool))

    def _surface_terms(self, index: int, view: View, target: torch.Tensor, rendering: Rendering) -> torch.Tensor:
        """Normal and multi-view terms against one random neighbour, whose depth is the one it had when it was trained on last."""
        settings, others = self.settings, self.neighbours[index]
        depth = unbiased_depth(rendering, view)
        loss = settings.normal_weight * single_view_normal_loss(rendering, depth, view, target)
        self.depths[index] = torch.where(rendering.alpha > 0.5, depth, 0).detach()
        if len(others):
            other = int(others[torch.randint(len(others), (1,), generator=self.generator)])
            other_view, other_target, _ = self._photo(other, False)
            if other not in self.depths:
                self.depths[other] = torch.from_numpy(depth_map(self.gaussians, other_view)[0])
            neighbour = Neighbour(other_view, losses.to_grey(other_target), self.depths[other])
            geometric, photometric = multi_view_losses(rendering, depth, (losses.to_grey(target), view), neighbour, (settings.num_patches, self.generator))
            loss = loss + settings.geometric_weight * geometric + settings.photometric_weight * photometric
        return loss

    def _update(self, index: int, rendering: Rendering) -> None:
        """Adam steps, and the view's statistics."""
        statistics = rendering.statistics
        self.statistics.add(statistics.gradient, statistics.absolute_gradient, rendering.radii, statistics.max_transmittance)
        self.optimiser.rates["means"] = self.settings.position_rate(self.iteration, self.extent)
        self.optimiser.step()
        if self.settings.exposure:
            rows = torch.zeros(len(self.data.views), dtype=torch.bool)
            rows[index] = True
            self.exposure.step(rows)

    def _densify(self) -> None:
        settings, iteration, num_views = self.settings, self.iteration, len(self.train_views)
        if not self.queue:  # every view was seen once
            if settings.trims(iteration, num_views):
                densify.trim(self.optimiser, self.statistics)
            self.statistics.seen.zero_()
        if settings.densifies(iteration, num_views):
            limits = replace(self.limits, max_gaussians=settings.allowed_gaussians(iteration, self.num_initial))
            densify.densify(self.optimiser, self.statistics, limits, self.generator)
        if settings.resets_opacity(iteration):
            densify.reset_opacity(self.optimiser)

    def _record(self, loss: float, quality: float) -> dict[str, float] | None:
        self._recent.append((loss, quality))
        if self.iteration % LOG_EVERY and self.iteration != self.settings.iterations:
            return None
        loss, quality = np.mean(self._recent, axis=0).tolist()
        self._recent = []
        row = {"iteration": self.iteration, "loss": loss, "psnr": quality, "num_gaussians": len(self.gaussians), "seconds": self._elapsed()}
        self.log.append(row)
        return row

    def _elapsed(self) -> float:
        return self._seconds + time.perf_counter() - self._started


def scene_extent(views: list[View], points: np.ndarray) -> float:
    """E, world units: 1.1 x the largest distance of a camera from their mean, but at least half the median distance to the points."""
    centres = np.stack([view.centre for view in views])
    middle = centres.mean(0)
    spread = np.linalg.norm(centres - middle, axis=1).max()
    distance = np.median(np.linalg.norm(np.asarray(points, np.float64) - middle, axis=1))
    return float(max(1.1 * spread, 0.5 * distance))


def _item(source: Sequence | Callable | None, index: int) -> np.ndarray | None:
    if source is None:
        return None
    return source(index) if callable(source) else source[index]
