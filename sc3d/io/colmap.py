"""COLMAP models, read by pycolmap after a look at them, taken apart, put together and written.

Photo names of text models are read here, to the end of their line: pycolmap stops at a blank.

pycolmap believes the counts in binary files: one that is too large makes it fill the memory, or read on
behind the end for ever. In text files a count never leads beyond its line. Cameras and poses are not checked
by pycolmap at all.
Layout: https://colmap.github.io/format.html; rigs.bin and frames.bin as COLMAP 3.12 and later write them.
    Little endian throughout.
"""

from __future__ import annotations

import codecs
import logging
import mmap
import shutil
import struct
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Protocol

import numpy as np
import pycolmap

from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path
from sc3d.io.limits import FARTHEST, MAX_PIXELS, MAX_SIDE, DamagedFileError

logger = logging.getLogger(__name__)

FILES = ("cameras", "rigs", "frames", "images", "points3D")  # rigs and frames only in newer models
LARGEST = 1 << 62  # count of a list: bounded by the size of the file alone
# id, position, color, error; track of photo and keypoint
POINT = np.array([[0, 43, 0, 0, 0], [8, 8, 0, LARGEST, 0]])
# id, rig, rotation, translation; sensor and photo
FRAME = np.array([[0, 64, 0, 0, 0], [4, 16, 0, LARGEST, 0]])
MAX_NAME = 4096  # bytes of a photo name
POSE_FIELDS = 9  # words in front of the name in images.txt
NO_POINTS, NO_ROWS, NO_PIXELS = np.zeros((0, 3)), np.zeros(0, int), np.zeros((0, 2))
NOT_RIGID = 0.01  # largest error of R R^T: text models are rounded


