"""The labelled cloud as 3D Tiles: one file of points per node of an octree, in a local frame (east, north, up)
that the tileset puts on the globe.

Layout: 3D Tiles 1.0 (OGC 18-053r2), point clouds (`pnts`): a feature table with positions and colors, and a
    batch table with what `exporters.laz` knows of each point, by the same names.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

import sc3d
from sc3d.exporters.copc import octree_folder, part_size
from sc3d.exporters.laz import POINTS_AT_ONCE, Survey, survey
from sc3d.exporters.octree import Node, Octree
from sc3d.exporters.projected_cloud import MapProjection, ProjectedCloud, projected_chunks
from sc3d.georeferencing.georeference import crs_to_geodetic, geodetic_to_enu
from sc3d.io.atomic import atomic_path
from sc3d.io.json_files import write_json
from sc3d.scene.labelled_cloud import is_confirmed
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export

UNIT = 0.001  # m, of the whole numbers that the octree is made of
# of a point in the batch table, widest first, so that each begins at a multiple of its size
PROPERTIES = (
    ("confidence", "<f4", "FLOAT"),
    ("num_views", "<u2", "UNSIGNED_SHORT"),
    ("classification", "u1", "UNSIGNED_BYTE"),
    ("label", "u1", "UNSIGNED_BYTE"),
    ("state", "u1", "UNSIGNED_BYTE"),
    ("synthetic", "u1", "UNSIGNED_BYTE"),
)
COLORS = ("red", "green", "blue")
HEADER = struct.Struct("<4s6I")

Box = tuple[np.ndarray, np.ndarray]  # lowest and highest position (3,), int64 UNIT


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / "3dtiles"]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/3dtiles/tileset.json` and a `.pnts` per node. Heights of the CRS are taken as those above the
    ellipsoid; without a CRS the coordinates are the scene's own, and no globe knows where they are.
    """
    found, path = survey(scene, settings), outputs(scene, settings)[0]
    frame = LocalFrame.around(found)

    def chunks() -> Iterator[np.ndarray]:
        return _records(scene, settings, found, frame)

    with atomic_path(path) as folder, octree_folder(path, found) as parts:
        folder.mkdir()
        octree, boxes = Octree.around(*_box(chunks())), dict[Node, Box]()
        for node, records in octree.nodes(chunks, parts, part_size(settings)):
            (folder / _name(node)).write_bytes(_points_file(records))
            boxes[node] = _box([records])
        write_json(folder / "tileset.json", _tileset(scene, octree, frame, boxes))
    return {"points": found.num_points, "tiles": len(boxes), **found.projection.figures()}


