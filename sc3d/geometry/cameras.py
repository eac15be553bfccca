"""Views: a COLMAP camera of any model plus a pose; rays, projection, undistortion.

Camera frame: x right, y down, z forward. Pixel coordinates: the center of the top-left pixel is (0.5, 0.5).
Poses and rays are float64, so positions of UTM size keep their millimeters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
import pycolmap

GROWN = 0.1  # of each side of the view without empty borders
LEAST_COSINE = 0.1  # between the optical axis and the photo's border, where a pinhole view can show that
SUBPIXEL = 4  # bits


@dataclass(frozen=True)
class View:
    """One photo's camera.

    name: file name of the photo, as COLMAP stores it (may contain folders)
    camera: pycolmap camera, any model
    cam_from_world: (4, 4) float64 rigid transform
    """

    name: str
    camera: pycolmap.Camera
    cam_from_world: np.ndarray

    @property
    def width(self) -> int:
        return self.camera.width

    @property
    def height(self) -> int:
        return self.camera.height

    @property
    def focal(self) -> float:
        """Mean focal length, px."""
        return float(self.camera.mean_focal_length())

    @cached_property
    def matrix(self) -> np.ndarray:
        """(3, 3) calibration matrix, px; distortion not included."""
        return np.asarray(self.camera.calibration_matrix(), dtype=np.float64)

    @cached_property
    def center(self) -> np.ndarray:
        """(3,) camera center, world."""
        rotation, translation = self.cam_from_world[:3, :3], self.cam_from_world[:3, 3]
        return -rotation.T @ translation

    @cached_property
    def cone_cosine(self) -> float:
        """Cosine of the largest angle between the optical axis and a ray through the image border.

        Polynomial distortion folds points from far outside the field of view back into the image; nothing
        beyond this cone is seen.
        """
        return float(self._border_rays[:, 2].min())

    @cached_property
    def frustum(self) -> np.ndarray:
        """(4, 3) unit normals, camera frame, of planes through the center; everything in the image lies on
        their negative side.

        All zero where the field of view is too wide for planes.
        """
        rays_cam = self._border_rays
        if not rays_cam[:, 2].min() > 0.05:
            return np.zeros((4, 3))
        slopes = rays_cam[:, :2] / rays_cam[:, 2:]
        (left, top), (right, bottom) = slopes.min(axis=0), slopes.max(axis=0)
        planes = np.array([[-1, 0, left], [1, 0, -right], [0, -1, top], [0, 1, -bottom]])
        return planes / np.linalg.norm(planes, axis=1, keepdims=True)

    @cached_property
    def _border_rays(self) -> np.ndarray:
        """Of the pixels' corners once around the image."""
        columns, rows = np.arange(0, self.width + 1), np.arange(0, self.height + 1)
        border = np.concatenate(
            [
                np.stack([columns, np.zeros_like(columns)], 1),
                np.stack([np.full_like(rows, self.width), rows], 1),
                np.stack([columns[::-1], np.full_like(columns, self.height)], 1),
                np.stack([np.zeros_like(rows), rows[::-1]], 1),
            ]
        )
        return _unit_rays(self.camera, border.astype(np.float64))

    def shifted(self, origin: np.ndarray) -> View:
        """The same view in a world whose origin is moved to `origin` (3,): points there are `points -
        origin`.
        """
        moved = self.cam_from_world.copy()
        moved[:3, 3] += moved[:3, :3] @ np.asarray(origin, dtype=np.float64)
        return replace(self, cam_from_world=moved)

    def resized(self, width: int, height: int) -> View:
        """The same view sampled with another number of pixels; the field of view is kept."""
        if (width, height) == (self.width, self.height):
            return self
        camera = pycolmap.Camera(self.camera.todict())
        camera.rescale(width, height)
        return replace(self, camera=camera)


def pinhole_view(
    name: str,
    size: tuple[int, int],
    calibration: tuple[float, float, float, float],
    cam_from_world: np.ndarray,
) -> View:
    """A view without distortion. `size` (width, height) px; `calibration` (fx, fy, cx, cy) px;
    `cam_from_world` (4, 4).
    """
    camera = pycolmap.Camera(model="PINHOLE", width=size[0], height=size[1], params=list(calibration))
    return View(name, camera, np.asarray(cam_from_world, dtype=np.float64))