def load_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a model, binary or text; InputError if it is missing, damaged, without photos, or has cameras or
    poses that are none.
    """
    if not is_model(folder):
        above = f" (one is in {folder.parent}: move its files there)" if is_model(folder.parent) else ""
        raise InputError(
            f"no cameras in {folder}: run `sc3d reconstruct PHOTOS SCENE`, or put a COLMAP model there{above}"
        )
    check_counts(folder)
    try:
        with _as_pycolmap_reads(folder) as readable:
            model = pycolmap.Reconstruction(str(readable))
        images = [model.image(image_id) for image_id in model.reg_image_ids()]
        if not _is_binary(folder):
            full_names = _text_names(folder)
            for image in images:
                image.name = full_names[image.image_id]
        names = [image.name for image in images]
        _check_rigs(model, folder)
        poses = [image.cam_from_world() for image in images]
    except InputError:
        raise
    # pycolmap raises bare RuntimeError, ValueError, IndexError, MemoryError and UnicodeDecodeError for broken
    # files
    except IndexError:
        raise InputError(
            f"cannot read the COLMAP model in {folder}: its points (points3D) name keypoints that its photos (images) do"
            " not list: empty the file of points too, or export the model again"
        ) from None
    except Exception as error:
        raise InputError(
            f"cannot read the COLMAP model in {folder}: {(str(error).splitlines() or [type(error).__name__])[0]}"
        ) from None
    if not images:
        raise InputError(f"the COLMAP model in {folder} has no registered photos")
    for camera_id in sorted({image.camera_id for image in images}):
        _check_camera(model.camera(camera_id), folder)
    _check_poses(poses, names, folder)
    return model


def is_model(folder: Path) -> bool:
    """Whether a folder holds the cameras of a model, binary or text."""
    return any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))


def photo_names(folder: Path) -> list[str]:
    """Names of the photos of a model, of which nothing else is read; InputError if it is damaged."""
    if not _is_binary(folder):
        try:
            return list(_text_names(folder).values())
        except (OSError, ValueError) as error:
            raise InputError(f"cannot read the COLMAP model in {folder}: {error}") from None
    names: list[str] = []
    _check_part(folder, "images", lambda data, count: _walk_images(data, count, names))
    return names


def warn_of_larger(folder: Path) -> None:
    """Say if a model beside this one, as COLMAP numbers them, has more photos."""
    others = [other for other in sorted(folder.parent.glob("[0-9]*")) if other != folder and is_model(other)]
    if not others:
        return
    with suppress(InputError):  # one that is damaged is in nobody's way
        count, counts = len(photo_names(folder)), [len(photo_names(other)) for other in others]
        if max(counts) > count:
            logger.warning(
                "%s has %d photos, but the model beside it in %s has %d: take that one, if it is meant",
                folder,
                count,
                others[counts.index(max(counts))],
                max(counts),
            )


def _is_binary(folder: Path) -> bool:
    """As pycolmap decides it, which asks for points, too."""
    cameras = all((folder / f"{name}.bin").exists() for name in ("cameras", "images"))
    return cameras and ((folder / "points3D.bin").exists() or not (folder / "points3D.txt").exists())


def _text_names(folder: Path) -> dict[int, str]:
    """Name by id of the photos in images.txt, blanks included; a line of keypoints follows each."""
    names = {}
    with (folder / "images.txt").open(encoding="utf-8-sig") as lines:
        for line in lines:
            words = line.strip().split(maxsplit=POSE_FIELDS)
            if not words or words[0].startswith("#"):
                continue
            names[int(words[0])] = words[POSE_FIELDS] if len(words) > POSE_FIELDS else ""
            next(lines, None)
    return names


@contextmanager
def _as_pycolmap_reads(folder: Path) -> Iterator[Path]:
    """The folder itself, or for the time of the block a copy without what pycolmap does not bear: byte order
    marks in text, and no file of points.
    """
    is_binary = _is_binary(folder)
    files = [folder / f"{name}.{'bin' if is_binary else 'txt'}" for name in FILES]
    marked = not is_binary and any(file.is_file() and _starts_with_mark(file) for file in files)
    if not files[FILES.index("images")].is_file():
        raise InputError(f"the COLMAP model in {folder} has no file of photos (images.bin or images.txt)")
    if not marked and files[-1].exists():
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="sc3d-colmap-") as name:
        copy = Path(name)
        (copy / files[-1].name).write_bytes(struct.pack("<Q", 0) if is_binary else b"")
        for file in filter(Path.is_file, files):
            with file.open("rb") as source, (copy / file.name).open("wb") as target:
                source.seek(len(codecs.BOM_UTF8) if marked and _starts_with_mark(file) else 0)
                shutil.copyfileobj(source, target)
        yield copy


def _starts_with_mark(file: Path) -> bool:
    with file.open("rb") as stream:
        return stream.read(len(codecs.BOM_UTF8)) == codecs.BOM_UTF8


class PosedCamera(Protocol):
    """A photo's camera; cam_from_world: (4, 4) rigid transform. `geometry.cameras.View` is one."""

    @property
    def name(self) -> str: ...
    @property
    def camera(self) -> pycolmap.Camera: ...
    @property
    def cam_from_world(self) -> np.ndarray: ...


def registered_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """The photos that have a pose, by name; they die with the model."""
    return sorted((model.image(image_id) for image_id in model.reg_image_ids()), key=lambda image: image.name)


def copy_cameras(model: pycolmap.Reconstruction) -> dict[int, pycolmap.Camera]:
    """The cameras by id, which do not die with the model."""
    return {camera_id: pycolmap.Camera(model.camera(camera_id).todict()) for camera_id in model.cameras}


def cam_from_world(image: pycolmap.Image) -> np.ndarray:
    """(4, 4) float64 rigid transform."""
    matrix = np.eye(4)
    matrix[:3] = image.cam_from_world().matrix()
    return matrix


