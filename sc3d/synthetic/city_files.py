"""Files of a city, written piece by piece: clouds and meshes as PLY in the dialect of Open3D, cameras as a
COLMAP model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from sc3d.geometry.cameras import View
from sc3d.io.atomic import atomic_path
from sc3d.io.colmap import build_model, write_model
from sc3d.io.ply import Element, Property, format_header, record_writer, vertex_element

CLOUD = np.dtype(
    [
        ("x", "<f8"),
        ("y", "<f8"),
        ("z", "<f8"),
        ("nx", "<f4"),
        ("ny", "<f4"),
        ("nz", "<f4"),
        ("red", "u1"),
        ("green", "u1"),
        ("blue", "u1"),
        ("label", "u1"),
        ("instance", "<i4"),
    ]
)
VERTEX = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8")])
FACE = np.dtype([("count", "u1"), ("corners", "<u4", 3)])
FACES = Property("vertex_indices", "u4", "u1")
COMMENTS = ["sc3d synthetic city"]
ROOM = 512  # bytes of a mesh's header, whose counts are known at the end only
TOGETHER = 1 << 20  # triangles written at a time


@dataclass
class CloudWriter:
    """A cloud that grows. write: takes (N,) records."""

    write: Callable[[np.ndarray], None]

    def append(
        self,
        positions: np.ndarray,
        normals: np.ndarray,
        colors: np.ndarray,
        label: np.ndarray,
        instance: np.ndarray,
    ) -> None:
        """positions: (N, 3) float64; normals: (N, 3) float32; colors: (N, 3) uint8; label: (N, 1) uint8;
        instance: (N, 1) int32.
        """
        table = np.empty(len(positions), CLOUD)
        columns = [*positions.T, *normals.T, *colors.T, label.ravel(), instance.ravel()]
        for name, column in zip(CLOUD.names or (), columns, strict=True):
            table[name] = column
        self.write(table)


@dataclass
class MeshWriter:
    """A triangle soup that grows. triangles: so far."""

    stream: BinaryIO
    triangles: int = 0

    def append(self, corners: np.ndarray) -> None:
        """corners: (T, 3, 3) float64."""
        self.stream.write(np.ascontiguousarray(corners, "<f8").tobytes())
        self.triangles += len(corners)


@contextmanager
def open_cloud(path: Path, num_points: int) -> Iterator[CloudWriter]:
    """A cloud of `num_points`, all of which must be appended; it gets its name when the block succeeds."""
    with record_writer(path, CLOUD, num_points, COMMENTS) as write:
        yield CloudWriter(write)


@contextmanager
def open_mesh(path: Path) -> Iterator[MeshWriter]:
    """A triangle soup with three vertices per triangle; it gets its name when the block succeeds."""
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        stream.write(bytes(ROOM))
        mesh = MeshWriter(stream)
        yield mesh
        for first in range(0, mesh.triangles, TOGETHER):
            numbers = np.arange(first, min(first + TOGETHER, mesh.triangles), dtype=np.int64)
            faces = np.empty(len(numbers), FACE)
            faces["count"], faces["corners"] = 3, 3 * numbers[:, None] + np.arange(3)
            stream.write(faces.tobytes())
        stream.seek(0)
        elements = [vertex_element(VERTEX, 3 * mesh.triangles), Element("face", mesh.triangles, (FACES,))]
        stream.write(format_header(elements, COMMENTS, ROOM))


def write_cameras(path: Path, views: list[View]) -> None:
    """Views that share the camera of the first, as a COLMAP model without points."""
    write_model(path, build_model(views))
