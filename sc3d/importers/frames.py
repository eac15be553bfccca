"""From the frame of a cloud or model to that of the scene: large coordinates, a CRS of its own, or the world
already.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import View
from sc3d.georeferencing.alignment import Similarity, fit_similarity
from sc3d.georeferencing.georeference import (
    Georeference,
    from_origin,
    geodetic_to_enu,
    projected_crs,
    read_georeference,
    triple,
)
from sc3d.importers.clouds import Geometry
from sc3d.importers.project import Project, rigid
from sc3d.scene.frame_check import check_frame
from sc3d.scene.scene import Scene

logger = logging.getLogger(__name__)

LARGE = 1e5  # coordinates beyond this belong to a CRS and lose millimeters in float32
FAR = 20.0  # times the extent of the cameras: a cloud farther away than this is in another frame
# m from the Earth's center: what lies on it; and m along its axis, more than any height in a projected CRS
ON_EARTH, ALONG_AXIS = (6.33e6, 6.40e6), 2e4


def near_origin(project: Project, epsg: int | None) -> Project:
    """A project with large coordinates moved near the origin: world = CRS - offset, or ENU for geocentric
    ones; any other unchanged. `epsg`: the CRS of the coordinates; of exports where they are geocentric.
    """
    centers = np.array([view.center for view in project.views])
    if project.georeference is None and _is_geocentric(centers):
        return _from_geocentric(project, epsg)
    if project.georeference is not None or np.abs(np.median(centers, axis=0)).max() < LARGE:
        return project
    if epsg is None:
        logger.warning(
            "the cameras have coordinates of a CRS, but nothing says which: pass --epsg to make use of it"
        )
        return project
    projected_crs(epsg)
    offset = whole_offset(centers)
    return replace(
        project,
        views=[view.shifted(offset) for view in project.views],
        points=project.points - offset,
        georeference=Georeference(epsg, tuple(offset.tolist())),
        offset=offset,
    )


def _is_geocentric(centers: np.ndarray) -> bool:
    middle = np.median(centers, axis=0)
    distance = float(np.linalg.norm(middle))
    return ON_EARTH[0] < distance < ON_EARTH[1] and abs(float(middle[2])) > ALONG_AXIS


def _from_geocentric(project: Project, epsg: int | None) -> Project:
    import pyproj

    logger.warning(
        "the cameras of this %s project are in geocentric coordinates: read as those of WGS 84 (EPSG:4978)",
        project.program,
    )
    geodetic = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979")
    middle = np.median([view.center for view in project.views], axis=0)
    origin, enu = enu_of_geocentric(middle, lambda points: np.stack(geodetic.transform(*points.T), axis=1))
    return replace(
        project,
        views=[moved_view(view, middle, enu) for view in project.views],
        points=enu.apply(project.points - middle),
        georeference=from_origin(origin, epsg),
        model=None,
    )


def enu_of_geocentric(
    middle: np.ndarray, to_geodetic: Callable[[np.ndarray], np.ndarray]
) -> tuple[tuple[float, float, float], Similarity]:
    """Origin (latitude, longitude, height) of a local ENU frame near a geocentric position, and the
    similarity from geocentric coordinates minus that position to it.

    middle: (3,) m; to_geodetic: (N, 3) geocentric to (N, 3) latitude, longitude, height on WGS 84
    """
    # points that show how one frame lies in the other
    frame = middle + 1000 * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
    geodetic = to_geodetic(frame)
    origin = triple(round(float(value), digits) for value, digits in zip(geodetic[0], (6, 6, 0)))
    return origin, fit_similarity(frame - middle, geodetic_to_enu(geodetic, origin))


def moved_view(view: View, middle: np.ndarray, moved: Similarity) -> View:
    """A view after a similarity of coordinates minus `middle`."""
    center = moved.apply((view.center - middle)[None])[0]
    pose = rigid(view.cam_from_world[:3, :3] @ moved.rotation.T, center, view.name)
    return replace(view, cam_from_world=pose)


def whole_offset(points: np.ndarray) -> np.ndarray:
    """(3,) whole-number position near the points; the height stays as it is."""
    return np.round(np.median(points, axis=0)) * [1.0, 1.0, 0.0]


def frame_of_scene(
    scene: Scene, geometry: Geometry, epsg: int | None
) -> tuple[list[View], Georeference | None]:
    """Cameras and place of a scene that is there; for one without cameras, a place near a geometry whose CRS
    is stated or `epsg`.
    """
    has_cameras = any((scene.sparse / f"cameras{suffix}").exists() for suffix in (".bin", ".txt"))
    views, georeference = scene.model.views if has_cameras else [], read_georeference(scene)
    epsg = geometry.epsg or epsg
    if georeference is None and not views and epsg is not None:
        georeference = Georeference(epsg, tuple(whole_offset(geometry.positions).tolist()))
    return views, georeference


def place_geometries(
    geometries: dict[Path, Geometry],
    georeference: Georeference | None,
    views: list[View],
    sparse_points: np.ndarray,
    epsg: int | None,
) -> dict[Path, tuple[Geometry, str]]:
    """The geometries in the scene's world, each with what its coordinates were taken for; a warning where one
    lies elsewhere than the cameras and sparse points (P, 3).

    epsg: the CRS of those that state none
    """
    placed = {}
    for path, geometry in geometries.items():
        taken = frame_of(geometry.positions, geometry.epsg or epsg, georeference, views, str(path))
        moved = place_geometry(geometry, taken, georeference)
        check_frame(path, moved.positions, views, sparse_points)
        placed[path] = moved, "world" if taken is None else f"EPSG:{taken}"
    return placed


def place_geometry(geometry: Geometry, epsg: int | None, georeference: Georeference | None) -> Geometry:
    """A geometry in what `frame_of` says, in the world."""
    positions = move_to_world(geometry.positions, epsg, georeference)
    attributes = dict(geometry.attributes)
    if "normals" in attributes:
        attributes["normals"] = turn_to_world(geometry.positions, attributes["normals"], epsg, georeference)
    return replace(geometry, positions=positions, attributes=attributes)


def frame_of(
    positions: np.ndarray, epsg: int | None, georeference: Georeference | None, views: list[View], name: str
) -> int | None:
    """The CRS that positions of a cloud, or some of them, are in; None = the world of the scene already.

    epsg: as its file or the user says; None = not stated: the world, unless only the scene's CRS brings it to
        the cameras
    """
    centers = np.array([view.center for view in views]).reshape(-1, 3)
    if epsg is not None and georeference is not None:
        return epsg
    if epsg is not None and (not len(centers) or _far(positions, centers)):
        raise InputError(
            f"{name} is in EPSG:{epsg}, but nothing says where the scene's cameras are: run `sc3d georeference` on the scene first"
        )
    if georeference is not None and len(centers) and _far(positions, centers):
        with suppress(InputError):  # outside of the CRS
            if not _far(georeference.from_crs(positions), centers):
                return georeference.epsg
    return None


def move_to_world(positions: np.ndarray, epsg: int | None, georeference: Georeference | None) -> np.ndarray:
    """Positions (N, 3) in what `frame_of` says, in the world."""
    if epsg is None or georeference is None:
        return positions
    return georeference.from_crs(_reproject(positions, epsg, georeference))


def turn_to_world(
    positions: np.ndarray, normals: np.ndarray, epsg: int | None, georeference: Georeference | None
) -> np.ndarray:
    """(N, 3) float32 unit normals at positions (N, 3) in what `frame_of` says, turned as the world is;
    those of no length stay.
    """
    if epsg is None or georeference is None:
        return normals
    ahead = move_to_world(positions + np.nan_to_num(normals.astype(np.float64)), epsg, georeference)
    turned = ahead - move_to_world(positions, epsg, georeference)
    length = np.linalg.norm(turned, axis=1, keepdims=True)
    return np.divide(turned, length, out=np.zeros_like(turned), where=length > 0).astype(np.float32)


def _reproject(positions: np.ndarray, epsg: int, georeference: Georeference) -> np.ndarray:
    """From one projected CRS to that of the georeference; heights keep their value in meters."""
    if epsg == georeference.epsg:
        return positions
    import pyproj

    source = projected_crs(epsg)
    east, north = pyproj.Transformer.from_crs(source, georeference.crs, always_xy=True).transform(
        positions[:, 0], positions[:, 1]
    )
    if not np.isfinite([east, north]).all():
        raise InputError(f"positions outside the area of EPSG:{epsg}: it is another CRS")
    return np.stack(
        [east, north, positions[:, 2] * source.axis_info[0].unit_conversion_factor / georeference.unit],
        axis=1,
    )


def _far(positions: np.ndarray, centers: np.ndarray) -> bool:
    middle = np.median(centers, axis=0)
    extent = max(float(np.linalg.norm(np.ptp(centers, axis=0))), 1.0)
    return float(np.linalg.norm(np.median(positions, axis=0) - middle)) > FAR * extent
