"""The window: the cloud in any of its colourings, the cameras, and a legend. Needs a display."""

from __future__ import annotations

import ctypes
import logging
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from sc3d.classes import ClassTable
from sc3d.errors import InputError, Sc3dError
from sc3d.geometry.cameras import View, local_origin
from sc3d.view.aerial import frusta, frustum_depth
from sc3d.view.colors import COLOURINGS, Colouring, color_points, legend_entries
from sc3d.view.pictures import LINE_COLOR
from sc3d.view.renderers import vulkan_works

if TYPE_CHECKING:
    import open3d as o3d

logger = logging.getLogger(__name__)

_PANEL_EM = 13  # width of the panel, in font heights


def show(cloud: o3d.t.geometry.PointCloud, views: Sequence[View], class_table: ClassTable | None = None, by: Colouring = "label") -> None:
    """Open a window and return when it is closed.

    cloud: with any of the attributes that `color_points` shows; those it has can be chosen in the panel, or with keys 1 to 4 without Vulkan
    views: cameras drawn as pyramids; by: colouring at the start
    Raises Sc3dError without a display, InputError if the attribute for `by` is missing.
    """
    if not has_display():
        raise Sc3dError("no display to open a window on: `sc3d view SCENE --screenshot FILE` renders a picture without one")
    colorings = {by: color_points(cloud, by, class_table)}
    for other in COLOURINGS:
        with suppress(InputError):  # attributes the cloud lacks cannot be chosen
            colorings[other] = color_points(cloud, other, class_table)
    points = cloud.point.positions.cpu().numpy().astype(np.float64)
    origin = local_origin(list(views)) if len(views) else np.round(points.mean(axis=0))
    lines = frusta(views, frustum_depth(views, points)) - origin
    colorings = {name: colorings[name] for name in COLOURINGS if name in colorings}
    opened = _show_with_panel if vulkan_works() else _show_with_keys
    opened((points - origin).astype(np.float32), colorings, lines, by, class_table)


def has_display() -> bool:
    """Whether a window can be opened; on Linux an X server (or XWayland) must answer."""
    if not sys.platform.startswith("linux"):
        return True
    if not os.environ.get("DISPLAY"):
        return False
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return False
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = x11.XOpenDisplay(None)
    if display:
        x11.XCloseDisplay(ctypes.c_void_p(display))
    return bool(display)


def _show_with_panel(points: np.ndarray, colorings: dict[str, np.ndarray], lines: np.ndarray, by: str, class_table: ClassTable | None) -> None:
    import open3d as o3d

    application = o3d.visualization.gui.Application.instance
    application.initialize()
    window = _Window(points, colorings, lines, class_table)
    window.choose(by)
    application.run()


