"""A triangle soup with a material, a label and a texture frame per triangle."""

from __future__ import annotations

import numpy as np

GROUND, WALL, TILES, FLAT_ROOF, LEAF, BARK, PAINT, GLASS, PLAIN, BRICK = range(10)  # materials
# of facades that are seen from near
PLASTER, MASONRY, ASHLAR, PANE, WOOD = range(10, 15)
NO_CLASS, BUILDING, TREE, ROAD, GRASS = range(5)  # labels

# columns of the per-triangle float table
# texture frame (origin, u axis, v axis), normal, tint, size of the textured face
FRAME, NORMAL, TINT, SIZE = slice(0, 9), slice(9, 12), slice(12, 15), slice(15, 17)
NUM_COLUMNS = 17


def linear(color: tuple[float, float, float] | np.ndarray) -> np.ndarray:
    """Linear light of an RGB color given as 0..255 display values; same shape, 0..1."""
    return (np.asarray(color, np.float64) / 255.0) ** 2.2


class MeshBuilder:
    """Collects triangles; `finish` returns the tables that rendering works on."""

    def __init__(self) -> None:
        self._corners: list[np.ndarray] = []
        self._floats: list[np.ndarray] = []
        self._ints: list[np.ndarray] = []
        self.num_objects = 0

    def new_object(self) -> int:
        """The id of a new object: one building, one tree, one car."""
        self.num_objects += 1
        return self.num_objects

    def add(
        self,
        corners: np.ndarray,
        kind: tuple[int, int, int],
        tint: np.ndarray,
        frame: np.ndarray | None = None,
        size: tuple[float, float] = (0.0, 0.0),
        normals: np.ndarray | None = None,
    ) -> None:
        """Add triangles.

        corners: (F, 3, 3) world, counter-clockwise seen from outside
        kind: (material, label, object id)
        tint: (3,) or (F, 3) linear RGB
        frame: (3, 3) origin, u axis and v axis of the texture; None = world xy
        size: width and height of the textured face, m
        normals: (F, 3) unit shading normals; None = geometric
        """
        corners = np.asarray(corners, np.float64)
        floats = np.zeros((len(corners), NUM_COLUMNS))
        frame = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]) if frame is None else np.asarray(frame)
        floats[:, FRAME] = frame.reshape(-1)
        floats[:, NORMAL] = face_normals(corners) if normals is None else normals
        floats[:, TINT] = tint
        floats[:, SIZE] = size
        self._corners.append(corners)
        self._floats.append(floats)
        self._ints.append(np.tile(np.asarray(kind, np.int32), (len(corners), 1)))

    def polygon(self, points: np.ndarray, kind: tuple[int, int, int], tint: np.ndarray) -> None:
        """Add a convex planar polygon (N, 3), counter-clockwise from outside; u runs along its first edge, v
        up its plane.
        """
        points = np.asarray(points, np.float64)
        fan = np.stack([np.stack([points[0], points[i], points[i + 1]]) for i in range(1, len(points) - 1)])
        axis_u = points[1] - points[0]
        axis_u = axis_u / np.linalg.norm(axis_u)
        axis_v = np.cross(face_normals(fan[:1])[0], axis_u)
        local = (points - points[0]) @ np.stack([axis_u, axis_v]).T
        origin = points[0] + local[:, 0].min() * axis_u
        self.add(
            fan, kind, tint, np.stack([origin, axis_u, axis_v]), (np.ptp(local[:, 0]), np.ptp(local[:, 1]))
        )

    def box(
        self,
        pose: np.ndarray,
        low: tuple[float, float, float],
        high: tuple[float, float, float],
        kind: tuple[int, int, int],
        tint: np.ndarray,
        top: bool = True,
    ) -> None:
        """Add an upright box from `low` to `high` in the frame of `pose` (4, 4); its bottom is left out."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        ground = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        for i in range(4):
            a, b = ground[i], ground[(i + 1) % 4]
            self.polygon(placed(pose, [[*a, z0], [*b, z0], [*b, z1], [*a, z1]]), kind, tint)
        if top:
            self.polygon(placed(pose, np.c_[ground, np.full(4, z1)]), kind, tint)

    def finish(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(T, 3, 3) float32 corners, (T, 17) float32 columns of this module, (T, 3) int32 material, label and
        object.
        """
        return (
            np.concatenate(self._corners).astype(np.float32),
            np.concatenate(self._floats).astype(np.float32),
            np.concatenate(self._ints).astype(np.int32),
        )


def face_normals(corners: np.ndarray) -> np.ndarray:
    """(F, 3) unit normals of triangles (F, 3, 3)."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)


def upright_pose(position: np.ndarray, yaw: float) -> np.ndarray:
    """(4, 4) world_from_local of an object at `position` (3,), turned by `yaw` radians about z."""
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = position
    return pose


def placed(pose: np.ndarray, points: np.ndarray | list) -> np.ndarray:
    """Points (N, 3) moved by a (4, 4) pose."""
    return np.asarray(points, np.float64) @ pose[:3, :3].T + pose[:3, 3]
