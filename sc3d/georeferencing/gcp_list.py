"""Lines of ODM's `gcp_list.txt`, and of what other editors of such lists write: CRS, positions, pixels, names."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import InputError
from sc3d.io.json_files import read_text
from sc3d.scene.photo_names import PhotoNames

if TYPE_CHECKING:
    import pyproj

NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?")
DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")


@dataclass(frozen=True)
class Mark:
    """A line of the file: position (x, y, z) in the CRS, pixel (x, y), name of the photo as known, or as
    written where it is not, name of the point.
    """

    position: tuple[float, ...]
    pixel: tuple[float, float]
    photo: str
    known: bool
    name: str


def read_lines(path: Path) -> list[tuple[int, str]]:
    """Lines that say something, with their numbers; the first is the CRS."""
    numbered = [(number, line.strip()) for number, line in enumerate(read_text(path).splitlines(), start=1)]
    lines = [(number, line) for number, line in numbered if line and not line.startswith("#")]
    if not lines:
        raise InputError(
            f"{path} is empty: the CRS is expected in its first line, then `x y z px py photo [name]`"
        )
    return lines


def parse_crs(header: str, path: Path) -> pyproj.CRS:
    """CRS of a header: `EPSG:32615`, `WGS84 UTM 15N`, `WGS84` (longitude, latitude) or a PROJ string."""
    import pyproj

    words = header.strip("'\";, \t").split()
    try:
        if [word.upper() for word in words[:2]] == ["WGS84", "UTM"] and len(words) == 3:
            zone, south = int(words[2].rstrip("NSns")), words[2].upper().endswith("S")
            if not 1 <= zone <= 60:
                raise ValueError
            return pyproj.CRS.from_epsg((32700 if south else 32600) + zone)
        crs = (
            pyproj.CRS.from_epsg(4326)
            if [word.upper() for word in words] == ["WGS84"]
            else pyproj.CRS.from_user_input(" ".join(words))
        )
    except (pyproj.exceptions.CRSError, ValueError):
        raise InputError(
            f"{path} starts with {header!r}: a CRS is expected there, such as EPSG:32615, WGS84 UTM 15N or +proj=utm +zone=15"
        ) from None
    if not (crs.is_projected or crs.is_geographic):
        raise InputError(f"{path}: {crs.name} is neither a projected nor a geographic CRS")
    return crs


def parse_mark(line: str, where: str, known: PhotoNames) -> Mark:
    """A line of the file. A point without a name is called by its position."""
    fields = _split(line)
    try:
        numbers = [_number(field) for field in fields[:5]]
        if len(fields) < 6 or not np.isfinite(numbers).all():
            raise ValueError
    except ValueError:
        raise InputError(
            f"{where}: `x y z px py photo [name]` with finite numbers is expected, not {line!r}"
        ) from None
    photo, name = _photo_and_name(fields[5:], known)
    found = known.match(photo, changed=False)
    if len(found) > 1:
        raise InputError(
            f"{where}: {photo!r} may be {' or '.join(found[:3])}: write it with its folder, apart by tabs"
        )
    return Mark(
        tuple(numbers[:3]),
        (numbers[3], numbers[4]),
        found[0] if found else photo,
        bool(found),
        name or " ".join(fields[:3]),
    )


def _split(line: str) -> list[str]:
    """Columns of a line: apart by tabs, semicolons or commas where that gives numbers, else by blanks. Other
    programs add columns behind the name.
    """
    for separator in ("\t", ";", ","):
        fields = [field.strip().strip("'\"").strip() for field in line.split(separator)]
        if len(fields) >= 6 and all(NUMBER.fullmatch(field) for field in fields[:5]):
            return fields[:7]
    return line.split()


def is_title(line: str) -> bool:
    """Whether a line names columns: no word of it begins like a number."""
    return not any(re.match(r"[+-]?\.?\d", field) for field in re.split(r"[\s;,]+", line))


def _photo_and_name(words: list[str], known: PhotoNames) -> tuple[str, str]:
    """Photo and point of the columns behind the numbers. A photo's name may hold blanks: the longest that is
    known counts.
    """
    for count in range(len(words), 0, -1):
        photo = " ".join(words[:count]).strip("'\"")
        if known.match(photo, changed=False):
            return photo, " ".join(words[count:]).strip("'\" ")
    return words[0], " ".join(words[1:])


def _number(text: str) -> float:
    return float(text.replace(",", ".") if DECIMAL_COMMA.fullmatch(text) else text)
