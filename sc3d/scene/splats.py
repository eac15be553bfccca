"""The trained Gaussians of a scene, as plain arrays."""

from __future__ import annotations

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import local_origin
from sc3d.io.splats import ORIGIN, origin_comment, read_splat_ply
from sc3d.scene.frame_check import check_frame, check_scale
from sc3d.scene.scene import Scene


def read_scene_splats(scene: Scene) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The arrays of `gaussians.ply` (`io.splats.read_splat_ply`) and the (3,) world position of their local
    origin.

    A file of another program, which has no comment with the origin, is in the frame of the cameras' model.
    Raises InputError that says what to run if there are none, or if they belong to other cameras than the
    scene's; warns if they lie elsewhere.
    """
    scene.require(scene.gaussians, hint=f"run `sc3d train {scene.path}` first")
    origin = local_origin(scene.model.views)
    arrays, comments = read_splat_ply(scene.gaussians, origin)
    if any(line.startswith(ORIGIN) for line in comments) and origin_comment(origin) not in comments:
        raise InputError(
            f"{scene.gaussians} was trained with other cameras than those in {scene.sparse}:"
            f" run `sc3d train {scene.path} --overwrite`"
        )
    if not len(arrays["means"]):
        raise InputError(f"{scene.gaussians} holds no Gaussians: run `sc3d train {scene.path} --overwrite`")
    points = arrays["means"].astype(np.float64) + origin
    is_near = check_frame(scene.gaussians, points, scene.model.views, scene.model.points)
    if is_near and not any(line.startswith(ORIGIN) for line in comments):
        check_scale(scene.gaussians, points, scene.model.views, scene.model.points)
    return arrays, origin
