"""A point that was clicked: its label, how sure it is, how the photos voted, and which of them saw it. Needs
no window.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import open3d as o3d

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, in_image, local_origin, project, rays
from sc3d.geometry.neighbors import estimate_normals, orient_normals
from sc3d.geometry.raycast import FirstSurface, see_points
from sc3d.io.json_files import read_json
from sc3d.runner import sidecar
from sc3d.scene.class_table import ClassTable
from sc3d.scene.labelled_cloud import INSTANCE, NORMAL_NEIGHBORS, Votes, read_surface, read_votes, spacing_of
from sc3d.scene.scene import Scene
from sc3d.settings.common import Memory
from sc3d.tiling.memory import SHOWN_BYTES, TRIANGLE, fits, surface_bytes
from sc3d.view.catalog import Catalog
from sc3d.view.colors import STATES

if TYPE_CHECKING:
    from sc3d.geometry.raycast import RayTarget

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class PickedPoint:
    """What is known of one point; None where the cloud does not have it.

    row: in the cloud; position: (3,) float64 world; label: name of its class; confidence: 0 to 1; state: see
        `colors.STATES`
    votes: by class name, in photos of full weight, largest first; photos: names of those that see it on their
        first surface
    object: number of the object that it belongs to, 0 = none; of_object: what is known of that, for people
    to read
    """

    row: int
    position: np.ndarray
    label: str | None
    confidence: float | None
    state: str | None
    votes: dict[str, float]
    photos: tuple[str, ...]
    object: int | None = None
    of_object: tuple[tuple[str, str], ...] = ()

    def facts(self) -> list[tuple[str, str]]:
        """Names and values for people to read; photos not included."""
        found = [("position", " ".join(f"{value:.2f}" for value in self.position)), ("class", self.label)]
        found += [
            ("confidence", None if self.confidence is None else f"{self.confidence:.2f}"),
            ("state", self.state),
        ]
        if self.object is not None:
            found += [("object", str(self.object) if self.object else "none"), *self.of_object]
        found += [
            ("votes", ", ".join(f"{name} {count:.1f}" for name, count in self.votes.items()) or None),
            ("seen by", f"{len(self.photos)} photos"),
        ]
        return [(name, value) for name, value in found if value is not None]

    def __str__(self) -> str:
        facts = "; ".join(f"{name} {value}".strip() for name, value in self.facts())
        return f"point {self.row}: {facts}{': ' if self.photos else ''}{', '.join(self.photos)}"


class Inspector:
    """Looks points of one cloud up; the search tree and the surface that hides them are made when they are
    first needed.

    views: photos that may have seen the points; surface: `Scene.surface`, surfels of the cloud if there is
        no mesh
    voxel_size: of the labels, which is the tolerance of visibility, world units; None = 2 point spacings
    memory: in which the surface must fit, or nobody is told which photos see a point
    catalog: of the objects that the cloud has
    """

    def __init__(
        self,
        cloud: o3d.t.geometry.PointCloud,
        views: Sequence[View],
        class_table: ClassTable | None,
        surface: Sequence[Path],
        voxel_size: float | None = None,
        memory: Memory = Memory(),
        catalog: Catalog | None = None,
    ) -> None:
        self._memory, self._catalog = memory, catalog
        self.cloud, self.views, self.class_table, self._files = cloud, list(views), class_table, surface
        self._points = cloud.point.positions.cpu().numpy().astype(np.float64)
        self._given_voxel_size = voxel_size

    @classmethod
    def from_scene(
        cls,
        scene: Scene,
        cloud: o3d.t.geometry.PointCloud,
        views: Sequence[View],
        memory: Memory = Memory(),
    ) -> Inspector:
        """Looks points up as `label` saw them: with the voxel size that it wrote down."""
        table, voxel_size = scene.class_table() if scene.classes.exists() else None, None
        with suppress(InputError, KeyError, TypeError, ValueError):
            record: Any = read_json(sidecar(scene.seeds))
            voxel_size = float(record["summary"]["voxel_size"])
        return cls(cloud, views, table, scene.surface, voxel_size, memory, Catalog(scene))

    def nearest(self, position: np.ndarray) -> int:
        """Row of the point nearest to a (3,) world position."""
        _, rows, _ = self._tree.search_knn_vector_3d(np.asarray(position, np.float64) - self._points[0], 1)
        return int(rows[0])

    def look_up(self, row: int) -> PickedPoint:
        """All that is known of a point of the cloud."""
        attributes, table = self.cloud.point, self.class_table
        value = {
            name: attributes[name][row].item()
            for name in ("label", "confidence", "state")
            if name in attributes
        }
        label = (
            None
            if "label" not in value
            else table.name(value["label"])
            if table is not None
            else f"class {value['label']}"
        )
        state = (
            None
            if "state" not in value
            else STATES[value["state"]].name
            if value["state"] < len(STATES)
            else f"state {value['state']}"
        )
        photos = (
            photos_that_see(self._points[row], self._normal(row), self.views, self.surface, self._voxel_size)
            if self.views and self._surface_fits
            else []
        )
        number = int(attributes[INSTANCE][row].item()) if INSTANCE in attributes else None
        known = self._catalog.facts(number) if self._catalog is not None and number else []
        about = label, value.get("confidence"), state, self._votes_of(row), tuple(photos)
        return PickedPoint(row, self._points[row], *about, number, tuple(known))

    def _votes_of(self, row: int) -> dict[str, float]:
        votes = self._votes
        if votes is None:
            return {}
        counts = votes.values[row, : len(votes.channels.ids)]  # without those for none of the classes
        found = zip(counts.tolist(), votes.channels.ids.tolist(), strict=True)
        cast = [(count, label) for count, label in found if label and count > 0]
        named = self.class_table.name if self.class_table is not None else "class {}".format
        return {named(label): count for count, label in sorted(cast, key=lambda entry: (-entry[0], entry[1]))}

    def _normal(self, row: int) -> np.ndarray:
        """(3,) unit normal of a point, estimated if the cloud has none."""
        if "normals" in self.cloud.point:
            normal = self.cloud.point.normals[row].cpu().numpy().astype(np.float64)
            if np.isfinite(normal).all() and normal.any():
                return normal / np.linalg.norm(normal)
        count, rows, _ = self._tree.search_knn_vector_3d(
            self._points[row] - self._points[0], NORMAL_NEIGHBORS
        )
        point = self._points[row][None]
        if count < 3:
            return np.array([0.0, 0.0, 1.0])
        normal = estimate_normals(self._points[np.asarray(rows)], np.arange(count)[None])[:1]
        return orient_normals(point, normal, np.array([view.center for view in self.views]))[0]

    @cached_property
    def _tree(self) -> o3d.geometry.KDTreeFlann:
        return o3d.geometry.KDTreeFlann(np.ascontiguousarray((self._points - self._points[0]).T))

    @cached_property
    def _votes(self) -> Votes | None:
        return read_votes(self.cloud)

    @cached_property
    def _voxel_size(self) -> float:
        return self._given_voxel_size or 2 * spacing_of(self._points)

    @cached_property
    def _surface_fits(self) -> bool:
        found = self.has_room(0)
        if not found:
            logger.warning(
                "which photos see a point is not told: the surface, %.1f GiB, does not fit into memory beside the cloud",
                self._surface_bytes / (1 << 30),
            )
        return found

    @property
    def _surface_bytes(self) -> int:
        return surface_bytes(self._files) or 2 * TRIANGLE * len(self._points)  # two triangles of each surfel

    def has_room(self, num_bytes: int) -> bool:
        """Whether so much fits into memory beside the cloud and the surface."""
        return fits(len(self._points) * SHOWN_BYTES + self._surface_bytes + num_bytes, self._memory)

    @cached_property
    def surface(self) -> RayTarget:
        """What hides points from photos."""
        logger.info("preparing the surface, to find out which photos see a point ...")
        normals = self.cloud.point.normals.cpu().numpy() if "normals" in self.cloud.point else None
        return read_surface(self._files, self._points, normals, local_origin(self.views))


def photos_that_see(
    point: np.ndarray, normal: np.ndarray, views: Sequence[View], surface: RayTarget, voxel_size: float
) -> list[str]:
    """Names of the photos in which a point lies on the first surface, by the rule that fusion uses.

    point, normal: (3,) world, the normal towards the outside; voxel_size: tolerance, world units. One ray is
        cast per photo.
    """
    return [view.name for view in views if _sees(view, point[None], normal[None], surface, voxel_size)]


def _sees(view: View, points: np.ndarray, normals: np.ndarray, surface: RayTarget, voxel_size: float) -> bool:
    pixels, _ = project(view, points)
    if not in_image(view, pixels)[0]:
        return False
    # of the pixel's center, as in a picture of the whole surface
    directions, ray_z = rays(view, np.floor(pixels) + 0.5)
    distance, incidence = surface.cast(view, (directions @ view.cam_from_world[:3, :3].T).astype(np.float32))
    everywhere = (
        np.broadcast_to(values[:1].astype(np.float32), (view.height, view.width))
        for values in (distance, incidence, ray_z)
    )
    return len(see_points(view, points, normals, FirstSurface(*everywhere), voxel_size).points) > 0


def point_on_ray(points: np.ndarray, origin: np.ndarray, direction: np.ndarray, size: float) -> int | None:
    """Row of the point that a click shows: the one nearest to the ray among the first points that it passes.

    points: (N, 3); origin, direction: (3,) in the same frame; size: side of a drawn point, in the units of
        the points
    returns: None if the ray passes no point within `size`
    """
    direction = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    offsets = np.asarray(points, np.float64) - origin
    along = offsets @ direction
    across = np.sqrt(np.maximum(np.einsum("ij,ij->i", offsets, offsets) - along**2, 0))
    passed = np.flatnonzero((along > 0) & (across <= size))
    if not len(passed):
        return None
    first = passed[along[passed] <= along[passed].min() + 2 * size]
    return int(first[np.argmin(across[first])])


def position_at(
    depth: np.ndarray, pixel: tuple[int, int], view_matrix: np.ndarray, projection: np.ndarray
) -> np.ndarray | None:
    """(3,) position of what a pixel of a rendered view shows, in the frame of the view's scene; None for the
    background.

    depth: (H, W), either z (inf = background) or, as Open3D before 0.20 has it, the depth buffer (0 = near
        plane, 1 = far plane and background)
    pixel: column, row; view_matrix, projection: (4, 4) of OpenGL, camera looking along -z
    """
    column, row = pixel
    value = float(depth[row, column])
    right, up = 2 * (column + 0.5) / depth.shape[1] - 1, 1 - 2 * (row + 0.5) / depth.shape[0]
    projection = np.asarray(projection, np.float64)
    if np.isinf(depth).any() or depth.max() > 1:
        if not np.isfinite(value):
            return None
        clip_z, clip_w = projection[2:, 2] * -value + projection[2:, 3]
    elif value >= 1:
        return None
    else:
        clip_z, clip_w = 2 * value - 1, 1.0
    found = np.linalg.inv(projection @ np.asarray(view_matrix, np.float64)) @ [
        right * clip_w,
        up * clip_w,
        clip_z,
        clip_w,
    ]
    return found[:3] / found[3]
