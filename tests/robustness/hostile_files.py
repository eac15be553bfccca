"""Small valid files of every kind that sc3d reads, the call that reads each, and the many ways in which a
file can be damaged.
"""

from __future__ import annotations

import io
import json
import random
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

try:
    import resource
except ImportError:  # Windows
    resource = None

from sc3d.errors import InputError
from tests.builders import views

XYZ = ["property float x", "property float y", "property float z"]
LITTLE = "binary_little_endian"


@dataclass(frozen=True)
class Reader:
    """What is read.

    build: writes valid files into a folder
    read: reads them; a damaged file may only make it raise InputError
    targets: names of the files to damage
    """

    build: Callable[[Path], None]
    read: Callable[[Path], object]
    targets: tuple[str, ...]


def ply(form: str, lines: list[str], body: bytes) -> bytes:
    return ("ply\nformat " + form + " 1.0\n" + "\n".join(lines) + "\nend_header\n").encode() + body


def labelled_ply(form: str = LITTLE, count: int = 24) -> bytes:
    """A cloud with everything that `propagate` reads."""
    rng = np.random.default_rng(0)
    columns = [
        ("float", "double", rng.normal(size=(count, 3)) + [512345, 5187654, 210], "x y z"),
        ("float", "float", np.tile([0, 0, 1], (count, 1)), "nx ny nz"),
        ("uchar", "uchar", rng.integers(0, 256, (count, 3)), "red green blue"),
        ("uchar", "uchar", rng.integers(0, 2, (count, 1)), "label"),
        ("float", "float", rng.random((count, 1)), "confidence"),
        ("uchar", "uchar", rng.integers(0, 5, (count, 1)), "state"),
        ("int", "int", rng.integers(0, 9, (count, 1)), "num_views"),
        ("float", "float", rng.integers(0, 9, (count, 1)), "votes_0"),
        ("float", "float", rng.integers(0, 9, (count, 1)), "votes_1"),
    ]
    lines = [
        f"element vertex {count}",
        *(f"property {kind} {name}" for _, kind, _, names in columns for name in names.split()),
    ]
    if form == "ascii":
        rows = [
            " ".join(f"{value:.9g}" for _, _, values, _ in columns for value in values[row])
            for row in range(count)
        ]
        return ply(form, lines, ("\n".join(rows) + "\n").encode())
    codes = {"double": "f8", "float": "f4", "uchar": "u1", "int": "i4"}
    order = "<" if form == LITTLE else ">"
    table = np.zeros(
        count, [(name, order + codes[kind]) for _, kind, _, names in columns for name in names.split()]
    )
    for _, _, values, names in columns:
        for name, column in zip(names.split(), values.T, strict=True):
            table[name] = column
    return ply(form, lines, table.tobytes())


def mesh_ply(form: str = LITTLE) -> bytes:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]], np.float64)
    faces = [[0, 1, 2, 3], [0, 1, 4], [1, 2, 4], [2, 3, 4]]
    lines = [
        f"element vertex {len(vertices)}",
        *XYZ,
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
    ]
    if form == "ascii":
        return ply(
            form,
            lines,
            (
                "\n".join(
                    " ".join(map(str, row))
                    for row in [*vertices.tolist(), *([len(face), *face] for face in faces)]
                )
                + "\n"
            ).encode(),
        )
    order = "<" if form == LITTLE else ">"
    return ply(
        form,
        lines,
        vertices.astype(order + "f4").tobytes()
        + b"".join(bytes([len(face)]) + np.array(face, order + "i4").tobytes() for face in faces),
    )


def splats_ply(count: int = 20) -> bytes:
    names = [
        "x",
        "y",
        "z",
        "nx",
        "ny",
        "nz",
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(9)),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]
    rng = np.random.default_rng(1)
    values = rng.normal(size=(count, len(names)))
    values[:, names.index("scale_0") : names.index("scale_0") + 3] -= 2
    return ply(
        LITTLE,
        [
            "comment sc3d origin 0.000 0.000 0.000",
            f"element vertex {count}",
            *(f"property float {name}" for name in names),
        ],
        values.astype("<f4").tobytes(),
    )


