"""Point clouds and meshes through Open3D, checked on the way in, whole or not there on the way out."""

from __future__ import annotations

import io
import logging
import math
import re
from collections.abc import Callable, Collection
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np

from sc3d.errors import InputError, examples
from sc3d.io.atomic import atomic_path
from sc3d.io.colors import COLORS, color_names, to_bytes
from sc3d.io.limits import FARTHEST
from sc3d.io.pcd import check_pcd, read_fields
from sc3d.io.ply import (
    RESERVED,
    TOGETHER,
    Element,
    Header,
    Property,
    check_ply,
    format_header,
    num_triangles,
    read_columns,
    read_header,
    read_positions,
)
from sc3d.io.splats import SPLATS, is_splat_ply

logger = logging.getLogger(__name__)

COARSE = 0.005  # steps of positions that are told, world units
PCD_NORMALS = ["normal_x", "normal_y", "normal_z"]
MAX_NAME = 200  # characters of an attribute
TAKEN = {name for group in TOGETHER for name in group}  # columns of what Open3D reads together
NO_MESH = format_header(
    [
        Element("vertex", 0, tuple(Property(axis, "f8") for axis in "xyz")),
        Element("face", 0, (Property("vertex_indices", "u4", "u1"),)),
    ]
)
CHECKS: dict[str, Callable[[Path], object]] = {".ply": check_ply, ".pcd": check_pcd}


def read_cloud(path: Path):  # -> o3d.t.geometry.PointCloud; open3d is imported late
    """Read a point cloud with all its attributes (PLY, PCD, XYZ), colors as uint8; InputError if it is
    damaged, empty, made of Gaussians or has positions that are not finite or too far away.
    """
    if path.suffix.lower() == ".ply" and path.is_file() and is_splat_ply(read_header(path)):
        raise InputError(f"{path} {SPLATS}")
    own = {".pcd": _read_pcd, ".ply": _read_capitals}.get(path.suffix.lower())
    cloud = own(path) if own is not None and path.is_file() else None
    if cloud is None:
        cloud = _read_geometry(path, "read_point_cloud", {".ply", ".pcd", ".xyz", ".xyzn", ".xyzrgb", ".pts"})
        if path.suffix.lower() == ".ply":
            _add_columns(cloud, path)
    if "positions" not in cloud.point or not len(cloud.point.positions):
        raise InputError(f"{path} holds no points")
    _check_positions(path, cloud.point.positions.numpy(), "remove those points first")
    _unify_colors(cloud, path)
    return cloud


def read_mesh(path: Path):  # -> o3d.t.geometry.TriangleMesh
    """Read a triangle mesh; InputError if it is damaged, empty or has vertices that are not finite or too far
    away, or triangles of other vertices.
    """
    if path.is_file() and _has_capitals(read_header(path)):
        raise InputError(f"{path} has its positions as X Y Z: name these properties of the mesh x y z")
    if path.is_file() and path.suffix.lower() == ".ply" and not num_triangles([path]):
        raise InputError(f"{path} holds no triangles")
    mesh = _read_geometry(path, "read_triangle_mesh", {".ply"})
    if "positions" not in mesh.vertex or "indices" not in mesh.triangle or not len(mesh.triangle.indices):
        raise InputError(f"{path} holds no triangles")
    import open3d as o3d

    header = read_header(path)
    exact, colors = read_positions(path, header), _mesh_colors(path, header)
    if exact is not None:  # Open3D reads float32, which has steps of half a meter at UTM size
        mesh.vertex.positions = o3d.core.Tensor(exact)
    if colors is not None:
        mesh.vertex.colors = o3d.core.Tensor(colors)
    _check_positions(path, mesh.vertex.positions.numpy(), "repair the mesh first")
    corners = mesh.triangle.indices.numpy()
    if corners.min() < 0 or corners.max() >= len(mesh.vertex.positions):
        raise InputError(f"{path} has triangles of vertices that do not exist: repair the mesh first")
    return mesh


def _read_pcd(path: Path):
    """A PCD with padding or with fields of several numbers, over which Open3D ends the process; None for any
    other.
    """
    import open3d as o3d

    header = check_pcd(path)
    if header.is_plain:
        return None
    fields = read_fields(path, header)
    if not set("xyz") <= fields.keys():
        raise InputError(f"{path} holds no points: it has no fields x, y and z")
    cloud = o3d.t.geometry.PointCloud()
    for attribute, group in (("positions", list("xyz")), ("normals", PCD_NORMALS)):
        if set(group) <= fields.keys():
            columns = np.concatenate([fields.pop(name) for name in group], axis=1)
            cloud.point[attribute] = o3d.core.Tensor(np.ascontiguousarray(columns))
    for name, values in fields.items():
        cloud.point[f"{name}_" if name in RESERVED - {"colors"} else name] = o3d.core.Tensor(
            np.ascontiguousarray(_widened(values))
        )
    return cloud


def _has_capitals(header: Header) -> bool:
    vertex = header.element("vertex")
    names = {entry.name for entry in vertex.properties} if vertex is not None else set()
    return "x" not in names and set("XYZ") <= names


def _read_capitals(path: Path):
    """A PLY whose positions are called X Y Z, which Open3D does not know; None for any other."""
    import open3d as o3d

    header = read_header(path)
    vertex = header.element("vertex")
    if vertex is None or not _has_capitals(header):
        return None
    kinds = {entry.name: entry.dtype for entry in vertex.properties if not entry.length}
    found = read_columns(path, check_ply(path), list(kinds))
    if found is None:
        raise InputError(f"{path} has its positions as X Y Z, and vertices with lists: name them x y z")
    columns = {name: column.astype(kinds[name])[:, None] for name, column in zip(kinds, found.T, strict=True)}
    cloud = o3d.t.geometry.PointCloud()
    for attribute, group in (("positions", "XYZ"), ("normals", ("NX", "NY", "NZ"))):
        if set(group) <= columns.keys():
            values = np.concatenate([columns.pop(name) for name in group], axis=1)
            cloud.point[attribute] = o3d.core.Tensor(np.ascontiguousarray(values))
    for name, values in columns.items():
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(_widened(values)))
    return cloud


