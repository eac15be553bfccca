"""PLY files: the header, whether the rest is what the header announces, and tables of records written.

Open3D reads them with RPly, which writes beyond its buffer for long names, runs for ever over elements
without properties, follows vertex numbers that do not exist, and leaves what it could not read uninitialized
without an error. So everything is checked before.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path

TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
NAMES = {code: name for name, code in reversed(TYPES.items())}  # those that RPly and Open3D write
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
MAX_HEADER = 1 << 16  # bytes
MAX_WORD, MAX_LINE = 250, 1000  # characters that RPly has room for
MAX_CORNERS = 255  # of a face: polygons are cut into triangles in a time that grows with the square
TOGETHER = (("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue"))
RESERVED = {"positions", "normals", "colors"}  # what Open3D calls these groups
CORNERS = ("vertex_indices", "vertex_index")
PADDING = 64  # bytes of blanks that may follow


class Property(NamedTuple):
    """A column of an element. dtype: numpy code without byte order, of the items of a list; length: that of
    the list's length, "" for no list.
    """

    name: str
    dtype: str
    length: str = ""


class Element(NamedTuple):
    """A table: "vertex", "face"."""

    name: str
    rows: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        return any(entry.length for entry in self.properties)


@dataclass(frozen=True)
class Header:
    """order: byte order as in numpy, "" for text; comments: lines without the word; size: bytes of the
    header.
    """

    order: str
    comments: tuple[str, ...]
    elements: tuple[Element, ...]
    size: int

    def element(self, name: str) -> Element | None:
        return next((element for element in self.elements if element.name == name), None)

    @property
    def record(self) -> np.dtype | None:
        """Of a vertex of a binary PLY; None unless the vertices come first and have no lists."""
        first = self.elements[0] if self.elements else None
        if not self.order or first is None or first.name != "vertex" or first.has_lists:
            return None
        return np.dtype([(entry.name, self.order + entry.dtype) for entry in first.properties])


def read_header(path: Path) -> Header:
    """The header of a PLY; InputError if the file is none or its header is damaged."""
    if not path.is_file():
        raise InputError(f"{path} is missing")
    with path.open("rb") as file:
        head = file.read(MAX_HEADER)
    ending = next((ending for ending in (b"\r\n", b"\n", b"\r") if head.startswith(b"ply" + ending)), b"")
    end = -1 if not ending else head.find(ending + b"end_header" + ending)
    if end < 0:
        raise InputError(f"{path} is not a PLY file: its header is missing or cut off")
    lines = [line.decode("utf-8", "replace") for line in head[:end].split(ending)[1:]]
    size = end + len(ending + b"end_header" + ending)
    try:
        return _parse(lines, size)
    except (ValueError, IndexError, KeyError) as error:
        line = str(error) if isinstance(error, _LineError) else "a line is damaged"
        raise InputError(f"{path} has a PLY header that cannot be understood: {line}") from None


class _LineError(ValueError):
    """Says which line it is."""


def _parse(lines: list[str], size: int) -> Header:
    orders, comments = [], []
    elements: list[tuple[str, int, list[Property]]] = []
    for line in lines:
        words = line.split()
        kind = words[0] if words else ""
        if len(line) > MAX_LINE or (
            kind not in ("comment", "obj_info") and max(map(len, words), default=0) > MAX_WORD
        ):
            raise _LineError(f"{line[:60]!r}... is too long")
        try:
            if kind == "format":
                orders.append(FORMATS[words[1]])
            elif kind == "comment":
                comments.append(line[len("comment") :].strip())
            elif kind == "element":
                elements.append((words[1], _count(words[2]), []))
            elif kind == "property":
                elements[-1][2].append(_property(words))
            elif kind != "obj_info":
                raise KeyError(kind)
        except (ValueError, IndexError, KeyError):
            raise _LineError(repr(line[:120])) from None
    if len(orders) != 1:
        raise _LineError("one format is expected")
    tables = tuple(Element(name, rows, tuple(properties)) for name, rows, properties in elements)
    _check_names(tables)
    return Header(orders[0], tuple(comments), tables, size)


def _count(word: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) < 19):
        raise ValueError(word)
    return int(word)


def _property(words: list[str]) -> Property:
    if "\ufffd" in words[-1]:  # no text
        raise ValueError(words[-1])
    if len(words) != (5 if words[1] == "list" else 3):
        raise ValueError(words)
    if words[1] != "list":
        return Property(words[2], TYPES[words[1]])
    count = TYPES[words[2]]
    if count.startswith("f"):
        raise ValueError(count)
    return Property(words[4], TYPES[words[3]], count)


def _check_names(tables: tuple[Element, ...]) -> None:
    _check_once([element.name for element in tables], "element")
    for element in tables:
        names = [entry.name for entry in element.properties]
        _check_once(names, f"property of {element.name!r}")
        if element.rows and not names:
            raise _LineError(f"the element {element.name!r} has {element.rows} rows and no properties")
    vertex = next((element for element in tables if element.name == "vertex"), None)
    types = {} if vertex is None else {entry.name: entry.dtype + entry.length for entry in vertex.properties}
    for group in TOGETHER:
        found = [types[name] for name in group if name in types]
        if found and (len(found) < 3 or len(set(found)) > 1):
            raise _LineError(f"{', '.join(group)} must all be there and of one type")
    if RESERVED & types.keys():
        raise _LineError(
            f"a property is called {min(RESERVED & types.keys())!r}, which stands for three others"
        )
    _check_faces(tables, vertex)


def _check_faces(tables: tuple[Element, ...], vertex: Element | None) -> None:
    face = next((element for element in tables if element.name == "face" and element.rows), None)
    if face is not None and (vertex is None or not vertex.rows):
        raise _LineError(f"{face.rows} faces have no vertices")
    for entry in face.properties if face is not None else ():
        if entry.name in CORNERS and (not entry.length or entry.dtype.startswith("f")):
            raise _LineError(f"{entry.name} must be a list of whole numbers")


def _check_once(names: list[str], what: str) -> None:
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise _LineError(f"{what} {twice!r} is there twice")


def check_ply(path: Path) -> Header:
    """Read the header and compare it with the body: counts, lengths of lists, vertex numbers of faces, in
    text also the words. InputError if anything is wrong.
    """
    header = read_header(path)
    body = path.stat().st_size - header.size
    least = sum(
        element.rows * sum(_least(entry, header.order) for entry in element.properties)
        for element in header.elements
    )
    if body + (0 if header.order else 1) < least:
        raise InputError(
            f"{path} is truncated: {least} bytes are announced, {body} are there; write or copy it again"
        )
    if not header.order:
        _check_text(path, header)
        return header
    data = np.memmap(path, np.uint8, "r") if path.stat().st_size else np.zeros(0, np.uint8)
    end = header.size
    for element in header.elements:
        end = _skip(path, header, element, data, end)
    rest = len(data) - end
    if rest > PADDING or bytes(data[end:]).strip(b" \t\r\n\0"):
        raise InputError(
            f"{path} has {rest} bytes more than its header announces: it is damaged, write or copy it again"
        )
    return header


def read_records(path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """(N,) structured vertices of a binary PLY that is checked before, and its comments; InputError for any
    other, or if the vertices do not come first or have lists.
    """
    header = check_ply(path)
    if header.record is None:
        raise InputError(f"{path}: a binary PLY with the vertices first is expected")
    return np.fromfile(path, header.record, header.elements[0].rows, offset=header.size), header.comments


def read_columns(path: Path, header: Header, names: Sequence[str]) -> np.ndarray | None:
    """(V, K) float64 of named properties of the vertices of a checked PLY; None unless the vertices come
    first and have them all.
    """
    vertex = header.elements[0] if header.elements else None
    if vertex is None or vertex.name != "vertex" or vertex.has_lists:
        return None
    known = [entry.name for entry in vertex.properties]
    if not set(names) <= set(known):
        return None
    if header.order:
        table = np.fromfile(path, header.record, vertex.rows, offset=header.size)
        return np.stack([table[name].astype(np.float64) for name in names], axis=1)
    with path.open("rb") as file:
        file.seek(header.size)
        numbers = np.fromfile(file, np.float64, vertex.rows * len(known), sep=" ").reshape(vertex.rows, -1)
    return np.stack([numbers[:, known.index(name)] for name in names], axis=1)


def read_positions(path: Path, header: Header) -> np.ndarray | None:
    """(V, 3) float64 x, y, z of the vertices of a checked PLY, which Open3D keeps for clouds only; None
    unless they are doubles and come first.
    """
    vertex = header.elements[0] if header.elements else None
    doubles = {entry.name for entry in vertex.properties if entry.dtype == "f8"} if vertex else set()
    return read_columns(path, header, "xyz") if {"x", "y", "z"} <= doubles else None


def _least(entry: Property, order: str) -> int:
    """Smallest number of bytes in the file."""
    return 2 if not order else np.dtype(entry.length or entry.dtype).itemsize


def _skip(path: Path, header: Header, element: Element, data: np.ndarray, start: int) -> int:
    """Position behind an element's table, in bytes or, for text, in numbers."""
    text = not header.order
    if not element.has_lists:
        return start + element.rows * (
            len(element.properties)
            if text
            else sum(np.dtype(entry.dtype).itemsize for entry in element.properties)
        )
    from sc3d.io import record_walk as kernels  # loads numba

    vertex = header.element("vertex")
    fields = np.array(
        [_field(entry, element.name, vertex.rows if vertex else 0) for entry in element.properties], np.int64
    )
    found = (
        kernels.walk_numbers(data, start, element.rows, fields)
        if text
        else kernels.walk_bytes(data, start, element.rows, fields, header.order == ">")
    )
    if found[0] < 0:
        what = {
            kernels.CUT_OFF: "the file is truncated",
            kernels.OUT_OF_RANGE: "it names a vertex that does not exist",
            kernels.WRONG_LENGTH: f"a list has more than {MAX_CORNERS} entries, a negative number of them, or fewer than a face has",
        }[found[0]]
        raise InputError(f"{path}: in row {found[1]} of {element.name!r} {what}; write or copy it again")
    return found[0]


