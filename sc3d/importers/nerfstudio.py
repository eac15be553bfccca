"""nerfstudio, instant-ngp and Blender's synthetic scenes: `transforms.json`, `transforms_train.json`.

Lens values stand at the top of the file, in each frame, or both: then those at the top count in nerfstudio,
those of the frame in instant-ngp (whose files have `aabb_scale` and no `camera_model`). instant-ngp's
`is_fisheye` is OpenCV's fisheye; nerfstudio's `camera_model` says the same.
`transform_matrix` is world from camera with OpenGL axes (x right, y up, z backwards). `applied_transform`
(and `applied_scale`) lead from the original frame to that of the file; they are undone, so that clouds and
meshes in the original frame fit.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from sc3d.errors import InputError, examples
from sc3d.geometry.cameras import View
from sc3d.geometry.distortion import DistortionModel, Lenses
from sc3d.importers.photos import names_in, photo_folder, plain_name
from sc3d.importers.project import Project, rigid
from sc3d.io.clouds import read_cloud
from sc3d.io.folders import resolved
from sc3d.io.images import image_size
from sc3d.io.json_files import read_json
from sc3d.settings.reconstruction import Import

logger = logging.getLogger(__name__)

EXPECTED = "a transforms.json or its folder is expected"
FILES = ("transforms.json", "transforms_train.json")  # the first that is there
PERSPECTIVE = {"PERSPECTIVE", "OPENCV", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL"}
FISHEYE = {"OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
# lenses of instant-ngp, and terms of other programs, that no COLMAP model has
UNKNOWN = ("ftheta_p0", "latlong", "equirectangular", "orthographic", "k5", "k6")
LENS = (
    "w",
    "h",
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "k1",
    "k2",
    "k3",
    "k4",
    "p1",
    "p2",
    "is_fisheye",
    "camera_model",
)
OPENGL = np.array([1.0, -1.0, -1.0])  # y and z of the camera change sign


def matches(path: Path) -> bool:
    return (
        _file(path).is_file() and _file(path).suffix == ".json" and _file(path).name.startswith("transforms")
    )


def files(path: Path) -> list[Path]:
    return [_file(path)]


def read(path: Path, settings: Import) -> Project:
    file = _file(path)
    content = read_json(file)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise InputError(f"{file} has no list of frames")
    _warn_of_others(path, file)
    frames, lenses = content["frames"], Lenses(settings.tolerance)
    poses = _poses(content, file)
    no_camera = pycolmap.Camera()
    project = Project(
        "nerfstudio",
        [View(plain_name(frame["file_path"]), no_camera, pose) for frame, pose in zip(frames, poses)],
        *_points(file.parent, content),
        photos=file.parent,
        notes={"applied_transform": "undone" if "applied_transform" in content else "none"},
    )
    tables = [_lens_table(content, frame) for frame in frames]
    sizes = _sizes(project, tables, settings)
    unknown = [row for row, size in enumerate(sizes) if size is None]
    if frames and len(unknown) == len(frames):
        raise InputError(
            f"{file} states no w and h, and none of its photos is there, such as {project.views[0].name}: pass their folder with --images"
        )
    views = [
        view
        if size is None
        else replace(view, camera=lenses.camera(_distortion_model(table, size, where), where))
        for row, (view, table, size) in enumerate(zip(project.views, tables, sizes))
        for where in [f"{file}, frame {row}"]
    ]
    _warn_of_lenses(content, file)
    lenses.warn(file)
    return replace(project, views=views).without(unknown, "without a stated size that are not there")


def _file(path: Path) -> Path:
    if not path.is_dir():
        return path
    return next((path / name for name in FILES if (path / name).is_file()), path / FILES[0])


def _warn_of_others(path: Path, file: Path) -> None:
    """Blender's synthetic scenes have their photos in three files."""
    others = sorted(other.name for other in file.parent.glob("transforms_*.json") if other != file)
    if path.is_dir() and file.name != FILES[0] and others:
        logger.warning("%s: only %s is read, left out: %s", path, file.name, examples(others))


def _poses(content: dict, file: Path) -> list[np.ndarray]:
    """(4, 4) cam_from_world of every frame, in the original frame."""
    original, scale = _original_from_saved(content, file)
    poses = []
    for number, frame in enumerate(content["frames"]):
        where = f"{file}, frame {number}"
        if (
            not isinstance(frame, dict)
            or not isinstance(frame.get("file_path"), str)
            or not frame["file_path"]
        ):
            raise InputError(f"{where} has no file_path")
        matrix = _matrix(frame.get("transform_matrix"), where)
        world_from_cam = original[:3, :3] @ matrix[:3, :3] * OPENGL
        center = original[:3, :3] @ (matrix[:3, 3] / scale) + original[:3, 3]
        poses.append(rigid(world_from_cam.T, center, where))
    return poses