class _Window:
    """A 3D view with a panel at its right: colouring, legend, cameras, point size."""

    def __init__(self, points: np.ndarray, colorings: dict[str, np.ndarray], lines: np.ndarray, class_table: ClassTable | None) -> None:
        import open3d as o3d

        self._gui, self._rendering = o3d.visualization.gui, o3d.visualization.rendering
        self._colorings, self._class_table = colorings, class_table
        self._cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(np.ascontiguousarray(points)))
        self._material = self._rendering.MaterialRecord()
        self._material.shader, self._material.point_size = "defaultUnlit", 3.0
        self._window = self._gui.Application.instance.create_window("sc3d", 1400, 900)
        self._em = self._window.theme.font_size
        self._scene = self._gui.SceneWidget()
        self._scene.scene = self._rendering.Open3DScene(self._window.renderer)
        self._scene.scene.set_background([1.0, 1.0, 1.0, 1.0])
        self._scene.scene.view.set_post_processing(False)  # tone mapping would change class colours
        self._panel = self._build_panel()
        self._window.add_child(self._scene)
        self._window.add_child(self._panel)
        self._window.set_on_layout(self._lay_out)
        self._add_cameras(lines)
        low, high = np.quantile(points[:: max(1, len(points) // 100_000)], [0.002, 0.998], axis=0)
        middle, span = (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
        bounds = o3d.geometry.AxisAlignedBoundingBox(low.astype(np.float64), high.astype(np.float64))
        self._scene.setup_camera(50.0, bounds, middle.astype(np.float32))
        self._scene.look_at(middle, middle + np.array([0.0, -0.75, 0.75]) * span, [0, 0, 1])

    def choose(self, by: str) -> None:
        """Colour the cloud by an attribute and explain its colours."""
        import open3d as o3d

        self._radio.selected_index = list(self._colorings).index(by)
        self._cloud.point.colors = o3d.core.Tensor.from_numpy(self._colorings[by].astype(np.float32) / np.float32(255))
        self._scene.scene.remove_geometry("cloud")
        self._scene.scene.add_geometry("cloud", self._cloud, self._material)
        for name, legend in self._legends.items():
            legend.visible = name == by
        self._window.set_needs_layout()

    def _build_panel(self) -> object:
        gui, half = self._gui, self._em // 2
        panel = gui.Vert(half, gui.Margins(self._em, self._em, self._em, self._em))
        panel.add_child(gui.Label("Colour by"))
        self._radio = gui.RadioButton(gui.RadioButton.VERT)
        self._radio.set_items(list(self._colorings))
        self._radio.set_on_selection_changed(lambda index: self.choose(list(self._colorings)[index]))
        panel.add_child(self._radio)
        self._legends = {name: self._build_legend(name) for name in self._colorings}
        for legend in self._legends.values():
            panel.add_child(legend)
        cameras = gui.Checkbox("Cameras")
        cameras.checked = True
        cameras.set_on_checked(lambda shown: self._scene.scene.show_geometry("cameras", shown))
        panel.add_child(cameras)
        panel.add_child(gui.Label("Point size"))
        slider = gui.Slider(gui.Slider.INT)
        slider.set_limits(1, 12)
        slider.int_value = int(self._material.point_size)
        slider.set_on_value_changed(self._resize_points)
        panel.add_child(slider)
        return panel

    def _build_legend(self, by: str) -> object:
        import open3d as o3d

        gui = self._gui
        legend = gui.Vert(self._em // 4, gui.Margins(0, self._em // 2, 0, self._em // 2))
        entries = legend_entries(by, self._class_table)
        if by == "confidence":
            entries = [("1 (bright)", (253, 231, 36)), ("0 (dark)", (110, 60, 140))]
        for name, color in entries:
            row = gui.Horiz(self._em // 2)
            row.add_child(gui.ImageWidget(o3d.geometry.Image(np.tile(np.uint8(color), (self._em, self._em, 1)))))
            row.add_child(gui.Label(name))
            legend.add_child(row)
        return legend

    def _add_cameras(self, lines: np.ndarray) -> None:
        import open3d as o3d

        ends = lines.reshape(-1, 3)
        if not len(ends):
            return
        line_set = o3d.geometry.LineSet(o3d.utility.Vector3dVector(ends), o3d.utility.Vector2iVector(np.arange(len(ends)).reshape(-1, 2)))
        line_set.paint_uniform_color(np.array(LINE_COLOR) / 255)
        material = self._rendering.MaterialRecord()
        material.shader, material.line_width = "unlitLine", 2.0
        self._scene.scene.add_geometry("cameras", line_set, material)

    def _resize_points(self, size: float) -> None:
        self._material.point_size = float(size)
        self._scene.scene.modify_geometry_material("cloud", self._material)

    def _lay_out(self, _context: object) -> None:
        area, width = self._window.content_rect, _PANEL_EM * self._em
        self._scene.frame = self._gui.Rect(area.x, area.y, area.width - width, area.height)
        self._panel.frame = self._gui.Rect(area.get_right() - width, area.y, width, area.height)


def _show_with_keys(points: np.ndarray, colorings: dict[str, np.ndarray], lines: np.ndarray, by: str, class_table: ClassTable | None) -> None:
    """The OpenGL window, where Vulkan is missing: keys 1 to 4 choose the colouring, the legend goes to the log."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    visualizer = o3d.visualization.VisualizerWithKeyCallback()
    if not visualizer.create_window("sc3d", 1400, 900):
        raise Sc3dError("cannot open a window here: `sc3d view SCENE --screenshot FILE` renders a picture without one")

    def choose(name: str) -> bool:
        cloud.colors = o3d.utility.Vector3dVector(colorings[name] / 255.0)
        visualizer.update_geometry(cloud)
        return False

    choose(by)
    visualizer.add_geometry(cloud)
    if len(lines):
        ends = lines.reshape(-1, 3)
        line_set = o3d.geometry.LineSet(o3d.utility.Vector3dVector(ends), o3d.utility.Vector2iVector(np.arange(len(ends)).reshape(-1, 2)))
        line_set.paint_uniform_color(np.array(LINE_COLOR) / 255)
        visualizer.add_geometry(line_set)
    for number, name in enumerate(colorings, start=1):
        visualizer.register_key_callback(ord(str(number)), lambda _, name=name: choose(name))
        legend = ", ".join(f"{entry} rgb{tuple(color)}" for entry, color in legend_entries(name, class_table))
        logger.info("key %d: %s%s", number, name, f" ({legend})" if legend else "")
    visualizer.run()
    visualizer.destroy_window()
