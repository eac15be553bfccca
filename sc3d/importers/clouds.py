"""Clouds (PLY, LAS, LAZ, E57, PCD, XYZ) and meshes (PLY, OBJ) of other programs: float64 positions, colors,
classes and whatever else they hold.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import InputError, examples
from sc3d.io.clouds import read_cloud, read_mesh
from sc3d.io.colors import COLORS, color_names, to_bytes
from sc3d.io.crs import read_las_crs
from sc3d.io.e57 import read_e57
from sc3d.io.las import open_las, warn_of_spare
from sc3d.io.ply import RESERVED, read_header
from sc3d.io.splats import OTHER_FORMATS, SPLATS
from sc3d.io.text_clouds import DEGREES, axes_of, read_table

if TYPE_CHECKING:
    import laspy
    import open3d as o3d

logger = logging.getLogger(__name__)

CLOUDS = {".ply", ".las", ".laz", ".e57", ".pcd", ".xyz", ".xyzn", ".xyzrgb", ".pts", ".txt", ".csv", ".asc"}
MESHES = {".ply", ".obj"}
# clouds and meshes that are refused by name
UNREAD = {
    ".ptx",
    ".rcp",
    ".rcs",
    ".fls",
    ".stl",
    ".glb",
    ".gltf",
    ".fbx",
    ".dae",
    ".off",
} | OTHER_FORMATS
# as PDAL and CloudCompare name it
CLASSIFICATION = ("classification", "scalar_Classification", "scalar_classification", "Classification")
# as CloudCompare and PDAL name them in LAS, and PCL in PCD
NORMALS = (
    ("NormalX", "NormalY", "NormalZ"),
    ("normalx", "normaly", "normalz"),
    ("nx", "ny", "nz"),
    ("normal_x", "normal_y", "normal_z"),
)
# of columns without names: points that tell by correlation, by which it differs; else mean differences
FEW, UNLIKE, RATIO = 10, 0.3, 4.0
UNIT = 1e-3  # by which lengths of normals differ from 1 that are left as they are
# kept where a file makes use of them
LAS_EXTRAS = (
    "intensity",
    "return_number",
    "number_of_returns",
    "gps_time",
    "user_data",
    "point_source_id",
    "scan_angle",
    "scan_angle_rank",
    "nir",
    "synthetic",
    "key_point",
    "withheld",
    "overlap",
    "scanner_channel",
    "scan_direction_flag",
    "edge_of_flight_line",
)


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
    elif suffix == ".e57":
        found = _read_e57(path)
    elif is_mesh(path):
        found = _read_obj(path) if suffix == ".obj" else _read_ply_mesh(path)
    elif suffix in (".ply", ".pcd"):
        found = _read_open3d(path)
    elif suffix in CLOUDS:
        found = _read_text(path)
    elif suffix in OTHER_FORMATS:
        raise InputError(f"{path} {SPLATS}")
    else:
        raise InputError(
            f"{path}: {', '.join(sorted(CLOUDS | MESHES))} can be read: save it as LAS, LAZ or PLY (meshes: PLY or OBJ)"
        )
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
        columns = np.ascontiguousarray(values.reshape(len(values), -1))
        if name not in RESERVED:
            table[name] = tensor(columns)
        elif name == "normals" and columns.shape[1] == 3:
            table.normals = tensor(columns)
        else:  # not what Open3D means by it
            table[f"{name}_"] = tensor(columns)
    return made


def _read_las(path: Path) -> Geometry:
    warn_of_spare(path)
    with open_las(path) as reader:
        return _las_geometry(reader.read(), path)


def _las_geometry(file: laspy.LasData, path: Path) -> Geometry:
    names = set(file.point_format.dimension_names)
    attributes = {"classification": np.asarray(file.classification, np.uint8)}
    attributes |= {
        name: np.asarray(file[name]) for name in LAS_EXTRAS if name in names and np.any(file[name])
    }
    attributes |= {name: np.asarray(file[name]) for name in file.point_format.extra_dimension_names}
    colors = None
    if {"red", "green", "blue"} <= names:
        colors = to_bytes(np.stack([np.asarray(file[name]) for name in COLORS], axis=1), path)
    _warn_of_withheld(attributes, path)
    crs = read_las_crs(file.header, path)
    positions = np.asarray(file.xyz, np.float64)
    positions[:, 2] *= crs.height_scale
    return Geometry(positions, colors, _with_normals(attributes), epsg=crs.epsg)


def _read_e57(path: Path) -> Geometry:
    cloud = read_e57(path)
    attributes = {"scan": cloud.scan} if cloud.scan.any() else {}
    attributes |= {"intensity": cloud.intensity} if cloud.intensity is not None else {}
    return Geometry(cloud.positions, cloud.colors, attributes, epsg=cloud.crs.epsg)


def _warn_of_withheld(attributes: dict[str, np.ndarray], path: Path) -> None:
    withheld = attributes.get("withheld")
    if withheld is not None:
        logger.warning(
            "%s: %d of %d points are marked as withheld, which others take for deleted; they are kept, with the mark as"
            " the column withheld",
            path,
            np.count_nonzero(withheld),
            len(withheld),
        )


def _with_normals(attributes: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same attributes, with normals in three of them under their usual name, of length 1."""
    attributes = dict(attributes)
    for names in NORMALS:
        if set(names) <= attributes.keys() and "normals" not in attributes:
            columns = [attributes.pop(name).reshape(-1) for name in names]
            attributes["normals"] = np.stack(columns, axis=1).astype(np.float32)
    if "normals" in attributes and attributes["normals"].shape[1:] == (3,):
        attributes["normals"] = _of_length_1(attributes["normals"])
    return attributes