def _is_instant_ngp(content: dict) -> bool:
    return "aabb_scale" in content and "camera_model" not in content


def _lens_table(content: dict, frame: dict) -> dict[str, Any]:
    """All values for the lens of a frame; null says nothing."""
    tables = (content, frame) if _is_instant_ngp(content) else (frame, content)
    return {key: value for table in tables for key, value in table.items() if value is not None}


def _warn_of_lenses(content: dict, file: Path) -> None:
    """Lens values of frames that do not count, and shutters that no model here has."""
    frames = content["frames"]
    ignored = [
        frame["file_path"]
        for frame in frames
        if not _is_instant_ngp(content)
        and any(content.get(key) is not None and frame.get(key, content[key]) != content[key] for key in LENS)
    ]
    if ignored:
        logger.warning(
            "%s: lens values of %d of %d frames differ from those at the top of the file, which count, as in nerfstudio: %s",
            file,
            len(ignored),
            len(frames),
            examples(ignored),
        )
    if any(any(table.get("rolling_shutter") or []) for table in (content, *frames)):
        logger.warning("%s: its photos have a rolling shutter: each is read as if exposed at once", file)


def _sizes(project: Project, tables: list[dict], settings: Import) -> list[tuple[int, int] | None]:
    """(width, height) of every view as stated, else of its photo; None where there is neither."""
    stated = [(table.get("w"), table.get("h")) for table in tables]
    folder = photo_folder(project, settings.images) if any(None in size for size in stated) else None
    names = names_in(folder) if folder else None
    sizes: list[tuple[int, int] | None] = []
    for view, table, size in zip(project.views, tables, stated):
        found = names.match(view.name, changed=False) if names and None in size else ()
        if None not in size:
            sizes.append((_whole(table, "w", view.name), _whole(table, "h", view.name)))
        else:
            sizes.append(image_size(folder / found[0]) if folder and len(found) == 1 else None)
    return sizes


def _whole(table: dict, key: str, where: str) -> int:
    value = _number(table, key, where)
    if not value.is_integer():
        raise InputError(f"{where}: {key} is {value}: a number of pixels is whole")
    return int(value)


def _number(table: dict, key: str, where: str, default: float | None = None) -> float:
    try:
        return float(table[key] if default is None else table.get(key, default))
    except (TypeError, ValueError):
        raise InputError(f"{where}: {key} is no number") from None


