"""nerfstudio and instant-ngp: `transforms.json`.

`transform_matrix` is world from camera with OpenGL axes (x right, y up, z backwards). `applied_transform`
(and `applied_scale`) lead from the original frame to that of the file; they are undone, so that clouds and
meshes in the original frame fit.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from sc3d.errors import InputError
from sc3d.geometry.cameras import View
from sc3d.geometry.distortion import DistortionModel, to_camera
from sc3d.importers.project import Project, rigid
from sc3d.io.clouds import read_cloud
from sc3d.io.images import image_size
from sc3d.io.json_files import read_json
from sc3d.settings.reconstruction import Import

EXPECTED = "a transforms.json or its folder is expected"
FILE = "transforms.json"
PERSPECTIVE = {"PERSPECTIVE", "OPENCV", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL"}
OPENGL = np.array([1.0, -1.0, -1.0])  # y and z of the camera change sign


def matches(path: Path) -> bool:
    return (path / FILE).is_file() or (path.suffix == ".json" and path.name.startswith("transforms"))


def files(path: Path) -> list[Path]:
    return [path / FILE if path.is_dir() else path]


def read(path: Path, settings: Import) -> Project:
    file = files(path)[0]
    content = read_json(file)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise InputError(f"{file} has no list of frames")
    original, scale = _original_from_saved(content, file)
    cameras: dict[DistortionModel, pycolmap.Camera] = {}
    views = []
    for number, frame in enumerate(content["frames"]):
        where = f"{file}, frame {number}"
        name = str(frame.get("file_path", "")) if isinstance(frame, dict) else ""
        if not name:
            raise InputError(f"{where} has no file_path")
        matrix = _matrix(frame.get("transform_matrix"), where)
        world_from_cam = original[:3, :3] @ matrix[:3, :3] * OPENGL
        center = original[:3, :3] @ (matrix[:3, 3] / scale) + original[:3, 3]
        distortion = _distortion_model(content, frame, file.parent / name, where)
        if distortion not in cameras:
            cameras[distortion] = to_camera(distortion, settings.tolerance, where)
        views.append(View(_tidy(name), cameras[distortion], rigid(world_from_cam.T, center, where)))
    points, colors = _points(file.parent, content, original, scale)
    return Project(
        "nerfstudio",
        views,
        points,
        colors,
        photos=file.parent,
        notes={"applied_transform": "undone" if "applied_transform" in content else "none"},
    )


def _distortion_model(content: dict, frame: dict, photo: Path, where: str) -> DistortionModel:
    """Parameters of a frame: those at the top of the file count first, as in nerfstudio; null says nothing."""

    def stated(key: str) -> float | None:
        value = next((table[key] for table in (content, frame) if table.get(key) is not None), None)
        try:
            return None if value is None else float(value)
        except (TypeError, ValueError):
            raise InputError(f"{where}: {key} is no number") from None

    def number(key: str, default: float) -> float:
        value = stated(key)
        return default if value is None else value

    model = str(content.get("camera_model", frame.get("camera_model", "OPENCV")))
    if model not in PERSPECTIVE | {"OPENCV_FISHEYE"}:
        raise InputError(
            f"{where}: the camera model {model} has no COLMAP model that is known here; {', '.join(sorted(PERSPECTIVE))} and OPENCV_FISHEYE have"
        )
    width, height = stated("w"), stated("h")
    if width is None or height is None:
        width, height = image_size(photo)
    angle, focal = stated("camera_angle_x"), stated("fl_x")
    if focal is None and angle:
        focal = width / 2 / float(np.tan(angle / 2))
    if focal is None:
        raise InputError(f"{where}: neither fl_x nor camera_angle_x is given")
    listed = content.get("distortion_params", frame.get("distortion_params"))
    k1, k2, k3, k4, p1, p2 = (
        listed if listed is not None else [number(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2")]
    )
    fisheye = model == "OPENCV_FISHEYE"
    return DistortionModel(
        int(width),
        int(height),
        (focal, number("fl_y", focal)),
        (number("cx", width / 2), number("cy", height / 2)),
        (k1, k2, k3, k4),
        (0.0, 0.0) if fisheye else (p1, p2),
        fisheye,
    )


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


def _points(folder: Path, content: dict, original: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) points of `ply_file_path` in the original frame, (P, 3) colors; none without such a file."""
    file = folder / str(content.get("ply_file_path") or "")
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


def _tidy(name: str) -> str:
    return str(Path(name.replace("\\", "/")))


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