def picture(form: str, mode: str = "RGB", size: tuple[int, int] = (40, 30), **options: object) -> bytes:
    """An encoded image of random rectangles."""
    rng, stream = np.random.default_rng(2), io.BytesIO()
    values = np.kron(
        rng.integers(0, 4 if mode == "L" else 256, (size[1] // 10, size[0] // 10, 3)),
        np.ones((10, 10, 1), int),
    ).astype(np.uint8)
    Image.fromarray(values if mode == "RGB" else values[..., 0]).save(stream, form, **options)
    return stream.getvalue()


def tracked_model() -> pycolmap.Reconstruction:
    """Cameras that see points, as in a real model."""
    model, scene_views = pycolmap.Reconstruction(), views()
    model.add_camera_with_trivial_rig(scene_views[0].camera)
    for row, view in enumerate(scene_views):
        keypoints = pycolmap.Point2DList(
            [pycolmap.Point2D(np.array([10.0 * point, 5.0 * row])) for point in range(6)]
        )
        image = pycolmap.Image(name=view.name, camera_id=1, image_id=row + 1, points2D=keypoints)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world[:3]))
    for point in range(5):
        track = pycolmap.Track()
        for row in range(len(scene_views) - point % 3):
            track.add_element(row + 1, point)
        model.add_point3D(np.array([512345.0 + point, 5187654, 210]), track, np.array([1, 2, 3], np.uint8))
    return model


def exif() -> Image.Exif:
    found = Image.Exif()
    found[0x0110] = "FC6310"
    found.get_ifd(0x8825).update(
        {1: "N", 2: (46.0, 50.0, 33.6), 3: "W", 4: (91.0, 59.0, 39.9), 5: b"\x00", 6: 198.5}
    )
    found.get_ifd(0x8769).update({0xA405: 24, 0xA002: 40})
    return found


@contextmanager
def bounded() -> Iterator[None]:
    """A second of processor time, and, on Linux, 1 GiB more than the process has."""
    started = time.process_time()
    with bounded_memory() if sys.platform == "linux" else nullcontext():
        yield
    assert time.process_time() - started < 1


@contextmanager
def bounded_memory() -> Iterator[None]:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (1 << 30), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def refused(match: str, read, *arguments) -> None:
    with bounded(), pytest.raises(InputError, match=match) as caught:
        read(*arguments)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 1000


def patch(file: Path, position: int, form: str, *values) -> None:
    content = bytearray(file.read_bytes())
    struct.pack_into(form, content, position, *values)
    file.write_bytes(content)


# ---- damage

NUMBERS = [
    0,
    1,
    2,
    3,
    127,
    128,
    255,
    256,
    32767,
    65535,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**40,
    2**60,
    2**63 - 1,
    2**63,
    2**64 - 1,
]
FLOATS = [float("nan"), float("inf"), -float("inf"), 1e300, -1e38, 3.5e38, 1e-310, 0.0, -1.0]
WORDS = [
    "nan",
    "inf",
    "-inf",
    "1e999",
    "-1",
    "0",
    "99999999999999999999",
    "4294967296",
    "2147483648",
    "1e30",
    "../../etc/passwd",
    "/etc/passwd",
    "",
    "x",
    "\x00",
    "true",
    "\ud7ff",
]
VALUES = [
    None,
    True,
    {},
    [],
    -1,
    0,
    1e308,
    -1e308,
    2**70,
    float("nan"),
    float("inf"),
    "",
    "../x",
    "\ud800",
    "nan",
    [[[[]]]],
    {"a": None},
    "0" * 300,
]


