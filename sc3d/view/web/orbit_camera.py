"""A view as a browser's camera wants it: where it is, what it turns around, which way is up."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from sc3d.geometry.cameras import View, look_at, undistorted

if TYPE_CHECKING:
    import viser

_NEAR, _FAR = 1 / 500, 50.0  # of the distance to what is looked at
_STEEP = 0.99  # sine of the slope from which a look is straight down, where +z is no way up
# half the heights of windows, as tangents: how a place is looked at, and at most, where nobody can step back
_USUAL, _WIDEST = 0.4, 1.7
_AROUND, _MARGIN = 2.5, 1.1  # size of the window, in sizes of a place: as wanted, and at least
_FLIGHT, _STEPS = 0.6, 12  # s, and pictures in it


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
        up = np.array([0.0, 0.0, 1.0]) if upright and abs(forward[2]) < _STEEP else image_up
        return cls(view.center, view.center + distance * forward, up, field_of_view(undistorted(view))[0])

    @classmethod
    def of_place(
        cls,
        points: np.ndarray,
        target: np.ndarray,
        towards: np.ndarray,
        reach: float,
        least: float,
        aspect: float,
        ahead: np.ndarray,
    ) -> OrbitCamera:
        """All of a place in the window, with what is around it if there is room to step back.

        points: (K, 3) of the place; target: (3,) one that is looked at; towards: (3,) unit, from it to the
        eye; reach: how far away on that line the eye may be; least: height that is shown of a smaller place;
            aspect: width over height of the window; ahead: (3,) level, top of the window in a look
            straight down
        """
        up = np.array([0.0, 0.0, 1.0]) if abs(towards[2]) < _STEEP else np.asarray(ahead, np.float64)
        right, down, behind = look_at(target + towards, target, tuple(up))[:3, :3] @ (points - target).T
        sizes = np.maximum(np.abs(right) / aspect, np.abs(down))
        wanted = max(float((_AROUND * sizes / _USUAL - behind).max()), least / 2 / _USUAL)
        distance = min(wanted, reach)
        before = distance + behind  # the eye; what is not before it needs the widest window
        slope = np.where(before > 0, _MARGIN * sizes / np.where(before > 0, before, 1), _WIDEST).max()
        fov = 2 * float(np.arctan(np.clip(slope, _USUAL, _WIDEST)))
        return cls(target + distance * towards, target, up, fov)

    @classmethod
    def of_client(cls, client: viser.ClientHandle) -> OrbitCamera:
        """Where a browser looks from."""
        camera = client.camera
        return cls(camera.position, camera.look_at, camera.up_direction, camera.fov)

    @property
    def ahead(self) -> np.ndarray:
        """(3,) unit, level: where one goes who goes on, in a look straight down towards the top."""
        level = (self.look_at - self.position) / self.distance + self.up
        level = level * [1, 1, 0]
        size = float(np.linalg.norm(level))
        return level / size if size > 1e-3 else np.array([0.0, 1.0, 0.0])

    def between(self, other: OrbitCamera, share: float) -> OrbitCamera:
        """A pose on the way to another, 0 to 1: around what is looked at, never through it."""
        if share >= 1:
            return other
        start, end = self.position - self.look_at, other.position - other.look_at
        axis = np.cross(start, end) / (self.distance * other.distance)
        angle = float(np.arctan2(np.linalg.norm(axis), start @ end / (self.distance * other.distance)))
        if np.linalg.norm(axis) < 1e-6:  # the same direction, or the opposite one
            axis = np.cross(start, np.eye(3)[np.argmin(np.abs(start))])
        turn = Rotation.from_rotvec(share * angle * axis / np.linalg.norm(axis))
        distance = self.distance ** (1 - share) * other.distance**share
        look_at = (1 - share) * self.look_at + share * other.look_at
        up = (1 - share) * self.up + share * other.up
        return OrbitCamera(
            look_at + distance * turn.apply(start / self.distance),
            look_at,
            up if np.linalg.norm(up) > 0.1 else other.up,
            (1 - share) * self.fov + share * other.fov,
        )

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
            camera.near, camera.far = _NEAR * self.distance, max(camera.far, _FAR * self.distance)


def fly(goals: Sequence[tuple[viser.ClientHandle, OrbitCamera]]) -> None:
    """Move browsers there within `_FLIGHT`, so that one sees where that is."""
    starts = [OrbitCamera.of_client(client) for client, _ in goals]
    for step in range(1, _STEPS + 1):
        share = (step / _STEPS) ** 2 * (3 - 2 * step / _STEPS)
        for (client, goal), start in zip(goals, starts, strict=True):
            start.between(goal, share).move(client)
        time.sleep(_FLIGHT / _STEPS)


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