def point_arrays(model: pycolmap.Reconstruction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(P,) uint64 ids of the points in order, (P, 3) float64 world positions, (P, 3) uint8 RGB."""
    ids = np.array(sorted(model.point3D_ids()), np.uint64)
    points = [model.point3D(int(point_id)) for point_id in ids]
    xyz = np.array([point.xyz for point in points], np.float64).reshape(-1, 3)
    return ids, xyz, np.array([point.color for point in points], np.uint8).reshape(-1, 3)


def observed_rows(image: pycolmap.Image, point_ids: np.ndarray) -> np.ndarray:
    """(K,) row of the point that each of a photo's `get_observation_points2D` shows; -1 for those that were
    filtered out of the model. point_ids: (P,) in order
    """
    seen = np.array([keypoint.point3D_id for keypoint in image.get_observation_points2D()], np.uint64)
    rows = np.searchsorted(point_ids, seen)
    known = np.append(point_ids, np.uint64(0))[rows] == seen
    return np.where(known & (rows < len(point_ids)), rows, -1)


def build_model(
    views: Sequence[PosedCamera],
    points: np.ndarray = NO_POINTS,
    colors: np.ndarray = NO_POINTS,
    observations: Sequence[tuple[np.ndarray, np.ndarray]] | None = None,
) -> pycolmap.Reconstruction:
    """A model of views, of which those with equal cameras share one; photos are numbered from 1 on.

    points, colors: (P, 3) float64 world and uint8 RGB
    observations: per view the rows (K,) of points that it sees and their pixels (K, 2); None = nothing
    """
    model, cameras = pycolmap.Reconstruction(), {}
    if observations is None:
        observations = [(NO_ROWS, NO_PIXELS)] * len(views)
    for number, (view, (_, pixels)) in enumerate(zip(views, observations, strict=True), start=1):
        key = (view.camera.model_name, view.camera.width, view.camera.height, *view.camera.params)
        if key not in cameras:
            cameras[key] = pycolmap.Camera(view.camera.todict())
            cameras[key].camera_id, cameras[key].has_prior_focal_length = len(cameras), True
            model.add_camera_with_trivial_rig(cameras[key])
        image = pycolmap.Image(
            name=view.name,
            camera_id=cameras[key].camera_id,
            image_id=number,
            points2D=pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels]),
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world[:3]))
    tracks = [pycolmap.Track() for _ in points]
    for number, (rows, _) in enumerate(observations, start=1):
        for position, row in enumerate(rows):
            tracks[row].add_element(number, position)
    for point, color, track in zip(points, colors, tracks, strict=True):
        model.add_point3D(point, track, color)
    return model


def write_model(path: Path, model: pycolmap.Reconstruction) -> None:
    """Write a binary model as the folder `path`, atomically."""
    with atomic_path(path) as temporary:
        temporary.mkdir()
        model.write_binary(str(temporary))


def _check_rigs(model: pycolmap.Reconstruction, folder: Path) -> None:
    for rig_id, rig in model.rigs.items():
        unplaced = [sensor.id for sensor, pose in rig.non_ref_sensors.items() if pose is None]
        if unplaced:
            raise InputError(
                f"{folder}: camera {unplaced[0]} of rig {rig_id} has no pose in the rig, so its photos have no position: "
                "calibrate the rig (colmap rig_configurator, mapper) or take the model without it"
            )


def _check_camera(camera: pycolmap.Camera, folder: Path) -> None:
    where = f"{folder}: camera {camera.camera_id}"
    if camera.model_name == "EQUIRECTANGULAR":
        raise InputError(
            f"{where} is spherical (EQUIRECTANGULAR), which has no image plane: cut its photos into perspective ones first"
        )
    if not (
        0 < camera.width <= MAX_SIDE
        and 0 < camera.height <= MAX_SIDE
        and camera.width * camera.height <= MAX_PIXELS
    ):
        raise InputError(
            f"{where} is {camera.width}x{camera.height}: sizes from 1 px to {MAX_PIXELS // 10**6} megapixels are possible"
        )
    params = np.array(camera.params)
    if not np.isfinite(params).all() or not (params[list(camera.focal_length_idxs())] > 0).all():
        raise InputError(
            f"{where} has parameters that are not finite numbers, or a focal length that is not positive"
        )


def _check_poses(poses: list[pycolmap.Rigid3d], names: list[str], folder: Path) -> None:
    """poses: cam_from_world."""
    matrices = np.array([pose.matrix() for pose in poses])
    with np.errstate(all="ignore"):
        length = np.linalg.norm([pose.rotation.quat for pose in poses], axis=1)
        error = np.abs(matrices[:, :, :3] @ matrices[:, :, :3].transpose(0, 2, 1) - np.eye(3)).max(
            axis=(1, 2)
        )
        right = (error < NOT_RIGID) & (length > 0.5) & (np.abs(matrices[:, :, 3]) < FARTHEST).all(axis=1)
    if not right.all():
        raise InputError(
            f"{folder}: the pose of photo {names[int(np.argmin(right))]!r} is not a rotation and a finite position"
        )


def check_counts(folder: Path) -> None:
    """InputError if a file of a binary model is not as long as its counts say, or an id is used twice; a text
    model is left to pycolmap.
    """
    if not _is_binary(folder):
        return
    walks = {
        "cameras": _walk_cameras,
        "rigs": _walk_rigs,
        "frames": _walk_frames,
        "images": _walk_images,
        "points3D": _walk_points,
    }
    for name in FILES:
        if (folder / f"{name}.bin").exists():
            _check_part(folder, name, walks[name])


def _check_part(folder: Path, name: str, walk: Callable[[mmap.mmap, int], int]) -> None:
    file = folder / f"{name}.bin"
    try:
        _check_file(file, walk)
    except (DamagedFileError, struct.error) as error:
        what = str(error) if isinstance(error, DamagedFileError) else "is cut off"
        raise InputError(
            f"{file.name} of the COLMAP model in {folder} {what}: it is damaged, write or copy it again"
        ) from None


def _check_file(file: Path, walk: Callable[[mmap.mmap, int], int]) -> None:
    if not file.is_file():
        raise DamagedFileError("is no file")
    if file.stat().st_size < 8:
        raise DamagedFileError("is cut off")
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        count = _read("<Q", data, 0)[0]
        if count > len(data) // 8:  # no record is shorter
            raise DamagedFileError(f"announces {count} entries in {len(data)} bytes")
        end = walk(data, count)
        if end != len(data):
            raise DamagedFileError(
                "is cut off" if end > len(data) else f"has {len(data) - end} bytes more than it announces"
            )


def _read(form: str, data: mmap.mmap, position: int) -> tuple:
    return struct.unpack_from(form, data, position)


def _walk_cameras(data: mmap.mmap, count: int) -> int:
    position: int = 8
    ids: set[int] = set()
    for _ in range(count):
        number, model = _read("<Ii", data, position)
        _once(number, ids, "camera")
        position += 24 + 8 * _num_params(model)
    return position


@cache
def _num_params(model: int) -> int:
    try:
        return len(pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1).params)
    except (ValueError, TypeError):
        raise DamagedFileError(f"has a camera of the unknown model {model}") from None


def _walk_rigs(data: mmap.mmap, count: int) -> int:
    position: int = 8
    ids: set[int] = set()
    for _ in range(count):
        number, sensors = _read("<II", data, position)
        _once(number, ids, "rig")
        position += 8 + (8 if sensors else 0)
        for _ in range(max(sensors, 1) - 1):
            _, _, has_pose = _read("<iI?", data, position)
            position += 9 + (56 if has_pose else 0)
    return position


def _walk_frames(data: mmap.mmap, count: int) -> int:
    return _walk_records(data, count, FRAME)


def _walk_points(data: mmap.mmap, count: int) -> int:
    return _walk_records(data, count, POINT)


def _walk_records(data: mmap.mmap, count: int, fields: np.ndarray) -> int:
    if not count:
        return 8
    from sc3d.io import record_walk as kernels  # loads numba

    view = np.frombuffer(data, np.uint8)
    end, row = kernels.walk_bytes(view, 8, count, fields, False)
    del view  # it would keep the file mapped
    if end < 0:
        raise DamagedFileError(f"is cut off in entry {row} of {count}")
    return end


def _walk_images(data: mmap.mmap, count: int, names: list[str] | None = None) -> int:
    """names: gets the names of the photos."""
    position: int = 8
    ids: set[int] = set()
    for _ in range(count):
        _once(_read("<I", data, position)[0], ids, "photo")
        end = data.find(b"\0", position + 64, position + 64 + MAX_NAME)
        if end < 0:
            raise DamagedFileError(f"has a photo whose name does not end within {MAX_NAME} bytes")
        if names is not None:
            names.append(data[position + 64 : end].decode(errors="replace"))
        points = _read("<Q", data, end + 1)[0]
        position = end + 9 + 24 * points
        if position > len(data):
            raise DamagedFileError(f"is cut off: photo {len(ids)} of {count} announces {points} keypoints")
    return position


def _once(number: int, ids: set[int], what: str) -> None:
    if number in ids:
        raise DamagedFileError(f"has the {what} {number} twice")
    ids.add(number)