def _of_length_1(normals: np.ndarray) -> np.ndarray:
    """(N, 3) normals, those of another length than 0 or about 1 made so."""
    length = np.linalg.norm(normals.astype(np.float64), axis=1)
    other = np.isfinite(length) & (length > 0) & (np.abs(length - 1) > UNIT)
    if not other.any():
        return normals
    made = normals.astype(np.float32)
    made[other] = (normals[other] / length[other, None]).astype(np.float32)
    return made


def _read_open3d(path: Path) -> Geometry:
    cloud = read_cloud(path)
    table = {name: values.numpy() for name, values in cloud.point.items()}
    colors = table.pop("colors", None)
    positions = table.pop("positions")
    return Geometry(
        positions.astype(np.float64),
        colors,
        _with_normals(_classified(table, path)),
    )


def _read_ply_mesh(path: Path) -> Geometry:
    """Further attributes of the vertices are lost."""
    mesh = read_mesh(path)
    colors = to_bytes(mesh.vertex.colors.numpy(), path) if "colors" in mesh.vertex else None
    return Geometry(
        mesh.vertex.positions.numpy().astype(np.float64), colors, {}, mesh.triangle.indices.numpy()
    )


def _read_obj(path: Path) -> Geometry:
    """Vertices (with colors behind the position, if there) and faces as triangles; texture is not used.
    Open3D's reader would round to float32.
    """
    vertices, faces = [], []
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            for kind, *words in _obj_lines(file):
                if kind == "v":
                    vertices.append([float(word) for word in words])
                elif kind == "f":
                    corners = [int(word.split("/")[0]) for word in words]
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
    colors = to_bytes(table[:, 3:6], path) if table.shape[1] >= 6 else None
    return Geometry(table[:, :3], colors, {}, triangles)


def _obj_lines(file: Iterable[str]) -> Iterator[list[str]]:
    """Words of each line, without comments; a backslash at the end continues a line."""
    before = ""
    for line in file:
        line = before + line.partition("#")[0].rstrip()
        if line.endswith("\\"):
            before = line[:-1] + " "
            continue
        before = ""
        if words := line.split():
            yield words


def _read_text(path: Path) -> Geometry:
    """A cloud as text (`io.text_clouds`), by its header, or x y z and then colors or normals, by their
    values.
    """
    names, table = read_table(path)
    axes = axes_of(names)
    if names and not all(axes):
        _require_plain_order(path, names, axes)
    if all(axes):
        columns = dict(zip(names, table.T, strict=True))
    else:
        columns, axes = _unnamed(path, table), list("xyz")
    positions = np.stack([columns.pop(axis) for axis in axes], axis=1)
    found = color_names(columns)
    colors = None if found is None else np.stack([columns.pop(name) for name in found], axis=1)
    if colors is not None:
        are_whole = np.nanmax(colors, initial=0) > 1 and bool((colors == np.rint(colors)).all())
        colors = to_bytes(colors.astype(np.int64) if are_whole else colors, path)
    return Geometry(positions, colors, _with_normals(_classified(columns, path)))


