"""Point clouds and meshes through Open3D, checked on the way in, whole or not there on the way out."""

from __future__ import annotations

import io
import re
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path
from sc3d.io.limits import FARTHEST
from sc3d.io.pcd import check_pcd
from sc3d.io.ply import check_ply, read_header, read_positions

CHECKS = {".ply": check_ply, ".pcd": check_pcd}


def read_cloud(path: Path):  # -> o3d.t.geometry.PointCloud; open3d is imported late
    """Read a point cloud with all its attributes (PLY, PCD, XYZ); InputError if it is damaged, empty or has
    positions that are not finite or too far away.
    """
    cloud = _read_geometry(path, "read_point_cloud", {".ply", ".pcd", ".xyz", ".xyzn", ".xyzrgb", ".pts"})
    if "positions" not in cloud.point or not len(cloud.point.positions):
        raise InputError(f"{path} holds no points")
    _check_positions(path, cloud.point.positions.numpy(), "remove those points first")
    return cloud


def read_mesh(path: Path):  # -> o3d.t.geometry.TriangleMesh
    """Read a triangle mesh; InputError if it is damaged, empty or has vertices that are not finite or too far
    away, or triangles of other vertices.
    """
    mesh = _read_geometry(path, "read_triangle_mesh", {".ply"})
    if "positions" not in mesh.vertex or "indices" not in mesh.triangle or not len(mesh.triangle.indices):
        raise InputError(f"{path} holds no triangles")
    exact = read_positions(path, read_header(path))
    if exact is not None:  # Open3D reads float32, which has steps of half a meter at UTM size
        import open3d as o3d

        mesh.vertex.positions = o3d.core.Tensor(exact)
    _check_positions(path, mesh.vertex.positions.numpy(), "repair the mesh first")
    corners = mesh.triangle.indices.numpy()
    if corners.min() < 0 or corners.max() >= len(mesh.vertex.positions):
        raise InputError(f"{path} has triangles of vertices that do not exist: repair the mesh first")
    return mesh


def _read_geometry(path: Path, reader: str, suffixes: set[str]):
    """Open3D tells of files that it could not read to the end on Python's standard output only."""
    import open3d as o3d

    if not path.is_file():
        raise InputError(f"{path} is missing")
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: {', '.join(sorted(suffixes))} can be read")
    if path.suffix.lower() in CHECKS:
        CHECKS[path.suffix.lower()](path)
    told = io.StringIO()
    try:
        with redirect_stdout(told):
            geometry = getattr(o3d.t.io, reader)(str(path))
            # fails for names that are no text
            list(geometry.point if hasattr(geometry, "point") else geometry.vertex)
    except (RuntimeError, ValueError, IndexError) as error:
        told.write(f"failed: {error}")
    failure = re.search(
        r"\b(?:failed|unable to)\b[^\n\x1b]*", told.getvalue().replace(str(path), "the file"), re.IGNORECASE
    )
    if failure:
        raise InputError(
            f"cannot read {path}: Open3D says {failure[0].rstrip('. ')!r}; write or copy it again"
        )
    return geometry


def _check_positions(path: Path, positions: np.ndarray, advice: str) -> None:
    if not np.isfinite(positions).all():
        raise InputError(f"{path} has positions that are not finite numbers: {advice}")
    if np.abs(positions).max() > FARTHEST:
        raise InputError(f"{path} has positions more than {FARTHEST:g} from the origin: {advice}")


def write_geometry(path: Path, geometry) -> None:
    """Write a tensor point cloud or mesh, atomically."""
    import open3d as o3d

    write = (
        o3d.t.io.write_point_cloud
        if isinstance(geometry, o3d.t.geometry.PointCloud)
        else o3d.t.io.write_triangle_mesh
    )
    with atomic_path(path) as temporary:
        if not write(str(temporary), geometry):
            raise OSError(f"could not write {path}: is the disk full?")
        try:
            check_ply(temporary)  # a disk that becomes full is not always noticed
        except InputError as error:
            raise OSError(f"could not write {path}: is the disk full? ({error})") from None
