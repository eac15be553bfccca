"""A window, or a picture without a display."""

from __future__ import annotations

import logging

from sc3d.errors import InputError
from sc3d.io import read_cloud, write_image
from sc3d.scene import Scene
from sc3d.settings import View

logger = logging.getLogger(__name__)


def main(command: View) -> None:
    from sc3d.view.pictures import Style, screenshot
    from sc3d.view.window import show

    scene = Scene(command.scene)
    scene.require(hint="")
    file = command.file or next((path for path in (scene.labelled, scene.seeds, scene.cloud) if path.exists()), None)
    if file is None:
        raise InputError(f"{scene.path} has no cloud to show: run `sc3d extract SCENE`, or pass --file FILE")
    cloud = read_cloud(file)
    class_table = scene.class_table() if scene.classes.exists() else None
    views = scene.model.views if scene.sparse.is_dir() else []
    if command.photo is not None:
        chosen = next((view for view in views if view.name == command.photo), None)
        if chosen is None:
            raise InputError(f"no photo {command.photo!r} in {scene.sparse}: one of {', '.join(view.name for view in views[:5])} ...")
    if command.screenshot is None:
        show(cloud, views if command.cameras else [], class_table, command.by)
        return
    style = Style(by=command.by, from_above=command.from_above, cameras=views if command.cameras and command.photo is None else ())
    image = screenshot(cloud, chosen if command.photo is not None else None, command.size, style, class_table)
    write_image(command.screenshot, image)
    logger.info("wrote %s", command.screenshot)
