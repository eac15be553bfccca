"""Labels for the Gaussians themselves: each takes the class of the pixels that it shows, in closed form, A[i,
c] += alpha T s.

A fragment's weight w = alpha T is its share of a pixel; summed over the pixels of class c of all views (times
the mask's confidence s) it is
the evidence that Gaussian i belongs to c. It equals the gradient of sum(image * mask) with respect to the
Gaussian's color.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import torch
from tqdm import tqdm

from sc3d.geometry.cameras import View
from sc3d.splatting.cpu import label_lifting as kernels_lift
from sc3d.splatting.cpu import projection as kernels_project
from sc3d.splatting.device import has_kernels
from sc3d.splatting.gaussians import SH_C0, Gaussians
from sc3d.splatting.rendering import camera_array, interleaved, render, sort_into_tiles

SCALE = 1 << 30  # evidence of one whole pixel, in fixed point: 2^63 of it are 8 thousand million pixels
ReadMask = Callable[[View], tuple[np.ndarray, np.ndarray | None]]
"""Class ids (H, W) uint8 of a view, 0 = unlabelled, and the confidence (H, W) uint8, 255 = sure, or None =
all sure; of the view's size.
"""


def lift(gaussians: Gaussians, views: Iterable[View], read: ReadMask, num_ids: int) -> np.ndarray:
    """Evidence of every class for every Gaussian, from labelled views. It depends neither on the order of the
    views nor on threads.

    views: pinhole, in the local frame of the Gaussians; num_ids: largest class id + 1
    returns: (N, num_ids) float64, pixels times confidence; column 0 stays 0
    raises ValueError for a view with distortion or a mask of another size than the view
    """
    evidence = np.zeros((len(gaussians), num_ids), np.int64)
    for view in tqdm(views, desc="lifting labels", unit="photo", disable=None):
        mask, confidence = read(view)
        if not view.camera.is_undistorted() or mask.shape != (view.height, view.width):
            raise ValueError(
                f"{view.name}: labels are lifted through pinhole views, from masks of the view's size"
            )
        weights = (
            np.ones(mask.shape, np.float32) if confidence is None else confidence.astype(np.float32) / 255
        )
        if has_kernels(gaussians.means):
            _add_view(gaussians, view, mask, weights, evidence)
        else:
            evidence += np.rint(evidence_by_gradient(gaussians, view, mask, weights, num_ids) * SCALE).astype(
                np.int64
            )
    return evidence / SCALE


def _add_view(
    gaussians: Gaussians, view: View, mask: np.ndarray, weights: np.ndarray, evidence: np.ndarray
) -> None:
    """Add one view to evidence (N, num_ids) int64. mask: (H, W) uint8; weights: (H, W) float32."""
    ids = np.flatnonzero(np.bincount(mask.ravel(), minlength=256)[1:]) + 1
    if not len(ids) or not len(gaussians):
        return
    arrays = [tensor.detach().contiguous().numpy() for tensor in gaussians.parameters().values()]
    count, camera = len(gaussians), camera_array(view)
    records, depths, radii = (
        np.empty((count, kernels_project.RECORD), np.float32),
        np.zeros(count, np.float32),
        np.zeros(count, np.float32),
    )
    kernels_project.project(
        *arrays, 0, camera, interleaved(-(-count // kernels_project.CHUNK)), records, depths, radii
    )
    visible, records, offsets, ranks, instances, starts = sort_into_tiles(camera, records, depths)
    columns = np.full(256, kernels_lift.NONE)
    columns[ids] = np.arange(len(ids))
    contributions = np.zeros((len(ranks), len(ids)), np.float32)
    kernels_lift.lift(
        records.reshape(-1),
        ranks,
        instances,
        starts,
        interleaved(len(starts) - 1),
        columns[mask],
        weights,
        contributions,
    )
    kernels_lift.collect(visible, offsets, contributions, ids, float(SCALE), evidence)


def evidence_by_gradient(
    gaussians: Gaussians, view: View, mask: np.ndarray, weights: np.ndarray, num_ids: int
) -> np.ndarray:
    """The same for one view by the renderer's backward pass, three classes at a time: the twin of the kernel,
    and the way on a GPU.

    returns: (N, num_ids) float64
    """
    evidence = np.zeros((len(gaussians), num_ids))
    # away from 0, where colors are cut
    gray = painted(gaussians.detached(), np.full((len(gaussians), 3), 0.5))
    target, weight = torch.from_numpy(mask.astype(np.int64)), torch.from_numpy(weights)
    for first in range(1, num_ids, 3):
        dc = gray.sh.clone().requires_grad_()
        image = render(replace(gray, sh=dc), view, 0, geometry=False).color
        shown = torch.stack([(target == label) * weight for label in range(first, first + 3)], dim=2)
        (image * shown.to(image)).sum().backward()
        part = dc.grad[:, 0].cpu().numpy().astype(np.float64) / SH_C0
        evidence[:, first : first + 3] = part[:, : num_ids - first]
    return evidence


def winners(evidence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The class of most evidence and its share.

    evidence: (N, num_ids), column 0 unused
    returns: (N,) uint8 ids, 0 = no evidence; (N,) float32 confidence, 0 to 1
    """
    label = evidence[:, 1:].argmax(axis=1) + 1 if evidence.shape[1] > 1 else np.zeros(len(evidence), int)
    total = evidence[:, 1:].sum(axis=1)
    best = np.take_along_axis(evidence, label[:, None], axis=1)[:, 0]
    seen = total > 0
    return np.where(seen, label, 0).astype(np.uint8), np.where(
        seen, best / np.where(seen, total, 1), 0
    ).astype(np.float32)


def painted(gaussians: Gaussians, colors: np.ndarray) -> Gaussians:
    """The same Gaussians in one color each from everywhere. colors: (N, 3) RGB, 0 to 1; float32"""
    values = torch.from_numpy(np.ascontiguousarray(colors, np.float32)).to(gaussians.means)
    return Gaussians(
        gaussians.means,
        gaussians.log_scales,
        gaussians.quats,
        gaussians.opacity_logits,
        ((values - 0.5) / SH_C0)[:, None],
    )


@torch.no_grad()
def class_images(gaussians: Gaussians, view: View, shares: np.ndarray) -> np.ndarray:
    """Alpha-weighted images of per-Gaussian values, three at a time.

    shares: (N, C) not negative; returns: (H, W, C) float32 sum of w * share
    """
    count = shares.shape[1]
    padded = np.pad(shares, ((0, 0), (0, -count % 3)))
    images = [
        render(painted(gaussians, padded[:, first : first + 3]), view, 0, geometry=False).color.cpu().numpy()
        for first in range(0, count, 3)
    ]
    return np.concatenate(images, axis=2)[..., :count]
