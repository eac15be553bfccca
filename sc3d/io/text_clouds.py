"""Clouds as text, as programs of all countries write them: blanks, tabs, commas, semicolons or bars between
numbers, points or commas in them, a header or none, comments, a first line with the number of points.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np

from sc3d.errors import InputError

LOOKED_AT = 60  # lines that tell whether numbers have commas
COMMENTS = ("//", "#", "%", "!")
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
THOUSANDS = re.compile(r"[+-]?\d{1,3}(,\d{3})+\.\d*")
BETWEEN = re.compile(r"[\s;|]+")
BETWEEN_OR_COMMA = re.compile(r"[\s;|,]+")


def read_table(path: Path) -> tuple[list[str], np.ndarray]:
    """Names of the columns in small letters, [] if there is no header of as many, and (N, K) float64
    values, K >= 3. InputError for what is no table of numbers.
    """
    with path.open("rb") as file:
        encoding = "utf-16" if file.read(2) in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    with path.open(encoding=encoding, errors="replace") as file:
        words_of = _dialect(path, list(islice(file, LOOKED_AT)))
    names: list[str] = []
    rows: list[list[float]] = []
    with path.open(encoding=encoding, errors="replace") as file:
        for number, line in enumerate(file, start=1):
            words = words_of(line)
            try:
                rows += [[float(word) for word in words]] if words else []
            except ValueError:
                if rows and len(rows[-1]) > 1:
                    raise InputError(
                        f"{path}, line {number}: numbers are expected, not {line.strip()[:60]!r}"
                    ) from None
                names = [word.strip("\"'").lower().removeprefix("scalar_") for word in words]
    if rows and len(rows[0]) == 1:  # PTS says the number of points in front of them
        rows = [row for row in rows if len(row) > 1]
    width = len(rows[0]) if rows else 0
    other = next((len(row) for row in rows if len(row) != width), width)
    if width < 3 or other != width:
        counts = f"{width} and {other}" if other != width else str(width)
        raise InputError(
            f"{path}: x y z [r g b] with as many numbers in every line are expected, there are {counts} of them in a"
            " line: save it as PLY or LAS"
        )
    return (names if len(names) == width else []), np.array(rows)


def _dialect(path: Path, lines: list[str]) -> Callable[[str], list[str]]:
    """The function that splits a line into words with points in their numbers, [] for a comment."""
    bodies = [BETWEEN.split(line.strip(" ;|\t\r\n")) for line in lines if _is_data(line)]
    rows = [words for words in bodies if len(words) > 2]
    with_comma = [word for words in rows for word in words if "," in word]
    if any(THOUSANDS.fullmatch(word) for word in with_comma):
        raise InputError(f"{path} has commas between thousands: save it without them")
    has_comma = bool(with_comma) and all(DECIMAL_COMMA.fullmatch(word) for word in with_comma)
    between = BETWEEN if has_comma else BETWEEN_OR_COMMA

    def words_of(line: str) -> list[str]:
        line = line.strip()
        if line.startswith(COMMENTS):
            return _header(line)
        words = between.split(line.strip(" ,;|\t")) if line else []
        return [word.replace(",", ".") for word in words] if has_comma else words

    return words_of


def _is_data(line: str) -> bool:
    return not line.lstrip().startswith(COMMENTS) and not re.search(r"[A-DF-Za-df-z]", line)


def _header(line: str) -> list[str]:
    """CloudCompare has the names of the columns behind a comment mark: "//X Y Z R G B"; [] for other
    comments.
    """
    words = BETWEEN_OR_COMMA.split(line.lstrip("/#%! ").strip())
    return words if [word.lower() for word in words[:3]] == ["x", "y", "z"] else []
