"""The labelled cloud as a tensor point cloud: which attributes it has, and the surface it stands for."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import open3d as o3d

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, local_origin
from sc3d.geometry.neighbors import NeighborIndex, estimate_normals, orient_normals, point_spacing
from sc3d.geometry.raycast import FirstSurface, RayTarget, Surface, first_surface, nearest_points
from sc3d.geometry.voxel_traversal import VoxelSurface
from sc3d.io.clouds import read_cloud, read_mesh
from sc3d.io.ply import num_triangles
from sc3d.scene.channels import Channels
from sc3d.scene.frame_check import check_together
from sc3d.scene.labels import STATE_NAMES, Labels

logger = logging.getLogger(__name__)

NORMAL_NEIGHBORS = 30
SPACING_SAMPLE, SPACING_NEIGHBORS = 100_000, 8
SURFACE_VOXEL = 2.5  # of the grid that blocks rays where there is no mesh, in point spacings
# a pixel shows the label of a cloud point at most this many point spacings away from the surface that it sees
REACH = 4.0
UNCONFIRMED = "unconfirmed"  # attribute: 1 where one photo only shows the surface
VOTES = "votes_"  # + class id; PLY has scalar properties only
INSTANCE = "instance"  # attribute: number of the object that a point belongs to, 0 = none


def point_arrays(cloud: o3d.t.geometry.PointCloud, centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 3) float64 and unit normals (N, 3) float32 of a cloud.

    Missing normals are estimated (eq. 5) and turned towards the nearest of the camera centers (M, 3).
    """
    points = cloud.point.positions.numpy().astype(np.float64)
    given = cloud.point.normals.numpy() if "normals" in cloud.point else None
    return points, unit_normals(given, points, centers, points.min(axis=0))


def is_confirmed(cloud: o3d.t.geometry.PointCloud) -> np.ndarray:
    """(N,) bool: points of surface that several photos confirm, as `extract` has it; all of a cloud that does
    not say.
    """
    if UNCONFIRMED not in cloud.point:
        return np.ones(len(cloud.point.positions), bool)
    return cloud.point[UNCONFIRMED].cpu().numpy().ravel() == 0


def confirmed_only(cloud: o3d.t.geometry.PointCloud) -> o3d.t.geometry.PointCloud:
    """The points of `is_confirmed`."""
    kept = is_confirmed(cloud)
    return cloud if kept.all() else cloud.select_by_mask(o3d.core.Tensor(kept))


def unit_normals(
    given: np.ndarray | None, points: np.ndarray, centers: np.ndarray, origin: np.ndarray
) -> np.ndarray:
    """(N, 3) float32 unit normals of points (N, 3) world: those given (N, 3), if they are all usable, else
    estimated.

    centers: (M, 3) camera centers, to the nearest of which estimated normals are turned; origin: as in
        `NeighborIndex`
    """
    if given is not None:
        normals, usable = given.astype(np.float32), usable_normals(given)
        if usable.all():
            return normals / np.linalg.norm(normals, axis=1, keepdims=True)
        logger.warning(
            "%d of %d normals have no length or are not finite: all are estimated",
            (~usable).sum(),
            len(normals),
        )
    neighbors, _ = NeighborIndex(points, origin).nearest(points, NORMAL_NEIGHBORS)
    if neighbors.shape[1] < 3:
        raise InputError(f"the cloud has {len(points)} points: normals need at least 3")
    return orient_normals(points, estimate_normals(points, neighbors), centers)


def usable_normals(normals: np.ndarray) -> np.ndarray:
    """(N,) bool normals (N, 3) that have a direction."""
    lengths = np.linalg.norm(normals.astype(np.float32), axis=1)
    return np.isfinite(lengths) & (lengths > 0)


