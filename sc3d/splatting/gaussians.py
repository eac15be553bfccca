"""The Gaussians themselves: parameters, initialisation from sparse points, the 3DGS PLY."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass
class Gaussians:
    """N Gaussians as raw (unconstrained) parameters, float32.

    means: (N, 3) centres, local world frame
    log_scales: (N, 3) natural log of the standard deviations, world units
    quats: (N, 4) wxyz rotations world_from_gaussian, not necessarily normalised
    opacity_logits: (N,)
    sh: (N, K, 3) spherical harmonics, K = 1, 4, 9, 16; colour = 0.5 + sum_k Y_k(direction) sh_k; direction from the camera to the mean
    """

    means: torch.Tensor
    log_scales: torch.Tensor
    quats: torch.Tensor
    opacity_logits: torch.Tensor
    sh: torch.Tensor

    def __len__(self) -> int:
        return self.means.shape[0]
