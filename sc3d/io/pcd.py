"""PCD files: does the body hold what the header announces? Open3D takes memory for whatever it says. Layout:
https://pointclouds.org/documentation/tutorials/pcd_file_format.html.
"""

from __future__ import annotations

import struct
from pathlib import Path

from sc3d.errors import InputError

MAX_HEADER = 1 << 16  # bytes
RATIO, SLACK = 300, 1 << 20  # LZF cannot expand by more than 88


def check_pcd(path: Path) -> None:
    """InputError unless a PCD file is as long as its header says."""
    with path.open("rb") as file:
        head = file.read(MAX_HEADER)
    start = head.find(b"\nDATA ")
    end = head.find(b"\n", start + 1)
    if start < 0 or end < 0:
        raise InputError(f"{path} is not a PCD file: its header is missing or cut off")
    lines = [
        line.split()
        for line in head[:end].decode("utf-8", "replace").splitlines()
        if line.strip() and not line.startswith("#")
    ]
    fields = {line[0]: line[1:] for line in lines}
    try:
        sizes = [int(word) for word in fields["SIZE"]]
        counts = [int(word) for word in fields.get("COUNT", ["1"] * len(sizes))]
        width, height = int(fields["WIDTH"][0]), int(fields["HEIGHT"][0])
        points, kind = int(fields.get("POINTS", [str(width * height)])[0]), fields["DATA"][0]
        if (
            not len(fields["FIELDS"]) == len(sizes) == len(counts)
            or min(*sizes, *counts, width, height, points) < 0
            or max(sizes) > 8
        ):
            raise ValueError
    except (KeyError, IndexError, ValueError, TypeError):
        raise InputError(f"{path} has a PCD header that cannot be understood") from None
    if points != width * height:
        raise InputError(f"{path} announces {points} points and {width} x {height} of them: it is damaged")
    _check_body(
        path,
        kind,
        points,
        (sum(counts), sum(size * count for size, count in zip(sizes, counts))),
        head[end + 1 : end + 9],
    )


def _check_body(path: Path, kind: str, points: int, row: tuple[int, int], start: bytes) -> None:
    """row: numbers and bytes of a point; start: the first bytes of the body, which begins at `MAX_HEADER` at
    the latest.
    """
    body = path.stat().st_size
    needed = points * (2 * row[0] if kind == "ascii" else row[1])
    if kind == "binary_compressed":
        packed, unpacked = struct.unpack("<II", start) if len(start) == 8 else (1 << 32, 0)
        if packed > body or unpacked > RATIO * packed + SLACK or needed > unpacked:
            raise InputError(
                f"{path} is truncated, or its compressed part is damaged; write or copy it again"
            )
    elif kind not in ("ascii", "binary") or needed > body:
        raise InputError(
            f"{path} is truncated: {points} points are announced in {body} bytes; write or copy it again"
        )
