"""A window, a page in the browser, or a picture or video without a display."""

from __future__ import annotations

import logging
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import InputError
from sc3d.io.clouds import read_cloud
from sc3d.io.images import IMAGE_SUFFIXES, read_image, write_image
from sc3d.io.json_files import read_json
from sc3d.runner import sidecar
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import View

if TYPE_CHECKING:
    import open3d as o3d

    from sc3d.geometry.cameras import View as Camera
    from sc3d.scene.class_table import ClassTable
    from sc3d.view.display_splats import ShownSplats
    from sc3d.view.picking import Inspector

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
            raise InputError(
                f"no photo {command.photo!r} in {scene.sparse}: one of {', '.join(view.name for view in views[:5])} ..."
            )
    if command.flight is not None:
        _write_flight(command, scene)
    if command.web or command.html is not None:
        _show_page(command, scene, views)
    elif command.splats and command.screenshot is not None:
        write_image(command.screenshot, _picture_of_splats(command, scene, photo))
        logger.info("wrote %s", command.screenshot)
    elif command.screenshot is not None:
        write_image(command.screenshot, _picture_of_cloud(command, scene, views, photo))
        logger.info("wrote %s", command.screenshot)
    elif command.flight is None:
        _open_window(command, scene, views)


def _check(command: View) -> None:
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


def _picture_of_cloud(command: View, scene: Scene, views: list[Camera], photo: Camera | None) -> np.ndarray:
    """(H, W, 3) uint8 RGB"""
    from sc3d.view.display_cloud import class_ids, only_classes
    from sc3d.view.screenshot import Style, screenshot

    cloud, table = _read_cloud(command, scene, votes=command.by == "disagreement"), _class_table(scene)
    cloud = only_classes(cloud, class_ids(table, command.classes))
    style = Style(
        by=command.by,
        from_above=command.from_above,
        cameras=views if command.cameras and photo is None else (),
    )
    return screenshot(cloud, photo, command.size, style, table)


def _open_window(command: View, scene: Scene, views: list[Camera]) -> None:
    from sc3d.view.display import check_display

    check_display()
    from sc3d.view.display_cloud import class_ids
    from sc3d.view.window import show

    inspector = _inspector(scene, _read_cloud(command, scene, votes=True), views)
    show(
        inspector,
        views if command.cameras else [],
        command.by,
        class_ids(inspector.class_table, command.classes),
    )


