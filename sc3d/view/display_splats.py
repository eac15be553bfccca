"""The Gaussians of a scene as a viewer needs them: with their labels where there are any, and painted by
them.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import local_origin
from sc3d.io.ply import read_records
from sc3d.io.splats import ORIGIN, read_splat_ply
from sc3d.scene.class_table import ClassTable
from sc3d.scene.scene import Scene
from sc3d.view.colors import Coloring, confidence_colors
from sc3d.view.display_cloud import class_ids

if TYPE_CHECKING:
    import open3d as o3d

    from sc3d.splatting.gaussians import Gaussians

logger = logging.getLogger(__name__)

SPLAT_COLORINGS: tuple[Coloring, ...] = ("photo", "label", "confidence")


@dataclass(frozen=True)
class DisplaySplats:
    """N Gaussians in the frame shifted by `origin` (3,), and their labels where `sc3d export --format splats`
    has found them.

    label: (N,) uint8 ids, 0 = no photo shows it with a label, or it floats; confidence: (N,) float32, share
        of the class in all that it shows, 0 to 1; table: the classes; all None for gaussians.ply
    """

    gaussians: Gaussians
    origin: np.ndarray
    label: np.ndarray | None = None
    confidence: np.ndarray | None = None
    table: ClassTable | None = None

    def painted(self, by: Coloring) -> Gaussians:
        """Class colors or confidences instead of the photos' colors. InputError if there are no labels."""
        if by == "photo":
            return self.gaussians
        return self.gaussians.painted(self.colors(by) / 255)

    def colors(self, by: Coloring) -> np.ndarray:
        """(N, 3) uint8 RGB; of the photos: the mean over all directions of view, without what changes with
        them.
        """
        if by == "photo":
            return self.gaussians.base_colors
        if by not in SPLAT_COLORINGS:
            raise InputError(f"splats have no {by}: choose --by photo, label or confidence")
        label, confidence, table = self.labels()
        return table.palette[label] if by == "label" else confidence_colors(confidence)

    def labels(self) -> tuple[np.ndarray, np.ndarray, ClassTable]:
        """`label`, `confidence` and `table`. InputError if there are none."""
        if self.label is None or self.confidence is None or self.table is None:
            raise InputError("the splats have no labels: run `sc3d export SCENE --format splats`")
        return self.label, self.confidence, self.table

    def only(self, ids: set[int] | None) -> DisplaySplats:
        """Those of some classes, None = all. InputError if there are none."""
        if ids is None:
            return self
        if self.label is None:
            raise InputError(
                "--classes needs labels, and the splats have none: run `sc3d export SCENE --format splats`"
            )
        labels, _, table = self.labels()
        chosen = np.isin(labels, sorted(ids))
        if not chosen.any():
            names = ", ".join(table.name(label) for label in sorted(ids))
            raise InputError(f"no splat has one of the classes {names}: nothing to show or write")
        return self[chosen]

    def centers(self) -> o3d.t.geometry.PointCloud:
        """The centers as a cloud: positions (world), colors, and label and confidence where there are
        labels.
        """
        import open3d as o3d

        cloud = o3d.t.geometry.PointCloud(
            o3d.core.Tensor(self.gaussians.means.numpy().astype(np.float64) + self.origin)
        )
        cloud.point.colors = o3d.core.Tensor(self.colors("photo"))
        if self.label is not None:
            label, confidence, _ = self.labels()
            cloud.point["label"] = o3d.core.Tensor(label[:, None])
            cloud.point["confidence"] = o3d.core.Tensor(confidence[:, None])
        return cloud

    def most_visible(self, count: int) -> DisplaySplats:
        """At most `count` splats: those with the largest area times opacity, in their order."""
        if len(self.gaussians) <= count:
            return self
        area = (
            np.sort(self.gaussians.scales.numpy(), axis=1)[:, 1:].prod(axis=1)
            * self.gaussians.opacities.numpy()
        )
        return self[np.sort(np.argsort(-area, kind="stable")[:count])]

    def __getitem__(self, chosen: np.ndarray) -> DisplaySplats:
        label, confidence = (
            None if values is None else values[chosen] for values in (self.label, self.confidence)
        )
        return replace(self, gaussians=self.gaussians[chosen], label=label, confidence=confidence)


def trained_splats(scene: Scene) -> DisplaySplats:
    """gaussians.ply; InputError that says what to run if it is missing or belongs to other cameras."""
    from sc3d.splatting.dataset import load_gaussians

    return DisplaySplats(*load_gaussians(scene))


def read_splats(path: Path, table: ClassTable) -> DisplaySplats:
    """What `sc3d export SCENE --format splats` wrote; InputError if the file has no labels."""
    from sc3d.splatting.gaussians import Gaussians

    arrays, comments = read_splat_ply(path)
    records, _ = read_records(path)
    origins = [line.split()[2:] for line in comments if line.startswith(f"{ORIGIN} ")]
    if not {"label", "confidence"} <= set(records.dtype.names or ()) or not origins:
        raise InputError(f"{path} has no labels: run `sc3d export SCENE --format splats`")
    label, confidence = (np.ascontiguousarray(records[name]) for name in ("label", "confidence"))
    return DisplaySplats(Gaussians.from_arrays(arrays), np.array(origins[0], float), label, confidence, table)


def labelled_splats(scene: Scene) -> DisplaySplats:
    """The splats of a scene that have labels; InputError if they are missing or belong to other cameras."""
    table = scene.class_table()
    scene.require(scene.labelled_splats, hint=f"run `sc3d export {scene.path} --format splats` first")
    found = read_splats(scene.labelled_splats, table)
    if scene.sparse.is_dir() and np.abs(found.origin - local_origin(scene.model.views)).max() > 1e-3:
        raise InputError(
            f"{scene.labelled_splats} belongs to other cameras than those in {scene.sparse}: run `sc3d export {scene.path} --format splats --overwrite`"
        )
    return found


def best_splats(scene: Scene) -> DisplaySplats:
    """The labelled splats if they have been exported, else those that were trained."""
    if scene.classes.exists() and scene.labelled_splats.exists():
        return labelled_splats(scene)
    logger.info("the splats have no labels yet: `sc3d export %s --format splats` labels them", scene.path)
    return trained_splats(scene)


def splats_colored_by(scene: Scene, by: Coloring, classes: tuple[str, ...] = ()) -> DisplaySplats:
    """The splats that can be colored in some way, of the named classes: gaussians.ply for the photos' colors,
    else the labelled ones. For class colors, gaussians.ply does while there are no others.
    """
    labelled = by == "confidence" or (by == "label" and scene.labelled_splats.exists())
    if labelled or classes:
        return labelled_splats(scene).only(class_ids(scene.class_table(), classes))
    if by == "label":
        logger.info(
            "the splats have no labels yet and are shown as trained: `sc3d export %s --format splats` labels them",
            scene.path,
        )
    return trained_splats(scene)