def read_surface(
    files: Sequence[Path],
    points: np.ndarray,
    normals: np.ndarray | None,
    origin: np.ndarray,
    kind: Literal["auto", "surfels", "voxels"] = "auto",
) -> RayTarget:
    """The surface that rays hit, `Label.surface`: the mesh and what lies beside it (`Scene.surface`) if there
    is one and nothing else is wanted, else that of the points.

    points: (N, 3) float64 world; normals: (N, 3) float32 unit or None = estimated; origin: (3,) world, shift
        of the frame for float32
    """
    if kind == "auto" and files[0].exists():
        meshes = [read_mesh(path) for path in files if path == files[0] or num_triangles([path])]
        parts = [(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()) for mesh in meshes]
        check_together(files[0], parts[0][0].astype(np.float64), points)
        return Surface.from_meshes(parts, origin)
    if kind == "surfels":
        return Surface.from_cloud(points, normals, origin)
    return VoxelSurface.from_cloud(points, normals, SURFACE_VOXEL * spacing_of(points))


def with_labels(
    cloud: o3d.t.geometry.PointCloud,
    normals: np.ndarray,
    labels: Labels,
    votes: Votes | None = None,
    instance: np.ndarray | None = None,
) -> o3d.t.geometry.PointCloud:
    """The same points, in order, with attributes label, confidence, state, num_views (and votes per class;
    and the object (N,) uint32 of each point).
    """
    result = cloud.clone()
    attributes = {
        "normals": normals.astype(np.float32),
        "label": labels.label[:, None],
        "confidence": labels.confidence[:, None],
        "state": labels.state[:, None],
        "num_views": labels.num_views[:, None].astype(np.int32),
    }
    for name in [name for name in result.point if name.startswith(VOTES) or name == INSTANCE]:
        del result.point[name]
    if instance is not None:
        attributes[INSTANCE] = instance.astype(np.uint32)[:, None]
    if votes is not None:
        attributes |= {
            f"{VOTES}{name}": votes.values[:, channel, None].astype(np.float32)
            for channel, name in enumerate(votes.channels.names)
        }
    for name, values in attributes.items():
        result.point[name] = o3d.core.Tensor(np.ascontiguousarray(values))
    return result


def read_labelled(path: Path, made_by: str) -> tuple[o3d.t.geometry.PointCloud, Labels]:
    """Read a cloud that has labels; `made_by` names the command that writes it, for the error."""
    require_labelled(path, made_by)
    cloud = read_cloud(path)
    return cloud, take_labels(cloud, path, made_by)


def require_labelled(path: Path, made_by: str) -> None:
    """InputError that names the command which writes a labelled cloud, if it is missing."""
    if not path.exists():
        raise InputError(f"{path} is missing: run `sc3d {made_by} SCENE` first")


def take_labels(cloud: o3d.t.geometry.PointCloud, path: Path, made_by: str) -> Labels:
    """The labels of a cloud that was read from `path`, checked; its attributes get their proper types."""
    ranges = {
        "label": (255, np.uint8),
        "confidence": (1, np.float32),
        "state": (len(STATE_NAMES) - 1, np.uint8),
        "num_views": (2**31 - 1, np.int32),
    }
    missing = [name for name in ranges if name not in cloud.point]
    if missing:
        raise InputError(f"{path} has no attribute {missing[0]!r}: it was not written by `sc3d {made_by}`")
    labels = Labels(
        *(_in_range(path, name, cloud.point[name].numpy().ravel(), *ranges[name]) for name in ranges)
    )
    for name in ranges:
        cloud.point[name] = o3d.core.Tensor(getattr(labels, name)[:, None])
    return labels


def instances_of(cloud: o3d.t.geometry.PointCloud, path: Path) -> np.ndarray | None:
    """(N,) uint32 object of each point of a cloud that was read from `path`, 0 = none; None if it does not
    say.
    """
    if INSTANCE not in cloud.point:
        return None
    return _in_range(path, INSTANCE, cloud.point[INSTANCE].cpu().numpy().ravel(), 2**32 - 1, np.uint32)


