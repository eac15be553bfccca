"""What the browser draws: the cloud in a node per class and step of detail, the splats in a node per class,
and the cameras.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from sc3d.geometry.cameras import View, undistorted
from sc3d.scene.class_table import ClassTable
from sc3d.scene.photo_names import PhotoNames
from sc3d.view.colors import Coloring
from sc3d.view.display_cloud import DisplayCloud
from sc3d.view.display_splats import SPLAT_COLORINGS, DisplaySplats
from sc3d.view.screenshot import LINE_COLOR
from sc3d.view.web.orbit_camera import field_of_view, orientation

if TYPE_CHECKING:
    import viser

_COVER = 0.9  # half side of a drawn point, in point spacings: neighbors overlap a little
SLASH = "\N{DIVISION SLASH}"  # in a name of the viewer's, where a slash would make a folder
_LINE_WIDTH = 2.0  # px
_SPLAT_UNIT, _LARGEST_HALF = 4.0, 6e4  # of the median splat; covariance that a 16-bit float can hold
_SEEING_COLOR = (0, 158, 115)  # of cameras that see the picked point


class CloudLayer:
    """The first points of a cloud, in chunks: what is added, hidden or recolored is sent once, and the rest
    stays in the browser.

    root: name of its node in the scene tree; node /ROOT/CLASS holds the chunks of a class
    """

    def __init__(
        self,
        server: viser.ViserServer,
        display: DisplayCloud,
        root: str,
        by: Coloring,
        hidden: Collection[int] = (),
    ) -> None:
        self._scene, self._display, self._by, self._relief, self._scale = server.scene, display, by, True, 1.0
        self._root = server.scene.add_frame(f"/{root}", show_axes=False)
        self._classes: dict[int, viser.FrameHandle] = {}
        self._add_classes(hidden)
        self._chunks: list[list[tuple[np.ndarray, viser.PointCloudHandle]]] = []
        self._lock = threading.RLock()  # sliders call from several threads

    @property
    def count(self) -> int:
        """Number of points that are there, hidden ones included."""
        return min(len(self._chunks) * self._display.chunk, len(self._display.points))

    def show_points(self, count: int) -> None:
        """Show about the first `count` points: whole chunks, at least one."""
        wanted = max(
            1, min(round(count / self._display.chunk), -(-len(self._display.points) // self._display.chunk))
        )
        with self._lock:
            for handles in self._chunks[wanted:]:
                for _, handle in handles:
                    handle.remove()
            del self._chunks[wanted:]
            while len(self._chunks) < wanted:
                self._chunks.append(self._add_chunk(len(self._chunks)))
            self.resize(self._scale)

    def relabel(self, hidden: Collection[int]) -> None:
        """Show the same number of points with the labels that the cloud has now; hidden: classes."""
        with self._lock:
            count = self.count
            for _, handle in self._handles():
                handle.remove()
            self._chunks.clear()
            self._add_classes(hidden)
            self.show_points(count)

    def color_by(self, by: Coloring, relief: bool = True) -> None:
        """Show another attribute. relief: shaded, where the cloud has normals"""
        with self._lock:
            self._by, self._relief, colors = by, relief, self._display.colors(by, relief)
            for rows, handle in self._handles():
                handle.colors = colors[rows]

    def resize(self, scale: float) -> None:
        """Draw the points `scale` times as large as closes the gaps between them."""
        with self._lock:
            self._scale = scale
            for _, handle in self._handles():
                handle.point_size = self._point_size()

    def show_class(self, label: int, visible: bool) -> None:
        """Show or hide a class."""
        if label in self._classes:
            self._classes[label].visible = visible

    def show(self, visible: bool) -> None:
        """Show or hide all of it."""
        self._root.visible = visible

    def _add_classes(self, hidden: Collection[int]) -> None:
        """Nodes of the classes that occur and have none yet."""
        for label in self._display.class_counts:
            if label not in self._classes:
                name = f"{self._root.name}/{node_name(self._display.class_table, label)}"
                self._classes[label] = self._scene.add_frame(
                    name, show_axes=False, visible=label not in hidden
                )

    def _handles(self) -> list[tuple[np.ndarray, viser.PointCloudHandle]]:
        return [entry for handles in self._chunks for entry in handles]

    def _point_size(self) -> float:
        return self._scale * _COVER * self._display.spacing_at(self.count)

    def _add_chunk(self, number: int) -> list[tuple[np.ndarray, viser.PointCloudHandle]]:
        start, colors = number * self._display.chunk, self._display.colors(self._by, self._relief)
        labels = self._display.label[start : start + self._display.chunk]
        handles = []
        for label, node in self._classes.items():
            rows = start + np.flatnonzero(labels == label)
            if len(rows):
                handle = self._scene.add_point_cloud(
                    f"{node.name}/{number:02d}",
                    self._display.points[rows],
                    colors[rows],
                    point_size=self._point_size(),
                    precision="float32",
                    point_shading="flat",
                )
                handles.append((rows, handle))
        return handles


class MarkLayer:
    """Points that are drawn once more, larger and in colors of their own; none at the start."""

    def __init__(self, server: viser.ViserServer, name: str, cover: float) -> None:
        """name: of its node in the scene tree; cover: side of a point, in point spacings"""
        self._scene, self._name, self._cover = server.scene, f"/{name}", cover
        self._handle: viser.PointCloudHandle | None = None

    def show(self, points: np.ndarray, colors: np.ndarray, spacing: float) -> None:
        """Mark these points and no others. points: (K, 3) float32; colors: (K, 3) uint8; spacing: of those
        shown
        """
        if self._handle is not None:
            self._handle.remove()
        self._handle = None
        if len(points):
            self._handle = self._scene.add_point_cloud(
                self._name,
                points,
                colors,
                point_size=self._cover * spacing,
                precision="float32",
                point_shading="flat",
            )


class SplatLayer:
    """The Gaussians, a node per class, or one node if they have no labels; loaded when they are first shown."""

    def __init__(
        self,
        server: viser.ViserServer,
        load: Callable[[], DisplaySplats],
        display: DisplayCloud,
        by: Coloring,
        hidden: Collection[int] = (),
    ) -> None:
        """load: reads them; display: has the frame of the viewer and the class table"""
        self._server, self._load, self._display, self._by, self._hidden = (
            server,
            load,
            display,
            by,
            set(hidden),
        )
        self._root: viser.FrameHandle | None = None
        self._splats: DisplaySplats | None = None
        self._nodes: dict[int, tuple[np.ndarray, viser.GaussianSplatHandle]] = {}
        self._lock = threading.RLock()

    def color_by(self, by: Coloring) -> None:
        """Class colors or confidences where there are labels; else the photos'."""
        with self._lock:
            self._by = by
            if self._splats is not None:
                colors = self._colors(self._splats)
                for rows, handle in self._nodes.values():
                    handle.rgbs = colors[rows]

    def show_class(self, label: int, visible: bool) -> None:
        """Show or hide a class; splats without labels stay."""
        with self._lock:
            (self._hidden.discard if visible else self._hidden.add)(label)
            if label in self._nodes and self._splats is not None and self._splats.label is not None:
                self._nodes[label][1].visible = visible

    def show(self, visible: bool) -> None:
        """Show or hide all of them."""
        with self._lock:
            if visible and self._splats is None:
                self._add()
            if self._root is not None:
                self._root.visible = visible

    def _add(self) -> None:
        splats = self._splats = self._load()
        scene, gaussians, colors = self._server.scene, splats.gaussians, self._colors(splats)
        self._root = scene.add_frame("/splats", show_axes=False)
        means, opacities = (
            gaussians.means.numpy() + (splats.origin - self._display.origin),
            gaussians.opacities.numpy()[:, None],
        )
        covariances, unit = half_precision(gaussians.covariances.numpy())
        label = np.zeros(len(means), np.uint8) if splats.label is None else splats.label
        for present in np.unique(label).tolist():
            rows = np.flatnonzero(label == present)
            name = "all" if splats.label is None else node_name(self._display.class_table, present)
            handle = scene.add_gaussian_splats(
                f"/splats/{name}",
                (means[rows] / unit).astype(np.float32),
                covariances[rows],
                colors[rows],
                opacities[rows],
                scale=unit,
                visible=splats.label is None or present not in self._hidden,
            )
            self._nodes[present] = rows, handle

    def _colors(self, splats: DisplaySplats) -> np.ndarray:
        labelled = splats.label is not None and self._by in SPLAT_COLORINGS
        return splats.colors(self._by if labelled else "photo")


