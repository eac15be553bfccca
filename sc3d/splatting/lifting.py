"""Labels for the Gaussians themselves: each takes the class of the pixels that it shows, in closed form, A[i,
c] += alpha T s.

A fragment's weight w = alpha T is its share of a pixel; summed over the pixels of class c of all views
(times the mask's confidence s) it is the evidence that Gaussian i belongs to c. It equals the gradient of
sum(image * mask) with respect to the Gaussian's color.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from sc3d.geometry.cameras import View
from sc3d.io.progress import progress
from sc3d.splatting import device
from sc3d.splatting.cpu.label_lifting import add_evidence
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.gpu.label_lifting import evidence_by_gradient

SCALE = 1 << 30  # evidence of one whole pixel, in fixed point: 2^63 of it are 8 thousand million pixels
ReadMask = Callable[[View], tuple[np.ndarray, np.ndarray | None]]
"""Channels of the classes (H, W) uint8 of a view, 0 = unlabelled, and the confidence (H, W) uint8, 255 = sure, or None =
all sure; of the view's size.
"""


def lift(gaussians: Gaussians, views: Iterable[View], read: ReadMask, num_channels: int) -> np.ndarray:
    """Evidence of every class for every Gaussian, from labelled views. It depends neither on the order of the
    views nor on threads.

    views: pinhole, in the local frame of the Gaussians; num_channels: classes + 1, as in `sc3d.scene.channels`
    returns: (N, num_channels) float64, pixels times confidence; column 0 stays 0
    raises ValueError for a view with distortion or a mask of another size than the view
    """
    evidence = np.zeros((len(gaussians), num_channels), np.int64)
    for view in progress(views, "lifting labels", "photo"):
        mask, confidence = read(view)
        if not view.camera.is_undistorted() or mask.shape != (view.height, view.width):
            raise ValueError(
                f"{view.name}: labels are lifted through pinhole views, from masks of the view's size"
            )
        sure = np.full(mask.shape, 255, np.uint8) if confidence is None else confidence
        weights = sure.astype(np.float32) / 255
        if device.has_kernels(gaussians.means):
            add_evidence(gaussians, view, mask, weights, float(SCALE), evidence)
        else:
            part = evidence_by_gradient(gaussians, view, mask, weights, num_channels)
            evidence += np.rint(part * SCALE).astype(np.int64)
    return evidence / SCALE


def winners(evidence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The class of most evidence and its share.

    evidence: (N, num_channels), column 0 unused
    returns: (N,) uint8 channels, 0 = no evidence; (N,) float32 confidence, 0 to 1
    """
    label = evidence[:, 1:].argmax(axis=1) + 1 if evidence.shape[1] > 1 else np.zeros(len(evidence), int)
    total, best = evidence[:, 1:].sum(axis=1), np.take_along_axis(evidence, label[:, None], axis=1)[:, 0]
    seen = total > 0
    share = np.where(seen, best / np.where(seen, total, 1), 0)
    return np.where(seen, label, 0).astype(np.uint8), share.astype(np.float32)
