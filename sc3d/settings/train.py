"""What can be set about training, and the schedules that follow from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Literal, NamedTuple

from sc3d.errors import InputError
from sc3d.settings.common import DepthMode, Memory, Workers

Exposure = Literal["none", "gain", "affine"]


class Amounts(NamedTuple):
    """What 0 stands for in the settings of the same names, and the training steps for each photo, in all at least
    and at most so many.
    """

    max_gaussians: int
    max_size: int
    steps_per_photo: int
    fewest_steps: int
    most_steps: float = math.inf


ON_CPU = Amounts(200_000, 800, 40, 1000)
ON_GPU = Amounts(1_000_000, 1600, 300, 7000, 30_000)
"""By the common practice of 3D Gaussian splatting; never run here, for want of a GPU."""


@dataclass(frozen=True)
class TrainSettings:
    """Gaussian training. Times are fractions of the run, so that a short run goes through all phases of a
    long one.
    """

    iterations: int = 0
    """training steps, one photo each; 0 = on the CPU 40 for each photo, at least 1000; on a GPU 300, at least 7000,
    at most 30 000, which is the paper's number
    """
    max_gaussians: int = 0
    """never more Gaussians than this: bounds memory and time; 0 = 200 000 on the CPU, 1 000 000 on a GPU (no
    default for a GPU was ever run: they follow common practice)
    """
    max_size: int = 0
    """longest side of the training images, px; 0 = 800 on the CPU, 1600 on a GPU"""
    downscale: float = 0.0
    """divide the photos' size by this instead of fitting max_size; 0 = fit max_size"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """where to train: on the CPU, or on a GPU with gsplat (pip install 'sc3d[cuda]'); auto = the GPU if there
    are both
    """
    sh_degree: int = 2
    """degree of the view-dependent color, 0 to 3; 0 = the same from everywhere"""
    seed: int = 0
    """the same seed gives the same result"""
    plain: bool = False
    """no normal and multi-view terms: faster, rougher surface"""
    exposure: Exposure = "gain"
    """fit to each photo a gain and offset of its brightness, or an affine transform of its colors (3x3 and an
    offset) for photos whose white balance changes, or nothing
    """
    test_every: int = 0
    """hold out every Nth photo and report PSNR, SSIM and depth agreement on them; 0 = none. Tells how views
    between others look
    """
    test_sector: float = 0.0
    """share of the photos to hold out as one contiguous part of the capture, and to report on like
    test_every, which then takes every Nth of the others; 0 = none. Tells how views beyond the others look
    """
    checkpoint_every: int = 500
    """save a checkpoint every N iterations, to continue an interrupted run; 0 = never"""

    ssim_weight: float = 0.2
    """share of 1 - SSIM in the image loss; the rest is L1"""
    flatten_weight: float = 10.0
    """weight of the smallest scale (relative to the scene's extent), which presses Gaussians flat"""
    normal_weight: float = 0.05
    """weight of the agreement between rendered normals and those of the rendered depth"""
    geometric_weight: float = 0.03
    """weight of the depth agreement between neighboring views"""
    photometric_weight: float = 0.15
    """weight of the patch similarity (NCC) between neighboring views"""
    stereo_weight: float = 1.0
    """weight of the relative difference to confirmed depth of stereo, which falls to 0 over the run"""
    sky_weight: float = 0.5
    """weight of what is opaque where stereo found sky"""
    surface_from: float = 0.25
    """when normal and multi-view terms begin, fraction of the run"""
    depth_mode: DepthMode = "blended"
    """depth that the normal and multi-view terms look at: of the alpha-blended planes, or where half of the
    light is gone (median), which takes more time
    """
    num_neighbors: int = 8
    """neighboring views to choose from"""
    num_patches: int = 8192
    """7x7 patches compared per step"""

    fill: bool = True
    """also start on the depth maps of `sc3d depth` if there are some, keep to what they confirm, and leave their sky
    empty; and between, at the depth where the photos' patches agree, or an interpolated one. False = from the sparse
    points alone
    """
    random_background: bool = True
    """render before a random color, so that dark surfaces become opaque; False = black"""
    coarse_until: float = 0.25
    """train on images of half size until this fraction of the run"""
    densify_from: float = 0.02
    """first densification, fraction of the run"""
    densify_until: float = 0.5
    """last densification, fraction of the run"""
    gradient_threshold: float = 2e-4
    """mean image-position gradient (NDC) that asks for more Gaussians"""
    absolute_gradient_threshold: float = 8e-4
    """mean absolute gradient that splits Gaussians with a large radius"""
    means_rate: float = 1.6e-4
    """first learning rate of positions in a run of 30 000, relative to the scene; up to 4 times that in
    shorter ones; falls to 1 %
    """

    def __post_init__(self) -> None:
        if (
            min(self.iterations, self.max_gaussians) < 0
            or 0 != self.max_size < 16
            or not 0 <= self.sh_degree <= 3
            or self.downscale < 0
        ):
            raise InputError(
                "max_size must be 0 or at least 16, sh_degree 0 to 3, iterations, max_gaussians and downscale not negative"
            )
        if self.test_every < 0 or not 0 <= self.test_sector < 1:
            raise InputError(
                f"test_every must not be negative, and test_sector a share of the photos from 0 to below 1, such as 0.2: they are {self.test_every} and {self.test_sector}"
            )

    def resolved(self, device: str, num_photos: int = 0) -> TrainSettings:
        """With the numbers that every 0 stands for.

        device: that trains, cuda or cpu (as all others count); num_photos: that are trained on; 0 = not known yet:
            `iterations` stays as it is
        """
        auto = ON_GPU if device == "cuda" else ON_CPU
        steps = min(max(auto.fewest_steps, auto.steps_per_photo * num_photos), auto.most_steps)
        return replace(
            self,
            iterations=self.iterations or (int(steps) if num_photos else 0),
            max_gaussians=self.max_gaussians or auto.max_gaussians,
            max_size=self.max_size or auto.max_size,
        )

    def size(self, longest: int) -> int:
        """Longest side of the training image of a photo whose longest side is `longest`, px; of `resolved`
        settings.
        """
        return round(longest / self.downscale) if self.downscale else min(longest, self.max_size)

    @property
    def seen_by(self) -> int:
        """Photos that must see a sparse point to start on it: with a sector held out, those that only the
        sector's photos have found are not known.
        """
        return 2 if self.test_sector else 0

    def active_sh_degree(self, iteration: int) -> int:
        """One degree more every 30th of the run."""
        return min(self.sh_degree, 30 * iteration // self.iterations)

    def position_rate(self, iteration: int, extent: float) -> float:
        """Learning rate of the means, world units: log-linear; a short run takes larger steps, as the root of
        the number of steps it lacks.
        """
        boost = min(max((30_000 / self.iterations) ** 0.5, 1.0), 4.0)
        return self.means_rate * boost * extent * 0.01 ** (iteration / self.iterations)

    def exposure_rate(self, iteration: int) -> float:
        """Learning rate of what is fitted to each photo; colors have farther to go than brightness, which
        cameras mostly settle, so theirs begins higher and falls to a tenth.
        """
        return 0.02 * 0.1 ** (iteration / self.iterations) if self.exposure == "affine" else 1e-3

    def densify_interval(self, num_views: int) -> int:
        """Iterations between densifications: a 300th of the run, but long enough for statistics of every view
        (or of 100).
        """
        return max(self.iterations // 300, min(self.iterations // 60, 50), min(num_views, 100), 1)

    def densifies(self, iteration: int, num_views: int) -> bool:
        """Whether Gaussians are added after this iteration."""
        active = self.densify_from * self.iterations <= iteration <= self.densify_until * self.iterations
        return active and iteration % self.densify_interval(num_views) == 0

    def allowed_gaussians(self, iteration: int, num_initial: int) -> int:
        """The cap at this iteration: it rises linearly while densifying, so that the places that need most
        get Gaussians, not the first to ask.
        """
        progress = (iteration / self.iterations - self.densify_from) / max(
            self.densify_until - self.densify_from, 1e-9
        )
        return min(
            self.max_gaussians,
            round(num_initial + max(self.max_gaussians - num_initial, 0) * min(max(progress, 0.0), 1.0)),
        )

    def prunes_unseen(self, iteration: int, num_views: int) -> bool:
        """Whether to drop what fewer than two views saw, asked after each pass over the views: every 30th of
        the run while densifying.
        """
        interval = max(self.iterations // 30, num_views)
        due = iteration // interval > (iteration - num_views) // interval
        return due and num_views >= 4 and 2 * num_views <= iteration <= self.densify_until * self.iterations

    def resets_opacity(self, iteration: int) -> bool:
        """Every tenth of the run while densifying, in runs long enough to recover from it (700 iterations)."""
        interval = self.iterations // 10
        return (
            interval >= 700
            and 0 < iteration < self.densify_until * self.iterations
            and iteration % interval == 0
        )

    def coarse(self, iteration: int) -> bool:
        """Whether the images of this iteration are halved."""
        return iteration < self.coarse_until * self.iterations

    def shapes_surface(self, iteration: int) -> bool:
        """Whether the normal and multi-view terms apply."""
        return not self.plain and iteration >= max(self.surface_from, self.coarse_until) * self.iterations


@dataclass(frozen=True)
class Train(Memory, Workers, TrainSettings):
    """Gaussian training. Times are fractions of the run, so that a short run goes through all phases of a
    long one.
    """

    blocks: int = 0
    """cut the ground into so many blocks, which are trained one by one, or side by side on --workers or
    --cluster, in the memory of a block, and merged; each takes its share of iterations and max_gaussians; 0 =
    train everything at once
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.blocks < 0 or self.workers < 0:
            raise InputError("blocks and workers must not be negative")

    @property
    def training(self) -> TrainSettings:
        """What decides the result of one training."""
        return TrainSettings(**{field.name: getattr(self, field.name) for field in fields(TrainSettings)})
