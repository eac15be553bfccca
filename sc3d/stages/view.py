"""A window, or a picture or video without a display."""

from __future__ import annotations

import logging

import numpy as np

from sc3d.errors import InputError
from sc3d.io import IMAGE_SUFFIXES, read_cloud, read_image, write_image
from sc3d.scene import Scene
from sc3d.settings import View

logger = logging.getLogger(__name__)

WHITE = (255, 255, 255)  # where there are no splats


def main(command: View) -> None:
    scene = Scene(command.scene)
    scene.require(hint="")
    _check(command)
    views = scene.model.views if scene.sparse.is_dir() else []
    photo = None
    if command.photo is not None:
        photo = next((view for view in views if view.name == command.photo), None)
        if photo is None:
            raise InputError(f"no photo {command.photo!r} in {scene.sparse}: one of {', '.join(view.name for view in views[:5])} ...")
    if command.flight is not None:
        _write_flight(command, scene)
    if command.splats and command.screenshot is not None:
        write_image(command.screenshot, _picture_of_splats(command, scene, photo))
        logger.info("wrote %s", command.screenshot)
    elif command.screenshot is not None or command.flight is None:
        _show_cloud(command, scene, views, photo)


def _check(command: View) -> None:
    """Raise InputError for options that do not fit together, before any work."""
    if command.splats and command.screenshot is None and command.flight is None:
        raise InputError("the window shows no splats: add --screenshot FILE for a picture, or --flight FILE for a video")
    if command.splats and command.file is not None:
        raise InputError("--splats shows SCENE/gaussians.ply: leave out --file")
    if command.flight is not None and command.flight.suffix.lower() != ".mp4":
        raise InputError(f"{command.flight}: give the video a name that ends in .mp4")
    if command.screenshot is not None and command.screenshot.suffix.lower() not in IMAGE_SUFFIXES:
        raise InputError(f"{command.screenshot}: give the picture a name that ends in .png or .jpg")
    if min(command.size) < 16:
        raise InputError(f"--size {command.size[0]} {command.size[1]} is too small: at least 16 px each way")


def _show_cloud(command: View, scene: Scene, views: list, photo) -> None:  # noqa: ANN001 - geometry.cameras.View or None
    from sc3d.view.pictures import Style, screenshot
    from sc3d.view.window import show

    file = command.file or next((path for path in (scene.labelled, scene.seeds, scene.cloud) if path.exists()), None)
    if file is None:
        raise InputError(f"{scene.path} has no cloud to show: run `sc3d extract SCENE`, or pass --file FILE")
    cloud = read_cloud(file)
    class_table = scene.class_table() if scene.classes.exists() else None
    if command.screenshot is None:
        show(cloud, views if command.cameras else [], class_table, command.by)
        return
    style = Style(by=command.by, from_above=command.from_above, cameras=views if command.cameras and photo is None else ())
    write_image(command.screenshot, screenshot(cloud, photo, command.size, style, class_table))
    logger.info("wrote %s", command.screenshot)


def _picture_of_splats(command: View, scene: Scene, photo) -> np.ndarray:  # noqa: ANN001 - geometry.cameras.View or None
    """(H, W, 3) uint8 RGB: the splats from the air, or beside a photo."""
    from sc3d.geometry.cameras import resample
    from sc3d.splatting.pictures import compare, load_gaussians, rendered
    from sc3d.view.aerial import aerial_view, fitted, without_outliers
    from sc3d.view.sheet import half_of, side_by_side

    gaussians, origin = load_gaussians(scene)
    if photo is None:
        seen = gaussians.means[gaussians.opacities > 0.5].numpy()
        points = seen if len(seen) else gaussians.means.numpy()
        return rendered(gaussians, aerial_view(without_outliers(points), command.size, command.from_above), WHITE)
    source = photo.shifted(origin)
    view = fitted(source, half_of(command.size))
    found = compare(gaussians, view, resample(read_image(scene.photo(photo.name)), source, view))
    return side_by_side(found.photo, found.rendered, (photo.name, f"splats, PSNR {found.psnr:.2f} dB"))


def _write_flight(command: View, scene: Scene) -> None:
    from tqdm import tqdm

    from sc3d.splatting.pictures import load_gaussians, rendered
    from sc3d.view.flight import flight_path, write_video

    gaussians, origin = load_gaussians(scene)
    path = flight_path([view.shifted(origin) for view in scene.model.views], command.size)
    frames = (rendered(gaussians, view, WHITE) for view in tqdm(path, desc="flight", unit="frame", disable=None))
    write_video(command.flight, frames, (path[0].width, path[0].height))
    logger.info("wrote %s", command.flight)
