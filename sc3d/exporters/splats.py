"""Gaussians with labels, in the PLY that splat viewers read."""

from __future__ import annotations

from functools import reduce
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.exporters.masks import render_mask
from sc3d.exporters.projected_cloud import MapProjection, chosen_classes, find_projection
from sc3d.geometry.cameras import undistorted
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.io.splats import origin_comment, write_splat_ply
from sc3d.scene.channels import Channels
from sc3d.scene.labelled_cloud import REACH, require_labelled
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export
from sc3d.splatting.dataset import load_gaussians
from sc3d.splatting.lifting import lift, winners
from sc3d.tiling.seen_points import labelled_sight
from sc3d.view.display_splats import DisplaySplats

# longest side of the masks whose labels are lifted, px; Gaussians are trained at about that size
LIFTED_SIZE = 800
# point spacings: farther from all points of its class, a splat floats before or behind what it was labelled
# for
GUARD = 32.0


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.labelled_splats]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/splats.ply`: gaussians.ply with `label` (uchar) and `confidence` (float) per splat; of the
    chosen classes only.
    """
    chosen, projection = chosen_classes(scene, settings), find_projection(scene, settings)
    splats = label_splats(scene, settings).only(chosen)
    write_splats(outputs(scene, settings)[0], splats, projection)
    return figures(splats, projection)


def label_splats(scene: Scene, settings: Export) -> DisplaySplats:
    """Lift the fused labels, as every photo sees them on the surface, to all Gaussians of the scene."""
    source, table = settings.labelled or scene.labelled, scene.class_table()
    channels = table.channels
    require_labelled(source, "propagate")
    gaussians, origin = load_gaussians(scene)
    views = [undistorted(view.shifted(origin), LIFTED_SIZE) for view in scene.model.views]
    sizes = {view.name: (view.width, view.height) for view in views}
    with labelled_sight(scene, settings, source, sizes, scene.labelled_splats, LIFTED_SIZE) as seen:
        surface, labels = seen.surface, seen.labels
        unknown = table.unknown(labels.label)
        if unknown:
            raise InputError(
                f"{source} has class id {unknown[0]}, which is not in {scene.classes}: add it there"
            )
        evidence = lift(
            gaussians,
            views,
            lambda view: _channel_mask(
                channels, render_mask(surface, labels.confidence, view.shifted(-origin))
            ),
            channels.count,
        )
        winner, confidence = winners(evidence)
        label, means = channels.to_ids(winner), gaussians.means.numpy() + origin
        distances = (distance_to_class(means, label, *part) for part in seen.parts())
        floating = reduce(np.minimum, distances) > GUARD / REACH * surface.reach
    if not (label > 0)[~floating].any():
        raise InputError(
            f"no splat shows a label of {source}: check that gaussians.ply and this cloud belong together"
        )
    return DisplaySplats(
        gaussians,
        origin,
        np.where(floating, np.uint8(0), label),
        np.where(floating, np.float32(0), confidence),
        table,
    )


def _channel_mask(channels: Channels, mask: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return channels.from_ids(mask[0]), mask[1]


def distance_to_class(
    positions: np.ndarray, label: np.ndarray, points: np.ndarray, point_label: np.ndarray
) -> np.ndarray:
    """(N,) distance of each position (N, 3) to the nearest of the points (P, 3) of the same label; 0 for
    label 0, infinite if there is none.
    """
    distance = np.where(label == 0, 0.0, np.inf)
    for present in np.intersect1d(label[label > 0], point_label):
        rows = np.flatnonzero(label == present)
        distance[rows] = NeighborIndex(points[point_label == present]).nearest(positions[rows], 1)[1][:, 0]
    return distance


def write_splats(path: Path, splats: DisplaySplats, projection: MapProjection) -> None:
    """3DGS PLY with two more properties, which viewers ignore; positions stay in the local frame, comments
    say where it lies.
    """
    comments = [origin_comment(splats.origin)]
    if projection.crs is not None:
        comments.append(
            f"sc3d EPSG:{projection.epsg} origin "
            + " ".join(f"{value:.3f}" for value in origin_in_crs(splats, projection))
        )
    label, confidence, table = splats.labels()
    comments += [f"sc3d label {entry.id} {entry.name}" for entry in table]
    extra: dict[str, np.ndarray] = {
        "label": label.astype(np.uint8),
        "confidence": confidence.astype(np.float32),
    }
    write_splat_ply(path, splats.gaussians.arrays(), comments, extra)


def origin_in_crs(splats: DisplaySplats, projection: MapProjection) -> np.ndarray:
    """(3,) easting, northing and height of the splats' origin in the CRS; the world without one."""
    return projection.to_crs(splats.origin[None])[0]


def figures(splats: DisplaySplats, projection: MapProjection) -> dict[str, object]:
    """What the summary and the sidecar say."""
    label, confidence, table = splats.labels()
    counts = np.bincount(label, minlength=256)
    return {
        "splats": len(label),
        "labelled": f"{(label > 0).mean():.1%}",
        "mean_confidence": round(float(confidence[label > 0].mean()), 3),
        "origin": np.round(origin_in_crs(splats, projection) + 0.0, 3).tolist(),
        **projection.figures(),
        "splats_by_class": {table.name(int(row)): int(counts[row]) for row in np.flatnonzero(counts)},
    }