def _field(entry: Property, element: str, num_vertices: int) -> tuple[int, int, int, int, int]:
    """As the kernels want it; what is signed must not be negative."""
    width = np.dtype(entry.dtype).itemsize
    if not entry.length:
        return 0, width, 0, 0, 0
    length, longest = np.dtype(entry.length).itemsize, min(MAX_CORNERS, np.iinfo(entry.length).max)
    if element == "face" and entry.name in CORNERS:
        return (
            length,
            width,
            3,
            longest,
            min(max(num_vertices, 1), np.iinfo(entry.dtype).max + entry.dtype.startswith("u")),
        )
    return length, width, 0, longest, 0


def _check_text(path: Path, header: Header) -> None:
    """Words of a text PLY: numbers, as many as announced, within their types."""
    with path.open("rb") as file:
        file.seek(header.size)
        try:
            with warnings.catch_warnings():
                # how older numpy says that not all could be read
                warnings.simplefilter("error", DeprecationWarning)
                data = np.fromfile(file, np.float64, sep=" ")
        except (ValueError, DeprecationWarning):
            raise InputError(f"{path} has words that are not numbers; write or copy it again") from None
    position = 0
    for element in header.elements:
        end = _skip(path, header, element, data, position)
        if end > len(data):
            raise InputError(
                f"{path} is truncated: {end} numbers are announced, {len(data)} are there; write or copy it again"
            )
        if not element.has_lists:
            _check_types(path, element, data[position:end].reshape(element.rows, len(element.properties)))
        position = end
    if position < len(data):
        raise InputError(
            f"{path} has {len(data) - position} numbers more than its header announces: it is damaged, write or copy it again"
        )


