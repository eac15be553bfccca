"""Files in and out: checked on the way in, written to a temporary name and renamed on the way out."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from sc3d.errors import InputError

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` with the same suffix (file or folder); it replaces `path` only if the block succeeds."""
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK, effective_ids=True):
            raise PermissionError
    except (PermissionError, NotADirectoryError, FileExistsError):
        raise InputError(f"cannot write to {path.parent}: check its permissions or choose another folder") from None
    try:
        yield temporary
        if not temporary.exists():
            raise OSError(f"nothing was written to {temporary}")
        if temporary.is_file():
            with temporary.open("rb") as file:
                os.fsync(file.fileno())
        elif path.is_dir():
            shutil.rmtree(path)
        os.replace(temporary, path)
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)


def write_text(path: Path, content: str) -> None:
    """Write UTF-8 text, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(content, encoding="utf-8")


def write_json(path: Path, content: object) -> None:
    """Write JSON, indented, atomically."""
    write_text(path, json.dumps(content, indent=1) + "\n")


def read_json(path: Path) -> object:
    """Read JSON; InputError if missing or broken."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid JSON ({error})") from None


def digest(path: Path) -> str:
    """Content hash of a file, or of all files of a folder with their names; "" if it does not exist."""
    state = hashlib.blake2b(digest_size=16)
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else []
    if not files:
        return ""
    for file in files:
        if path.is_dir():
            state.update(str(file.relative_to(path)).encode() + b"\0")
        with file.open("rb") as stream:
            while chunk := stream.read(1 << 20):
                state.update(chunk)
    return state.hexdigest()


def find_photos(folder: Path) -> list[Path]:
    """Photos of a folder and its subfolders, by name; InputError if there are none or two share a stem."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: give the folder that holds the photos")
    photos = sorted(file for file in folder.rglob("*") if file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith("."))
    if not photos:
        raise InputError(f"no photos in {folder}: JPEG, PNG or TIFF files are expected")
    by_stem: dict[str, Path] = {}
    for photo in photos:
        other = by_stem.setdefault(photo.stem, photo)
        if other is not photo:
            raise InputError(f"{other} and {photo} share the name {photo.stem!r}, by which masks are found: rename one")
    return photos


def read_image(path: Path) -> np.ndarray:
    """(H, W, 3) uint8 RGB, as stored (EXIF orientation is not applied, as in COLMAP)."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise InputError(f"cannot read the photo {path}: it is missing, damaged or not an image")
    return np.ascontiguousarray(image[..., ::-1])


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header; InputError if the file is not an image."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        raise InputError(f"cannot read the image {path}: it is missing, damaged or not an image") from None


def read_index_image(path: Path) -> np.ndarray:
    """(H, W) uint8 of a grey or palette PNG (labels or confidence)."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            if image.mode not in ("L", "P", "1"):
                raise InputError(f"{path} has colours ({image.mode}): an 8-bit PNG with one id per pixel is expected")
            return np.array(image.convert("L") if image.mode == "1" else image, dtype=np.uint8)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        raise InputError(f"cannot read the mask {path}: it is missing, damaged or not an image") from None


def write_image(path: Path, image: np.ndarray) -> None:
    """Write (H, W) or (H, W, 3) uint8 RGB; the suffix chooses the format."""
    import cv2

    with atomic_path(path) as temporary:
        if not cv2.imwrite(str(temporary), image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])):
            raise OSError(f"could not write {path}: is the disk full?")


def read_cloud(path: Path):  # -> o3d.t.geometry.PointCloud; open3d is imported late
    """Read a point cloud with all its attributes (PLY, PCD, XYZ); InputError if it is truncated, empty or has positions that are not finite."""
    import open3d as o3d

    _check_ply(path)
    cloud = o3d.t.io.read_point_cloud(str(path))
    if "positions" not in cloud.point or not len(cloud.point.positions):
        raise InputError(f"{path} holds no points")
    if not np.isfinite(cloud.point.positions.numpy()).all():
        raise InputError(f"{path} has positions that are not finite numbers: remove those points first")
    return cloud


def read_mesh(path: Path):  # -> o3d.t.geometry.TriangleMesh
    """Read a triangle mesh; InputError if it is truncated, empty or has positions that are not finite."""
    import open3d as o3d

    _check_ply(path)
    mesh = o3d.t.io.read_triangle_mesh(str(path))
    if "positions" not in mesh.vertex or "indices" not in mesh.triangle or not len(mesh.triangle.indices):
        raise InputError(f"{path} holds no triangles")
    if not np.isfinite(mesh.vertex.positions.numpy()).all():
        raise InputError(f"{path} has vertices that are not finite numbers: repair the mesh first")
    return mesh


def write_geometry(path: Path, geometry) -> None:  # noqa: ANN001 - tensor PointCloud or TriangleMesh
    """Write a tensor point cloud or mesh, atomically."""
    import open3d as o3d

    write = o3d.t.io.write_point_cloud if isinstance(geometry, o3d.t.geometry.PointCloud) else o3d.t.io.write_triangle_mesh
    with atomic_path(path) as temporary:
        if not write(str(temporary), geometry):
            raise OSError(f"could not write {path}: is the disk full?")


PLY_SIZES = {"char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2, "int": 4, "uint": 4, "int32": 4,
             "uint32": 4, "float": 4, "float32": 4, "double": 8, "float64": 8}


def _check_ply(path: Path) -> None:
    """Open3D reads a truncated PLY as far as it goes, without an error: compare the header's counts with the file's size first."""
    if not path.is_file():
        raise InputError(f"{path} is missing")
    if path.suffix.lower() != ".ply":
        return
    with path.open("rb") as file:
        header = file.read(1 << 16)
    end = header.find(b"end_header")
    if not header.startswith(b"ply") or end < 0:
        raise InputError(f"{path} is not a PLY file: its header is missing or cut off")
    body = path.stat().st_size - (header.find(b"\n", end) + 1)
    least, count, binary = 0, 0, False
    for line in header[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                binary = words[1].startswith("binary")
            elif words[:1] == ["element"]:
                count = int(words[2])
            elif words[:2] == ["property", "list"]:
                least += count * (PLY_SIZES[words[2]] if binary else 2)
            elif words[:1] == ["property"]:
                least += count * (PLY_SIZES[words[1]] if binary else 2)
        except (IndexError, ValueError, KeyError):
            raise InputError(f"{path} has a PLY header that cannot be understood: {line!r}") from None
    if body < least - (0 if binary else 1) or count < 0:
        raise InputError(f"{path} is truncated: {least} bytes are announced, {body} are there; write or copy it again")
