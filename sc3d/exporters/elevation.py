"""Terrain for maps: heights of the ground (DTM), of the surface (DSM), of what stands on the ground (nDSM),
and contour lines.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.exporters.contours import interval_for, trace_contours, write_contours
from sc3d.exporters.geotiff import write_lengths
from sc3d.exporters.height_grids import GroundGrid, grid_of, ground_grid, read_points, surface_grid
from sc3d.exporters.packages import load
from sc3d.exporters.projected_cloud import MapProjection
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export

FILES = {
    "dtm": ("dtm.tif", "dtm_distance.tif"),
    "dsm": ("dsm.tif",),
    "ndsm": ("ndsm.tif",),
    "contours": ("contours.gpkg",),
}
FAR = 20.0  # ground this far from any that was measured is a guess, m

logger = logging.getLogger(__name__)


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / name for kind in _kinds(settings) for name in FILES[kind]]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """What `settings.format` names of: `export/dtm.tif` and `dtm_distance.tif` (0 where ground was
    measured, else how far that is), `dsm.tif`, `ndsm.tif` (float32, units of the CRS), `contours.gpkg`; on
    one grid.
    """
    kinds = _kinds(settings)
    if settings.pixel_size < 0 or settings.contour_interval < 0:
        raise InputError("--pixel-size and --contour-interval must not be negative: 0 chooses them")
    if "contours" in kinds:
        load("pyogrio")
    cloud = read_points(scene, settings)
    grid, projection = grid_of(cloud, settings.pixel_size), cloud.projection
    figures: dict[str, object] = {"size": f"{grid.width} x {grid.height} px of {grid.pixel:g} m"}
    if set(kinds) != {"dsm"}:
        ground = ground_grid(cloud, grid, scene.class_table())
        figures |= _figures(ground)
    if "dtm" in kinds:
        heights, distances = (scene.export / name for name in FILES["dtm"])
        write_lengths(heights, ground.height, projection, grid, "height of the ground")
        write_lengths(distances, ground.distance, projection, grid, "distance to measured ground")
    if {"dsm", "ndsm"} & set(kinds):
        top = surface_grid(cloud, grid).height
    if "dsm" in kinds:
        write_lengths(scene.export / "dsm.tif", top, projection, grid, "height of the surface")
    if "ndsm" in kinds:
        above = top - ground.height
        write_lengths(scene.export / "ndsm.tif", above, projection, grid, "height above the ground")
    if "contours" in kinds:
        figures |= _write_contours(scene, settings, ground, projection)
    return figures | projection.figures()


def _kinds(settings: Export) -> list[str]:
    return [name for name in FILES if name in settings.format]


def _write_contours(
    scene: Scene, settings: Export, ground: GroundGrid, projection: MapProjection
) -> dict[str, object]:
    interval = settings.contour_interval or interval_for(ground.height, projection.unit)
    lines = trace_contours(ground, interval, projection.unit)
    write_contours(scene.export / FILES["contours"][0], lines, projection)
    return {"contours": len(lines), "interval": f"{interval:g} {'m' if projection.unit == 1 else 'units'}"}


def _figures(ground: GroundGrid) -> dict[str, object]:
    """What the summary says of the ground; a warning where much of it is a guess."""
    distance = ground.distance[np.isfinite(ground.distance)]
    far = float((distance > FAR).mean())
    if far > 0:
        logger.warning(
            "%.1f %% of the terrain is more than %g m from any point of the ground: dtm_distance.tif says where",
            100 * far,
            FAR,
        )
    return {
        "interpolated": f"{(distance > 0).mean():.1%}",
        "farthest": f"{distance.max():.1f} m",
        "ground_points_left_out": f"{ground.dropped:.1%}",
    }
