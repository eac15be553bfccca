"""Open3D's two renderers behind one function: Filament on Vulkan, and the OpenGL visualizer through EGL.
Neither needs a display.

Known failures, and what is done about them (Open3D 0.20):
- no Vulkan driver: the process aborts instead of raising, and after a failed start the OpenGL visualizer
    fails too: so another process tries first;
- with Mesa 25.0 (Debian 13), Vulkan draws all points and triangles in the color of the first one: so that
    process looks at the colors;
- two living OffscreenRenderers abort: each dies in the function that made it;
- the OpenGL visualizer ignores the principal point and fx != fy: it draws a larger centered picture, from
    which the view is cut.
"""

from __future__ import annotations

import ctypes
import functools
import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import Sc3dError
from sc3d.geometry.cameras import View, pinhole_view
from sc3d.io.messages import messages_to
from sc3d.io.python_process import run_python

if TYPE_CHECKING:
    import open3d as o3d

logger = logging.getLogger(__name__)

_NO_RENDERER = "cannot render pictures here: `apt install libvulkan1 mesa-vulkan-drivers` (or libegl1 libgl1-mesa-dri) provides a software renderer"
VULKAN_PROBE = (
    "from sc3d.view.renderers import probe_vulkan; probe_vulkan()"  # says `work`, or ends with an error
)

_LINE_WIDTH = 3.0  # px
_WRONG_COLORS = 3  # status of the process that tries Vulkan


@dataclass(frozen=True)
class Renderable:
    """What is drawn, in a frame near the origin, so that float32 suffices.

    points: (N, 3) float32; colors: (N, 3) uint8 RGB; point_size: px
    triangles: (F, 3) int, rows of `points`; None = a cloud
    lines: (L, 2, 3) float32 ends of lines; line_color: RGB uint8
    """

    points: np.ndarray
    colors: np.ndarray
    point_size: float = 1.0
    triangles: np.ndarray | None = None
    lines: np.ndarray | None = None
    line_color: tuple[int, int, int] = (240, 160, 20)


def render(
    renderable: Renderable, view: View, background: tuple[int, int, int], renderer: str = "auto"
) -> np.ndarray:
    """Draw through a pinhole view.

    view: without distortion, in the frame of `renderable`; renderer: "auto", "vulkan" or "egl"
    returns: (H, W, 3) uint8 RGB, colors exactly as given: no light, no antialiasing
    Raises Sc3dError that names the packages to install.
    """
    if renderer == "auto":
        renderer = "vulkan" if vulkan_works() else "egl"
    with _quiet():
        return (_render_vulkan if renderer == "vulkan" else _render_egl)(renderable, view, background)


@functools.cache
def vulkan_works() -> bool:
    """Whether OffscreenRenderer works here and draws the right colors, tried in another process because it may
    abort.
    """
    try:
        probe = run_python(VULKAN_PROBE, timeout=120)
    except (OSError, subprocess.TimeoutExpired):
        return False
    if probe.returncode == _WRONG_COLORS:
        logger.info("Open3D's Vulkan renderer draws wrong colors here, OpenGL is used")
    elif probe.returncode:
        logger.info(
            "Open3D's Vulkan renderer does not work here (`apt install libvulkan1 mesa-vulkan-drivers`), OpenGL is used"
        )
    return probe.returncode == 0


def probe_vulkan() -> None:
    """Say `work`, or end with a status other than 0 if Vulkan draws other colors than asked for."""
    if draws_colors(_render_vulkan):
        sys.stdout.write("work\n")
    else:
        sys.stderr.write("wrong colors, so OpenGL draws\n")
        sys.exit(_WRONG_COLORS)


