"""Gaussians with labels, in the PLY that splat viewers read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.exporters.masks import render_mask
from sc3d.exporters.projected_cloud import Placement, chosen_classes, find_placement
from sc3d.geometry.cameras import undistorted
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.io.clouds import read_cloud
from sc3d.io.splats import origin_comment, read_splat_ply, write_splat_ply
from sc3d.scene.class_table import ClassTable
from sc3d.scene.labelled_cloud import REACH, LabelledSurface, read_labelled
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export
from sc3d.splatting.dataset import load_gaussians
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.lifting import lift, winners

# longest side of the masks whose labels are lifted, px; Gaussians are trained at about that size
LIFTED_SIZE = 800
# point spacings: farther from all points of its class, a splat floats before or behind what it was labelled
# for
GUARD = 32.0


@dataclass(frozen=True)
class LabelledSplats:
    """N Gaussians in a frame shifted by `origin`.

    label: (N,) uint8 ids, 0 = no photo shows it with a label, or it floats
    confidence: (N,) float32, share of the class in all that it shows, 0 to 1; 0 without label
    origin: (3,) float64 world position of the Gaussians' origin; table: the classes
    """

    gaussians: Gaussians
    label: np.ndarray
    confidence: np.ndarray
    origin: np.ndarray
    table: ClassTable

    def only(self, classes: set[int]) -> LabelledSplats:
        """Those of the given class ids; InputError if there are none."""
        chosen = np.isin(self.label, sorted(classes))
        if not chosen.any():
            raise InputError(
                f"no splat has one of the classes {', '.join(self.table.name(label) for label in sorted(classes))}: nothing to write"
            )
        return LabelledSplats(
            self.gaussians[chosen], self.label[chosen], self.confidence[chosen], self.origin, self.table
        )

    def counts(self) -> dict[str, int]:
        """Number of splats per class name."""
        counts = np.bincount(self.label, minlength=256)
        return {self.table.name(int(label)): int(counts[label]) for label in np.flatnonzero(counts)}


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / "splats.ply"]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/splats.ply`: gaussians.ply with `label` (uchar) and `confidence` (float) per splat; of the
    chosen classes only.
    """
    chosen, placement = chosen_classes(scene, settings), find_placement(scene, settings)
    splats = label_splats(scene, settings).only(chosen)
    write_splats(outputs(scene, settings)[0], splats, placement)
    return figures(splats, placement)


def label_splats(scene: Scene, settings: Export) -> LabelledSplats:
    """Lift the fused labels, as every photo sees them on the surface, to all Gaussians of the scene."""
    source, table = settings.labelled or scene.labelled, scene.class_table()
    cloud, labels = read_labelled(source, "propagate")
    unknown = table.unknown(labels.label)
    if unknown:
        raise InputError(f"{source} has class id {unknown[0]}, which is not in {scene.classes}: add it there")
    gaussians, origin = load_gaussians(scene)
    surface = LabelledSurface.build(cloud, scene.model.views, scene.mesh)
    views = [undistorted(view.shifted(origin), LIFTED_SIZE) for view in scene.model.views]
    evidence = lift(
        gaussians,
        views,
        lambda view: render_mask(surface, labels.confidence, view.shifted(-origin)),
        table.num_ids,
    )
    label, confidence = winners(evidence)
    points = cloud.point.positions.numpy().astype(np.float64)
    floating = (
        distance_to_class(gaussians.means.numpy() + origin, label, points, surface.label)
        > GUARD / REACH * surface.reach
    )
    if not (label > 0)[~floating].any():
        raise InputError(
            f"no splat shows a label of {source}: check that gaussians.ply and this cloud belong together"
        )
    return LabelledSplats(
        gaussians,
        np.where(floating, np.uint8(0), label),
        np.where(floating, np.float32(0), confidence),
        origin,
        table,
    )


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


def write_splats(path: Path, splats: LabelledSplats, placement: Placement) -> None:
    """3DGS PLY with two more properties, which viewers ignore; positions stay in the local frame, comments
    say where it lies.
    """
    comments = [origin_comment(splats.origin)]
    if placement.crs is not None:
        comments.append(
            f"sc3d EPSG:{placement.epsg} origin "
            + " ".join(f"{value:.3f}" for value in origin_in_crs(splats, placement))
        )
    comments += [f"sc3d label {entry.id} {entry.name}" for entry in splats.table]
    extra = {"label": splats.label.astype(np.uint8), "confidence": splats.confidence.astype(np.float32)}
    write_splat_ply(path, splats.gaussians.arrays(), comments, extra)


def read_splats(path: Path, table: ClassTable) -> LabelledSplats:
    """What `write_splats` wrote; InputError if the file has no labels."""
    arrays, comments = read_splat_ply(path)
    found = read_cloud(path).point
    origins = [line.split()[2:] for line in comments if line.startswith("sc3d origin ")]
    if "label" not in found or "confidence" not in found or not origins:
        raise InputError(f"{path} has no labels: run `sc3d export SCENE --format splats`")
    return LabelledSplats(
        Gaussians.from_arrays(arrays),
        found["label"].numpy().ravel(),
        found["confidence"].numpy().ravel(),
        np.array(origins[0], float),
        table,
    )


def origin_in_crs(splats: LabelledSplats, placement: Placement) -> np.ndarray:
    """(3,) easting, northing and height of the splats' origin in the CRS; the world without one."""
    return placement.points(splats.origin[None])[0]


def figures(splats: LabelledSplats, placement: Placement) -> dict[str, object]:
    """What the summary and the sidecar say."""
    labelled = splats.label > 0
    return {
        "splats": len(splats.label),
        "labelled": f"{labelled.mean():.1%}",
        "mean_confidence": round(float(splats.confidence[labelled].mean()), 3),
        "origin": np.round(origin_in_crs(splats, placement) + 0.0, 3).tolist(),
        **placement.figures(),
        "splats_by_class": splats.counts(),
    }