def _add_columns(cloud, path: Path) -> None:
    """Give a cloud the columns of a checked PLY that Open3D passes over: those of the older names of
    types.
    """
    import open3d as o3d

    header = read_header(path)
    vertex = header.element("vertex")
    kinds = {entry.name: entry.dtype for entry in vertex.properties if not entry.length} if vertex else {}
    lists = [entry.name for entry in vertex.properties if entry.length] if vertex else []
    if lists:
        logger.warning("%s: lists of its points are left out: %s", path, examples(lists))
    known = set(cloud.point)
    for group, attribute in zip(TOGETHER, ("positions", "normals", "colors"), strict=True):
        known |= set(group) if attribute in known else set()
    missing = [name for name in kinds if name not in known]
    found = read_columns(path, header, missing) if missing else None
    for name, column in zip(missing, found.T if found is not None else (), strict=False):
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(column.astype(kinds[name])[:, None]))


def _unify_colors(cloud, path: Path) -> None:
    """Give a cloud its colors under the usual name, as (N, 3) uint8."""
    import open3d as o3d

    names = None if "colors" in cloud.point else color_names(list(cloud.point))
    if names is not None:
        columns = np.concatenate([cloud.point[name].numpy().reshape(-1, 1) for name in names], axis=1)
        for name in names:
            del cloud.point[name]
    elif "colors" in cloud.point and cloud.point.colors.dtype != o3d.core.uint8:
        columns = cloud.point.colors.numpy()
    else:
        return
    cloud.point.colors = o3d.core.Tensor(np.ascontiguousarray(to_bytes(columns, path)))


def _mesh_colors(path: Path, header: Header) -> np.ndarray | None:
    """(V, 3) float32 in [0, 1] where Open3D, which divides by 255, reads others; else None."""
    vertex = header.element("vertex")
    types = {entry.name: entry.dtype for entry in vertex.properties} if vertex is not None else {}
    names = color_names(types)
    if names is None or (names == COLORS and types["red"] == "u1"):
        return None
    found = read_columns(path, header, names)
    if found is None:
        return None
    return to_bytes(found.astype(types[names[0]]), path).astype(np.float32) / 255


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
    step = float(np.spacing(np.abs(positions).max())) if positions.dtype == np.float32 else 0.0
    if step > COARSE:
        logger.warning(
            "%s has its positions as float32, which at such coordinates has steps of %.3g: write it with doubles",
            path,
            step,
        )


def _storable(geometry):
    """The same cloud or mesh with attributes of names, types and shapes that Open3D writes to PLY and reads
    again.
    """
    import open3d as o3d

    is_cloud = isinstance(geometry, o3d.t.geometry.PointCloud)
    table = geometry.point if is_cloud else geometry.vertex
    columns: dict[str, np.ndarray] = {}
    for name in table:
        values = table[name].numpy()
        values = values.reshape(len(values), math.prod(values.shape[1:]))  # also of no rows
        if name in RESERVED:
            columns[name] = values
        elif values.shape[1] == 1:
            columns[_plain_name(name, columns)] = values
        else:
            for place, column in enumerate(values.T):
                columns[_plain_name(f"{name}_{place}", columns)] = column[:, None]
    made = o3d.t.geometry.PointCloud() if is_cloud else geometry.clone()
    target = made.point if is_cloud else made.vertex
    for name in [name for name in target if name not in columns]:
        del target[name]
    for name, values in columns.items():
        target[name] = o3d.core.Tensor(np.ascontiguousarray(_widened(values)))
    return made


def _plain_name(name: str, others: Collection[str]) -> str:
    """A name that a PLY can have, unlike the others: of letters, digits, "_", "." and "-"."""
    plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", name)[:MAX_NAME].strip("_") or "attribute"
    if plain.lower() in RESERVED | TAKEN:
        plain += "_"
    number, unique = 1, plain
    while unique in others:
        number, unique = number + 1, f"{plain}_{number + 1}"
    return unique


def _widened(values: np.ndarray) -> np.ndarray:
    """Numbers of a type that Open3D writes to PLY."""
    kind, size = values.dtype.kind, values.dtype.itemsize
    if kind == "b":
        return values.astype(np.uint8)
    if kind == "u" and size > 1 or kind == "i" and size != 4:
        fits = np.abs(values.astype(np.float64)).max(initial=0) < 2**31
        return values.astype(np.int32 if fits else np.float64)
    return values.astype(np.float32) if values.dtype == np.float16 else values


def write_geometry(path: Path, geometry) -> None:
    """Write a tensor point cloud or mesh, atomically; attributes get names, types and shapes that a PLY
    has.
    """
    import open3d as o3d

    geometry = _storable(geometry)
    is_cloud = isinstance(geometry, o3d.t.geometry.PointCloud)
    write = o3d.t.io.write_point_cloud if is_cloud else o3d.t.io.write_triangle_mesh
    with atomic_path(path) as temporary:
        if not is_cloud and not len(geometry.vertex.positions):  # Open3D refuses it
            temporary.write_bytes(NO_MESH)
            return
        if not write(str(temporary), geometry):
            raise OSError(f"could not write {path}: is the disk full?")
        try:
            check_ply(temporary)  # a disk that becomes full is not always noticed
        except InputError as error:
            raise OSError(f"could not write {path}: is the disk full? ({error})") from None