class CameraLayer:
    """The photos' cameras as pyramids, in the frame of the viewer."""

    def __init__(self, server: viser.ViserServer, views: Sequence[View], depth: float) -> None:
        """depth: length of the pyramids, world units"""
        self._root = server.scene.add_frame("/cameras", show_axes=False)
        self._handles = {}
        names = PhotoNames(view.name for view in views)
        for view in views:
            pinhole = undistorted(view)
            fov, aspect = field_of_view(pinhole)
            handle = server.scene.add_camera_frustum(
                f"/cameras/{names.key(view.name).replace('/', SLASH)}",
                fov,
                aspect,
                thickness=_LINE_WIDTH,
                thickness_units="screen",
                color=LINE_COLOR,
                wxyz=orientation(view),
                position=view.center,
                variant="filled",
            )
            handle.scale = depth / handle.compute_canonical_frustum_size()[2]
            self._handles[view.name] = handle

    def on_click(self, chosen: Callable[[str, viser.ClientHandle], None]) -> None:
        """Call `chosen` with the name of the photo whose camera is clicked, and the browser."""
        for name, handle in self._handles.items():
            handle.on_click(partial(_click, chosen, name))

    def set_images(self, images: dict[str, np.ndarray]) -> None:
        """Photos in the pyramids of these cameras, and of no others: (h, w, 3) uint8 RGB by name."""
        for name, handle in self._handles.items():
            if name in images or handle.image is not None:
                handle.image = images.get(name)

    def hide(self, hidden: Collection[str]) -> None:
        """Hide these cameras, which would stand before the eyes, and show all others."""
        for name, handle in self._handles.items():
            handle.visible = name not in hidden

    def mark(self, names: Sequence[str]) -> None:
        """Another color for these cameras, and for no others."""
        for name, handle in self._handles.items():
            handle.color = _SEEING_COLOR if name in names else LINE_COLOR

    def show(self, visible: bool) -> None:
        """Show or hide all of them."""
        self._root.visible = visible


def _click(
    chosen: Callable[[str, viser.ClientHandle], None], name: str, event: viser.SceneNodePointerEvent
) -> None:
    chosen(name, event.client)


def node_name(table: ClassTable | None, label: int) -> str:
    """Name of a class as part of a path in the scene tree, where a slash would mean a child."""
    return table.name(label).replace("/", SLASH) if table is not None else "points"


def half_precision(covariances: np.ndarray) -> tuple[np.ndarray, float]:
    """Covariances in a unit in which they fit into the 16-bit floats that browsers get; splats beyond that
    are drawn smaller.

    covariances: (N, 3, 3), world units squared
    returns: (N, 3, 3) float32 in units squared; the unit, in world units: a few times the size of the median
        splat
    """
    squared = np.trace(covariances, axis1=1, axis2=2).astype(np.float64)
    unit = _SPLAT_UNIT * float(np.sqrt(np.median(squared))) if len(squared) else 1.0
    unit = unit or 1.0
    shrink = np.minimum(1.0, _LARGEST_HALF / np.maximum(squared / unit**2, 1e-30))
    return (covariances / unit**2 * shrink[:, None, None]).astype(np.float32), unit
