"""The labelled cloud as COPC: LAZ 1.4 whose chunks are the nodes of an octree, so that programs read what they
show, over the network too. Points have what `exporters.laz` gives them.

Layout: COPC 1.0, https://copc.io: the info VLR (160 bytes) first, LAZ chunks of any size, the hierarchy (32
    bytes per node) as an EVLR.
"""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import laspy
import lazrs
import numpy as np

from sc3d.exporters.laz import Survey, records, survey
from sc3d.exporters.octree import BYTES, Node, Octree
from sc3d.io.atomic import atomic_path, require_room, temporary_name
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export
from sc3d.tiling.memory import max_points

# center, half side, spacing; place and size of the hierarchy; GPS times; reserved
INFO = struct.Struct("<5d2Q2d88x")
ENTRY = struct.Struct("<4iQ2i")  # level, x, y, z; place, bytes and points of a chunk
EVLR = struct.Struct("<2x16sHQ32s")
LARGEST_PART = 2_000_000  # points that are worked on at a time, where the memory allows


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / "labelled.copc.laz"]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/labelled.copc.laz`, with the same points as `labelled.laz`."""
    found, path = survey(scene, settings), outputs(scene, settings)[0]

    def chunks() -> Iterator[np.ndarray]:
        return (record.array for record in records(scene, settings, found))

    octree = Octree.around(*found.whole_box())
    with atomic_path(path) as temporary, temporary.open("wb+") as file, octree_folder(path, found) as folder:
        counts = _write(file, found, octree, octree.nodes(chunks, folder, part_size(settings)))
    return {**found.figures(), "nodes": len(counts), "levels": 1 + max(node.level for node in counts)}


@contextmanager
def octree_folder(path: Path, found: Survey) -> Iterator[Path]:
    """An empty folder beside an output for the cloud in parts; OSError if there is no room for it."""
    require_room(path, 3 * found.num_points * found.header.point_format.size // 2)
    with tempfile.TemporaryDirectory(prefix=temporary_name("octree"), dir=path.parent) as folder:
        yield Path(folder)


def part_size(settings: Export) -> int:
    """Points of an octree that are worked on at a time."""
    return min(LARGEST_PART, max_points(settings, BYTES))


def _write(
    file: IO[bytes], found: Survey, octree: Octree, nodes: Iterator[tuple[Node, np.ndarray]]
) -> dict[Node, int]:
    """Points of each node, in the order of the file."""
    header = found.header
    laszip = lazrs.LazVlr.new_for_compression(
        header.point_format.id, header.point_format.num_extra_bytes, use_variable_size_chunks=True
    )
    info = laspy.VLR("copc", 1, "COPC info", bytes(INFO.size))
    header.vlrs.insert(0, info)
    header.vlrs.append(laspy.vlrs.known.LasZipVlr(laszip.record_data()))
    header.are_points_compressed = True
    header.point_count = header.number_of_points_by_return[0] = found.num_points
    header.mins, header.maxs = (end * header.scales + header.offsets for end in found.whole_box())
    header.write_to(file)
    compressor, counts = lazrs.LasZipCompressor(file, laszip), dict[Node, int]()
    for node, points in nodes:
        if counts:
            compressor.finish_current_chunk()  # not the last, which `done` ends
        compressor.compress_many(points.tobytes())
        counts[node] = len(points)
    compressor.done()
    file.seek(header.offset_to_point_data)
    table = lazrs.read_chunk_table(file, laszip)
    file.seek(0, 2)
    hierarchy = _hierarchy(counts, table, header.offset_to_point_data + 8)
    header.start_of_first_evlr, header.number_of_evlrs = file.tell(), 1
    file.write(EVLR.pack(b"copc", 1000, len(hierarchy), b"COPC hierarchy"))
    info.record_data = _info(found, octree, file.tell(), len(hierarchy))
    file.write(hierarchy)
    file.seek(0)
    header.write_to(file, ensure_same_size=True)
    return counts


def _info(found: Survey, octree: Octree, place: int, size: int) -> bytes:
    """place, size: of the hierarchy, bytes."""
    scales, offsets = found.header.scales, found.header.offsets
    half = octree.side * scales[0] / 2
    center = octree.low * scales + offsets + half
    return INFO.pack(*center, half, octree.spacing(0) * scales[0], place, size, 0.0, 0.0)


def _hierarchy(counts: dict[Node, int], table: list[tuple[int, int]], start: int) -> bytes:
    """One page with all nodes. table: points and bytes of the chunks; start: of the first, bytes"""
    entries = []
    for (node, count), (_, size) in zip(counts.items(), table, strict=True):
        entries.append(ENTRY.pack(*node, start, size, count))
        start += size
    return b"".join(entries)