@dataclass(frozen=True)
class LocalFrame:
    """East, north and up of a place near the cloud, m; the exported coordinates themselves without a CRS.

    origin: latitude, longitude (degrees), height (m), WGS 84
    """

    projection: MapProjection
    origin: tuple[float, float, float] | None = None

    @classmethod
    def around(cls, found: Survey) -> LocalFrame:
        crs = found.projection.crs
        if crs is None:
            return cls(found.projection)
        latitude, longitude, height = crs_to_geodetic((found.low + found.high)[None] / 2, crs)[0].tolist()
        return cls(found.projection, (round(latitude, 6), round(longitude, 6), round(height)))

    def from_crs(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) exported coordinates to (N, 3) m."""
        if self.projection.crs is None or self.origin is None:
            return points
        return geodetic_to_enu(crs_to_geodetic(points, self.projection.crs), self.origin)

    @cached_property
    def to_earth(self) -> np.ndarray | None:
        """(4, 4) to geocentric coordinates, EPSG:4978."""
        if self.origin is None:
            return None
        import pyproj

        latitude, longitude = np.radians(self.origin[:2])
        east = np.array([-np.sin(longitude), np.cos(longitude), 0])
        up = np.array(
            [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
        )
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([east, np.cross(up, east), up], axis=1)
        matrix[:3, 3] = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(*self.origin)
        return matrix


def _records(scene: Scene, settings: Export, found: Survey, frame: LocalFrame) -> Iterator[np.ndarray]:
    for projected in projected_chunks(scene, settings):
        rows = np.flatnonzero(np.isin(projected.labels.label, found.classes))
        for start in range(0, len(rows), POINTS_AT_ONCE):
            yield _table(projected, rows[start : start + POINTS_AT_ONCE], found.codes, frame)


def _table(projected: ProjectedCloud, rows: np.ndarray, codes: np.ndarray, frame: LocalFrame) -> np.ndarray:
    """Records of the octree: positions in UNIT, colors if there are any, PROPERTIES."""
    colors, labels = projected.colors, projected.labels
    fields = [(axis, "<i4") for axis in "XYZ"] + [(name, "u1") for name in COLORS if colors is not None]
    table = np.zeros(len(rows), fields + [(name, dtype) for name, dtype, _ in PROPERTIES])
    for axis, column in zip("XYZ", np.rint(frame.from_crs(projected.points[rows]) / UNIT).T, strict=True):
        table[axis] = column
    if colors is not None:
        for name, column in zip(COLORS, colors[rows].T, strict=True):
            table[name] = column
    for name in ("confidence", "state", "label"):
        table[name] = getattr(labels, name)[rows]
    table["num_views"] = np.minimum(labels.num_views[rows], np.iinfo(np.uint16).max)
    table["classification"] = codes[labels.label[rows]]
    table["synthetic"] = ~is_confirmed(projected.cloud)[rows]
    return table


def _box(chunks: Iterable[np.ndarray]) -> Box:
    """Around all records."""
    ends = [[[end(chunk[axis]) for axis in "XYZ"] for end in (np.min, np.max)] for chunk in chunks]
    low, high = np.swapaxes(np.array(ends, np.int64), 0, 1)
    return low.min(axis=0), high.max(axis=0)


def _points_file(records: np.ndarray) -> bytes:
    """The content of a tile."""
    positions = np.stack([records[axis] for axis in "XYZ"], axis=1).astype(np.int64)
    center = np.rint(positions.mean(axis=0)).astype(np.int64)
    body = ((positions - center) * UNIT).astype("<f4").tobytes()
    features: dict[str, object] = {
        "POINTS_LENGTH": len(records),
        "RTC_CENTER": (center * UNIT).tolist(),
        "POSITION": {"byteOffset": 0},
    }
    if "red" in (records.dtype.names or ()):
        features["RGB"] = {"byteOffset": len(body)}
        body += np.stack([records[name] for name in COLORS], axis=1).tobytes()
    batch, columns = {}, b""
    for name, _, kind in PROPERTIES:
        batch[name] = {"byteOffset": len(columns), "componentType": kind, "type": "SCALAR"}
        columns += records[name].tobytes()
    # each part is a multiple of 8 bytes from the begin of the file
    parts = [_padded(json.dumps(features).encode(), b" ", HEADER.size), _padded(body, b"\0")]
    parts += [_padded(json.dumps(batch).encode(), b" "), _padded(columns, b"\0")]
    sizes = [len(part) for part in parts]
    return HEADER.pack(b"pnts", 1, HEADER.size + sum(sizes), *sizes) + b"".join(parts)


def _padded(content: bytes, filler: bytes, before: int = 0) -> bytes:
    return content + filler * (-(before + len(content)) % 8)


def _tileset(scene: Scene, octree: Octree, frame: LocalFrame, boxes: dict[Node, Box]) -> dict[str, object]:
    """boxes: of the points of each node; a tile's box holds those of its children too."""
    whole, children = dict(boxes), dict[Node, list[dict[str, object]]]()
    root: dict[str, object] = {}
    for node in sorted(boxes, reverse=True):  # children before their parents
        low, high = whole[node]
        below = children.pop(node, [])
        root = {
            "boundingVolume": {"box": _bounding_box(low, high)},
            "geometricError": octree.spacing(node.level) * UNIT if below else 0.0,
            "refine": "ADD",
            "content": {"uri": _name(node)},
        } | ({"children": below} if below else {})
        if node.level:
            above = whole[node.parent]
            whole[node.parent] = np.minimum(above[0], low), np.maximum(above[1], high)
            children.setdefault(node.parent, []).append(root)
    if frame.to_earth is not None:
        root = {"transform": frame.to_earth.T.ravel().tolist(), **root}  # by columns
    names = {str(entry.id): entry.name for entry in scene.class_table()}
    return {
        "asset": {"version": "1.0", "generator": f"sc3d {sc3d.__version__}", "extras": {"labels": names}},
        "geometricError": octree.side * UNIT,
        "root": root,
    }


def _bounding_box(low: np.ndarray, high: np.ndarray) -> list[float]:
    """Center and three half axes, m; never flat, which some programs do not take."""
    half = np.maximum(high - low, 1) * UNIT / 2
    return [*((low + high) * UNIT / 2).tolist(), *np.diag(half).ravel().tolist()]


def _name(node: Node) -> str:
    return f"{'-'.join(map(str, node))}.pnts"