def draws_colors(draw: Callable[[Renderable, View, tuple[int, int, int]], np.ndarray]) -> bool:
    """Whether a renderer shows red at the left and blue at the right, as points and as triangles."""
    corners = np.array([[x, y, 2.0] for x in (-1, -0.1, 0.1, 1) for y in (-1, 1)], np.float32)
    triangles = np.array([[0, 1, 2], [1, 3, 2], [4, 5, 6], [5, 7, 6]])
    colors = np.repeat(np.array([[200, 30, 40], [20, 60, 220]], np.uint8), 4, axis=0)
    middles = np.array([[x, 0, 2.0] for x in (-0.5, 0.5)], np.float32)
    cloud = Renderable(middles, colors[::4], point_size=8.0)
    view = pinhole_view("probe", (32, 32), (32, 32, 16, 16), np.eye(4))
    for renderable in (cloud, Renderable(corners, colors, triangles=triangles)):
        image = draw(renderable, view, (255, 255, 255))
        if not all((image[16, column] == colors[row]).all() for column, row in ((8, 0), (24, -1))):
            return False
    return True


def _render_vulkan(renderable: Renderable, view: View, background: tuple[int, int, int]) -> np.ndarray:
    import open3d as o3d

    rendering = o3d.visualization.rendering
    try:
        renderer = rendering.OffscreenRenderer(view.width, view.height)
    except RuntimeError:
        raise Sc3dError(_NO_RENDERER) from None
    scene = renderer.scene
    scene.set_background([*(np.array(background) / 255.0), 1.0])
    scene.view.set_post_processing(False)  # tone mapping would change class colors
    scene.view.set_antialiasing(False)
    scene.view.set_sample_count(1)
    for name, geometry in _tensor_geometries(renderable).items():
        material = rendering.MaterialRecord()
        material.shader = "unlitLine" if name == "lines" else "defaultUnlit"
        material.point_size = renderable.point_size
        material.line_width = _LINE_WIDTH
        scene.add_geometry(name, geometry, material)
    renderer.setup_camera(view.matrix, view.cam_from_world, view.width, view.height)
    return np.array(renderer.render_to_image())


def _tensor_geometries(renderable: Renderable) -> dict:
    import open3d as o3d

    tensor = o3d.core.Tensor.from_numpy
    colors = tensor(np.ascontiguousarray(renderable.colors, dtype=np.float32) / np.float32(255))
    points = tensor(np.ascontiguousarray(renderable.points, dtype=np.float32))
    geometries: dict[str, object] = {}
    if renderable.triangles is not None and len(renderable.triangles):
        mesh = o3d.t.geometry.TriangleMesh(
            points, tensor(np.ascontiguousarray(renderable.triangles, dtype=np.int32))
        )
        mesh.vertex.colors = colors
        # unused, but asked for
        mesh.vertex.normals = tensor(np.tile(np.array([0, 0, 1], np.float32), (len(renderable.points), 1)))
        geometries["mesh"] = mesh
    elif renderable.triangles is None and len(renderable.points):
        cloud = o3d.t.geometry.PointCloud(points)
        cloud.point.colors = colors
        geometries["cloud"] = cloud
    if renderable.lines is not None and len(renderable.lines):
        geometries["lines"] = line_set(renderable.lines, renderable.line_color)
    return geometries


def line_set(lines: np.ndarray, color: tuple[int, int, int]) -> o3d.geometry.LineSet:
    """lines: (L, 2, 3) ends; color: RGB uint8."""
    import open3d as o3d

    ends = np.asarray(lines, np.float64).reshape(-1, 3)
    found = o3d.geometry.LineSet(
        o3d.utility.Vector3dVector(ends), o3d.utility.Vector2iVector(np.arange(len(ends)).reshape(-1, 2))
    )
    found.paint_uniform_color(np.array(color) / 255.0)
    return found