def _check_types(path: Path, element: Element, table: np.ndarray) -> None:
    for entry, column in zip(element.properties, table.T, strict=False):
        if entry.dtype.startswith("f"):
            wrong = np.isfinite(column) & (np.abs(column) > np.finfo(entry.dtype).max)
        else:
            info = np.iinfo(entry.dtype)
            wrong = ~((column >= info.min) & (column <= info.max) & (column == np.floor(column)))
        if wrong.any():
            raise InputError(
                f"{path}: {entry.name} of {element.name!r} {int(np.argmax(wrong))} is {column[np.argmax(wrong)]:g}, which its type cannot hold"
            )


def write_records(
    path: Path,
    records: np.ndarray | Iterable[np.ndarray],
    dtype: np.dtype | None = None,
    count: int | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write records as the vertices of a binary little endian PLY, atomically.

    records: (N,) structured, or chunks of such, one after the other; fields are numbers, in the file's order
    dtype: of all records, in any byte order; count: of all records; both known from `records` if that is
        one array
    comments: lines of the header; a text of several lines makes several
    ValueError if there are more or fewer records, or a field that a PLY cannot have.
    """
    if isinstance(records, np.ndarray):
        dtype, count, records = records.dtype if dtype is None else dtype, len(records), [records]
    if dtype is None or count is None:
        raise ValueError("chunks need a dtype and a count")
    with record_writer(path, dtype, count, comments) as append:
        for chunk in records:
            append(chunk)


@contextmanager
def record_writer(
    path: Path, dtype: np.dtype, count: int, comments: Sequence[str] = ()
) -> Iterator[Callable[[np.ndarray], None]]:
    """Yield the function that appends (N,) records; the file gets its name when the block succeeds. Arguments
    as in `write_records`.
    """
    vertex = vertex_element(dtype, count)
    packed = np.dtype([(entry.name, "<" + entry.dtype) for entry in vertex.properties])
    written = 0
    with atomic_path(Path(path)) as temporary, temporary.open("wb") as file:
        file.write(format_header([vertex], comments))

        def append(records: np.ndarray) -> None:
            nonlocal written
            if records.dtype.names != packed.names:
                raise ValueError(f"records of {records.dtype.names} instead of {packed.names}")
            file.write(np.ascontiguousarray(records, packed).data)  # not tofile, which hides a full disk
            written += len(records)

        yield append
        if written != count:
            raise ValueError(f"{written} records instead of {count}")


def vertex_element(dtype: np.dtype, count: int) -> Element:
    """The element "vertex" of structured records; ValueError for a field that a PLY cannot have."""
    names = dtype.names or ()
    for name in names:
        if dtype[name].str[1:] not in NAMES:
            raise ValueError(f"{name!r} is of type {dtype[name]}, which PLY does not have")
    return Element("vertex", count, tuple(Property(name, dtype[name].str[1:]) for name in names))


def format_header(elements: Iterable[Element], comments: Sequence[str] = (), size: int = 0) -> bytes:
    """The header of a binary little endian PLY, which `read_header` takes; ValueError for a name or a line
    that it would not.

    size: bytes that the header shall have at least, by dots behind the last comment; for counts that are
        known at the end only
    """
    elements, lines = tuple(elements), ["format binary_little_endian 1.0"]
    lines += [f"comment {line}" for text in comments for line in text.splitlines()]
    last = len(lines) - 1
    for element in elements:
        lines.append(f"element {element.name} {element.rows}")
        for entry in element.properties:
            kind = f"list {NAMES[entry.length]} {NAMES[entry.dtype]}" if entry.length else NAMES[entry.dtype]
            lines.append(f"property {kind} {entry.name}")
    lines[last] += "." * (size - len("\n".join(["ply", *lines, "end_header", ""]).encode())) if last else ""
    header = "\n".join(["ply", *lines, "end_header", ""]).encode()
    if _parse(lines, len(header)).elements != elements or len(header) > MAX_HEADER:
        raise ValueError("a PLY cannot have these names, or so long a header")
    return header


def num_triangles(files: Iterable[Path]) -> int:
    """Triangles of mesh files; those that do not exist have none."""
    faces = [read_header(path).element("face") for path in files if path.is_file()]
    return sum(face.rows for face in faces if face is not None)
