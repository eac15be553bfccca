"""One training run: its state, one step, checkpoints. `sc3d.splatting.train` is the usual way in."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from sc3d.errors import InputError
from sc3d.geometry.cameras import View
from sc3d.geometry.view_selection import neighbor_views
from sc3d.io.atomic import atomic_path
from sc3d.settings.train import TrainSettings
from sc3d.splatting import losses
from sc3d.splatting import strategy as densify
from sc3d.splatting.checkpoint import check_state
from sc3d.splatting.cpu.ssim import image_loss
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.device import pick_device
from sc3d.splatting.evaluation import depth_map, held_out_scores, psnr
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.initialization import fill_points
from sc3d.splatting.multiview import Neighbor, multi_view_losses, single_view_normal_loss
from sc3d.splatting.optimizer import RowAdam
from sc3d.splatting.rendering import Rendering, render, unbiased_depth
from sc3d.splatting.strategy import DensifyLimits, Statistics

log = logging.getLogger(__name__)

LOG_EVERY = 50
CHECKPOINT_VERSION = 2


class Trainer:
    """The state of a run. `step` is one iteration; `train` is the usual way in."""

    def __init__(self, data: TrainingData, settings: TrainSettings) -> None:
        self.data, self.settings, self.device = data, settings, pick_device(settings.device)
        num_views = len(data.views)
        self.test_views = settings.held_out(num_views)
        self.train_views = [index for index in range(num_views) if index not in self.test_views]
        if len(self.train_views) < 2:
            raise InputError(
                f"{len(self.train_views)} photos to train on: at least 2 are needed (test_every holds {len(self.test_views)} out)"
            )
        self.generator = torch.Generator().manual_seed(settings.seed)
        used = data.subset(self.train_views)
        self.extent = scene_extent(used.views, data.points)
        self.limits = DensifyLimits(
            self.extent,
            settings.max_gaussians,
            settings.gradient_threshold,
            settings.absolute_gradient_threshold,
        )
        centers = np.stack([view.center for view in used.views])
        neighbors = neighbor_views(
            used.tracks, np.asarray(data.points, np.float64), centers, settings.num_neighbors
        )
        self.neighbors = {
            index: [self.train_views[other] for other in others]
            for index, others in zip(self.train_views, neighbors, strict=True)
        }
        self.optimizer = RowAdam(*self._initial(used, neighbors))
        self.exposure = RowAdam(
            {"exposure": torch.zeros(num_views, 2, requires_grad=True)}, {"exposure": 1e-3}
        )
        self.num_initial = len(self.gaussians)
        self.statistics = Statistics.zeros(self.num_initial, self.device)
        self.iteration, self.queue, self.depths = 0, [], {}
        self.log: list[dict[str, float]] = []
        self._recent: list[tuple[float, float]] = []
        self._seconds, self._started = 0.0, time.perf_counter()

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians as they are now; leaves of the autograd graph."""
        return densify.current(self.optimizer)

    @property
    def exposures(self) -> np.ndarray:
        """(V, 2) exposure a, b of every view."""
        return self.exposure.parameters["exposure"].detach().numpy().copy()

    def step(self) -> dict[str, float] | None:
        """One photo: render, compare, update, and densify when it is time. Returns a log row every 50
        iterations.
        """
        index, iteration = self._next_view(), self.iteration
        view, target, mask = self._photo(index, self.settings.coarse(iteration))
        gaussians = self.gaussians
        # A different color behind the surface each time: holes never pay off.
        background = torch.rand(3, generator=self.generator) if self.settings.random_background else None
        rendering = render(
            gaussians,
            view,
            self.settings.active_sh_degree(iteration),
            background,
            self.settings.shapes_surface(iteration),
        )
        image = rendering.color
        if self.settings.exposure:
            image = losses.apply_exposure(image, self.exposure.parameters["exposure"][index])
        if mask is not None:
            image = torch.where(mask[..., None], image, target)
        loss = image_loss(image, target, self.settings.ssim_weight)
        if self.settings.flatten_weight:
            loss = loss + self.settings.flatten_weight * losses.flatten_loss(
                gaussians.log_scales, rendering.radii > 0, self.extent
            )
        if self.settings.shapes_surface(iteration):
            depth = unbiased_depth(rendering, view)
            loss = loss + self._surface_terms(
                index, target, rendering, depth if mask is None else torch.where(mask, depth, 0)
            )
        loss.backward()
        self._update(index, rendering)
        self.iteration += 1
        self._densify()
        used = ... if mask is None or not mask.any() else mask
        return self._record(float(loss.detach()), psnr(image.detach()[used], target[used]))

    def evaluate(self) -> dict[str, float]:
        """Mean PSNR (dB) and SSIM of the held-out views; their exposure is fitted to the photo if exposures
        are used.
        """
        return held_out_scores(self.gaussians, self.data, self.settings)

    def save(self, path: Path) -> None:
        """Write everything the rest of the run depends on."""
        state = {
            **self._identity(),
            "iteration": self.iteration,
            "queue": self.queue,
            "parameters": {name: tensor.detach() for name, tensor in self.optimizer.parameters.items()},
            "optimizer": self.optimizer.state(),
            "exposure": self.exposure.parameters["exposure"].detach(),
            "exposure_optimizer": self.exposure.state(),
            "statistics": vars(self.statistics),
            "depths": self.depths,
            "generator": self.generator.get_state(),
            "log": self.log,
            "recent": self._recent,
            "seconds": self._elapsed(),
        }
        with atomic_path(path) as temporary:
            torch.save(state, temporary)

    def resume(self, path: Path) -> bool:
        """Continue from `save`; False (and a warning) if the file belongs to other settings or photos."""
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            matches = all(state[name] == value for name, value in self._identity().items())
            if matches:
                check_state(state, self.optimizer.parameters, self.data.views, str(path))
        except Exception as error:  # torch raises many types for broken files
            raise InputError(
                f"{path} is not a readable checkpoint ({type(error).__name__}): delete it to start over"
            ) from None
        if not matches:
            log.warning("%s was made with other settings or photos: starting over", path)
            return False
        self.optimizer.parameters.update(
            {name: tensor.to(self.device).requires_grad_() for name, tensor in state["parameters"].items()}
        )
        self.optimizer.restore(state["optimizer"])
        self.exposure.parameters["exposure"] = state["exposure"].requires_grad_()
        self.exposure.restore(state["exposure_optimizer"])
        self.statistics = Statistics(
            **{name: values.to(self.device) for name, values in state["statistics"].items()}
        )
        self.depths = {index: depth.to(self.device) for index, depth in state["depths"].items()}
        self.iteration, self.queue, self.log = state["iteration"], state["queue"], state["log"]
        self.generator.set_state(state["generator"])
        self._recent, self._seconds, self._started = state["recent"], state["seconds"], time.perf_counter()
        return True

    def _identity(self) -> dict[str, object]:
        """What must be the same for a checkpoint to fit."""
        views = [f"{view.name} {view.width}x{view.height}" for view in self.data.views]
        return {
            "version": CHECKPOINT_VERSION,
            "settings": asdict(self.settings),
            "views": views,
            "num_points": len(self.data.points),
        }

    def _initial(
        self, data: TrainingData, neighbors: list[np.ndarray]
    ) -> tuple[dict[str, torch.Tensor], dict[str, float | np.ndarray]]:
        points, colors = np.asarray(data.points, np.float64), np.asarray(data.colors)
        if self.settings.fill:
            more = fill_points(data, neighbors, self.settings.max_gaussians // 4)
            points, colors = np.concatenate([points, more[0]]), np.concatenate([colors, more[1]])
        if len(points) > self.settings.max_gaussians:
            chosen = (
                torch.randperm(len(points), generator=self.generator)[: self.settings.max_gaussians]
                .sort()
                .values.numpy()
            )
            points, colors = points[chosen], colors[chosen]
        gaussians = Gaussians.from_points(points, colors, self.settings.sh_degree)
        rates = {
            "means": 0.0,
            "log_scales": 5e-3,
            "quats": 1e-3,
            "opacity_logits": 0.05,
            "sh_dc": 2.5e-3,
            "sh_rest": 1.25e-4,
        }
        return {
            name: tensor.to(self.device).requires_grad_() for name, tensor in gaussians.parameters().items()
        }, rates

    def _photo(self, index: int, halved: bool = False) -> tuple[View, torch.Tensor, torch.Tensor | None]:
        """`TrainingData.photo` on the device."""
        view, image, mask = self.data.photo(index, halved)
        return view, image.to(self.device), None if mask is None else mask.to(self.device)

    def _next_view(self) -> int:
        if not self.queue:
            order = torch.randperm(len(self.train_views), generator=self.generator)
            self.queue = [self.train_views[position] for position in order.tolist()]
        return self.queue.pop()

    def _surface_terms(
        self, index: int, target: torch.Tensor, rendering: Rendering, depth: torch.Tensor
    ) -> torch.Tensor:
        """Normal and multi-view terms against one random neighbor, whose depth is the one it had when it was
        trained on last.
        """
        settings, view, others = self.settings, self.data.views[index], self.neighbors[index]
        loss = settings.normal_weight * single_view_normal_loss(rendering, depth, view, target)
        self.depths[index] = torch.where(rendering.alpha > 0.5, depth, 0).detach()
        if others:
            other = others[int(torch.randint(len(others), (1,), generator=self.generator))]
            other_view, other_target, _ = self._photo(other)
            if other not in self.depths:
                self.depths[other] = torch.from_numpy(depth_map(self.gaussians, other_view)[0]).to(
                    self.device
                )
            neighbor = Neighbor(other_view, losses.to_gray(other_target), self.depths[other])
            source, draw = (losses.to_gray(target), view), (settings.num_patches, self.generator)
            geometric, photometric = multi_view_losses(rendering, depth, source, neighbor, draw)
            loss = loss + settings.geometric_weight * geometric + settings.photometric_weight * photometric
        return loss

    def _update(self, index: int, rendering: Rendering) -> None:
        """Adam steps, and the view's statistics."""
        statistics = rendering.statistics
        self.statistics.add(
            statistics.gradient, statistics.absolute_gradient, rendering.radii, statistics.max_transmittance
        )
        self.optimizer.rates["means"] = self.settings.position_rate(self.iteration, self.extent)
        self.optimizer.step()
        if self.settings.exposure:
            rows = torch.zeros(len(self.data.views), dtype=torch.bool)
            rows[index] = True
            self.exposure.step(rows)

    def _densify(self) -> None:
        settings, iteration, num_views = self.settings, self.iteration, len(self.train_views)
        if not self.queue:  # every view was seen once
            if settings.trims(iteration, num_views):
                densify.trim(self.optimizer, self.statistics)
            self.statistics.start_pass()
        if settings.densifies(iteration, num_views):
            limits = replace(
                self.limits, max_gaussians=settings.allowed_gaussians(iteration, self.num_initial)
            )
            densify.densify(self.optimizer, self.statistics, limits, self.generator)
        if settings.resets_opacity(iteration):
            densify.reset_opacity(self.optimizer)

    def _record(self, loss: float, quality: float) -> dict[str, float] | None:
        self._recent.append((loss, quality))
        if self.iteration % LOG_EVERY and self.iteration != self.settings.iterations:
            return None
        loss, quality = np.mean(self._recent, axis=0).tolist()
        self._recent = []
        row = {
            "iteration": self.iteration,
            "loss": loss,
            "psnr": quality,
            "num_gaussians": len(self.gaussians),
            "seconds": self._elapsed(),
        }
        self.log.append(row)
        return row

    def _elapsed(self) -> float:
        return self._seconds + time.perf_counter() - self._started


def scene_extent(views: list[View], points: np.ndarray) -> float:
    """E, world units: 1.1 x the largest distance of a camera from their mean, but at least half the median
    distance to the points.
    """
    centers = np.stack([view.center for view in views])
    middle = centers.mean(0)
    spread = np.linalg.norm(centers - middle, axis=1).max()
    distance = np.median(np.linalg.norm(np.asarray(points, np.float64) - middle, axis=1))
    return float(max(1.1 * spread, 0.5 * distance))
