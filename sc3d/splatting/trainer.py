"""Training: photos with known cameras and sparse points become Gaussians that lie on the surface."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch

from sc3d.errors import InputError
from sc3d.geometry.view_selection import neighbor_views, scene_extent
from sc3d.io.atomic import atomic_path
from sc3d.io.progress import Progress
from sc3d.scene.held_out import HeldOutPhoto
from sc3d.settings.train import TrainSettings
from sc3d.splatting import losses, strategy
from sc3d.splatting.checkpoint import check_state, optimizer_state, restore_optimizer
from sc3d.splatting.cpu.steady_sums import steady_mean
from sc3d.splatting.dataset import TrainingData
from sc3d.splatting.device import pick_device
from sc3d.splatting.evaluation import depth_map, held_out_scores, psnr
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.initialization import initial_gaussians
from sc3d.splatting.rendered_view import Rendering
from sc3d.splatting.rendering import render, surface_depth
from sc3d.splatting.strategy import DensifyLimits, Statistics

log = logging.getLogger(__name__)

LOG_EVERY = 50
CHECKPOINT_VERSION = 3
# learning rates; that of the means follows `TrainSettings.position_rate`
RATES = {
    "means": 0.0,
    "log_scales": 5e-3,
    "quats": 1e-3,
    "opacity_logits": 0.05,
    "sh_dc": 2.5e-3,
    "sh_rest": 1.25e-4,
}


@dataclass
class TrainResult:
    """gaussians: not part of an autograd graph
    exposures: (V, 2) or (V, 12) of every view, see `losses.apply_exposure`; zero where held out
    log: rows of iteration, loss, psnr, num_gaussians, seconds; held_out: one row per photo left out
    """

    gaussians: Gaussians
    exposures: np.ndarray
    log: list[dict[str, float]]
    held_out: list[HeldOutPhoto] = field(default_factory=list)


def train(
    data: TrainingData, settings: TrainSettings, checkpoint: Path | None = None, progress: bool = True
) -> TrainResult:
    """Optimize Gaussians until they look like the photos.

    checkpoint: where `settings.checkpoint_every` saves; if it exists and belongs to the same settings, the
        run continues from it exactly
    progress: False hides the bar (it is hidden anyway where stderr is no terminal)
    Raises InputError for too few views or points and for images that do not fit their views.
    """
    trainer = Trainer(data, settings)
    settings = trainer.settings
    if checkpoint is not None and checkpoint.is_file():
        trainer.resume(checkpoint)
    initial = trainer.iteration
    with Progress(settings.iterations, "training", "step", initial=initial, bar=progress) as bar:
        while trainer.iteration < settings.iterations:
            row = trainer.step()
            bar.update()
            if row is not None:
                bar.show("loss {loss:.4f}, PSNR {psnr:.2f}, {num_gaussians} Gaussians".format(**row))
            saves = settings.checkpoint_every
            if checkpoint is not None and saves and trainer.iteration % saves == 0:
                trainer.save(checkpoint)
    gaussians = trainer.gaussians.detached().to("cpu")
    scores = held_out_scores(trainer.gaussians, data, settings)
    return TrainResult(gaussians, trainer.exposures.detach().numpy().copy(), trainer.log, scores)


class Trainer:
    """The state of a run. `step` is one iteration; `train` is the usual way in."""

    def __init__(self, data: TrainingData, settings: TrainSettings) -> None:
        self.data, self.train_views = data, data.held_out(settings).trained
        self.device = pick_device(settings.device)
        self.settings = settings = settings.resolved(self.device.type, len(self.train_views))
        self.generator = torch.Generator().manual_seed(settings.seed)
        used = data.subset(self.train_views, settings.seen_by)
        points, centers = np.asarray(used.points, np.float64), np.stack([view.center for view in used.views])
        neighbors = neighbor_views(used.tracks, points, centers, settings.num_neighbors)
        self.neighbors = {
            index: [self.train_views[other] for other in others]
            for index, others in zip(self.train_views, neighbors, strict=True)
        }
        self.extent = scene_extent(centers, points)
        gaussians = initial_gaussians(used, neighbors, settings, self.generator).to(self.device)
        self.optimizer = strategy.adam(gaussians, RATES)
        size = losses.EXPOSURE_SIZES[settings.exposure]
        self.exposures = torch.zeros(len(data.views), size, requires_grad=True)
        # of one photo per step: Adam for rows that have a gradient
        self.exposure_optimizer = torch.optim.SparseAdam([self.exposures], eps=1e-15)
        self.num_initial = len(gaussians)
        self.statistics = Statistics.zeros(self.num_initial, self.device)
        self.iteration = 0
        self.queue: list[int] = []
        self.depths: dict[int, torch.Tensor] = {}
        self.log: list[dict[str, float]] = []
        self._recent: list[tuple[float, float]] = []
        self._seconds, self._started = 0.0, time.perf_counter()

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians as they are now; leaves of the autograd graph."""
        return strategy.current_gaussians(self.optimizer)

    def step(self) -> dict[str, float] | None:
        """One photo: render, compare, update, and densify when it is time. Returns a log row every 50
        iterations.
        """
        settings, iteration, index = self.settings, self.iteration, self._next_view()
        view, target, mask = self.data.photo(index, settings.coarse(iteration), self.device)
        gaussians, shapes_surface = self.gaussians, settings.shapes_surface(iteration)
        # A different color behind the surface each time: holes never pay off.
        background = torch.rand(3, generator=self.generator) if settings.random_background else None
        degree = settings.active_sh_degree(iteration)
        rendering = render(gaussians, view, degree, background, shapes_surface, settings.depth_mode)
        image = rendering.color
        if settings.exposure != "none":
            exposure = torch.nn.functional.embedding(torch.tensor(index), self.exposures, sparse=True)
            image = losses.apply_exposure(image, exposure)
        stereo = self.data.stereo(index, settings.coarse(iteration), self.device) if settings.fill else None
        if stereo is not None:
            mask = ~stereo[1] if mask is None else mask & ~stereo[1]
        if mask is not None:
            image = torch.where(mask[..., None], image, target)
        loss = losses.image_loss(image, target, settings.ssim_weight)
        if settings.flatten_weight:
            flatness = losses.flatten_loss(gaussians.log_scales, rendering.radii > 0, self.extent)
            loss = loss + settings.flatten_weight * flatness
        if stereo is not None and settings.sky_weight and stereo[1].any():
            loss = loss + settings.sky_weight * steady_mean(rendering.alpha * stereo[1])
        if shapes_surface:
            depth = surface_depth(rendering, view)
            if stereo is not None:
                weight = settings.stereo_weight * (1 - iteration / settings.iterations)
                loss = loss + weight * losses.depth_loss(depth, rendering.alpha, stereo[0])
            depth = depth if mask is None else torch.where(mask, depth, 0)
            loss = loss + self._surface_terms(index, target, rendering, depth)
        loss.backward()
        self._update(rendering)
        self.iteration += 1
        self._densify()
        used = ... if mask is None or not mask.any() else mask
        return self._record(float(loss.detach()), psnr(image.detach()[used], target[used]))

    def save(self, path: Path) -> None:
        """Write everything the rest of the run depends on."""
        state = {
            **self._identity(),
            "iteration": self.iteration,
            "queue": self.queue,
            "parameters": self.gaussians.detached().parameters(),
            "optimizer": optimizer_state(self.optimizer),
            "exposures": self.exposures.detach(),
            "exposure_optimizer": optimizer_state(self.exposure_optimizer),
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
                check_state(state, self.gaussians.parameters(), self.exposures, self.data.views, str(path))
        except Exception as error:  # torch raises many types for broken files
            raise InputError(
                f"{path} is not a readable checkpoint ({type(error).__name__}): delete it to start over"
            ) from None
        if not matches:
            log.warning("%s was made with other settings or photos: starting over", path)
            return False
        self.optimizer = strategy.adam(Gaussians(**state["parameters"]).to(self.device), RATES)
        restore_optimizer(self.optimizer, state["optimizer"])
        self.exposures.data.copy_(state["exposures"])
        restore_optimizer(self.exposure_optimizer, state["exposure_optimizer"])
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
        settings, size = asdict(self.settings), len(self.data.points)
        return {"version": CHECKPOINT_VERSION, "settings": settings, "views": views, "num_points": size}

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
        loss = settings.normal_weight * losses.single_view_normal_loss(rendering, depth, view, target)
        self.depths[index] = torch.where(rendering.alpha > 0.5, depth, 0).detach()
        if others:
            other = others[int(torch.randint(len(others), (1,), generator=self.generator))]
            other_view, other_target, _ = self.data.photo(other, device=self.device)
            if other not in self.depths:
                known = torch.from_numpy(depth_map(self.gaussians, other_view, settings.depth_mode)[0])
                self.depths[other] = known.to(self.device)
            neighbor = losses.Neighbor(other_view, losses.to_gray(other_target), self.depths[other])
            source, draw = (losses.to_gray(target), view), (settings.num_patches, self.generator)
            geometric, photometric = losses.multi_view_losses(rendering, depth, source, neighbor, draw)
            loss = loss + settings.geometric_weight * geometric + settings.photometric_weight * photometric
        return loss

    def _update(self, rendering: Rendering) -> None:
        """The view's statistics, and steps of Adam."""
        self.statistics.add(rendering)
        rate = self.settings.position_rate(self.iteration, self.extent)
        next(group for group in self.optimizer.param_groups if group["name"] == "means")["lr"] = rate
        self.exposure_optimizer.param_groups[0]["lr"] = self.settings.exposure_rate(self.iteration)
        for optimizer in (self.optimizer, self.exposure_optimizer):
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if self.settings.exposure == "affine":
            # the mean photo keeps its colors: those of the scene cannot drift
            known = self.exposures.detach().numpy()  # numpy adds up in one order, whatever the threads
            known[self.train_views] -= known[self.train_views].mean(axis=0)

    def _densify(self) -> None:
        settings, iteration, num_views = self.settings, self.iteration, len(self.train_views)
        if not self.queue:  # every view was seen once
            if settings.prunes_unseen(iteration, num_views):
                strategy.prune_unseen(self.optimizer, self.statistics)
            self.statistics.start_pass()
        if settings.densifies(iteration, num_views):
            limits = DensifyLimits(
                self.extent,
                settings.allowed_gaussians(iteration, self.num_initial),
                settings.gradient_threshold,
                settings.absolute_gradient_threshold,
            )
            strategy.densify(self.optimizer, self.statistics, limits, self.generator)
        if settings.resets_opacity(iteration):
            strategy.reset_opacity(self.optimizer)

    def _record(self, loss: float, quality: float) -> dict[str, float] | None:
        self._recent.append((loss, quality))
        if self.iteration % LOG_EVERY and self.iteration != self.settings.iterations:
            return None
        loss, quality = np.mean(self._recent, axis=0).tolist()
        self._recent = []
        row = {"iteration": self.iteration, "loss": loss, "psnr": quality}
        row |= {"num_gaussians": len(self.gaussians), "seconds": self._elapsed()}
        self.log.append(row)
        return row

    def _elapsed(self) -> float:
        return self._seconds + time.perf_counter() - self._started
