"""LAS and LAZ files: are header, records and compressed chunks where the counts say?

laspy reads as many records as are announced, whether they are there or not, and lazrs ends the process where
a size leads to more memory than there is; it does not know points that are compressed as one stream, without
chunks, as LASzip did at first.
Layout: ASPRS LAS 1.4 R15; LASzip's VLR and layered chunks as in https://github.com/LASzip/LASzip (laszip_dll,
    lasreadpoint).
"""

from __future__ import annotations

import io
import logging
import math
import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from sc3d.errors import InputError
from sc3d.io.limits import DamagedFileError

if TYPE_CHECKING:
    import laspy

logger = logging.getLogger(__name__)

HEADER, HEADER_14 = 227, 375  # bytes, of versions up to 1.2 and of 1.4
VLR, EVLR = 54, 60  # bytes of the header of a record
POINT_SIZES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)  # bytes, smallest possible per point format
COLORED = (2, 3, 5, 7, 8, 10)  # point formats that have red, green and blue
LASZIP = (b"laszip encoded\0\0", 22204)
# bytes per type of item; 0 and 14 are bytes of any number
ITEM_SIZES = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # per type of item; bytes have one each
STREAM, POINTWISE, LAYERED = 1, 2, 3  # kinds of compression: all points in one, in chunks, by layers
RATIO, SLACK = 300, 1 << 20  # LAZ that claims to expand by more is refused: surveys come to 5 or 20
# points of a chunk that says its number itself; bytes of a chunk larger than its file
VARIABLE, LARGEST_CHUNK = 2**32 - 1, 64 << 20
STREAMED = -1  # the chunk table's position is at the end of the file


class LasHeader(NamedTuple):
    """size: bytes, then num_vlrs records up to `offset`, where the points begin; form: point format, 128 more
    if they are compressed; record: bytes of a point; evlrs: position and number of extended records;
    stream: where LASzip's record begins, if the points are compressed without chunks, else 0; spare: points
    more than are counted for which there is room, if they are not compressed.
    """

    size: int
    offset: int
    num_vlrs: int
    form: int
    record: int
    num_points: int
    evlrs: tuple[int, int]
    stream: int = 0
    spare: int = 0

    @property
    def has_colors(self) -> bool:
        return self.form & 63 in COLORED


def check_las(path: Path) -> LasHeader:
    """The header; InputError unless a LAS or LAZ file holds what it announces."""
    if not path.is_file():
        raise InputError(f"{path} is missing")
    if path.stat().st_size < HEADER:
        raise InputError(f"{path} is not a LAS file: it is shorter than a header")
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        try:
            return _check(data)
        except (DamagedFileError, struct.error) as error:
            what = str(error) if isinstance(error, DamagedFileError) else "is cut off"
            raise InputError(f"cannot read {path}: it {what}; write or copy it again") from None


def warn_of_spare(path: Path) -> LasHeader:
    """The header of a checked LAS; a warning if there are more points than it counts."""
    header = check_las(path)
    if header.spare:
        logger.warning(
            "%s: its header counts %d points, but there is room for %d more behind them, which are not read: write it again if they are points",
            path,
            header.num_points,
            header.spare,
        )
    return header


@contextmanager
def open_las(path: Path) -> Iterator[laspy.LasReader]:
    """A reader of a LAS or LAZ file that is checked before; InputError for whatever is wrong with it, also
    while it is read.
    """
    import laspy

    header = check_las(path)
    try:
        source = io.BytesIO(_in_one_chunk(path.read_bytes(), header)) if header.stream else path
        # not laszip, which ends the process for broken files
        backends = (laspy.LazBackend.LazrsParallel, laspy.LazBackend.Lazrs)
        with laspy.open(source, laz_backend=backends) as reader:
            yield reader
    except (KeyboardInterrupt, SystemExit, GeneratorExit, InputError):
        raise
    # laspy raises many kinds for broken files; a panic of lazrs is no Exception
    except BaseException as error:
        what = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"cannot read {path}: {what}; write or copy it again") from None


def _in_one_chunk(content: bytes, header: LasHeader) -> bytes:
    """The same file with its stream of points as one chunk, which is coded alike: lazrs reads chunks only."""
    import lazrs

    head, points = bytearray(content[: header.offset]), content[header.offset :]
    struct.pack_into("<H", head, header.stream, POINTWISE)
    struct.pack_into("<I", head, header.stream + 12, max(header.num_points, 1))
    items = struct.unpack_from("<H", head, header.stream + 32)[0]
    record = bytes(head[header.stream : header.stream + 34 + 6 * items])
    table = io.BytesIO()
    lazrs.write_chunk_table(table, [(header.num_points, len(points))], lazrs.LazVlr(record))
    start = struct.pack("<q", header.offset + 8 + len(points))
    return bytes(head) + start + points + table.getvalue()


def _check(data: mmap.mmap) -> LasHeader:
    header = _read_header(data)
    laszip = _walk_vlrs(data, header)
    _walk_evlrs(data, *header.evlrs)
    room = len(data) - header.offset
    if header.form < 128:
        return header._replace(spare=_spare(data, header))
    if header.num_points * header.record > RATIO * room + SLACK:
        raise DamagedFileError(
            f"announces {header.num_points} points in {room} compressed bytes, which cannot be"
        )
    if laszip is None:
        raise DamagedFileError("is compressed, but does not say how")
    if struct.unpack_from("<H", data, laszip)[0] == STREAM:
        _check_items(data, header, laszip)
        return header._replace(stream=laszip)
    if header.num_points:
        _check_chunks(data, header, laszip)
    return header


