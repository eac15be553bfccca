"""Labels for Gaussians by the renderer's backward pass, three classes at a time: the twin of `cpu.label_lifting`,
and the way on a GPU.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from sc3d.geometry.cameras import View
from sc3d.splatting.gaussians import SH_C0, Gaussians
from sc3d.splatting.rendering import render


def evidence_by_gradient(
    gaussians: Gaussians, view: View, mask: np.ndarray, weights: np.ndarray, num_channels: int
) -> np.ndarray:
    """Evidence of every class from one view; arguments as in `lifting.lift`, `weights` (H, W) 0 to 1.

    returns: (N, num_channels) float64
    """
    evidence = np.zeros((len(gaussians), num_channels))
    # away from 0, where colors are cut
    gray = gaussians.detached().painted(np.full((len(gaussians), 3), 0.5))
    target, weight = torch.from_numpy(mask.astype(np.int64)), torch.from_numpy(weights)
    for first in range(1, num_channels, 3):
        dc = gray.sh_dc.clone().requires_grad_()
        image = render(replace(gray, sh_dc=dc), view, 0, geometry=False).color
        shown = torch.stack([(target == label) * weight for label in range(first, first + 3)], dim=2)
        (gradient,) = torch.autograd.grad((image * shown.to(image)).sum(), dc)
        part = gradient.cpu().numpy().astype(np.float64) / SH_C0
        evidence[:, first : first + 3] = part[:, : num_channels - first]
    return evidence