def _render_egl(renderable: Renderable, view: View, background: tuple[int, int, int]) -> np.ndarray:
    import open3d as o3d

    canvas, rows, columns = _centered_canvas(view)
    visualizer = o3d.visualization.Visualizer()
    if not visualizer.create_window(width=canvas.width, height=canvas.height, visible=False):
        raise Sc3dError(_NO_RENDERER)
    try:
        options = visualizer.get_render_option()
        options.point_size = renderable.point_size
        options.line_width = _LINE_WIDTH
        options.background_color = np.array(background) / 255.0
        options.light_on = False
        options.mesh_show_back_face = True
        for geometry in _legacy_geometries(renderable):
            visualizer.add_geometry(geometry)
        control = visualizer.get_view_control()
        camera = o3d.camera.PinholeCameraParameters()
        camera.intrinsic = o3d.camera.PinholeCameraIntrinsic(canvas.width, canvas.height, canvas.matrix)
        camera.extrinsic = canvas.cam_from_world
        control.convert_from_pinhole_camera_parameters(camera, allow_arbitrary=True)
        near, far = _depth_range(renderable, view)
        control.set_constant_z_near(near)
        control.set_constant_z_far(far)
        visualizer.poll_events()
        visualizer.update_renderer()
        image = np.round(np.array(visualizer.capture_screen_float_buffer(True)) * 255).astype(np.uint8)
    finally:
        visualizer.destroy_window()
    return image[rows[:, None], columns]


def _centered_canvas(view: View) -> tuple[View, np.ndarray, np.ndarray]:
    """A view with square pixels and centered principal point that holds `view`, and the canvas rows (H,) and
    columns (W,) of its pixels.
    """
    (focal_x, _, center_x), (_, focal_y, center_y) = view.matrix[:2]
    focal = max(focal_x, focal_y)
    half_width = int(np.ceil(max(center_x, view.width - center_x) * focal / focal_x))
    half_height = int(np.ceil(max(center_y, view.height - center_y) * focal / focal_y))
    columns = np.floor((np.arange(view.width) + 0.5 - center_x) * focal / focal_x + half_width).astype(int)
    rows = np.floor((np.arange(view.height) + 0.5 - center_y) * focal / focal_y + half_height).astype(int)
    size = (2 * half_width, 2 * half_height)
    canvas = pinhole_view(view.name, size, (focal, focal, half_width, half_height), view.cam_from_world)
    return canvas, np.clip(rows, 0, size[1] - 1), np.clip(columns, 0, size[0] - 1)


def _depth_range(renderable: Renderable, view: View) -> tuple[float, float]:
    ends = (
        [renderable.points]
        if renderable.lines is None
        else [renderable.points, np.reshape(renderable.lines, (-1, 3))]
    )
    depth = np.concatenate(ends) @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3]
    depth = depth[depth > 0]
    if not len(depth):
        return 0.1, 1000.0
    far = float(depth.max()) * 1.01
    return max(float(depth.min()) * 0.99, far * 1e-4), far


def _legacy_geometries(renderable: Renderable) -> list:
    import open3d as o3d

    points = o3d.utility.Vector3dVector(renderable.points.astype(np.float64))
    colors = o3d.utility.Vector3dVector(renderable.colors / 255.0)
    geometries: list = []
    if renderable.triangles is not None:
        triangles = o3d.utility.Vector3iVector(renderable.triangles.astype(np.int32))
        mesh = o3d.geometry.TriangleMesh(points, triangles)
        mesh.vertex_colors = colors
        geometries.append(mesh)
    else:
        cloud = o3d.geometry.PointCloud(points)
        cloud.colors = colors
        geometries.append(cloud)
    if renderable.lines is not None and len(renderable.lines):
        geometries.append(line_set(renderable.lines, renderable.line_color))
    return geometries


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the renderers' chatter, which C++ writes to both streams, from the user; it goes to the debug log."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    saved = os.dup(1), os.dup(2)
    with tempfile.TemporaryFile() as chatter:
        try:
            os.dup2(chatter.fileno(), 1)
            os.dup2(chatter.fileno(), 2)
            with messages_to(saved[1]):
                yield
        finally:
            for target, descriptor in zip((1, 2), saved, strict=True):
                os.dup2(descriptor, target)
                os.close(descriptor)
            chatter.seek(0)
            logger.debug("renderer: %s", chatter.read().decode(errors="replace").strip())


def check_display() -> None:
    """Raise Sc3dError that says what to do where no window can be opened."""
    if not has_display():
        raise Sc3dError(
            "no display to open a window on: `sc3d view SCENE --screenshot FILE` renders a picture without one, --web shows it in a browser"
        )


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
