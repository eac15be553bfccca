"""A window, a page in the browser, or a picture or video without a display."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sc3d.errors import InputError
from sc3d.io.images import write_image
from sc3d.io.memory_limit import memory_limit
from sc3d.io.photo_folder import IMAGE_SUFFIXES
from sc3d.scene.photo_names import PhotoNames
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import ViewCommand

if TYPE_CHECKING:
    import numpy as np

    from sc3d.geometry.cameras import View

logger = logging.getLogger(__name__)


def main(command: ViewCommand) -> None:
    scene = Scene(command.scene)
    scene.require(hint="")
    _check(command)
    views = scene.model.views if scene.sparse.is_dir() else []
    photo = None if command.photo is None else _find_photo(command.photo, views, scene)
    if photo is not None:
        command = replace(command, photo=photo.name)
    if command.flight is not None:
        _write_flight(command, scene, command.flight)
    with memory_limit(command.memory.max_memory, "view"):
        if command.web or command.html is not None:
            _show_page(command, scene, views)
        elif command.screenshot is not None:
            write_image(command.screenshot, _picture(command, scene, views, photo))
            logger.info("wrote %s", command.screenshot)
        elif command.flight is None:
            _open_window(command, scene, views)


def _check(command: ViewCommand) -> None:
    """Raise InputError for options that do not fit together, before any work."""
    page = command.web or command.html is not None
    if page and (
        command.screenshot is not None
        or command.flight is not None
        or (command.web and command.html is not None)
    ):
        raise InputError("choose one of --web, --html FILE and --screenshot FILE or --flight FILE")
    if command.splats and not page and command.screenshot is None and command.flight is None:
        raise InputError(
            "the window shows no splats: add --web for the browser, --screenshot FILE for a picture, or --flight FILE for a video"
        )
    if command.splats and command.file is not None:
        raise InputError("--splats shows the Gaussians of the scene: leave out --file")
    if command.splats and command.by in ("state", "disagreement"):
        raise InputError(f"splats have no {command.by}: choose --by photo, label or confidence")
    if command.flight is not None and command.flight.suffix.lower() != ".mp4":
        raise InputError(f"{command.flight}: give the video a name that ends in .mp4")
    if command.screenshot is not None and command.screenshot.suffix.lower() not in IMAGE_SUFFIXES:
        raise InputError(f"{command.screenshot}: give the picture a name that ends in .png or .jpg")
    if command.html is not None and command.html.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{command.html}: give the page a name that ends in .html")
    if min(command.size) < 16:
        raise InputError(f"--size {command.size[0]} {command.size[1]} is too small: at least 16 px each way")
    if command.points < 0 or not 0 <= command.port < 1 << 16:
        raise InputError("--points is a number of points, and --port lies between 0 and 65535")


def _find_photo(name: str, views: list[View], scene: Scene) -> View:
    by_name = {view.name: view for view in views}
    return by_name[PhotoNames(by_name).one(name, scene.sparse)]


def _write_flight(command: ViewCommand, scene: Scene, path: Path) -> None:
    from sc3d.view.display_splats import splats_colored_by
    from sc3d.view.flight_video import write_flight

    by = command.by if command.splats else "photo"
    splats = splats_colored_by(scene, by, command.classes)
    write_flight(path, splats, by, scene.model.views, command.size)
    logger.info("wrote %s", path)


def _picture(command: ViewCommand, scene: Scene, views: list[View], photo: View | None) -> np.ndarray:
    """(H, W, 3) uint8 RGB"""
    from sc3d.view.display_cloud import class_ids, load_cloud, only_classes
    from sc3d.view.display_splats import splats_colored_by
    from sc3d.view.screenshot import Style, screenshot, screenshot_splats

    drawn = views if command.cameras and photo is None else ()
    style = Style(by=command.by, from_above=command.from_above, cameras=drawn)
    if command.splats:
        splats = splats_colored_by(scene, command.by, command.classes)
        pixels = None if photo is None else scene.read_photo(photo.name)
        return screenshot_splats(splats, photo, pixels, command.size, style)
    table = scene.class_table() if scene.classes.exists() else None
    cloud = load_cloud(scene, command.file, command.by == "disagreement", command.unconfirmed, command.memory)
    cloud = only_classes(cloud, class_ids(table, command.classes))
    return screenshot(cloud, photo, command.size, style, table)


def _open_window(command: ViewCommand, scene: Scene, views: list[View]) -> None:
    from sc3d.view.renderers import check_display

    check_display()
    from sc3d.view.display_cloud import class_ids, load_cloud
    from sc3d.view.picking import Inspector
    from sc3d.view.window import show

    cloud = load_cloud(
        scene,
        command.file,
        True if command.by == "disagreement" else None,
        command.unconfirmed,
        command.memory,
    )
    inspector = Inspector.from_scene(scene, cloud, views, command.memory)
    classes = class_ids(inspector.class_table, command.classes)
    show(inspector, views if command.cameras else [], command.by, classes)


def _show_page(command: ViewCommand, scene: Scene, views: list[View]) -> None:
    """Serve the page or write it."""
    from sc3d.view.colors import can_color, color_points
    from sc3d.view.display_cloud import class_ids, load_cloud
    from sc3d.view.display_splats import best_splats
    from sc3d.view.picking import Inspector
    from sc3d.view.web.page import WebView, load_viser, serve, write_page

    load_viser()
    has_cloud, by = command.file is not None or scene.best_cloud is not None, command.by
    splats_first = command.splats or not has_cloud
    splats = best_splats(scene) if splats_first else None
    votes = True if by == "disagreement" else None
    cloud = (
        load_cloud(scene, command.file, votes, command.unconfirmed, command.memory)
        if splats is None or has_cloud
        else splats.centers()
    )
    inspector = Inspector.from_scene(scene, cloud, views, command.memory)
    if splats_first and not can_color(cloud, by):
        by = "photo"
        logger.info("there are no labels yet, the colors are those of the photos")
    color_points(cloud, by, inspector.class_table)
    has_splats = splats is not None or scene.gaussians.exists()
    view = WebView(
        scene,
        inspector,
        (lambda: splats or best_splats(scene)) if has_splats else None,
        splats_first,
        by,
        class_ids(inspector.class_table, command.classes),
        command.cameras,
        command.photo,
        command.from_above,
        command.points,
    )
    if command.html is None:
        serve(view, command.host, command.port)
    else:
        write_page(command.html, view)
        logger.info("wrote %s", command.html)
