"""PCD files: does the body hold what the header announces? Open3D takes memory for whatever it says, makes
points of 0 0 0 from missing words, and ends the process over fields of several numbers, which are read here.
Layout: https://pointclouds.org/documentation/tutorials/pcd_file_format.html.
"""

from __future__ import annotations

import logging
import struct
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sc3d.errors import InputError

logger = logging.getLogger(__name__)

MAX_HEADER = 1 << 16  # bytes
RATIO, SLACK = 300, 1 << 20  # LZF cannot expand by more than 88
PADDING = "_"  # name of the bytes between fields
CODES = {"F": "f", "I": "i", "U": "u"}
PACKED = ("rgb", "rgba")  # three bytes in one number


class PcdHeader(NamedTuple):
    """fields: name, numpy code and numbers of each; kind: ascii, binary or binary_compressed; size: bytes of
    the header.
    """

    fields: tuple[tuple[str, str, int], ...]
    num_points: int
    kind: str
    size: int

    @property
    def is_plain(self) -> bool:
        """Whether each field is one number and has a name of its own, as Open3D expects."""
        names = [name for name, _, _ in self.fields]
        return (
            all(count == 1 for _, _, count in self.fields)
            and len(set(names)) == len(names)
            and PADDING not in names
        )

    @property
    def numbers(self) -> int:
        """Of a point."""
        return sum(count for _, _, count in self.fields)

    @property
    def record(self) -> np.dtype:
        """Of a point of a binary file, its fields named by their place."""
        return np.dtype(
            [(str(place), f"<{code}", count) for place, (_, code, count) in enumerate(self.fields)]
        )


def check_pcd(path: Path) -> PcdHeader:
    """The header; InputError unless a PCD file is as long as it says, in text also in words."""
    with path.open("rb") as file:
        head = file.read(MAX_HEADER)
    start = head.find(b"\nDATA ")
    end = head.find(b"\n", start + 1)
    if start < 0 or end < 0:
        raise InputError(f"{path} is not a PCD file: its header is missing or cut off")
    header = _parse(path, head[:end].decode("utf-8", "replace"), end + 1)
    _check_body(path, header, head[end + 1 : end + 9])
    if header.kind == "ascii":
        _numbers(path, header)
    return header


def _parse(path: Path, text: str, size: int) -> PcdHeader:
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    fields = {line[0]: line[1:] for line in lines}
    try:
        sizes = [int(word) for word in fields["SIZE"]]
        counts = [int(word) for word in fields.get("COUNT", ["1"] * len(sizes))]
        width, height = int(fields["WIDTH"][0]), int(fields["HEIGHT"][0])
        points, kind = int(fields.get("POINTS", [str(width * height)])[0]), fields["DATA"][0]
        types = fields.get("TYPE", ["F"] * len(sizes))
        if (
            not len(fields["FIELDS"]) == len(sizes) == len(counts) == len(types)
            or min(*sizes, *counts, width, height, points) < 0
            or max(sizes) > 8
        ):
            raise ValueError
        codes = [np.dtype(f"{CODES[word]}{width}").str[1:] for word, width in zip(types, sizes, strict=True)]
    except (KeyError, IndexError, ValueError, TypeError):
        raise InputError(f"{path} has a PCD header that cannot be understood") from None
    if points != width * height:
        raise InputError(f"{path} announces {points} points and {width} x {height} of them: it is damaged")
    return PcdHeader(tuple(zip(fields["FIELDS"], codes, counts, strict=True)), points, kind, size)


def _check_body(path: Path, header: PcdHeader, start: bytes) -> None:
    """start: the first bytes of the body."""
    body = path.stat().st_size - header.size
    least = 2 * header.numbers if header.kind == "ascii" else header.record.itemsize
    needed = header.num_points * least - (header.kind == "ascii")
    if header.kind == "binary_compressed":
        packed, unpacked = struct.unpack("<II", start) if len(start) == 8 else (1 << 32, 0)
        if packed > body or unpacked > RATIO * packed + SLACK or needed > unpacked:
            raise InputError(
                f"{path} is truncated, or its compressed part is damaged; write or copy it again"
            )
    elif header.kind not in ("ascii", "binary") or needed > body:
        raise InputError(
            f"{path} is truncated: {header.num_points} points are announced in {body} bytes; write or copy it again"
        )
    elif header.kind == "binary" and body - needed >= max(least, 1):
        logger.warning(
            "%s announces %d points, but there is room for %d more behind them, which are not read: write it again if they are points",
            path,
            header.num_points,
            (body - needed) // max(least, 1),
        )


def _numbers(path: Path, header: PcdHeader) -> np.ndarray:
    """(N, K) float64 of a text PCD; InputError for words that are no numbers, or another number of them."""
    with path.open("rb") as file:
        file.seek(header.size)
        try:
            with warnings.catch_warnings():
                # how older numpy says that not all could be read
                warnings.simplefilter("error", DeprecationWarning)
                found = np.fromfile(file, np.float64, sep=" ")
        except (ValueError, DeprecationWarning):
            raise InputError(
                f"{path} has words that are not numbers with a point: write or copy it again"
            ) from None
    if len(found) != header.num_points * header.numbers:
        raise InputError(
            f"{path} is truncated or damaged: {header.num_points} points of {header.numbers} numbers are announced,"
            f" {len(found)} numbers are there; write or copy it again"
        )
    return found.reshape(header.num_points, header.numbers)


def read_fields(path: Path, header: PcdHeader) -> dict[str, np.ndarray]:
    """(N, K) values of each field of a checked PCD but padding, colors as (N, 3) uint8 "colors"; InputError if
    it is compressed, or if two fields share a name.
    """
    if header.kind == "binary_compressed":
        raise InputError(
            f"{path} is a compressed PCD with fields of several numbers: save it as binary PCD without compression, or as PLY"
        )
    if header.kind == "binary":
        table = np.fromfile(path, header.record, header.num_points, offset=header.size)
        columns = [table[name].reshape(header.num_points, -1) for name in header.record.names or ()]
    else:
        ends = np.cumsum([count for _, _, count in header.fields])[:-1]
        parts = np.split(_numbers(path, header), ends, axis=1)
        columns = [part.astype(code) for part, (_, code, _) in zip(parts, header.fields, strict=True)]
    found: dict[str, np.ndarray] = {}
    for (name, _, count), values in zip(header.fields, columns, strict=True):
        if name == PADDING or not count:
            continue
        if name in found:
            raise InputError(f"{path} has two fields {name!r}: write it again with names of their own")
        if name in PACKED and values.shape[1] == 1 and values.dtype.itemsize == 4:
            name, values = "colors", _unpack(values)
        found[name] = values
    return found


def _unpack(values: np.ndarray) -> np.ndarray:
    """(N, 3) bytes of 0xAARRGGBB, as a whole number or in the bits of a float."""
    bits = np.ascontiguousarray(values[:, 0]).view(np.uint32)
    return np.stack([bits >> 16, bits >> 8, bits], axis=1).astype(np.uint8)