def _show_page(command: View, scene: Scene, views: list[Camera]) -> None:
    """Serve the page or write it."""
    from sc3d.view.colors import can_color, color_points
    from sc3d.view.display_cloud import class_ids
    from sc3d.view.web.page import WebView, load_viser, serve, write_page

    load_viser()
    has_cloud = command.file is not None or _file_of(scene) is not None
    splats_first = command.splats or not has_cloud
    splats = _splats_of_scene(scene) if splats_first else None
    inspector = _inspector(
        scene, _read_cloud(command, scene, votes=True) if has_cloud else splats.centers(), views
    )
    by = command.by
    if splats_first and not can_color(inspector.cloud, by):
        by = "photo"
        logger.info("there are no labels yet, the colors are those of the photos")
    color_points(inspector.cloud, by, inspector.class_table)
    load_splats = (
        None if splats is None and not scene.gaussians.exists() else lambda: splats or _splats_of_scene(scene)
    )
    view = WebView(
        scene,
        inspector,
        load_splats,
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


def _file_of(scene: Scene) -> object:
    """Path of the best cloud of a scene, None if there is none."""
    return next((path for path in (scene.labelled, scene.seeds, scene.cloud) if path.exists()), None)


def _read_cloud(command: View, scene: Scene, votes: bool) -> o3d.t.geometry.PointCloud:
    """The cloud to show. votes: with those of seeds.ply, if it has none itself and they can be had."""
    from sc3d.view.colors import can_color
    from sc3d.view.display_cloud import with_votes

    file = command.file or _file_of(scene)
    if file is None:
        raise InputError(f"{scene.path} has no cloud to show: run `sc3d extract SCENE`, or pass --file FILE")
    cloud = read_cloud(file)
    if not votes or can_color(cloud, "disagreement") or command.file is not None or not scene.seeds.exists():
        return cloud
    if command.by == "disagreement":
        return with_votes(cloud, read_cloud(scene.seeds))
    with suppress(InputError):
        return with_votes(cloud, read_cloud(scene.seeds))
    return cloud


def _class_table(scene: Scene) -> ClassTable | None:
    return scene.class_table() if scene.classes.exists() else None


def _inspector(scene: Scene, cloud: o3d.t.geometry.PointCloud, views: list[Camera]) -> Inspector:
    """Looks points up as `label` saw them: with the voxel size that it wrote down."""
    from sc3d.view.picking import Inspector

    voxel_size = None
    with suppress(InputError, KeyError, TypeError, ValueError):
        voxel_size = float(read_json(sidecar(scene.seeds))["summary"]["voxel_size"])
    return Inspector(cloud, views, _class_table(scene), scene.mesh, voxel_size)


def _splats_of_scene(scene: Scene) -> ShownSplats:
    """The labelled splats if they have been exported, else those that were trained."""
    from sc3d.view.display_splats import labelled_splats, trained_splats

    if scene.classes.exists() and (scene.export / "splats.ply").exists():
        return labelled_splats(scene, scene.class_table())
    logger.info("the splats have no labels yet: `sc3d export %s --format splats` labels them", scene.path)
    return trained_splats(scene)


def _splats(command: View, scene: Scene) -> ShownSplats:
    """The splats for a picture or video: gaussians.ply as trained or, for `--splats --by label` and `--by
    confidence`, the labelled ones.
    """
    from sc3d.view.display_cloud import class_ids
    from sc3d.view.display_splats import labelled_splats, trained_splats

    labelled = scene.export / "splats.ply"
    unlabelled = command.by == "photo" or (command.by == "label" and not labelled.exists())
    if command.classes or (command.splats and not unlabelled):
        table = scene.class_table()
        return labelled_splats(scene, table).only(class_ids(table, command.classes))
    if command.splats and command.by == "label":
        logger.info(
            "the splats have no labels yet and are shown as trained: `sc3d export %s --format splats` labels them",
            scene.path,
        )
    return trained_splats(scene)


def _picture_of_splats(command: View, scene: Scene, photo: Camera | None) -> np.ndarray:
    """(H, W, 3) uint8 RGB: the splats from the air, or beside a photo; in class colors or by confidence
    where they have labels.
    """
    from sc3d.geometry.cameras import resample
    from sc3d.splatting.evaluation import compare, picture
    from sc3d.view.captions import add_legend
    from sc3d.view.contact_sheet import half_of, side_by_side
    from sc3d.view.viewpoints import aerial_view, fitted, without_outliers

    splats = _splats(command, scene)
    table = scene.class_table() if splats.label is not None and command.by != "photo" else None
    gaussians = splats.gaussians if table is None else splats.painted(command.by, table)
    present = None if table is None else set(np.unique(splats.label).tolist())
    if photo is None:
        seen = gaussians.means[gaussians.opacities > 0.5].numpy()
        points = seen if len(seen) else gaussians.means.numpy()
        image = picture(
            gaussians, aerial_view(without_outliers(points), command.size, command.from_above), WHITE
        )
        return image if table is None else add_legend(image, command.by, table, present)
    source = photo.shifted(splats.origin)
    view = fitted(source, half_of(command.size))
    pixels = resample(read_image(scene.photo(photo.name)), source, view)
    if table is not None:
        image = side_by_side(
            (pixels, picture(gaussians, view, WHITE)), (photo.name, f"splats by {command.by}")
        )
        return add_legend(image, command.by, table, present)
    found = compare(gaussians, view, pixels)
    return side_by_side((found.photo, found.rendered), (photo.name, f"splats, PSNR {found.psnr:.2f} dB"))


def _write_flight(command: View, scene: Scene) -> None:
    from tqdm import tqdm

    from sc3d.splatting.evaluation import picture
    from sc3d.view.flight_video import flight_path, write_video

    splats = _splats(command, scene)
    gaussians = (
        splats.painted(command.by, scene.class_table())
        if command.splats and splats.label is not None
        else splats.gaussians
    )
    path = flight_path([view.shifted(splats.origin) for view in scene.model.views], command.size)
    frames = (
        picture(gaussians, view, WHITE) for view in tqdm(path, desc="flight", unit="frame", disable=None)
    )
    write_video(command.flight, frames, (path[0].width, path[0].height))
    logger.info("wrote %s", command.flight)
