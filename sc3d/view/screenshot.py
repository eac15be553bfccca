"""Pictures of a cloud or mesh without a display, from the air or through a photo's camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, local_origin, resample, undistorted
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.scene.class_table import ClassTable
from sc3d.view.captions import add_legend
from sc3d.view.colors import Coloring, as_uint8, color_points
from sc3d.view.contact_sheet import half_of, side_by_side
from sc3d.view.renderers import Renderable, render
from sc3d.view.viewpoints import fitted, frusta, frustum_depth, overview, without_outliers

if TYPE_CHECKING:
    import open3d as o3d

    from sc3d.view.display_splats import DisplaySplats

LINE_COLOR = (240, 150, 20)
_LARGEST_CANVAS = 8192  # px; what software renderers take


@dataclass(frozen=True)
class Style:
    """How a picture looks.

    by: coloring; a mesh is always drawn in its own colors
    from_above: straight down instead of oblique from the south, where no view is given
    cameras: views whose frusta are drawn
    legend: append the strip that explains the colors
    shading: strength of the darkened depth edges that make bare points readable; 0 = colors exactly as given
    background: RGB uint8
    max_points: larger clouds are thinned at random with `seed`
    supersampling: pixels drawn per picture pixel, along each side
    renderer: "vulkan", "egl", or the one that works
    """

    by: Coloring = "label"
    from_above: bool = False
    cameras: Sequence[View] = ()
    legend: bool = True
    shading: float = 0.0
    background: tuple[int, int, int] = (255, 255, 255)
    max_points: int = 3_000_000
    seed: int = 0
    supersampling: int = 2
    renderer: Literal["auto", "vulkan", "egl"] = "auto"


@dataclass(frozen=True)
class PointImage:
    """Which point each pixel of a picture shows; any coloring of the cloud can be painted from it.

    rows: (H', W') int32 rows of the points; -1 = background, -2 = a camera's line
    depth: (H', W') float32 z, world units; inf = background
    factor: pixels H', W' are a multiple of the picture's
    """

    rows: np.ndarray
    depth: np.ndarray
    factor: int

    def paint(self, colors: np.ndarray, style: Style) -> np.ndarray:
        """(H, W, 3) uint8 RGB; colors: (N, 3) uint8 RGB of all points."""
        palette = np.concatenate([colors, [LINE_COLOR, style.background]]).astype(np.uint8)
        image = palette[self.rows]
        if style.shading > 0:
            image = _shade_edges(image, self.depth, style.shading, self.factor)
        return _shrunk(image, self.factor)


def screenshot(
    geometry: o3d.t.geometry.PointCloud | o3d.t.geometry.TriangleMesh,
    view: View | None = None,
    size: tuple[int, int] = (1600, 1000),
    style: Style = Style(),
    class_table: ClassTable | None = None,
) -> np.ndarray:
    """A picture of a cloud or mesh, drawn without a display.

    view: a photo's camera, of which the undistorted (pinhole) form is drawn; None = an aerial view that holds
        everything
    size: (width, height) px; with a view, its longest side is the longer of the two
    returns: (H, W, 3) uint8 RGB; a legend adds rows below
    Raises InputError for an empty geometry or a missing attribute, Sc3dError where no renderer works.
    """
    if hasattr(geometry, "triangle"):
        return _mesh_picture(geometry, view, size, style)
    colors = color_points(geometry, style.by, class_table)
    image = draw_points(geometry.point.positions.cpu().numpy(), view, size, style).paint(colors, style)
    if not style.legend:
        return image
    labels = geometry.point[style.by].cpu().numpy() if style.by in ("label", "state") else None
    return add_legend(
        image, style.by, class_table, None if labels is None else set(np.unique(labels).tolist())
    )


def screenshot_splats(
    splats: DisplaySplats,
    view: View | None = None,
    photo: np.ndarray | None = None,
    size: tuple[int, int] = (1600, 1000),
    style: Style = Style(),
) -> np.ndarray:
    """A picture of Gaussians, with a legend where they are colored by their labels.

    view, photo: camera (world) and picture (H, W, 3) uint8 RGB that they are drawn beside; None = an overview
    style: what it says of coloring, direction and background
    returns: (H, W, 3) uint8 RGB
    """
    from sc3d.splatting.evaluation import compare, picture

    label = splats.label if style.by != "photo" else None
    gaussians = splats.gaussians if label is None else splats.painted(style.by)
    if view is None or photo is None:
        seen = gaussians.means[gaussians.opacities > 0.5].numpy()
        points = without_outliers(seen if len(seen) else gaussians.means.numpy())
        image = picture(gaussians, overview(points, size, style.from_above), style.background)
    else:
        source = view.shifted(splats.origin)
        target = fitted(source, half_of(size))
        pixels = resample(photo, source, target)
        if label is not None:
            drawn, caption = picture(gaussians, target, style.background), f"splats by {style.by}"
        else:
            found = compare(gaussians, target, pixels)
            pixels, drawn, caption = found.photo, found.rendered, f"splats, PSNR {found.psnr:.2f} dB"
        image = side_by_side((pixels, drawn), (view.name, caption))
    if label is None:
        return image
    return add_legend(image, style.by, splats.table, set(np.unique(label).tolist()))


def draw_points(points: np.ndarray, view: View | None, size: tuple[int, int], style: Style) -> PointImage:
    """Draw (N, 3) world points; arguments as for `screenshot`."""
    points = np.asarray(points, np.float64)
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    if not len(finite):
        raise InputError("the cloud has no points, nothing to draw")
    canvas, lines, factor = _canvas(points[finite], view, size, style)
    chosen = finite[_visible_sample(points[finite], canvas, style)]
    origin = local_origin([canvas])
    # every point is drawn in a color of its own: its number, 24 bits; the last stands for lines
    codes = np.arange(len(chosen) + 1)
    colors = np.stack([codes >> 16, codes >> 8 & 255, codes & 255], axis=1).astype(np.uint8)
    renderable = Renderable(
        (points[chosen] - origin).astype(np.float32),
        colors[:-1],
        _point_size(points[chosen], canvas),
        lines=(lines - origin).astype(np.float32),
        line_color=tuple(colors[-1].tolist()),
    )
    image = render(renderable, canvas.shifted(origin), (255, 255, 255), style.renderer).astype(np.int32)
    codes = image[..., 0] << 16 | image[..., 1] << 8 | image[..., 2]
    depth = points[chosen] @ canvas.cam_from_world[2, :3] + canvas.cam_from_world[2, 3]
    code = np.minimum(codes, len(chosen) + 1)
    rows, depth = (
        np.append(chosen, [-2, -1]).astype(np.int32),
        np.append(depth, [np.inf, np.inf]).astype(np.float32),
    )
    return PointImage(rows[code], depth[code], factor)


def _mesh_picture(
    mesh: o3d.t.geometry.TriangleMesh, view: View | None, size: tuple[int, int], style: Style
) -> np.ndarray:
    """A mesh in its own colors, gray without."""
    if "indices" not in mesh.triangle or not len(mesh.triangle.indices):
        raise InputError("the mesh has no triangles, nothing to draw")
    points = mesh.vertex.positions.cpu().numpy().astype(np.float64)
    colors = (
        as_uint8(mesh.vertex.colors.cpu().numpy())
        if "colors" in mesh.vertex
        else np.full((len(points), 3), 170, np.uint8)
    )
    canvas, lines, factor = _canvas(points, view, size, style)
    origin = local_origin([canvas])
    triangles, lines = mesh.triangle.indices.cpu().numpy(), (lines - origin).astype(np.float32)
    renderable = Renderable(
        (points - origin).astype(np.float32), colors, triangles=triangles, lines=lines, line_color=LINE_COLOR
    )
    return _shrunk(render(renderable, canvas.shifted(origin), style.background, style.renderer), factor)


def _canvas(
    points: np.ndarray, view: View | None, size: tuple[int, int], style: Style
) -> tuple[View, np.ndarray, int]:
    """The view that is drawn, supersampled; line ends of the frusta (L, 2, 3) world; pixels per picture pixel
    along each side.
    """
    lines = (
        frusta(style.cameras, frustum_depth(style.cameras, points))
        if len(style.cameras)
        else np.empty((0, 2, 3))
    )
    if view is None:
        view = overview(
            np.concatenate([without_outliers(points), lines.reshape(-1, 3)]), size, style.from_above
        )
    else:
        view = undistorted(view, max(size))
    factor = max(1, min(style.supersampling, _LARGEST_CANVAS // max(view.width, view.height)))
    return view.resized(view.width * factor, view.height * factor), lines, factor


def _visible_sample(points: np.ndarray, view: View, style: Style) -> np.ndarray:
    """Rows of the points before the camera and within the picture plus a margin, at most `max_points` of
    them, in order.
    """
    points_cam = points @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    pixels = (
        points_cam[:, :2] / np.maximum(points_cam[:, 2:], 1e-9) * np.diag(view.matrix)[:2]
        + view.matrix[:2, 2]
    )
    margin = 0.05 * max(view.width, view.height)
    inside = (pixels > -margin) & (pixels < [view.width + margin, view.height + margin])
    chosen = np.flatnonzero(inside.all(axis=1) & (points_cam[:, 2] > 1e-6))
    if len(chosen) > style.max_points:
        chosen = np.sort(np.random.default_rng(style.seed).choice(chosen, style.max_points, replace=False))
    return chosen


def _point_size(points: np.ndarray, view: View) -> float:
    """Side of a point in px that closes the cloud where its points lie farthest apart in the picture."""
    step = max(1, len(points) // 100_000)
    sample = points[np.random.default_rng(0).permutation(len(points))[::step]] if step > 1 else points
    if len(sample) < 8:
        return 3.0 * max(1.0, view.width / 1600)
    queries = sample[:: max(1, len(sample) // 5000)]
    # 4th neighbor: about 1 / sqrt(density) on surfaces
    spacing = NeighborIndex(sample).nearest(queries, 5)[1][:, 4] / np.sqrt(step)
    depth = queries @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3]
    apart = float(np.quantile(spacing / depth, 0.8)) * view.focal
    return float(np.clip(np.ceil(2.0 * apart), 1, max(3, view.width // 60)))


def _shade_edges(image: np.ndarray, depth: np.ndarray, strength: float, radius: int) -> np.ndarray:
    """Eye-dome lighting (Boucheny 2009): darken a pixel by how much nearer its neighbors are, in log depth."""
    far = ~np.isfinite(depth) | (depth <= 0)
    logs = np.log2(np.where(far, 1.0, depth)).astype(np.float32)
    logs[far] = np.inf
    response = np.zeros_like(logs)
    for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        neighbor = np.roll(logs, (dy * radius, dx * radius), axis=(0, 1))
        with np.errstate(invalid="ignore"):
            response += np.nan_to_num(np.maximum(logs - neighbor, 0.0), nan=0.0, posinf=0.0)
    shade = np.exp(-300.0 * strength * response / 8)
    shade = np.where(far, 1.0, np.maximum(shade, 0.35)).astype(np.float32)
    return np.round(image * shade[..., None]).astype(np.uint8)


def _shrunk(image: np.ndarray, factor: int) -> np.ndarray:
    if factor == 1:
        return image
    return cv2.resize(
        image, (image.shape[1] // factor, image.shape[0] // factor), interpolation=cv2.INTER_AREA
    )
