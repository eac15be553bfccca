"""What a rendered view is: its images, and what it tells about each Gaussian."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor


class ViewStatistics(Protocol):
    """What one view tells about each Gaussian, (N,) float32, for densification and pruning; no gradients."""

    @property
    def weight(self) -> Tensor:
        """Sum over pixels of w_i."""

    @property
    def max_transmittance(self) -> Tensor:
        """Largest transmittance in front of any of its fragments, 0 = never hit."""

    @property
    def gradient(self) -> Tensor:
        """|d loss / d mean2d| in normalized device units: pixel gradient times (W / 2, H / 2); zero until
        backward.
        """

    @property
    def absolute_gradient(self) -> Tensor:
        """The same from sums of absolute per-pixel gradients (AbsGS)."""


@dataclass
class Rendering:
    """One rendered view; w_i = alpha_i T_i is the weight of a fragment. Images may be non-contiguous (stored
    plane by plane).

    color: (H, W, 3) sum w c (+ (1 - A) background)
    alpha: (H, W) A = sum w
    normal: (H, W, 3) sum w n, camera frame, n towards the camera
    plane_distance: (H, W) sum w d, d = |n . mean_cam|, world units
    radii: (N,) float32 three-sigma radius, px; 0 = cannot touch the image; no gradient
    statistics: per-Gaussian sums; the gradients in it are filled by backward()
    median_depth: (H, W) depth z at which the transmittance falls to 1/2 (`cpu.median_depth`), world units,
        0 = it never does; None if it was not asked for
    """

    color: Tensor
    alpha: Tensor
    normal: Tensor
    plane_distance: Tensor
    radii: Tensor
    statistics: ViewStatistics
    median_depth: Tensor | None = None
