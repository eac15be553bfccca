"""What changed between two dates: maps, a list and a picture."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.exporters.change_picture import draw_changes
from sc3d.exporters.changes import (
    Change,
    Dates,
    Noise,
    common_grid,
    find_changes,
    measure_noise,
    read_dates,
)
from sc3d.exporters.geotiff import write_labels, write_lengths
from sc3d.exporters.height_grids import read_points
from sc3d.exporters.projected_cloud import MapProjection
from sc3d.exporters.vector_files import write_geojson
from sc3d.georeferencing.georeference import read_georeference
from sc3d.io.atomic import require_writable
from sc3d.io.images import write_image
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Compare, Export

LISTED = 10  # changes that are logged one by one

logger = logging.getLogger(__name__)


def main(command: Compare) -> None:
    """Write `height_change.tif`, `class_change.tif`, `changes.geojson` (`*_local` without a CRS) and
    `changes.png`.
    """
    scenes = Scene(command.before), Scene(command.after)
    folder = command.output or scenes[1].export / "compare"
    settings = Export(epsg=_check(command, *scenes))
    require_writable(folder)
    before, after = (read_points(scene, settings) for scene in scenes)
    projection, grid = before.projection, common_grid(before, after, command.pixel_size)
    dates = read_dates(before, after, grid, (scenes[0].class_table(), scenes[1].class_table()))
    logger.info(
        "common grid: %d x %d cells of %g m, %.1f %% of them seen at both dates",
        grid.width,
        grid.height,
        grid.pixel,
        100 * np.isfinite(dates.rise).mean(),
    )
    _tell_noise(measure_noise(dates), command.min_height)
    changes = find_changes(dates, command.min_height, command.min_area, projection.unit)
    folder.mkdir(parents=True, exist_ok=True)
    _write(folder, dates, changes, projection)
    names = scenes[0].path.resolve().name, scenes[1].path.resolve().name
    write_image(folder / "changes.png", draw_changes(dates, changes, names, projection.unit))
    _tell_changes(changes, folder)


def _check(command: Compare, before: Scene, after: Scene) -> int:
    """EPSG code of the results, 0 = none; InputError for scenes or options that do not fit together, before
    any work.
    """
    sizes = (command.min_height, command.min_area, command.pixel_size)
    if not (np.isfinite(sizes).all() and min(sizes[:2]) > 0 and command.pixel_size >= 0):
        raise InputError("--min-height and --min-area must be above 0, --pixel-size must not be negative")
    for scene in (before, after):
        scene.require(scene.classes, hint="copy the class table of the labels there")
        scene.require(scene.labelled, hint="run `sc3d propagate SCENE` first")
    if before.path.resolve() == after.path.resolve():
        raise InputError("both scenes are the same folder: name the one before, then the one after")
    placed = [read_georeference(scene) for scene in (before, after)]
    if placed[0] is not None and placed[1] is not None:
        return command.epsg or placed[0].epsg
    if placed[0] is not None or placed[1] is not None:
        lacking = before if placed[0] is None else after
        raise InputError(
            f"{lacking.path} has no georeference and the other scene has one: "
            f"run `sc3d georeference {lacking.path}`"
        )
    logger.warning("neither scene is georeferenced: both are taken to be in one frame, in m")
    return command.epsg


def _write(folder: Path, dates: Dates, changes: list[Change], projection: MapProjection) -> None:
    write_lengths(
        folder / "height_change.tif", dates.rise, projection, dates.grid, "height after less before"
    )
    labels = dates.after.label * dates.relabelled
    write_labels(folder / "class_change.tif", labels, projection, dates.grid, dates.table)
    write_geojson(folder / f"changes{'' if projection.crs else '_local'}.geojson", changes, projection)


def _tell_noise(noise: Noise, min_height: float) -> None:
    """How well the dates agree where nothing changed; a warning where they do not well enough."""
    where = "ground of both dates" if noise.on_ground else "all places, as the dates share no ground"
    logger.info("%s: shift of height %+.3f m, noise %.3f m", where, noise.shift, noise.spread)
    if abs(noise.shift) > 0.5 * min_height:
        logger.warning(
            "the later scene lies %.2f m %s than the earlier one: georeference both with the same control "
            "points, or raise --min-height",
            abs(noise.shift),
            "higher" if noise.shift > 0 else "lower",
        )
    if 3 * noise.spread > min_height:
        logger.warning(
            "heights differ by noise of %.2f m: changes below %.2f m are not to be trusted; "
            "raise --min-height",
            noise.spread,
            3 * noise.spread,
        )


def _tell_changes(changes: list[Change], folder: Path) -> None:
    for change in changes[:LISTED]:
        what = change.before if change.before == change.after else f"{change.before} to {change.after}"
        logger.info(
            "%d: %s, %s, %.0f m2, %+.1f m, %+.0f m3",
            change.number,
            change.kind,
            what,
            change.area,
            change.rise,
            change.volume,
        )
    if len(changes) > LISTED:
        logger.info("and %d smaller ones", len(changes) - LISTED)
    logger.info("compare: %d changes, in %s", len(changes), folder)