def _in_range(path: Path, name: str, values: np.ndarray, largest: int, dtype: type) -> np.ndarray:
    """The values as `dtype`; InputError if it cannot hold them, or they are not from 0 to `largest`."""
    if not ((values >= 0) & (values <= largest)).all() or (
        np.issubdtype(dtype, np.integer) and (values != np.floor(values)).any()
    ):
        raise InputError(
            f"{path} has values of {name!r} that are not from 0 to {largest}: it is damaged, or was not written by sc3d"
        )
    return values.astype(dtype)


@dataclass(frozen=True)
class Votes:
    """values: (N, channels) float32, in views of full weight, of which column 0 counts views; channels: the
    class of each column.
    """

    values: np.ndarray
    channels: Channels


def vote_channels(names: Iterable[str]) -> Channels | None:
    """The classes of which a cloud has votes, by the names of its attributes; None if there are none."""
    numbers = [name[len(VOTES) :] for name in names if name.startswith(VOTES)]
    none = "none" in numbers
    ids = [int(number) for number in numbers if number.isdecimal() and len(number) < 4 and number.isascii()]
    return None if 0 not in ids or len(ids) < 2 or max(ids) > 255 else Channels.of_classes(ids, none)


def read_votes(cloud: o3d.t.geometry.PointCloud) -> Votes | None:
    """The votes that `label` left in a cloud; None if there are none. InputError if they are none."""
    channels = vote_channels(cloud.point)
    if channels is None:
        return None
    votes = np.concatenate(
        [cloud.point[f"{VOTES}{name}"].numpy().astype(np.float32) for name in channels.names], axis=1
    )
    if not (np.isfinite(votes) & (votes >= 0)).all():
        raise InputError("the votes of the cloud are not finite numbers: run `sc3d label` again")
    return Votes(votes, channels)


def spacing_of(points: np.ndarray) -> float:
    """Sampling distance of the (N, 3) points, world units, from at most 100 000 of them; 1 if they
    coincide.
    """
    sample = points[:: max(1, len(points) // SPACING_SAMPLE)]
    return (
        point_spacing(NeighborIndex(points, points.min(axis=0)).nearest(sample, SPACING_NEIGHBORS + 1)[1])
        or 1.0
    )


@dataclass(frozen=True)
class LabelledSurface:
    """A labelled cloud and the surface it lies on; built once, looked at through many views.

    label: (N,) uint8 ids; reach: largest distance between surface and point, world units
    """

    surface: RayTarget
    index: NeighborIndex
    label: np.ndarray
    reach: float

    @classmethod
    def build(
        cls, cloud: o3d.t.geometry.PointCloud, views: list[View], files: Sequence[Path]
    ) -> LabelledSurface:
        """cloud: with `label`; views: of the scene, for the side that normals face; files:
        `Scene.surface`, voxels of the cloud if there is no mesh.
        """
        if "label" not in cloud.point:
            raise InputError("the cloud has no labels: run `sc3d label SCENE` and `sc3d propagate SCENE`")
        points, normals = point_arrays(cloud, np.array([view.center for view in views]))
        surface = read_surface(files, points, normals, local_origin(views))
        return cls(
            surface,
            NeighborIndex(points, points.min(axis=0)),
            cloud.point["label"].numpy().ravel(),
            REACH * spacing_of(points),
        )

    def see(
        self, view: View, size: tuple[int, int], wanted: np.ndarray | None = None
    ) -> tuple[np.ndarray, FirstSurface]:
        """The class at each pixel of a photo, distortion included: that of the cloud point nearest to the
        first surface.

        size: (width, height) of the result, px; wanted: (H, W) bool pixels to label, None = all
        returns: (H, W) uint8 ids, 0 = unlabelled or nothing hit; the first surface
        """
        rows, first = self.rows(view, size, wanted)
        return np.where(rows >= 0, self.label[rows], 0).astype(np.uint8), first

    def rows(
        self, view: View, size: tuple[int, int], wanted: np.ndarray | None = None
    ) -> tuple[np.ndarray, FirstSurface]:
        """The same, as rows of the cloud: (H, W) int, -1 = nothing hit."""
        sized = view.resized(*size)
        first = first_surface(self.surface, sized)
        return nearest_points(first, sized, self.index, self.reach, wanted), first
