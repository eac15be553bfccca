"""A cloud file of another program for a stage that works in the scene's world: one home for every way in
which a cloud comes from outside.

`sc3d import` keeps it (`importers.frames`, `importers.clouds`), `sc3d label --cloud` needs it for one run.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.georeferencing.georeference import Georeference, read_georeference
from sc3d.importers.clouds import Geometry, read_geometry, to_open3d
from sc3d.importers.frames import frame_of, move_to_world, place_geometry, turn_to_world
from sc3d.io.chunked_clouds import CloudFile, columns, positions
from sc3d.io.clouds import write_geometry
from sc3d.io.crs import read_las_crs
from sc3d.io.las import open_las
from sc3d.io.ply import read_header, write_records
from sc3d.scene.scene import Scene
from sc3d.settings.common import Resources
from sc3d.tiling.memory import fits, num_points

logger = logging.getLogger(__name__)

BYTES = 250  # of a point while a file is read and written as a whole
PARTS = (".las", ".laz")  # can be read in parts, besides binary PLY


@contextmanager
def cloud_in_world(scene: Scene, path: Path, resources: Resources, output: Path) -> Iterator[Path]:
    """A cloud file in the world of a scene: the same one, where it is a PLY in that frame, else a PLY made
    of it beside `output`, which is there while the block runs.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist")
    count, plain = num_points(path), _is_plain(path)
    whole = count is None or fits(count * BYTES, resources)
    georeference = read_georeference(scene)
    geometry = read_geometry(path) if whole and not plain else None
    sample = geometry.positions if geometry is not None else _first(path)
    epsg = frame_of(sample, _stated(path, geometry), georeference, scene.model.views, str(path))
    if epsg is None and plain:
        yield path
        return
    target = output.absolute().with_name(f".{output.name}.cloud.ply")
    try:
        if whole:
            moved = place_geometry(geometry or read_geometry(path), epsg, georeference)
            write_geometry(target, to_open3d(replace(moved, triangles=None)))
        else:
            _write_in_parts(target, path, epsg, georeference)
        logger.info("%s is read as %s", path, "world" if epsg is None else f"EPSG:{epsg}")
        yield target
    finally:
        with suppress(FileNotFoundError):
            target.unlink()


def _is_plain(path: Path) -> bool:
    """Whether it can be read in parts as it is: a binary PLY."""
    return path.suffix.lower() == ".ply" and read_header(path).record is not None


def _first(path: Path) -> np.ndarray:
    """(K, 3) positions of the first points of a file."""
    for _, records in CloudFile.open(path).chunks():
        return positions(records)
    raise InputError(f"{path} holds no points")


def _stated(path: Path, geometry: Geometry | None) -> int | None:
    """The CRS that a file says it is in."""
    if geometry is not None:
        return geometry.epsg
    if path.suffix.lower() not in PARTS:
        return None
    with open_las(path) as reader:
        return read_las_crs(reader.header, path).epsg


def _write_in_parts(target: Path, path: Path, epsg: int | None, georeference: Georeference | None) -> None:
    cloud = CloudFile.open(path)
    if path.suffix.lower() in PARTS:
        logger.info(
            "%s does not fit into memory as a whole: its positions, colors and classes are read", path
        )
    fields = [(name, "f8" if name in ("x", "y", "z") else cloud.dtype[name].str[1:]) for name in cloud.names]
    dtype = np.dtype(fields)

    def chunks() -> Iterator[np.ndarray]:
        for _, records in cloud.chunks():
            made = np.empty(len(records), dtype)
            for name in cloud.names:
                made[name] = records[name]
            points, normals = positions(records), columns(records, ("nx", "ny", "nz"))
            for axis, column in zip("xyz", move_to_world(points, epsg, georeference).T, strict=True):
                made[axis] = column
            if normals is not None:
                turned = turn_to_world(points, normals, epsg, georeference)
                for axis, column in zip(("nx", "ny", "nz"), turned.T, strict=True):
                    made[axis] = column
            yield made

    write_records(target, chunks(), dtype, cloud.num_points, ["sc3d"])