def _spare(data: mmap.mmap, header: LasHeader) -> int:
    """Points more than are counted that fit between the first and what follows the last."""
    room = len(data) - header.offset
    if header.num_points * header.record > room:
        raise DamagedFileError(
            f"announces {header.num_points} points of {header.record} bytes, {room} bytes are there"
        )
    waveforms = struct.unpack_from("<Q", data, 227)[0] if data[25] >= 3 and len(data) >= 235 else 0
    ends = [start for start in (header.evlrs[0] * bool(header.evlrs[1]), waveforms) if start > header.offset]
    spare = (min([*ends, len(data)]) - header.offset) // header.record - header.num_points
    if spare > 0 and not header.num_points:
        raise DamagedFileError(
            f"counts 0 points in its header, but has room for {spare}: its writer did not finish it"
        )
    return max(spare, 0)


def _read_header(data: mmap.mmap) -> LasHeader:
    if data[:4] != b"LASF":
        raise DamagedFileError("is not a LAS file")
    minor = data[25]
    size, offset, num_vlrs, form, record, count = struct.unpack_from("<HIIBHI", data, 94)
    evlrs = (0, 0)
    if minor >= 4:
        older = count
        start, number, count = struct.unpack_from("<QIQ", data, 235)
        evlrs = (start, number)
        if older and not count:
            raise DamagedFileError(
                f"counts 0 points in the header of version 1.{minor}, but {older} in its older field"
            )
    if size < (HEADER_14 if minor >= 4 else HEADER) or not size <= offset <= len(data):
        raise DamagedFileError("has a header of an impossible size")
    if form & 63 >= len(POINT_SIZES) or record < POINT_SIZES[form & 63]:
        raise DamagedFileError(f"has points of an impossible format ({form & 63}, {record} bytes)")
    scales = struct.unpack_from("<6d", data, 131)
    if not all(math.isfinite(value) for value in scales) or not all(scales[:3]):
        raise DamagedFileError(
            f"has a scale of 0, or none that is finite ({scales[0]:g} {scales[1]:g} {scales[2]:g})"
        )
    return LasHeader(size, offset, num_vlrs, form, record, count, evlrs)


def _walk_vlrs(data: mmap.mmap, header: LasHeader) -> int | None:
    """Where the content of LASzip's record begins, if there is one."""
    position, found = header.size, None
    if header.num_vlrs * VLR > header.offset - header.size:
        raise DamagedFileError(f"announces {header.num_vlrs} records in {header.offset - header.size} bytes")
    for _ in range(header.num_vlrs):
        user, number, length = struct.unpack_from("<16sHH", data, position + 2)
        position += VLR + length
        if position > header.offset:
            raise DamagedFileError("has a record that reaches into the points")
        if (user, number) == LASZIP:
            found = position - length
    return found


def _walk_evlrs(data: mmap.mmap, position: int, count: int) -> None:
    if count and (position < HEADER_14 or count * EVLR > len(data) - position):
        raise DamagedFileError(f"announces {count} extended records that are not there")
    for _ in range(count):
        position += EVLR + struct.unpack_from("<Q", data, position + 20)[0]
        if position > len(data):
            raise DamagedFileError("has an extended record that is cut off")


def _check_items(data: mmap.mmap, header: LasHeader, laszip: int) -> list[tuple[int, int, int]]:
    """What LASzip's record says that a point is made of: type, bytes and version of each item."""
    num_items = struct.unpack_from("<H", data, laszip + 32)[0]
    items = [struct.unpack_from("<HHH", data, laszip + 34 + 6 * row) for row in range(num_items)]
    if sum(size for _, size, _ in items) != header.record or any(
        ITEM_SIZES.get(item, size if item in (0, 14) else 0) != size for item, size, _ in items
    ):
        raise DamagedFileError("has points that are compressed in an unknown way")
    return items


def _check_chunks(data: mmap.mmap, header: LasHeader, laszip: int) -> None:
    kind, chunk = struct.unpack_from("<H10xI", data, laszip)
    one_size = chunk != VARIABLE
    if (
        not one_size
        and kind != LAYERED
        or one_size
        and not 0 < chunk * header.record <= max(LARGEST_CHUNK, header.num_points * header.record)
    ):
        raise DamagedFileError(f"has compressed chunks of {chunk} points, which cannot be")
    if kind not in (POINTWISE, LAYERED):
        raise DamagedFileError("has points that are compressed in an unknown way")
    items = _check_items(data, header, laszip)
    table = struct.unpack_from("<q", data, header.offset)[0]
    table = struct.unpack_from("<q", data, len(data) - 8)[0] if table == STREAMED else table
    if not header.offset + 8 <= table <= len(data) - 8:
        raise DamagedFileError("has no table of compressed chunks")
    num_chunks = struct.unpack_from("<I", data, table + 4)[0]
    if num_chunks > header.num_points or (one_size and num_chunks != -(-header.num_points // chunk)):
        raise DamagedFileError(f"announces {num_chunks} compressed chunks for {header.num_points} points")
    if kind == LAYERED:
        _walk_layers(
            data, header, (table, num_chunks), sum(LAYERS.get(item, size) for item, size, _ in items)
        )


def _walk_layers(data: mmap.mmap, header: LasHeader, chunks: tuple[int, int], num_layers: int) -> None:
    """Every chunk: its first point, the number of its points, the sizes of its layers, the layers."""
    position, (table, num_chunks), total = header.offset + 8, chunks, 0
    for _ in range(num_chunks):
        count, *sizes = struct.unpack_from(f"<I{num_layers}I", data, position + header.record)
        position, total = position + header.record + 4 + 4 * num_layers + sum(sizes), total + count
        if position > table:
            raise DamagedFileError("has a compressed chunk that is cut off")
    if position != table or total != header.num_points:
        raise DamagedFileError(
            f"has {total} points in its compressed chunks, {header.num_points} are announced"
        )
