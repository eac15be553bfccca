"""Clouds as text, as programs of all countries write them: blanks, tabs, commas, semicolons or bars between
numbers, points or commas in them, a header or none, comments, a first line with the number of points.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sc3d.errors import InputError, examples

logger = logging.getLogger(__name__)

LOOKED_AT = 60  # lines that tell whether numbers have commas
COMMENTS = ("//", "#", "%", "!")
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
THOUSANDS = re.compile(r"[+-]?\d{1,3}(,\d{3})+\.\d*|[+-]?\d{1,3}(\.\d{3})+,\d*|[+-]?\d{1,3}([.,]\d{3}){2,}")
QUOTED = re.compile(r'"([^"]*)"')
BLANKS = re.compile(r"[\s;|]+")
BLANKS_OR_COMMAS = re.compile(r"[\s;|,]+")
COMMA_AND_BLANK = re.compile(r",\s+|[\s;|]+")
STRONG = ";|\t"  # what separates columns if it is there, and never stands in a number
# names of axes in the languages of survey offices, in small letters and without units
AXES = (
    ("x", "easting", "east", "e", "eastings", "rechtswert", "ostwert", "ost", "est"),
    ("y", "northing", "north", "n", "northings", "hochwert", "nordwert", "nord"),
    (
        "z",
        "height",
        "elevation",
        "h",
        "elev",
        "altitude",
        "alt",
        "hoehe",
        "h\u00f6he",
        "hauteur",
        "\u00e9l\u00e9vation",
    ),
)
DEGREES = {
    "lat",
    "latitude",
    "lon",
    "long",
    "longitude",
    "breite",
    "l\u00e4nge",
    "breitengrad",
    "l\u00e4ngengrad",
}
UNIT = re.compile(r"\s*[\[(][^\])]*[\])]\s*$|_?\b(utm|gk|lv95)\b|_(utm|gk|m)$")
WORD = r"(?:points?|pos|position|coords?|coordinates?|koord|koordinate)"
AFFIX = re.compile(rf"^{WORD}[ _-]?(?=[xyzenh]$)|(?<=^[xyzenh])[ _-]?{WORD}$")  # as ArcGIS: POINT_X
HEAD = 1 << 16  # bytes that tell an encoding
# first words of rasters as text: ESRI, Surfer, GRASS
GRIDS = {"ncols", "nrows", "xllcorner", "xllcenter", "cellsize", "dsaa", "north:", "south:", "cols:", "rows:"}


class _WordError(ValueError):
    """Number of the column that has no number."""

    def __init__(self, column: int, word: str) -> None:
        super().__init__(column, word)
        self.column, self.word = column, word


class _Dialect(NamedTuple):
    """between: what separates the words of a line, all of it if `is_exact`, else as often as it comes;
    has_comma: numbers have commas; trailing: whether separators end each line.
    """

    between: re.Pattern[str]
    has_comma: bool = False
    is_exact: bool = False
    trailing: bool = True

    def split(self, line: str) -> list[str]:
        line = _unquoted(line)
        inner = line.strip(" ,;|\t\r\n\ufeff")
        if not inner:
            return []
        line = line.strip(" \r\n\ufeff") if self.is_exact else inner
        words = self.between.split(line)
        if self.is_exact and self.trailing and not words[-1].strip():
            words.pop()
        return words

    def numbers(self, line: str) -> list[float]:
        """Of a line; _WordError at the first word that is none."""
        words = self.split(line)
        try:
            if "_" in line:  # which Python allows in numbers
                raise ValueError
            if self.has_comma:
                return [float(word.replace(",", ".") or "nan") for word in words]
            return [float(word or "nan") for word in words]
        except ValueError:
            for column, word in enumerate(words):
                if not _is_number(word.replace(",", ".") if self.has_comma else word):
                    raise _WordError(column, word) from None
            raise


def read_table(path: Path) -> tuple[list[str], np.ndarray]:
    """Names of the columns in small letters, [] if there is no header of as many, and (N, K) float64
    values, K >= 3. InputError for what is no table of numbers.
    """
    encoding = _encoding(path)
    with path.open(encoding=encoding, errors="replace") as file:
        sample = list(islice(file, LOOKED_AT))
    _refuse_grid(path, sample)
    dialect = _dialect(path, sample)
    with path.open(encoding=encoding, errors="replace") as file:
        rows, heads = _rows(path, file, dialect)
    counts = [row[0] for row in rows if len(row) == 1]
    if rows and len(rows[0]) == 1:  # PTS says the number of points in front of them
        rows = [row for row in rows if len(row) > 1]
        if sum(counts) != len(rows):
            logger.warning(
                "%s announces %d points, %d are there: it may be cut off", path, sum(counts), len(rows)
            )
    width = len(rows[0]) if rows else 0
    other = next((len(row) for row in rows if len(row) != width), width)
    if width < 3 or other != width:
        counted = f"{width} and {other}" if other != width else str(width)
        raise InputError(
            f"{path}: x y z [r g b] with as many numbers in every line are expected, there are {counted} of them in a"
            " line: save it as PLY or LAS"
        )
    return _names(path, heads, dialect, width), np.array(rows)


def _encoding(path: Path) -> str:
    with path.open("rb") as file:
        head = file.read(HEAD)
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    try:
        head.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if error.start < len(head) - 4:  # no character that is cut
            return "cp1252"
    return "utf-8-sig"


def axes_of(names: list[str]) -> list[str]:
    """Which of the columns are x, y and z; "" for an axis that none is."""
    plain = {AFFIX.sub("", UNIT.sub("", name)).strip(): name for name in reversed(names)} | dict(
        zip(names, names)
    )
    return [next((plain[known] for known in axis if known in plain), "") for axis in AXES]


def _rows(path: Path, file: Iterator[str], dialect: _Dialect) -> tuple[list[list[float]], list[str]]:
    """Numbers of all lines, and the lines in front of them that may be headers."""
    rows: list[list[float]] = []
    heads: list[str] = []
    for number, line in enumerate(file, start=1):
        if line.lstrip().startswith(COMMENTS):
            heads += [head] if (head := _commented_header(line)) else []
            continue
        try:
            row = dialect.numbers(line)
        except _WordError as error:
            words = dialect.split(line)
            numbers = sum(_is_number(word.replace(",", ".")) for word in words)
            if (rows and len(rows[-1]) > 1) or (numbers > len(words) / 2 and numbers > 1):
                names = _best(heads, dialect, len(words))
                column = repr(names[error.column]) if names else str(error.column + 1)
                raise InputError(
                    f"{path}, line {number}, column {column}: numbers are expected, not {error.word.strip()[:60]!r}:"
                    " remove that column, or that line"
                ) from None
            heads.append(line)
            continue
        if row:
            rows.append(row)
    return rows, heads


def _dialect(path: Path, lines: list[str]) -> _Dialect:
    """What separates columns and decimals; InputError where numbers may be read in two ways."""
    raw = [line for line in lines if _is_data(line)]
    quoted = [word for line in raw for word in QUOTED.findall(line) if "," in word]
    bodies = [_unquoted(line).strip(" \r\n\ufeff") for line in raw]
    bodies = [body for body in bodies if body]
    strong = next(
        (mark for mark in STRONG if bodies and all(body.count(mark) > 1 for body in _long(bodies))), ""
    )
    _refuse_thousands(path, quoted)
    if strong:
        fields = [word.strip() for body in bodies for word in body.split(strong)]
    else:
        fields = _blank_fields(bodies)
    commas = [word for word in (field.rstrip(",") for field in fields) if "," in word]
    has_comma = bool(commas) and all(DECIMAL_COMMA.fullmatch(word) for word in commas)
    if strong and not has_comma:
        _refuse_thousands(path, commas)
        between = [word for field in fields for word in BLANKS.split(field)] if commas else []
        if any("," in word.strip(",") for word in between):
            raise InputError(
                f"{path}: {strong!r} separates columns, and {commas[0]!r} is no number: save it with points in numbers"
            )
    elif not has_comma and all(THOUSANDS.fullmatch(word) or DECIMAL_COMMA.fullmatch(word) for word in commas):
        _refuse_thousands(path, commas)
    if has_comma and any("." in field for field in fields) or quoted and any("." in line for line in raw):
        raise InputError(
            f"{path} has numbers with commas ({(quoted or commas)[0]}) and numbers with points: save it with points"
            " alone, and none between thousands"
        )
    blanks = (BLANKS if strong else COMMA_AND_BLANK) if has_comma else BLANKS_OR_COMMAS
    loose = _Dialect(blanks, has_comma)
    mark = strong or ("," if not has_comma and bodies and all("," in body for body in _long(bodies)) else "")
    return _exact(lines, bodies, mark, loose) if mark else loose


def _long(bodies: list[str]) -> list[str]:
    """Without the first line of PTS, the number of points."""
    return [body for body in bodies if not body.isdigit()] or bodies


def _blank_fields(bodies: list[str]) -> list[str]:
    """Words between blanks, and between commas with blanks behind them, of lines that have three or more."""
    rows = [COMMA_AND_BLANK.split(body.strip(",")) for body in bodies]
    return [word for words in rows if len(words) > 2 for word in words]


def _exact(lines: list[str], bodies: list[str], mark: str, loose: _Dialect) -> _Dialect:
    """A dialect in which two separators have an empty column between them, where that alone gives all lines
    one number of columns, or the number of the header; else `loose`.
    """
    rows = _long(bodies)
    exact = _Dialect(
        re.compile(rf" *{re.escape(mark)} *"),
        loose.has_comma,
        True,
        all(body.endswith(mark) for body in rows),
    )
    strict, collapsed = ({len(dialect.split(body)) for body in rows} for dialect in (exact, loose))
    if len(strict) > 1 or strict == collapsed:
        return loose
    heads = [line for line in lines if not _is_data(line)]
    strict_fits, loose_fits = (
        any(len(dialect.split(head)) in counts for head in heads)
        for dialect, counts in ((exact, strict), (loose, collapsed))
    )
    return exact if len(collapsed) > 1 or strict_fits and not loose_fits else loose


def _refuse_thousands(path: Path, words: list[str]) -> None:
    found = next((word for word in words if THOUSANDS.fullmatch(word)), None)
    if found is not None:
        raise InputError(f"{path} has commas or points between thousands ({found}): save it without them")


def _refuse_grid(path: Path, lines: list[str]) -> None:
    first = [words[0].lower() for line in lines[:6] if (words := line.split())]
    if sum(word in GRIDS for word in first) > 1 or first[:1] == ["dsaa"]:
        raise InputError(
            f"{path} is a raster of heights as text (such as an ESRI ASCII grid), not a cloud: convert it to points,"
            " as by `gdal_translate -of XYZ`"
        )


def _is_data(line: str) -> bool:
    return not line.lstrip().startswith(COMMENTS) and not re.search(r"[A-DF-Za-df-z]", line)


def _is_number(word: str) -> bool:
    try:
        float(word or "nan")
    except ValueError:
        return False
    return "_" not in word


def _unquoted(line: str) -> str:
    """A line of CSV without its quotes; a comma within them is one of a number."""
    if '"' not in line:
        return line
    return QUOTED.sub(
        lambda found: found[1].replace(",", ".") if DECIMAL_COMMA.fullmatch(found[1]) else found[1], line
    )


def _names(path: Path, heads: list[str], dialect: _Dialect, width: int) -> list[str]:
    """Names of the columns, [] if nothing has as many; a warning where a header is not used, InputError if
    it says that the axes are elsewhere than in the first three columns.
    """
    names = _best(heads, dialect, width)
    if names or not heads:
        return names
    for head in reversed(heads):
        for found in _splits(head, dialect):
            axes = axes_of(found)
            if all(axes) and axes != found[:3]:
                raise InputError(
                    f"{path}: its header names {len(found)} columns ({examples(found, 8)}), its lines have {width}:"
                    " make them as many"
                )
    logger.warning(
        "%s: its first line (%s) is no header of %d columns: the first three are taken as x y z",
        path,
        heads[-1].strip()[:80],
        width,
    )
    return []


def _best(heads: list[str], dialect: _Dialect, width: int) -> list[str]:
    """Names of `width` columns by one of the lines: those with axes first, then the last."""
    fitting = [names for head in reversed(heads) for names in _splits(head, dialect) if len(names) == width]
    return next((names for names in fitting if all(axes_of(names))), fitting[0] if fitting else [])


def _splits(head: str, dialect: _Dialect) -> list[list[str]]:
    """Ways to split a header into names: by the separator of the numbers, then by others."""
    marks = [mark for mark in (*STRONG, ",") if mark in head]
    ways = [dialect.split(head)] if dialect.is_exact else []
    ways += [head.strip().rstrip(mark).split(mark) for mark in marks]
    ways += [BLANKS_OR_COMMAS.split(head.strip(" ,;|\t\r\n"))]
    return [
        [word.strip().strip("\"'").strip().lower().removeprefix("scalar_") for word in words]
        for words in ways
    ]


def _commented_header(line: str) -> str:
    """CloudCompare has the names of the columns behind a comment mark: "//X Y Z R G B"; "" for other
    comments.
    """
    text = line.strip().lstrip("/#%! ").strip()
    words = BLANKS_OR_COMMAS.split(text)
    return text if [word.lower() for word in words[:3]] == ["x", "y", "z"] else ""
