"""Clouds (PLY, LAS, LAZ, PCD, XYZ) and meshes (PLY, OBJ) of other programs: float64 positions, colors,
classes and whatever else they hold.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import InputError
from sc3d.io.clouds import read_cloud, read_mesh
from sc3d.io.las import check_las
from sc3d.io.ply import read_header

if TYPE_CHECKING:
    import laspy
    import open3d as o3d

CLOUDS = {".ply", ".las", ".laz", ".pcd", ".xyz", ".xyzn", ".xyzrgb", ".pts", ".txt", ".csv", ".asc"}
MESHES = {".ply", ".obj"}
# as PDAL and CloudCompare name it
CLASSIFICATION = ("classification", "scalar_Classification", "scalar_classification", "Classification")
LAS_EXTRAS = ("intensity", "return_number", "number_of_returns")


@dataclass(frozen=True)
class Geometry:
    """A cloud or mesh as it was read. triangles: None for a cloud; attributes: (N, 1) or (N, K) per point;
    epsg: of its CRS, None = not stated.
    """

    positions: np.ndarray
    colors: np.ndarray | None
    attributes: dict[str, np.ndarray]
    triangles: np.ndarray | None = None
    epsg: int | None = None


def read_geometry(path: Path) -> Geometry:
    """Read a cloud or mesh; the suffix tells the format, the content of a PLY what it is. InputError for
    anything else.
    """
    suffix = path.suffix.lower()
    if not path.is_file():
        raise InputError(f"{path} does not exist")
    if suffix in (".las", ".laz"):
        found = _read_las(path)
    elif is_mesh(path):
        found = _read_obj(path) if suffix == ".obj" else _read_ply_mesh(path)
    elif suffix in (".ply", ".pcd"):
        found = _read_open3d(path)
    elif suffix in CLOUDS:
        found = _read_text(path)
    else:
        raise InputError(f"{path}: {', '.join(sorted(CLOUDS | MESHES))} can be read")
    if not len(found.positions):
        raise InputError(f"{path} holds no points")
    if not np.isfinite(found.positions).all():
        raise InputError(f"{path} has positions that are not finite numbers: remove those points first")
    return found


def to_open3d(geometry: Geometry) -> o3d.t.geometry.PointCloud | o3d.t.geometry.TriangleMesh:
    """The geometry as an Open3D tensor cloud or mesh."""
    import open3d as o3d

    tensor = o3d.core.Tensor
    if geometry.triangles is None:
        made = o3d.t.geometry.PointCloud(tensor(np.ascontiguousarray(geometry.positions, np.float64)))
        table = made.point
    else:
        made = o3d.t.geometry.TriangleMesh(
            tensor(np.ascontiguousarray(geometry.positions, np.float64)),
            tensor(np.ascontiguousarray(geometry.triangles, np.int32)),
        )
        table = made.vertex
    if geometry.colors is not None:
        # Open3D writes the colors of a mesh right only as floats
        table.colors = tensor(
            np.ascontiguousarray(
                geometry.colors if geometry.triangles is None else geometry.colors.astype(np.float32) / 255
            )
        )
    for name, values in geometry.attributes.items():
        table[name] = tensor(np.ascontiguousarray(values.reshape(len(values), -1)))
    return made


def _read_las(path: Path) -> Geometry:
    import laspy

    check_las(path)
    try:
        # not laszip, which ends the process for broken files
        file = laspy.read(path, laz_backend=(laspy.LazBackend.LazrsParallel, laspy.LazBackend.Lazrs))
        return _las_geometry(file, path)
    except (KeyboardInterrupt, InputError):
        raise
    # laspy raises many kinds for broken files; a panic of lazrs is no Exception
    except BaseException as error:
        raise InputError(
            f"cannot read {path}: {str(error).splitlines()[0] if str(error) else type(error).__name__}"
        ) from None


def _las_geometry(file: laspy.LasData, path: Path) -> Geometry:
    names = set(file.point_format.dimension_names)
    attributes = {"classification": np.asarray(file.classification, np.uint8)}
    attributes |= {
        name: np.asarray(file[name]) for name in LAS_EXTRAS if name in names and np.any(file[name])
    }
    attributes |= {name: np.asarray(file[name]) for name in file.point_format.extra_dimension_names}
    colors = None
    if {"red", "green", "blue"} <= names:
        colors = np.stack([np.asarray(file[name]) for name in ("red", "green", "blue")], axis=1)
        colors = (colors >> 8 if colors.max(initial=0) > 255 else colors).astype(np.uint8)
    return Geometry(
        np.asarray(file.xyz, np.float64),
        colors,
        {name: _storable(values) for name, values in attributes.items()},
        epsg=_las_epsg(file.header, path),
    )


def _las_epsg(header: laspy.LasHeader, path: Path) -> int | None:
    """EPSG code of the horizontal CRS in a LAS header."""
    import pyproj

    try:
        crs = header.parse_crs()
    except (pyproj.exceptions.CRSError, ValueError, IndexError):
        return None
    if crs is None:
        return None
    crs = crs.sub_crs_list[0] if crs.is_compound else crs
    if crs.is_geographic:
        raise InputError(f"{path} is in {crs.name}, in degrees: convert it to a projected CRS first")
    return crs.to_epsg()


def _read_open3d(path: Path) -> Geometry:
    cloud = read_cloud(path)
    table = {name: values.numpy() for name, values in cloud.point.items()}
    colors = table.pop("colors", None)
    positions = table.pop("positions")
    if colors is not None and colors.dtype != np.uint8:
        colors = np.clip(np.rint(colors * 255), 0, 255).astype(np.uint8)
    return Geometry(
        positions.astype(np.float64),
        colors,
        _classified({name: _storable(values) for name, values in table.items()}),
    )


def _read_ply_mesh(path: Path) -> Geometry:
    """A PLY mesh with Open3D's older reader, which keeps float64; further attributes of the vertices are
    lost.
    """
    import open3d as o3d

    read_mesh(path)  # checks that it is whole
    mesh = o3d.io.read_triangle_mesh(str(path))
    colors = (
        np.rint(np.asarray(mesh.vertex_colors) * 255).astype(np.uint8) if mesh.has_vertex_colors() else None
    )
    return Geometry(np.asarray(mesh.vertices), colors, {}, np.asarray(mesh.triangles))


def _read_obj(path: Path) -> Geometry:
    """Vertices (with colors behind the position, if there) and faces as triangles; texture is not used.
    Open3D's reader would round to float32.
    """
    vertices, faces = [], []
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            for line in file:
                if line.startswith("v "):
                    vertices.append([float(word) for word in line.split()[1:]])
                elif line.startswith("f "):
                    corners = [int(word.split("/")[0]) for word in line.split()[1:]]
                    corners = [corner - 1 if corner > 0 else len(vertices) + corner for corner in corners]
                    faces += [
                        [corners[0], corners[place], corners[place + 1]]
                        for place in range(1, len(corners) - 1)
                    ]
        table, triangles = np.array(vertices, np.float64), np.array(faces, np.int64).reshape(-1, 3)
    except (ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{path} cannot be read as OBJ: {error}") from None
    if not len(triangles) or triangles.min() < 0 or triangles.max() >= len(table):
        raise InputError(f"{path} holds no triangles, or triangles of vertices that it does not hold")
    colors = table[:, 3:6] if table.shape[1] >= 6 else None
    colors = (
        None
        if colors is None
        else np.clip(np.rint(colors * (255 if colors.max() <= 1 else 1)), 0, 255).astype(np.uint8)
    )
    return Geometry(table[:, :3], colors, {}, triangles)


def _read_text(path: Path) -> Geometry:
    """x y z per line, then colors (three whole numbers up to 255) or normals; separated by blanks, commas,
    semicolons or tabs; a header is skipped.
    """
    rows = []
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            words = line.replace(",", " ").replace(";", " ").split()
            if not words or words[0].startswith(("#", "//")):
                continue
            try:
                rows.append([float(word) for word in words])
            except ValueError:
                if rows:
                    raise InputError(
                        f"{path}, line {number}: numbers are expected, not {line.strip()[:60]!r}"
                    ) from None
    width = len(rows[-1]) if rows else 0
    # PTS starts with the number of points
    rows = [row for row in rows if len(row) == width] if rows and len(rows[0]) == 1 else rows
    if width < 3 or any(len(row) != width for row in rows):
        raise InputError(f"{path}: x y z [r g b] with as many numbers in every line are expected")
    table = np.array(rows)
    # PTS has the intensity in front of the colors
    offset = 4 if path.suffix.lower() == ".pts" and width == 7 else 3
    rest = table[:, offset : offset + 3]
    colored = (
        rest.shape[1] == 3 and (rest >= 0).all() and (rest <= 255).all() and (rest == np.rint(rest)).all()
    )
    normals = rest.shape[1] == 3 and not colored and np.allclose(np.linalg.norm(rest, axis=1), 1, atol=0.05)
    return Geometry(
        table[:, :3],
        rest.astype(np.uint8) if colored else None,
        {"normals": rest.astype(np.float32)} if normals else {},
    )


def is_mesh(path: Path) -> bool:
    """Whether a file that can be read is a mesh; a PLY tells by its header."""
    return path.suffix.lower() == ".obj" or (
        path.suffix.lower() == ".ply" and path.is_file() and has_faces(path)
    )


def has_faces(path: Path) -> bool:
    """Whether a PLY announces faces."""
    face = None
    with suppress(InputError):  # is told when it is read
        face = read_header(path).element("face")
    return face is not None and face.rows > 0


def _classified(attributes: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same attributes, with the class under the name `classification` as uint8."""
    for name in CLASSIFICATION:
        if name in attributes:
            values = attributes.pop(name)
            return attributes | {"classification": np.clip(np.rint(values), 0, 255).astype(np.uint8)}
    return attributes


def _storable(values: np.ndarray) -> np.ndarray:
    """Numbers of a type that Open3D writes to PLY."""
    if values.dtype == bool:
        return values.astype(np.uint8)
    if (
        values.dtype.kind == "u"
        and values.dtype.itemsize > 1
        or values.dtype.kind == "i"
        and values.dtype.itemsize > 4
    ):
        return values.astype(np.int32 if values.max(initial=0) < 2**31 else np.float64)
    return values.astype(np.float32) if values.dtype == np.float16 else values
