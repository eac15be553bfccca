"""Where exported coordinates lie: the CRS of the scene or a chosen one, or the scene's own frame where there
is no georeference.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import open3d as o3d

from sc3d.errors import InputError
from sc3d.georeferencing.georeference import (
    Georeference,
    check_area,
    crs_to_geodetic,
    projected_crs,
    read_georeference,
    triple,
    write_georeference,
)
from sc3d.georeferencing.up_direction import tell_tilt
from sc3d.io.chunked_clouds import CloudFile, positions
from sc3d.scene.class_table import ClassTable
from sc3d.scene.cloud_parts import cloud_of
from sc3d.scene.labelled_cloud import UNCONFIRMED, confirmed_only, is_confirmed, read_labelled, take_labels
from sc3d.scene.labels import Labels
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export
from sc3d.tiling.memory import fits, num_points, require_fit

if TYPE_CHECKING:
    import pyproj

logger = logging.getLogger(__name__)

BYTES = 250  # of a point while a cloud is exported as a whole


@dataclass(frozen=True)
class MapProjection:
    """How world coordinates become exported ones. georeference, epsg: None = they stay as they are, one unit
    = 1 m, z up.
    """

    georeference: Georeference | None = None
    epsg: int | None = None

    @cached_property
    def crs(self) -> pyproj.CRS | None:
        return projected_crs(self.epsg) if self.epsg else None

    @cached_property
    def unit(self) -> float:
        """Meters per unit of the exported coordinates, all three of them."""
        return float(self.crs.axis_info[0].unit_conversion_factor) if self.crs else 1.0

    def to_crs(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) world to (N, 3) float64 easting, northing, height in the CRS."""
        points = np.asarray(points, np.float64)
        if self.georeference is None:
            return points
        points = self.georeference.to_crs(points)
        if self.epsg == self.georeference.epsg:
            return points
        import pyproj

        between = pyproj.Transformer.from_crs(self.georeference.crs, self.crs, always_xy=True)
        east, north = between.transform(points[:, 0], points[:, 1])
        if not np.isfinite([east, north]).all():
            raise InputError(
                f"the scene lies outside the area of EPSG:{self.epsg}: choose the CRS of the place with --epsg"
            )
        return np.stack([east, north, points[:, 2] * self.georeference.unit / self.unit], axis=1)

    def directions_to_crs(self, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Unit vectors (N, 3) at world points (N, 3), turned as the CRS is (grid north is not true north);
        float32.
        """
        if self.georeference is None:
            return directions
        turned = self.to_crs(points + directions) - self.to_crs(points)
        length = np.linalg.norm(turned, axis=1, keepdims=True)
        return np.divide(turned, length, out=np.zeros_like(turned), where=length > 0).astype(np.float32)

    def figures(self) -> dict[str, object]:
        """What the summary says about coordinates."""
        return {
            "crs": f"EPSG:{self.epsg}"
            if self.epsg
            else "none: the scene has no georeference, coordinates are its own"
        }


def find_projection(scene: Scene, settings: Export) -> MapProjection:
    """The scene's georeference with the CRS of `--epsg`; without a georeference, `--epsg` says which CRS the
    world coordinates are in.
    """
    georeference = read_georeference(scene)
    if georeference is not None:
        projection = MapProjection(georeference, settings.epsg or georeference.epsg)
        if projection.epsg != georeference.epsg:
            place = crs_to_geodetic(np.array([georeference.offset]), georeference.crs)[0]
            check_area(projected_crs(settings.epsg or georeference.epsg), triple(place))
    elif settings.epsg:
        projection = MapProjection(Georeference(settings.epsg, (0.0, 0.0, 0.0)), settings.epsg)
    else:
        _warn(scene)
        return MapProjection()
    _ = projection.crs  # an unknown code is an error before any work
    return projection


@lru_cache(maxsize=8)
def _warn(scene: Scene) -> None:
    """Once per scene, not once per format."""
    logger.warning(
        "%s has no georeference: coordinates stay those of the scene, z is taken as up and 1 unit as 1 m",
        scene.path,
    )
    tell_tilt(scene)


@dataclass(frozen=True)
class ProjectedCloud:
    """The labelled cloud with its positions in the CRS.

    cloud: N points with attributes, positions in the world; points: (N, 3) float64 CRS
    """

    cloud: o3d.t.geometry.PointCloud
    labels: Labels
    points: np.ndarray
    projection: MapProjection

    @property
    def colors(self) -> np.ndarray | None:
        """(N, 3) uint8 RGB; None if the cloud has no colors."""
        if "colors" not in self.cloud.point:
            return None
        colors = self.cloud.point.colors.numpy()
        return colors if colors.dtype == np.uint8 else np.clip(np.rint(colors * 255), 0, 255).astype(np.uint8)


def read_projected_cloud(scene: Scene, settings: Export) -> ProjectedCloud:
    """Read the labelled cloud, check its labels against the class table and move it into the CRS."""
    path = settings.labelled or scene.labelled
    cloud, labels = read_labelled(path, "propagate")
    if not settings.unconfirmed:
        kept = is_confirmed(cloud)
        _tell_unconfirmed(path, int((~kept).sum()), len(kept))
        cloud, labels = confirmed_only(cloud), labels[kept]
    _require_known(scene.class_table(), labels, path, scene)
    projection = find_projection(scene, settings)
    return ProjectedCloud(cloud, labels, projection.to_crs(cloud.point.positions.numpy()), projection)


@lru_cache(maxsize=8)
def _tell_unconfirmed(path: Path, count: int, total: int) -> None:
    """Once per cloud, not once per format."""
    if count == total:
        raise InputError(
            f"no second photo confirms any point of {path}: pass --unconfirmed to write them all the same"
        )
    if count:
        logger.info(
            "%d of %d points are left out, as no second photo confirms them; `sc3d export --unconfirmed` writes them",
            count,
            total,
        )


def _require_known(table: ClassTable, labels: Labels, path: Path, scene: Scene) -> None:
    unknown = table.unknown(labels.label)
    if unknown:
        raise InputError(f"{path} has class id {unknown[0]}, which is not in {scene.classes}: add it there")


def fits_whole(path: Path, settings: Export) -> bool:
    """Whether a cloud fits into memory as a whole, or cannot be read in parts."""
    count = num_points(path) if path.exists() else None
    return count is None or fits(count * BYTES, settings)


def require_whole(scene: Scene, settings: Export, bytes_per_point: int, surface: int = 0) -> None:
    """InputError, before the work, if the labelled cloud, with so many bytes of surface, does not fit into memory,
    for formats that need all of it.
    """
    path = settings.labelled or scene.labelled
    count = (num_points(path) if path.exists() else None) or 0
    require_fit(
        count * bytes_per_point + surface,
        settings,
        f"{' and '.join(settings.format)} of {count / 1e6:.1f} million points",
        "allow more, or export laz, copc, 3dtiles, clouds, object-clouds, masks, dtm, dsm, ndsm or contours, which are"
        " written part by part",
    )


def projected_chunks(scene: Scene, settings: Export) -> Iterator[ProjectedCloud]:
    """The same in parts, in order; as a whole if that fits into memory."""
    path = settings.labelled or scene.labelled
    if fits_whole(path, settings):
        yield read_projected_cloud(scene, settings)
        return
    projection, table = find_projection(scene, settings), scene.class_table()
    left, file = 0, CloudFile.open(path)
    for _, records in file.chunks():
        if UNCONFIRMED in file.names and not settings.unconfirmed:
            kept = records[UNCONFIRMED] == 0
            left += int((~kept).sum())
            records = records[kept]
        if not len(records):
            continue
        cloud = cloud_of(records)
        labels = take_labels(cloud, path, "propagate")
        _require_known(table, labels, path, scene)
        yield ProjectedCloud(cloud, labels, projection.to_crs(positions(records)), projection)
    if left:
        _tell_unconfirmed(path, left, file.num_points)


def chosen_classes(scene: Scene, settings: Export) -> set[int]:
    """Ids of the classes to write: those named in `--classes`, or all with 0; InputError for a name that is
    not in the class table.
    """
    table = scene.class_table()
    if not settings.classes:
        return {0} | {entry.id for entry in table}
    ids = {entry.name: entry.id for entry in table}
    for name in settings.classes:
        if name not in ids:
            raise InputError(
                f"there is no class {name!r} in {scene.classes}: its classes are {', '.join(ids)}"
            )
    return {ids[name] for name in settings.classes}


def copy_georeference(scene: Scene, folder: Path) -> None:
    """Put the scene's georeference beside an export, as the formats have no place for it; `sc3d import` finds
    it there.
    """
    found = read_georeference(scene)
    if found is not None:
        write_georeference(Scene(folder), found)