def look_at(
    center: np.ndarray, target: np.ndarray, up: tuple[float, float, float] = (0.0, 0.0, 1.0)
) -> np.ndarray:
    """(4, 4) cam_from_world of a camera at `center` (3,) that looks at `target` (3,), image top towards `up`."""
    forward = np.asarray(target, np.float64) - center
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:  # straight up or down: image top towards +y
        right = np.cross(forward, (0.0, 1.0, 0.0))
    right = right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = -rotation @ np.asarray(center, np.float64)
    return transform


def pixel_centers(width: int, height: int) -> np.ndarray:
    """(height * width, 2) float64 pixel coordinates of all pixel centers, row by row."""
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def rays(view: View, pixels: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Viewing rays of pixels.

    pixels: (N, 2) px; None = all pixel centers row by row
    returns: (N, 3) unit directions, world; (N,) z component of each in the camera frame, so that depth =
        range * z. NaN where the model has no ray.
    """
    pixels = pixel_centers(view.width, view.height) if pixels is None else np.asarray(pixels, np.float64)
    directions_cam = _unit_rays(view.camera, pixels)
    return directions_cam @ view.cam_from_world[:3, :3], directions_cam[:, 2]


def camera_rays(camera: pycolmap.Camera) -> np.ndarray:
    """(height * width, 3) float32 unit directions of all pixel centers row by row, camera frame; NaN where
    the model has no ray.

    Kept for the last few cameras, because photos share cameras and differ by their pose only. Read-only.
    """
    return _camera_rays(camera.model_name, camera.width, camera.height, tuple(camera.params))


def opencv_parameters(camera: pycolmap.Camera) -> np.ndarray | None:
    """(8,) fx, fy, cx, cy, k1, k2, p1, p2 of the models that OPENCV contains; None for any other model."""
    params, model = list(camera.params), camera.model_name
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):  # f, cx, cy, k1, k2
        params = [params[0], *params, 0.0, 0.0]
    elif model not in ("PINHOLE", "OPENCV"):
        return None
    return np.array((params + 4 * [0.0])[:8])


def project(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates and depth of points (eq. 4, with the camera's own distortion).

    points: (N, 3) world
    returns: (N, 2) px, NaN outside the field of view or behind the camera; (N,) depth z, world units
    """
    points_cam = np.asarray(points, np.float64) @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    depth = points_cam[:, 2].copy()
    distance = np.linalg.norm(points_cam, axis=1)
    seen = (distance > 0) & (depth >= (view.cone_cosine - 1e-6) * distance)
    pixels = np.full((len(points_cam), 2), np.nan)
    if seen.any():
        pixels[seen] = view.camera.img_from_cam(
            np.ascontiguousarray(points_cam[seen]), check_cheirality=False
        )
    return pixels, depth


def in_image(view: View, pixels: np.ndarray) -> np.ndarray:
    """(N,) bool: which of the (N, 2) pixel coordinates lie inside the image; NaN does not."""
    return (
        (pixels[:, 0] >= 0) & (pixels[:, 0] < view.width) & (pixels[:, 1] >= 0) & (pixels[:, 1] < view.height)
    )


def may_see(view: View, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether the image may show something of a box; low, high: (3,) world."""
    corners = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    corners_cam = corners @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    return not (
        (corners_cam @ view.frustum.T > 1e-9 * np.abs(corners_cam).max()).all(axis=0)
        & view.frustum.any(axis=1)
    ).any()


def undistorted(view: View, max_size: int | None = None) -> View:
    """A pinhole view of the same pose that shows the whole photo, or at least what lies up to GROWN of a side
    around the largest field of view without empty borders, longest side at most `max_size` px. See `in_photo`.
    """
    if view.camera.is_undistorted():
        pinhole = view
    else:
        options = pycolmap.UndistortCameraOptions()
        options.blank_pixels = 0.0
        pinhole = _grown(view, replace(view, camera=pycolmap.undistort_camera(options, view.camera)))
    longest = max(pinhole.width, pinhole.height)
    if max_size is None or longest <= max_size:
        return pinhole
    scale = max_size / longest
    return pinhole.resized(max(1, round(pinhole.width * scale)), max(1, round(pinhole.height * scale)))


def in_photo(view: View, target: View) -> np.ndarray | None:
    """(H, W) bool pixels of `target`, a pinhole view of the same pose, that the photo of `view` shows; None if
    all are.
    """
    outline = None if view.camera.is_undistorted() else _outline(view, target)
    if outline is None:
        return None
    inside = np.zeros((target.height, target.width), np.uint8)
    fixed = np.round((outline - 0.5) * 2**SUBPIXEL).astype(np.int32)  # cv2: pixel center = integer
    cv2.fillPoly(inside, [fixed], 1, shift=SUBPIXEL)
    return None if inside.all() else inside > 0


def _grown(view: View, pinhole: View) -> View:
    """A field of view without empty borders, enlarged to that of the photo by at most GROWN of each side."""
    outline = _outline(view, pinhole)
    if outline is None:
        return pinhole
    size = np.array([pinhole.width, pinhole.height])
    low = np.floor(np.clip(outline.min(axis=0), -GROWN * size, 0))
    high = np.ceil(np.clip(outline.max(axis=0), size, (1 + GROWN) * size))
    (width, height), (focal_x, focal_y) = (high - low).astype(int), np.diag(pinhole.matrix)[:2]
    calibration = (focal_x, focal_y, *(pinhole.matrix[:2, 2] - low))
    return pinhole_view(view.name, (int(width), int(height)), calibration, view.cam_from_world)


def _outline(view: View, pinhole: View) -> np.ndarray | None:
    """(N, 2) px where the border of the photo lies in a pinhole view of the same pose; None if it sees more
    than that can show.
    """
    border = view._border_rays
    if not (np.isfinite(border).all() and (border[:, 2] > LEAST_COSINE).all()):
        return None
    pixels = border @ pinhole.matrix.T
    return pixels[:, :2] / pixels[:, 2:]


def resample(image: np.ndarray, view: View, target: View, labels: bool = False) -> np.ndarray:
    """Warp a photo or label map of `view` (any size of the same aspect) into `target`, a view with the same
    pose.

    image: (h, w) or (h, w, 3); returned at the size of `target`. Labels take the nearest pixel and are never
        mixed.
    """
    height, width = image.shape[:2]
    directions_cam = _unit_rays(target.camera, pixel_centers(target.width, target.height))
    pixels = view.camera.img_from_cam(directions_cam, check_cheirality=False) * [
        width / view.width,
        height / view.height,
    ]
    # cv2: pixel center = integer
    maps = (pixels - 0.5).astype(np.float32).reshape(target.height, target.width, 2)
    shrink = width / target.width
    if labels:
        return cv2.remap(image, maps, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    if shrink > 1.5:  # avoid aliasing: blur before sampling
        image = cv2.GaussianBlur(image, (0, 0), 0.45 * shrink)
    return cv2.remap(image, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def local_origin(views: list[View]) -> np.ndarray:
    """(3,) whole-number world position near the cameras; subtract it before float32 work."""
    return np.round(np.median([view.center for view in views], axis=0))


@lru_cache(maxsize=2)
def _camera_rays(model: str, width: int, height: int, params: tuple[float, ...]) -> np.ndarray:
    camera = pycolmap.Camera(model=model, width=width, height=height, params=list(params))
    directions = np.empty((height, width, 3), np.float32)
    step = max(1, 500_000 // width)  # pixels in float64 at a time
    for row in range(0, height, step):
        pixels = pixel_centers(width, min(step, height - row)) + [0, row]
        directions[row : row + step] = _unit_rays(camera, pixels).reshape(-1, width, 3)
    directions.setflags(write=False)
    return directions.reshape(-1, 3)


def _unit_rays(camera: pycolmap.Camera, pixels: np.ndarray) -> np.ndarray:
    directions = np.asarray(camera.cam_ray_from_img(np.ascontiguousarray(pixels, np.float64)), np.float64)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)