def _require_plain_order(path: Path, names: list[str], axes: list[str]) -> None:
    """A warning that the first three columns are taken; InputError if their names say otherwise, or say
    nothing where there are more than three.
    """
    told = f"{path}: its header ({examples(names, 8)}) names no x, y and z"
    if DEGREES & set(names):
        raise InputError(f"{told}, but degrees: convert it to a projected CRS first")
    in_place = [not axis or names.index(axis) == place for place, axis in enumerate(axes)]
    if not all(in_place) or len(names) > 3 and not any(axes):
        raise InputError(f"{told}: name those columns x y z")
    logger.warning("%s: the first three columns are taken", told)


def _unnamed(path: Path, table: np.ndarray) -> dict[str, np.ndarray]:
    """Columns by what their values look like, or by the suffix: x y z, then colors and normals in threes,
    and others between them, which are left out.
    """
    columns = dict(zip("xyz", table[:, :3].T, strict=True))
    given = {".xyzn": NORMALS[2], ".xyzrgb": COLORS}.get(path.suffix.lower())
    # PTS has the intensity in front of the colors, if it has one
    with_intensity = path.suffix.lower() == ".pts" and table.shape[1] >= 7 and table.shape[1] % 3 != 0
    place = 4 if with_intensity else 3
    while place + 3 <= table.shape[1]:
        part = table[:, place : place + 3]
        names = given if given is not None and given[0] not in columns else _kind(part)
        if names == COLORS and given is None and _intensity_first(path, table, place):
            place += 1
            continue
        if names is None or names[0] in columns:
            place += 1
            continue
        columns |= dict(zip(names, part.T, strict=True))
        place += 3
    if len(columns) < table.shape[1]:
        logger.warning(
            "%s: %d of its %d columns have no names and are left out",
            path,
            table.shape[1] - len(columns),
            table.shape[1],
        )
    return columns


def _intensity_first(path: Path, table: np.ndarray, place: int) -> bool:
    """Whether the first of four columns that may be colors is none, as it goes with its neighbor far less
    than the last with its own; a warning where nothing tells.
    """
    four = table[:, place : place + 4]
    rest = table.shape[1] - place
    if path.suffix.lower() == ".pts" or rest % 3 == 0 or four.shape[1] < 4 or _kind(four[:, 1:]) != COLORS:
        return False
    if len(four) >= FEW and (np.ptp(four, axis=0) > 0).all():
        likeness = np.corrcoef(four.T)
        first, last = likeness[0, 1], likeness[3, 2]
        is_first, is_last = first < last - UNLIKE, last < first - UNLIKE
    else:
        first, last = (np.abs(four[:, a] - four[:, b]).mean() for a, b in ((0, 1), (3, 2)))
        is_first, is_last = first > RATIO * last, last > RATIO * first
    if not is_last:
        logger.warning(
            "%s: its columns may be r g b and another one, or the other way round; columns %d to %d are taken as the"
            " colors: give it a header (x y z intensity r g b)",
            path,
            place + 1 + is_first,
            place + 3 + is_first,
        )
    return bool(is_first)


def _kind(part: np.ndarray) -> tuple[str, str, str] | None:
    """Names of three columns (N, 3): normals, colors or None."""
    whole, low, high = bool((part == np.rint(part)).all()), part.min(), part.max()
    if (not whole or low < 0) and np.allclose(np.linalg.norm(part, axis=1), 1, atol=0.05):
        return NORMALS[2]
    if low >= 0 and (high <= 1 or whole and high <= 65535):
        return COLORS
    return None


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


def _classified(attributes: dict[str, np.ndarray], path: Path) -> dict[str, np.ndarray]:
    """The same attributes, with the class under the name `classification` as uint8; 0 and a warning for
    what is no class from 0 to 255.
    """
    for name in CLASSIFICATION:
        if name in attributes:
            values = attributes.pop(name)
            return attributes | {"classification": _as_classes(values, path)}
    return attributes


def _as_classes(values: np.ndarray, path: Path) -> np.ndarray:
    numbers = np.nan_to_num(values.astype(np.float64), nan=-1.0)
    wrong = (numbers != np.rint(numbers)) | (numbers < 0) | (numbers > 255)
    if wrong.any():
        logger.warning(
            "%s: %d of %d points have a classification that is no whole number from 0 to 255 (%s): they get 0",
            path,
            np.count_nonzero(wrong),
            len(values),
            examples([f"{value:g}" for value in np.unique(values[wrong])]),
        )
    return np.where(wrong, 0, numbers).astype(np.uint8)
