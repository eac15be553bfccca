"""Positions and orientations of the cameras as KML for globes and as CSV for tables."""

from __future__ import annotations

import csv
import io
import warnings
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sc3d.errors import InputError
from sc3d.exporters.projected_cloud import MapProjection, find_projection
from sc3d.geometry.cameras import View
from sc3d.georeferencing.georeference import crs_to_geodetic, geodetic_to_enu, triple
from sc3d.io.atomic import atomic_path
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export

AXES = np.diag([1.0, -1.0, -1.0])  # x right, y up, z backwards, in the camera's own frame
HEIGHTS = "heights are those of the scene's CRS, which KML takes for heights above sea level"


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / f"cameras.{kind}" for kind in ("kml", "csv") if kind in settings.format]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/cameras.kml` and `export/cameras.csv`, as `--format` says."""
    projection, writers = find_projection(scene, settings), {".kml": _kml, ".csv": _csv}
    poses = [Pose.of(view, projection) for view in scene.model.views]
    for path in outputs(scene, settings):
        text = writers[path.suffix](poses, projection, scene)
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="")
    return {"photos": len(poses), **projection.figures()}


@dataclass(frozen=True)
class Pose:
    """Where a photo was taken from.

    position: (3,) in the CRS; omega_phi_kappa: (3,) degrees of R_x R_y R_z, the CRS (its grid north) from the
        camera, x right, y up, z backwards
    geodetic: latitude, longitude, height; heading_tilt_roll: (3,) degrees, from true north, from straight down,
        to the right around the viewing direction; None without a CRS
    """

    name: str
    position: np.ndarray
    omega_phi_kappa: np.ndarray
    geodetic: np.ndarray | None = None
    heading_tilt_roll: np.ndarray | None = None

    @classmethod
    def of(cls, view: View, projection: MapProjection) -> Pose:
        axes = AXES @ view.cam_from_world[:3, :3]  # rows: right, up, backwards, in the world
        center = view.center[None]
        position = projection.to_crs(center)[0]
        on_grid = projection.directions_to_crs(np.repeat(center, 3, axis=0), axes)
        found = cls(view.name, position, _angles(on_grid, "XYZ"))
        if projection.crs is None:
            return found
        ends = projection.to_crs(center + axes)
        place, *others = crs_to_geodetic(np.vstack([position, ends]), projection.crs)
        on_earth = geodetic_to_enu(np.array(others), triple(place))
        heading, tilt, roll = _angles(on_earth, "ZXZ") * [-1, 1, -1]
        return cls(view.name, position, found.omega_phi_kappa, place, np.array([heading % 360, tilt, roll]))


def _angles(axes: np.ndarray, order: str) -> np.ndarray:
    """(3,) degrees of three rotations in a row; axes: (3, 3) rows as long as each other, nearly at right angles"""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # straight down, one angle of two is 0
        return Rotation.from_matrix(axes.T / np.linalg.norm(axes, axis=1)).as_euler(order, degrees=True)


def _csv(poses: list[Pose], projection: MapProjection, scene: Scene) -> str:
    on_earth = projection.crs is not None
    names = ("easting", "northing", "height") if on_earth else ("x", "y", "z")
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    more = ("latitude", "longitude", "heading", "tilt", "roll") if on_earth else ()
    writer.writerow(["photo", *names, "omega", "phi", "kappa", *more, "crs"])
    for pose in poses:
        row = [pose.name, *(f"{value:.4f}" for value in (*pose.position, *pose.omega_phi_kappa))]
        if pose.geodetic is not None and pose.heading_tilt_roll is not None:
            row += [f"{value:.9f}" for value in pose.geodetic[:2]]
            row += [f"{value:.4f}" for value in pose.heading_tilt_roll]
        writer.writerow([*row, f"EPSG:{projection.epsg}" if on_earth else "none"])
    return table.getvalue()


def _kml(poses: list[Pose], projection: MapProjection, scene: Scene) -> str:
    if projection.crs is None:
        raise InputError(
            f"KML needs a place on Earth, which {scene.path} has not: run `sc3d georeference` first, or --format csv"
        )
    marks = "".join(_placemark(pose) for pose in poses)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">\n<Document>\n'
        f"<name>{escape(scene.path.absolute().name)}</name>\n<description>{HEIGHTS}</description>\n{marks}</Document>\n</kml>\n"
    )


def _placemark(pose: Pose) -> str:
    assert pose.geodetic is not None and pose.heading_tilt_roll is not None
    latitude, longitude, height = pose.geodetic
    heading, tilt, roll = pose.heading_tilt_roll
    return (
        f"<Placemark><name>{escape(pose.name)}</name>"
        f"<Camera><longitude>{longitude:.9f}</longitude><latitude>{latitude:.9f}</latitude><altitude>{height:.3f}</altitude>"
        f"<heading>{heading:.4f}</heading><tilt>{tilt:.4f}</tilt><roll>{roll:.4f}</roll>"
        "<altitudeMode>absolute</altitudeMode></Camera>"
        "<Point><altitudeMode>absolute</altitudeMode>"
        f"<coordinates>{longitude:.9f},{latitude:.9f},{height:.3f}</coordinates></Point></Placemark>\n"
    )
