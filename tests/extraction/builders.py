"""Five views of discs on planes, and what is extracted from them."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from sc3d.extraction.evidence import DepthViews, EvidenceStore
from sc3d.extraction.fusion import Surfaces, fuse_views
from sc3d.extraction.rendered import write_rendered
from sc3d.geometry.cameras import look_at, pinhole_view
from sc3d.settings.common import DepthMode
from sc3d.settings.reconstruction import Fill
from sc3d.splatting.gaussians import Gaussians

STEP = 0.1


def flat_square(half: float, height: float) -> Gaussians:
    """Opaque discs with normals along z."""
    x, y = np.meshgrid(np.arange(-half, half, STEP), np.arange(-half, half, STEP))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    gaussians = Gaussians.from_points(
        points, np.tile(np.uint8([200, 120, 40]), (len(points), 1)), 0, opacity=0.95
    )
    scales = torch.full_like(gaussians.log_scales, float(np.log(STEP)))
    scales[:, 2] = -8
    quats = torch.zeros_like(gaussians.quats)
    quats[:, 0] = 1
    return replace(gaussians, log_scales=scales, quats=quats)


def views() -> list:
    centers = [[-2, -2, 12], [2, -2, 12], [2, 2, 12], [-2, 2, 12], [0, 0, 13]]
    return [
        pinhole_view(
            f"{row}.jpg", (160, 120), (150, 150, 78, 62), look_at(np.array(center, float), np.zeros(3))
        )
        for row, center in enumerate(centers)
    ]


def data() -> DepthViews:
    neighbors = [np.array([other for other in range(5) if other != row]) for row in range(5)]
    return DepthViews(views(), lambda row: np.full((120, 160, 3), 90, np.uint8), neighbors, (1.0, 30.0))


def surface_of(
    gaussians: Gaussians,
    views_: DepthViews,
    fill: Fill = "occluders",
    mode: DepthMode = "blended",
    crop: int = 0,
) -> Surfaces:
    """As `sc3d extract` without the maps of `sc3d depth`."""
    with tempfile.TemporaryDirectory() as folder:
        store = EvidenceStore(Path(folder))
        write_rendered(gaussians, views_, store, 1, mode)
        return fuse_views(views_, store, 0.15, fill, crop)
