"""A view as a browser's camera wants it: where it is, what it turns around, which way is up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from sc3d.geometry.cameras import View, undistorted

if TYPE_CHECKING:
    import viser

_NEAR, _FAR = 1 / 500, 50.0  # of the distance to what is looked at


@dataclass(frozen=True)
class OrbitCamera:
    """position, look_at: (3,), the latter in the middle of the picture and the point to turn around; up: (3,)
    unit; fov: vertical, radians.
    """

    position: np.ndarray
    look_at: np.ndarray
    up: np.ndarray
    fov: float

    @classmethod
    def from_view(cls, view: View, middle: np.ndarray, upright: bool) -> OrbitCamera:
        """middle: (3,) of what is looked at, whose depth the point to turn around has; upright: turn around
        +z unless the view is straight down
        """
        forward, image_up = view.cam_from_world[2, :3], -view.cam_from_world[1, :3]
        towards = float((np.asarray(middle, np.float64) - view.center) @ forward)
        distance = towards if towards > 0 else float(np.linalg.norm(middle - view.center)) or 1.0
        up = np.array([0.0, 0.0, 1.0]) if upright and abs(forward[2]) < 0.99 else image_up
        return cls(view.center, view.center + distance * forward, up, field_of_view(undistorted(view))[0])

    @property
    def distance(self) -> float:
        """From the camera to the point to turn around."""
        return float(np.linalg.norm(self.look_at - self.position))

    def start(self, camera: viser.InitialCameraConfig) -> None:
        """Let browsers start here."""
        camera.position, camera.look_at, camera.up, camera.fov = (
            self.position,
            self.look_at,
            self.up,
            self.fov,
        )
        camera.near, camera.far = _NEAR * self.distance, _FAR * self.distance

    def move(self, client: viser.ClientHandle) -> None:
        """Move one browser here."""
        camera = client.camera
        with client.atomic():
            camera.position, camera.look_at, camera.up_direction, camera.fov = (
                self.position,
                self.look_at,
                self.up,
                self.fov,
            )


def orientation(view: View) -> np.ndarray:
    """(4,) quaternion wxyz, world_from_camera."""
    return np.roll(Rotation.from_matrix(view.cam_from_world[:3, :3].T).as_quat(), 1)


def field_of_view(pinhole: View) -> tuple[float, float]:
    """Vertical field of view, radians, and width over height of a view without distortion, as if its
    principal point were in the middle.
    """
    (focal_x, _, _), (_, focal_y, _) = pinhole.matrix[:2]
    return float(2 * np.arctan(pinhole.height / 2 / focal_y)), float(
        pinhole.width / focal_x / (pinhole.height / focal_y)
    )
