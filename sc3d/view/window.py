"""The window: the cloud in any of its colorings, classes on and off, the cameras, and what is known of a
clicked point. Needs a display.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import open3d as o3d

from sc3d.errors import Sc3dError
from sc3d.geometry.cameras import View, local_origin
from sc3d.view.colors import Coloring, color_points, color_scale, legend_entries
from sc3d.view.display_cloud import DisplayCloud
from sc3d.view.picking import Inspector, PickedPoint, point_on_ray, position_at
from sc3d.view.renderers import check_display, line_set, vulkan_works
from sc3d.view.screenshot import LINE_COLOR
from sc3d.view.viewpoints import frusta, frustum_depth

logger = logging.getLogger(__name__)

_PANEL_EM = 15  # width of the panel, in font heights
_PICKED_COLOR = (1.0, 0.0, 0.8)
_F1 = 290  # GLFW's key codes
_MAX_CLASS_KEYS = 12


def show(
    inspector: Inspector, views: Sequence[View] = (), by: Coloring = "label", classes: set[int] | None = None
) -> None:
    """Open a window and return when it is closed. A point clicked with Ctrl held is described in the panel
    and in the log.

    inspector: has the cloud, with any of the attributes that `color_points` shows; those it has can be chosen
    views: cameras drawn as pyramids; by: coloring at the start; classes: ids shown at the start, None = all
    Raises Sc3dError without a display, InputError if the attribute for `by` is missing.
    """
    check_display()
    color_points(inspector.cloud, by, inspector.class_table)
    points = inspector.cloud.point.positions.cpu().numpy().astype(np.float64)
    origin = local_origin(list(views)) if len(views) else np.round(points.mean(axis=0))
    lines = frusta(views, frustum_depth(views, points)) - origin
    display = DisplayCloud.from_cloud(inspector.cloud, origin, inspector.class_table)
    hidden = set() if classes is None else set(display.class_counts) - classes
    if vulkan_works():
        _show_with_panel(display, lines, inspector, hidden, by)
    else:
        _show_with_keys(display, lines, inspector, hidden, by)


def _show_with_panel(
    display: DisplayCloud, lines: np.ndarray, inspector: Inspector, hidden: set[int], by: Coloring
) -> None:
    application = o3d.visualization.gui.Application.instance
    application.initialize()
    window = _PanelWindow(display, lines, inspector, hidden)
    window.choose(by)
    application.run()
    window.forget()


class _PanelWindow:
    """A 3D view with a panel at its right: coloring, legend, classes, cameras, point size, the picked point.
    One geometry per class.
    """

    def __init__(
        self, display: DisplayCloud, lines: np.ndarray, inspector: Inspector, hidden: set[int]
    ) -> None:
        self._gui, self._rendering = o3d.visualization.gui, o3d.visualization.rendering
        self._display, self._inspector, self._hidden = display, inspector, hidden
        self._material = self._rendering.MaterialRecord()
        self._material.shader, self._material.point_size = "defaultUnlit", 3.0
        self._window = self._gui.Application.instance.create_window("sc3d", 1400, 900)
        self._em = self._window.theme.font_size
        self._scene = self._gui.SceneWidget()
        self._scene.scene = self._rendering.Open3DScene(self._window.renderer)
        self._scene.scene.set_background([1.0, 1.0, 1.0, 1.0])
        self._scene.scene.view.set_post_processing(False)  # tone mapping would change class colors
        self._scene.set_on_mouse(self._on_mouse)
        self._panel = self._build_panel()
        self._window.add_child(self._scene)
        self._window.add_child(self._panel)
        self._window.set_on_layout(self._lay_out)
        self._num_redraws = 0
        self._window.set_on_tick_event(self._on_tick)
        self._add_cameras(lines)
        self._look()

    def choose(self, by: Coloring) -> None:
        """Color the cloud by an attribute and explain its colors."""
        self._radio.selected_index = self._display.colorings.index(by)
        colors = self._display.colors(by).astype(np.float32) / np.float32(255)
        for label in self._display.class_counts:
            chosen = self._display.label == label
            cloud = o3d.t.geometry.PointCloud(
                o3d.core.Tensor.from_numpy(np.ascontiguousarray(self._display.points[chosen]))
            )
            cloud.point.colors = o3d.core.Tensor.from_numpy(np.ascontiguousarray(colors[chosen]))
            self._scene.scene.remove_geometry(f"class {label}")
            self._scene.scene.add_geometry(f"class {label}", cloud, self._material)
            self._scene.scene.show_geometry(f"class {label}", label not in self._hidden)
        for name, legend in self._legends.items():
            legend.visible = name == by
        self._redraw()

    def forget(self) -> None:
        """Let go of the cloud: the panel keeps this object alive, and Open3D takes tensors that outlive the
        program for leaks and fails.
        """
        del self._display, self._inspector

    def _look(self) -> None:
        """From the south, 45 degrees down."""
        low, high = np.quantile(self._display.points[:100_000], [0.002, 0.998], axis=0)
        middle, span = (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
        bounds = o3d.geometry.AxisAlignedBoundingBox(low.astype(np.float64), high.astype(np.float64))
        self._scene.setup_camera(50.0, bounds, middle.astype(np.float32))
        self._scene.look_at(middle, middle + np.array([0.0, -0.75, 0.75]) * span, [0, 0, 1])

    def _build_panel(self) -> Any:
        gui, half = self._gui, self._em // 2
        panel = gui.ScrollableVert(half, gui.Margins(self._em, self._em, self._em, self._em))
        panel.add_child(gui.Label("Color by"))
        self._radio = gui.RadioButton(gui.RadioButton.VERT)
        self._radio.set_items(list(self._display.colorings))
        self._radio.set_on_selection_changed(lambda index: self.choose(self._display.colorings[index]))
        panel.add_child(self._radio)
        self._legends = {name: self._build_legend(name) for name in self._display.colorings}
        for legend in self._legends.values():
            panel.add_child(legend)
        self._add_class_boxes(panel)
        self._add_box(
            panel, "cameras", True, lambda visible: self._scene.scene.show_geometry("cameras", visible)
        )
        panel.add_child(gui.Label("Point size"))
        slider = gui.Slider(gui.Slider.INT)
        slider.set_limits(1, 12)
        slider.int_value = int(self._material.point_size)
        slider.set_on_value_changed(self._resize_points)
        panel.add_child(slider)
        self._description = gui.Label("Ctrl + click: what is known of a point")
        panel.add_child(self._description)
        return panel

    def _build_legend(self, by: Coloring) -> Any:
        gui, scale = self._gui, color_scale(by)
        legend = gui.Vert(self._em // 4, gui.Margins(0, self._em // 2, 0, self._em // 2))
        entries: list[tuple[str, Any]] = [*legend_entries(by, self._display.class_table)]
        if scale is not None:
            entries = [(scale.high, scale.colors[-1]), (scale.low, scale.colors[0])]
        for name, color in entries:
            row = gui.Horiz(self._em // 2)
            row.add_child(
                gui.ImageWidget(
                    o3d.geometry.Image(np.tile(np.array(color, np.uint8), (self._em, self._em, 1)))
                )
            )
            row.add_child(gui.Label(name))
            legend.add_child(row)
        return legend

    def _add_class_boxes(self, panel: Any) -> None:
        if self._display.class_table is None or "label" not in self._display.cloud.point:
            return
        panel.add_child(self._gui.Label("Classes"))
        for label, count in self._display.class_counts.items():
            name = f"{self._display.class_table.name(label)} ({count:,})"
            self._add_box(
                panel,
                name,
                label not in self._hidden,
                partial(self._show_class, label),
            )

    def _add_box(self, panel: Any, name: str, checked: bool, changed: Callable[[bool], None]) -> None:
        box = self._gui.Checkbox(name)
        box.checked = checked
        box.set_on_checked(changed)
        panel.add_child(box)

    def _show_class(self, label: int, visible: bool) -> None:
        (self._hidden.discard if visible else self._hidden.add)(label)
        self._scene.scene.show_geometry(f"class {label}", visible)
        self._scene.force_redraw()

    def _add_cameras(self, lines: np.ndarray) -> None:
        if not len(lines):
            return
        material = self._rendering.MaterialRecord()
        material.shader, material.line_width = "unlitLine", 2.0
        self._scene.scene.add_geometry("cameras", line_set(lines, LINE_COLOR), material)

    def _resize_points(self, size: float) -> None:
        self._material.point_size = float(size)
        for label in self._display.class_counts:
            self._scene.scene.modify_geometry_material(f"class {label}", self._material)

    def _on_mouse(self, event: Any) -> Any:
        gui = self._gui
        if event.type != gui.MouseEvent.Type.BUTTON_DOWN or not event.is_modifier_down(gui.KeyModifier.CTRL):
            return gui.Widget.EventCallbackResult.IGNORED
        column, row = event.x - self._scene.frame.x, event.y - self._scene.frame.y
        # the renderer's thread must not touch the panel, nor keep its picture
        post = self._gui.Application.instance.post_to_main_thread
        pick = self._scene.scene.scene.render_to_depth_image
        pick(lambda depth: post(self._window, partial(self._pick, np.array(depth), column, row)))
        return gui.Widget.EventCallbackResult.HANDLED

    def _pick(self, depth: np.ndarray, column: int, row: int) -> None:
        """Describe the point at a pixel of the 3D view. depth: (H, W)"""
        if not (0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]):
            return
        camera = self._scene.scene.camera
        position = position_at(depth, (column, row), camera.get_view_matrix(), camera.get_projection_matrix())
        if position is not None:
            picked = self._inspector.look_up(self._inspector.nearest(position + self._display.origin))
            logger.info("%s", picked)
            self._describe(picked)

    def _describe(self, picked: PickedPoint) -> None:
        self._description.text = "\n".join(
            [f"{name}: {value}" for name, value in picked.facts()] + [f"  {name}" for name in picked.photos]
        )
        mark = o3d.t.geometry.PointCloud(
            o3d.core.Tensor((picked.position - self._display.origin).astype(np.float32)[None])
        )
        material = self._rendering.MaterialRecord()
        material.shader, material.point_size, material.base_color = (
            "defaultUnlit",
            14.0,
            [*_PICKED_COLOR, 1.0],
        )
        self._scene.scene.remove_geometry("picked")
        self._scene.scene.add_geometry("picked", mark, material)
        self._redraw()

    def _redraw(self) -> None:
        """Lay the panel out and draw it again; twice, as it settles one picture late."""
        self._window.set_needs_layout()
        self._num_redraws = 3

    def _on_tick(self) -> bool:
        self._num_redraws -= self._num_redraws > 0
        return self._num_redraws > 0

    def _lay_out(self, _context: object) -> None:
        area, width = self._window.content_rect, _PANEL_EM * self._em
        self._scene.frame = self._gui.Rect(area.x, area.y, area.width - width, area.height)
        self._panel.frame = self._gui.Rect(area.get_right() - width, area.y, width, area.height)


def _show_with_keys(
    display: DisplayCloud, lines: np.ndarray, inspector: Inspector, hidden: set[int], by: Coloring
) -> None:
    """Keys 1 to 5 choose the coloring, F1 to F12 show and hide classes, P describes the point in the middle;
    the log is the legend.

    lines: (L, 2, 3) ends of the cameras' lines, in the frame of `display`; hidden: ids of classes not shown
        at the start
    Raises Sc3dError if no window can be opened.
    """
    visualizer = o3d.visualization.VisualizerWithKeyCallback()
    if not visualizer.create_window("sc3d", 1400, 900):
        raise Sc3dError(
            "cannot open a window here: `sc3d view SCENE --screenshot FILE` renders a picture without one"
        )
    window = _KeyWindow(visualizer, display, inspector, hidden, by)
    if len(lines):
        visualizer.add_geometry(line_set(lines, LINE_COLOR))
    for number, name in enumerate(display.colorings, start=1):
        visualizer.register_key_callback(ord(str(number)), lambda _, name=name: window.choose(name))
        legend = ", ".join(
            f"{entry} rgb{tuple(color)}" for entry, color in legend_entries(name, display.class_table)
        )
        logger.info("key %d: %s%s", number, name, f" ({legend})" if legend else "")
    if display.class_table is not None and len(display.class_counts) > 1:
        for number, label in enumerate(list(display.class_counts)[:_MAX_CLASS_KEYS]):
            visualizer.register_key_callback(_F1 + number, lambda _, label=label: window.toggle(label))
            logger.info("key F%d: %s on and off", number + 1, display.class_table.name(label))
    visualizer.register_key_callback(ord("P"), lambda _: window.describe_middle())
    logger.info("key P: what is known of the point in the middle of the window")
    visualizer.run()
    visualizer.destroy_window()
    window.forget()


class _KeyWindow:
    """What the keys do."""

    def __init__(
        self,
        visualizer: o3d.visualization.VisualizerWithKeyCallback,
        display: DisplayCloud,
        inspector: Inspector,
        hidden: set[int],
        by: Coloring,
    ) -> None:
        self._visualizer, self._display, self._inspector = visualizer, display, inspector
        self._hidden, self._by = hidden, by
        self._cloud = o3d.geometry.PointCloud()
        self._fill()
        visualizer.add_geometry(self._cloud)

    def choose(self, by: Coloring) -> bool:
        """Color by an attribute."""
        self._by = by
        return self._update()

    def toggle(self, label: int) -> bool:
        """Show or hide a class."""
        self._hidden ^= {label}
        return self._update()

    def describe_middle(self) -> bool:
        """Log what is known of the point in the middle of the window."""
        camera = self._visualizer.get_view_control().convert_to_pinhole_camera_parameters()
        world_from_cam = np.linalg.inv(camera.extrinsic)
        rows = np.flatnonzero(self._visible)
        size = 2 * self._display.spacing
        found = point_on_ray(self._display.points[rows], world_from_cam[:3, 3], world_from_cam[:3, 2], size)
        if found is None:
            logger.info("there is no point in the middle of the window")
        else:
            logger.info("%s", self._inspector.look_up(int(self._display.rows[rows[found]])))
        return False

    def forget(self) -> None:
        """Let go of the cloud: the keys keep this object alive, and Open3D takes tensors that outlive the
        program for leaks and fails.
        """
        del self._display, self._inspector, self._cloud

    @property
    def _visible(self) -> np.ndarray:
        return ~np.isin(self._display.label, sorted(self._hidden))

    def _update(self) -> bool:
        self._fill()
        self._visualizer.update_geometry(self._cloud)
        return False

    def _fill(self) -> None:
        visible = self._visible
        self._cloud.points = o3d.utility.Vector3dVector(self._display.points[visible].astype(np.float64))
        self._cloud.colors = o3d.utility.Vector3dVector(self._display.colors(self._by)[visible] / 255.0)