def damage(content: bytes, rng: random.Random, is_text: bool) -> bytes:
    """One to four changes, of the kinds that disks, networks, programs and attackers make."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        kinds = [_flip, _overwrite, _overwrite, _truncate, _remove, _repeat, _extend, _zero]
        if is_text:
            kinds += [_replace_word] * 4 + [_move_line] * 2
        content = rng.choice(kinds)(content, rng)
    return content


def damage_json(content: bytes, rng: random.Random) -> bytes:
    """A value somewhere in the tree replaced, removed or repeated; still JSON."""
    tree = json.loads(content)
    for _ in range(rng.choice((1, 1, 2, 3))):
        places = list(_places(tree))
        if not places:
            break
        holder, key = rng.choice(places)
        action = rng.random()
        if action < 0.15 and isinstance(holder, dict):
            del holder[key]
        elif action < 0.25:
            other, name = rng.choice(places)
            holder[key] = other[name]  # may become endless: then it cannot be written
        elif action < 0.3 and isinstance(holder, dict):
            holder[rng.choice(WORDS)] = holder.pop(key)
        else:
            holder[key] = rng.choice(VALUES)
    try:
        return json.dumps(tree).encode("utf-8", "surrogatepass")
    except (ValueError, RecursionError):
        return content


def _places(tree: object) -> list[tuple]:
    found, open_ = [], [tree]
    while open_ and len(found) < 5000:
        node = open_.pop()
        keys = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        for key in keys:
            found.append((node, key))
            open_.append(node[key])
    return found


def _at(content: bytes, rng: random.Random) -> int:
    """Somewhere, more often near the start, where headers are."""
    return int(len(content) * rng.random() ** rng.choice((1, 3))) if content else 0


def _flip(content: bytes, rng: random.Random) -> bytes:
    changed = bytearray(content or b"\0")
    for _ in range(rng.choice((1, 1, 3, 20))):
        changed[min(_at(content, rng), len(changed) - 1)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _overwrite(content: bytes, rng: random.Random) -> bytes:
    order, where = rng.choice("<>"), _at(content, rng)
    code = rng.choice("BHIQfd")
    number = rng.choice(NUMBERS) & (2 ** (8 * struct.calcsize(order + code)) - 1)
    value = rng.choice(FLOATS)
    with np.errstate(over="ignore"):
        packed = (
            np.array(value, order + ("f4" if code == "f" else "f8")).tobytes()
            if code in "fd"
            else struct.pack(order + code, number)
        )
    return content[:where] + packed + content[where + len(packed) :]


def _truncate(content: bytes, rng: random.Random) -> bytes:
    return content[
        : rng.choice((rng.randrange(len(content) + 1), max(0, len(content) - rng.randrange(1, 9))))
    ]


def _remove(content: bytes, rng: random.Random) -> bytes:
    where = _at(content, rng)
    return content[:where] + content[where + rng.choice((1, 2, 4, 8, 24, 200)) :]


def _repeat(content: bytes, rng: random.Random) -> bytes:
    where, length, target = _at(content, rng), rng.choice((1, 4, 8, 24, 100)), _at(content, rng)
    return content[:target] + content[where : where + length] * rng.choice((1, 1, 3)) + content[target:]


def _extend(content: bytes, rng: random.Random) -> bytes:
    return content + rng.choice((b"\0", b"\n", b"1", rng.randbytes(7), bytes(64), content[-40:]))


def _zero(content: bytes, rng: random.Random) -> bytes:
    where, length = _at(content, rng), rng.choice((1, 4, 8, 64, len(content)))
    return content[:where] + bytes(min(length, len(content) - where)) + content[where + length :]


def _replace_word(content: bytes, rng: random.Random) -> bytes:
    lines = content.split(b"\n")
    row = rng.randrange(len(lines))
    words = lines[row].split(b" ")
    words[rng.randrange(len(words))] = rng.choice(WORDS).encode("utf-8", "surrogatepass")
    lines[row] = b" ".join(words)
    return b"\n".join(lines)


def _move_line(content: bytes, rng: random.Random) -> bytes:
    lines = content.split(b"\n")
    line = lines.pop(rng.randrange(len(lines)))
    for _ in range(rng.choice((0, 1, 2))):
        lines.insert(rng.randrange(len(lines) + 1), line)
    return b"\n".join(lines)
