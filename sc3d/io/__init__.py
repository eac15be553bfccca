"""Files in and out: checked on the way in, written to a temporary name and renamed on the way out."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import re
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path
from sc3d.io.limits import FARTHEST
from sc3d.io.images import check_end, open_image
from sc3d.io.pcd import check_pcd
from sc3d.io.ply import check_ply, read_header, read_positions

CHECKS = {".ply": check_ply, ".pcd": check_pcd}
IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}


def write_text(path: Path, content: str) -> None:
    """Write UTF-8 text, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(content, encoding="utf-8")


def write_json(path: Path, content: object) -> None:
    """Write JSON, indented, atomically."""
    write_text(path, json.dumps(content, indent=1) + "\n")


def read_json(path: Path, max_bytes: int | None = None) -> object:
    """Read JSON; InputError if missing, broken or larger than `max_bytes` (decoded, it takes up to 30 times as much)."""
    try:
        if not path.is_file():  # a pipe could be waited for
            raise FileNotFoundError(errno.ENOENT, "No such file")
        if max_bytes is not None and path.stat().st_size > max_bytes:
            raise InputError(f"{path} is larger than {max_bytes >> 20} MiB: that is no file of this kind")
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
    """Photos of a folder and its subfolders, by name; InputError if there are none, two share a stem, or one is a link that leads elsewhere."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: give the folder that holds the photos")
    photos = sorted(file for file in folder.rglob("*") if file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith(".") and file.is_file())
    if not photos:
        raise InputError(f"no photos in {folder}: JPEG, PNG or TIFF files are expected")
    by_stem: dict[str, Path] = {}
    for photo in photos:
        other = by_stem.setdefault(photo.stem, photo)
        if other is not photo:
            raise InputError(f"{other} and {photo} share the name {photo.stem!r}, by which masks are found: rename one")
        require_within(photo, folder)
    return photos


def require_within(file: Path, folder: Path) -> None:
    """InputError if a file of a folder is a link to a file outside of it; the folder itself may be a link."""
    if not file.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{file} is a link that leads out of {folder}: copy the file there, or make the whole folder a link")


def read_image(path: Path) -> np.ndarray:
    """(H, W, 3) uint8 RGB, as stored (EXIF orientation is not applied, as in COLMAP); InputError if it is damaged, cut off or too large."""
    import cv2

    check_photo(path)
    try:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"cannot read the photo {path}: it is missing, damaged or not an image")
    return np.ascontiguousarray(image[..., ::-1])


def check_photo(path: Path) -> tuple[int, int]:
    """(width, height) of a photo whose header can be read and that is not cut off; InputError for any other."""
    size = image_size(path)
    check_end(path)
    return size


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header; InputError if the file is not an image, or too large a one."""
    with open_image(path) as image:
        return image.size


def read_index_image(path: Path) -> np.ndarray:
    """(H, W) uint8 of a grey or palette PNG (labels or confidence)."""
    with open_image(path, "mask") as image:
        if image.mode.startswith("I"):
            raise InputError(f"{path} has 16 bits per pixel: an 8-bit PNG with one id per pixel is expected")
        if image.mode not in ("L", "P", "1"):
            raise InputError(f"{path} has colours ({image.mode}): an 8-bit PNG with one id per pixel is expected")
        return np.array(image.convert("L") if image.mode == "1" else image, dtype=np.uint8)


def write_image(path: Path, image: np.ndarray) -> None:
    """Write (H, W) or (H, W, 3) uint8 RGB; the suffix chooses the format."""
    import cv2

    done, encoded = cv2.imencode(path.suffix, image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1]))
    if not done:
        raise OSError(f"could not encode {path}")
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded)  # not by cv2.imwrite, which does not always notice that a disk is full


def read_cloud(path: Path):  # -> o3d.t.geometry.PointCloud; open3d is imported late
    """Read a point cloud with all its attributes (PLY, PCD, XYZ); InputError if it is damaged, empty or has positions that are not finite or too far away."""
    cloud = _read_geometry(path, "read_point_cloud", {".ply", ".pcd", ".xyz", ".xyzn", ".xyzrgb", ".pts"})
    if "positions" not in cloud.point or not len(cloud.point.positions):
        raise InputError(f"{path} holds no points")
    _check_positions(path, cloud.point.positions.numpy(), "remove those points first")
    return cloud


def read_mesh(path: Path):  # -> o3d.t.geometry.TriangleMesh
    """Read a triangle mesh; InputError if it is damaged, empty or has vertices that are not finite or too far away, or triangles of other vertices."""
    mesh = _read_geometry(path, "read_triangle_mesh", {".ply"})
    if "positions" not in mesh.vertex or "indices" not in mesh.triangle or not len(mesh.triangle.indices):
        raise InputError(f"{path} holds no triangles")
    exact = read_positions(path, read_header(path))
    if exact is not None:  # Open3D reads float32, which has steps of half a metre at UTM size
        import open3d as o3d

        mesh.vertex.positions = o3d.core.Tensor(exact)
    _check_positions(path, mesh.vertex.positions.numpy(), "repair the mesh first")
    corners = mesh.triangle.indices.numpy()
    if corners.min() < 0 or corners.max() >= len(mesh.vertex.positions):
        raise InputError(f"{path} has triangles of vertices that do not exist: repair the mesh first")
    return mesh


def _read_geometry(path: Path, reader: str, suffixes: set[str]):  # noqa: ANN202 - what Open3D's reader returns
    """Open3D tells of files that it could not read to the end on Python's standard output only."""
    import open3d as o3d

    if not path.is_file():
        raise InputError(f"{path} is missing")
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: {', '.join(sorted(suffixes))} can be read")
    if path.suffix.lower() in CHECKS:
        CHECKS[path.suffix.lower()](path)
    told = io.StringIO()
    try:
        with redirect_stdout(told):
            geometry = getattr(o3d.t.io, reader)(str(path))
            list(geometry.point if hasattr(geometry, "point") else geometry.vertex)  # fails for names that are no text
    except (RuntimeError, ValueError, IndexError) as error:
        told.write(f"failed: {error}")
    failure = re.search(r"\b(?:failed|unable to)\b[^\n\x1b]*", told.getvalue().replace(str(path), "the file"), re.IGNORECASE)
    if failure:
        raise InputError(f"cannot read {path}: Open3D says {failure[0].rstrip('. ')!r}; write or copy it again")
    return geometry


def _check_positions(path: Path, positions: np.ndarray, advice: str) -> None:
    if not np.isfinite(positions).all():
        raise InputError(f"{path} has positions that are not finite numbers: {advice}")
    if np.abs(positions).max() > FARTHEST:
        raise InputError(f"{path} has positions more than {FARTHEST:g} from the origin: {advice}")


def write_geometry(path: Path, geometry) -> None:  # noqa: ANN001 - tensor PointCloud or TriangleMesh
    """Write a tensor point cloud or mesh, atomically."""
    import open3d as o3d

    write = o3d.t.io.write_point_cloud if isinstance(geometry, o3d.t.geometry.PointCloud) else o3d.t.io.write_triangle_mesh
    with atomic_path(path) as temporary:
        if not write(str(temporary), geometry):
            raise OSError(f"could not write {path}: is the disk full?")
        try:
            check_ply(temporary)  # a disk that becomes full is not always noticed
        except InputError as error:
            raise OSError(f"could not write {path}: is the disk full? ({error})") from None
