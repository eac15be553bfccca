"""The OpenGL window, where Vulkan is missing: keys instead of a panel."""

from __future__ import annotations

import logging

import numpy as np
import open3d as o3d

from sc3d.errors import Sc3dError
from sc3d.view.colors import Coloring, legend_entries
from sc3d.view.display_cloud import ShownCloud
from sc3d.view.picking import Inspector, point_on_ray
from sc3d.view.screenshot import LINE_COLOR

logger = logging.getLogger(__name__)

_F1 = 290  # GLFW's key codes
_MAX_CLASS_KEYS = 12


def show_with_keys(
    shown: ShownCloud, lines: np.ndarray, inspector: Inspector, hidden: set[int], by: Coloring
) -> None:
    """Keys 1 to 5 choose the coloring, F1 to F12 show and hide classes, P describes the point in the middle;
    the log is the legend.

    lines: (L, 2, 3) ends of the cameras' lines, in the frame of `shown`; hidden: ids of classes that are not
        shown at the start
    Raises Sc3dError if no window can be opened.
    """
    visualizer = o3d.visualization.VisualizerWithKeyCallback()
    if not visualizer.create_window("sc3d", 1400, 900):
        raise Sc3dError(
            "cannot open a window here: `sc3d view SCENE --screenshot FILE` renders a picture without one"
        )
    window = _KeyWindow(visualizer, shown, inspector, hidden, by)
    if len(lines):
        ends = lines.reshape(-1, 3)
        line_set = o3d.geometry.LineSet(
            o3d.utility.Vector3dVector(ends), o3d.utility.Vector2iVector(np.arange(len(ends)).reshape(-1, 2))
        )
        line_set.paint_uniform_color(np.array(LINE_COLOR) / 255)
        visualizer.add_geometry(line_set)
    for number, name in enumerate(shown.colorings, start=1):
        visualizer.register_key_callback(ord(str(number)), lambda _, name=name: window.choose(name))
        legend = ", ".join(
            f"{entry} rgb{tuple(color)}" for entry, color in legend_entries(name, shown.class_table)
        )
        logger.info("key %d: %s%s", number, name, f" ({legend})" if legend else "")
    if shown.class_table is not None and len(shown.class_counts) > 1:
        for number, label in enumerate(list(shown.class_counts)[:_MAX_CLASS_KEYS]):
            visualizer.register_key_callback(_F1 + number, lambda _, label=label: window.toggle(label))
            logger.info("key F%d: %s on and off", number + 1, shown.class_table.name(label))
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
        shown: ShownCloud,
        inspector: Inspector,
        hidden: set[int],
        by: str,
    ) -> None:
        self._visualizer, self._shown, self._inspector, self._hidden, self._by = (
            visualizer,
            shown,
            inspector,
            hidden,
            by,
        )
        self._cloud = o3d.geometry.PointCloud()
        self._fill()
        visualizer.add_geometry(self._cloud)

    def choose(self, by: str) -> bool:
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
        size = 2 * self._shown.spacing
        found = point_on_ray(self._shown.points[rows], world_from_cam[:3, 3], world_from_cam[:3, 2], size)
        if found is None:
            logger.info("there is no point in the middle of the window")
        else:
            logger.info("%s", self._inspector.look_up(int(self._shown.rows[rows[found]])))
        return False

    def forget(self) -> None:
        """Let go of the cloud: the keys keep this object alive, and Open3D takes tensors that outlive the
        program for leaks and fails.
        """
        del self._shown, self._inspector, self._cloud

    @property
    def _visible(self) -> np.ndarray:
        return ~np.isin(self._shown.label, sorted(self._hidden))

    def _update(self) -> bool:
        self._fill()
        self._visualizer.update_geometry(self._cloud)
        return False

    def _fill(self) -> None:
        visible = self._visible
        self._cloud.points = o3d.utility.Vector3dVector(self._shown.points[visible].astype(np.float64))
        self._cloud.colors = o3d.utility.Vector3dVector(self._shown.colors(self._by)[visible] / 255.0)