def _distortion_model(table: dict, size: tuple[int, int], where: str) -> DistortionModel:
    """table: lens values; size: width, height px."""
    model = str(table.get("camera_model", "OPENCV"))
    if model not in PERSPECTIVE | FISHEYE:
        raise InputError(
            f"{where}: the camera model {model} has no COLMAP model that is known here; {', '.join(sorted(PERSPECTIVE | FISHEYE))} have"
        )
    unknown = [key for key in UNKNOWN if table.get(key)]
    if unknown:
        raise InputError(f"{where}: a lens with {unknown[0]} has no COLMAP model: export undistorted photos")
    is_fisheye = _number(table, "is_fisheye", where, 0.0) != 0
    if is_fisheye and "camera_model" in table and model in PERSPECTIVE:
        raise InputError(f"{where}: is_fisheye and the camera model {model} contradict one another")
    fisheye, (width, height) = is_fisheye or model in FISHEYE, size
    focal = _focal(table, size, where)
    listed = table.get("distortion_params")
    if fisheye and isinstance(listed, list) and len(listed) == 4:
        listed = [*listed, 0.0, 0.0]
    if listed is not None and (not isinstance(listed, list) or len(listed) != 6):
        raise InputError(
            f"{where}: distortion_params has other than 6 values (k1 k2 k3 k4 p1 p2): write them as k1, k2, p1, p2"
        )
    k1, k2, k3, k4, p1, p2 = (
        listed
        if listed is not None
        else [_number(table, key, where, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2")]
    )
    return DistortionModel(
        width,
        height,
        focal,
        (_number(table, "cx", where, width / 2), _number(table, "cy", where, height / 2)),
        (k1, k2, k3, k4),
        (0.0, 0.0) if fisheye else (p1, p2),
        fisheye,
        left_out=_tangential_cost((p1, p2), size, focal) if fisheye else (),
    )


def _tangential_cost(
    tangential: tuple[float, float], size: tuple[int, int], focal: tuple[float, float]
) -> tuple[tuple[str, float], ...]:
    """What it costs at most to leave out p1 and p2 of a fisheye, px: programs differ in what they do there."""
    reach = float(np.hypot(*np.divide(size, focal))) / 2
    cost = 3 * float(np.hypot(*tangential)) * reach**2 * max(focal)
    return (("p1 and p2 of a fisheye", cost),) if cost else ()


def _focal(table: dict, size: tuple[int, int], where: str) -> tuple[float, float]:
    """(fx, fy) px; a focal length counts before an angle, and one along x alone holds for both."""
    angles = [
        length / 2 / float(np.tan(_number(table, key, where) / 2)) if table.get(key) else None
        for key, length in zip(("camera_angle_x", "camera_angle_y"), size)
    ]
    horizontal = _number(table, "fl_x", where) if "fl_x" in table else angles[0]
    if horizontal is None:
        raise InputError(f"{where}: neither fl_x nor camera_angle_x is given")
    vertical = horizontal if "fl_x" in table or angles[1] is None else angles[1]
    return horizontal, _number(table, "fl_y", where) if "fl_y" in table else vertical


def _original_from_saved(content: dict, file: Path) -> tuple[np.ndarray, float]:
    """(4, 4) inverse of `applied_transform`, and the scale that was applied after it."""
    if content.get("applied_transform") is None:
        return np.eye(4), float(content.get("applied_scale", 1.0))
    applied = _matrix([*content["applied_transform"][:3], [0, 0, 0, 1]], f"{file}: applied_transform")
    return np.linalg.inv(applied), float(content.get("applied_scale", 1.0))


def _matrix(rows: object, where: str) -> np.ndarray:
    try:
        matrix = np.array(rows, np.float64)
        if matrix.shape == (3, 4):
            matrix = np.vstack([matrix, [0, 0, 0, 1]])
        if (
            matrix.shape != (4, 4)
            or not np.isfinite(matrix).all()
            or abs(np.linalg.det(matrix[:3, :3])) < 1e-12
        ):
            raise ValueError
    except (TypeError, ValueError):
        raise InputError(f"{where} is no 4x4 matrix of finite numbers that can be inverted") from None
    return matrix


def _points(folder: Path, content: dict) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) points of `ply_file_path` in the original frame, (P, 3) colors; none without such a file."""
    original, scale = _original_from_saved(content, folder)
    file = folder / plain_name(str(content.get("ply_file_path") or ""))
    if not resolved(file).is_relative_to(resolved(folder)):
        logger.warning("%s: ply_file_path leads out of the project, it is not read: %r", folder, str(file))
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if not file.is_file():
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    cloud = read_cloud(file)
    points = cloud.point.positions.numpy().astype(np.float64) / scale @ original[:3, :3].T + original[:3, 3]
    colors = (
        cloud.point.colors.numpy() if "colors" in cloud.point else np.full((len(points), 3), 128, np.uint8)
    )
    return points, colors if colors.dtype == np.uint8 else np.clip(np.rint(colors * 255), 0, 255).astype(
        np.uint8
    )


def camera_parameters(camera: pycolmap.Camera, where: str) -> dict[str, object]:
    """The keys of transforms.json for a camera, the inverse of what `read` does; InputError for models that
    the format has not.
    """
    params, model = list(camera.params), camera.model_name
    simple = {
        "SIMPLE_PINHOLE": 0,
        "SIMPLE_RADIAL": 1,
        "RADIAL": 2,
        "SIMPLE_RADIAL_FISHEYE": 1,
        "RADIAL_FISHEYE": 2,
    }
    if model in simple:
        params = [params[0], *params[:3], *params[3:]]
    names = {
        "OPENCV": ("k1", "k2", "p1", "p2"),
        "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
        "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3"),
        "PINHOLE": (),
    }.get(model, ("k1", "k2"))
    if model not in {*simple, "PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"} or (
        model == "FULL_OPENCV" and any(params[9:])
    ):
        raise InputError(
            f"{where}: transforms.json has no model like {model}: export undistorted photos or a COLMAP model instead"
        )
    keys = dict(zip(("fl_x", "fl_y", "cx", "cy", *names), [float(value) for value in params]))
    return {
        "camera_model": "OPENCV_FISHEYE" if "FISHEYE" in model else "OPENCV",
        "w": camera.width,
        "h": camera.height,
        **keys,
    }
