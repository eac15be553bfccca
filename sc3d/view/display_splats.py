"""The Gaussians of a scene as a viewer needs them: with their labels where there are any, and painted by
them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import local_origin
from sc3d.scene.class_table import ClassTable
from sc3d.scene.scene import Scene
from sc3d.view.colors import Coloring, confidence_colors

if TYPE_CHECKING:
    import open3d as o3d

    from sc3d.splatting.gaussians import Gaussians

SPLAT_COLORINGS: tuple[Coloring, ...] = ("photo", "label", "confidence")


@dataclass(frozen=True)
class ShownSplats:
    """N Gaussians in the frame shifted by `origin` (3,), and their labels where `sc3d export --format splats`
    has found them.

    label: (N,) uint8 ids, 0 = none; confidence: (N,) float32, 0 to 1; both None for gaussians.ply
    """

    gaussians: Gaussians
    origin: np.ndarray
    label: np.ndarray | None = None
    confidence: np.ndarray | None = None

    def painted(self, by: Coloring, table: ClassTable | None) -> Gaussians:
        """Class colors or confidences instead of the photos' colors. InputError if there are no labels."""
        if by == "photo":
            return self.gaussians
        return self.gaussians.painted(self.colors(by, table) / 255)

    def colors(self, by: Coloring, table: ClassTable | None) -> np.ndarray:
        """(N, 3) uint8 RGB; of the photos: the mean over all directions of view, without what changes with
        them.
        """
        if by == "photo":
            return self.gaussians.base_colors
        if by not in SPLAT_COLORINGS:
            raise InputError(f"splats have no {by}: choose --by photo, label or confidence")
        if self.label is None or table is None:
            raise InputError("the splats have no labels: run `sc3d export SCENE --format splats`")
        return table.palette[self.label] if by == "label" else confidence_colors(self.confidence)

    def only(self, ids: set[int] | None) -> ShownSplats:
        """Those of some classes, None = all. InputError if there are none."""
        if ids is None:
            return self
        if self.label is None:
            raise InputError(
                "--classes needs labels, and the splats have none: run `sc3d export SCENE --format splats`"
            )
        chosen = np.isin(self.label, sorted(ids))
        if not chosen.any():
            raise InputError("no splat has one of the chosen classes: nothing to show")
        return self[chosen]

    def centers(self) -> o3d.t.geometry.PointCloud:
        """The centers as a cloud: positions (world), colors, and label and confidence where there are labels."""
        import open3d as o3d

        cloud = o3d.t.geometry.PointCloud(
            o3d.core.Tensor(self.gaussians.means.numpy().astype(np.float64) + self.origin)
        )
        cloud.point.colors = o3d.core.Tensor(self.colors("photo", None))
        if self.label is not None:
            cloud.point["label"], cloud.point["confidence"] = (
                o3d.core.Tensor(self.label[:, None]),
                o3d.core.Tensor(self.confidence[:, None]),
            )
        return cloud

    def most_visible(self, count: int) -> ShownSplats:
        """At most `count` splats: those with the largest area times opacity, in their order."""
        if len(self.gaussians) <= count:
            return self
        area = (
            np.sort(self.gaussians.scales.numpy(), axis=1)[:, 1:].prod(axis=1)
            * self.gaussians.opacities.numpy()
        )
        return self[np.sort(np.argsort(-area, kind="stable")[:count])]

    def __getitem__(self, chosen: np.ndarray) -> ShownSplats:
        label, confidence = (
            None if values is None else values[chosen] for values in (self.label, self.confidence)
        )
        return replace(self, gaussians=self.gaussians[chosen], label=label, confidence=confidence)


def trained_splats(scene: Scene) -> ShownSplats:
    """gaussians.ply; InputError that says what to run if it is missing or belongs to other cameras."""
    from sc3d.splatting.dataset import load_gaussians

    return ShownSplats(*load_gaussians(scene))


def labelled_splats(scene: Scene, table: ClassTable) -> ShownSplats:
    """What `sc3d export SCENE --format splats` wrote; InputError if it is missing or belongs to other
    cameras.
    """
    from sc3d.exporters.splats import read_splats

    path = scene.export / "splats.ply"
    scene.require(path, hint=f"run `sc3d export {scene.path} --format splats` first")
    found = read_splats(path, table)
    if scene.sparse.is_dir() and np.abs(found.origin - local_origin(scene.model.views)).max() > 1e-3:
        raise InputError(
            f"{path} belongs to other cameras than those in {scene.sparse}: run `sc3d export {scene.path} --format splats --overwrite`"
        )
    return ShownSplats(found.gaussians, found.origin, found.label, found.confidence)
