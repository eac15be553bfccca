"""What a rendered view is: its images, and what it tells about each Gaussian."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass
class ViewStatistics:
    """What one view tells about each Gaussian, for densification and pruning; no gradients.

    weight: (N,) float32 sum over pixels of w_i; after forward
    max_transmittance: (N,) float32 largest transmittance in front of any of its fragments, 0 = never hit;
        after forward
    gradient: (N,) float32 |d loss / d mean2d| in normalized device units: pixel gradient times (W / 2, H /
        2); zero until backward
    absolute_gradient: (N,) float32 the same from sums of absolute per-pixel gradients (AbsGS); zero until
        backward
    """

    weight: Tensor
    max_transmittance: Tensor
    gradient: Tensor
    absolute_gradient: Tensor


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
    """

    color: Tensor
    alpha: Tensor
    normal: Tensor
    plane_distance: Tensor
    radii: Tensor
    statistics: ViewStatistics
