"""What people count: building footprints, tree crowns and other objects with area, height and confidence."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from sc3d.errors import InputError
from sc3d.exporters.best_photo import best_photos
from sc3d.exporters.packages import load
from sc3d.exporters.polygonize import orthogonalized, polygonize, simplified
from sc3d.exporters.projected_cloud import (
    BYTES,
    ProjectedCloud,
    find_projection,
    read_projected_cloud,
    require_whole,
)
from sc3d.exporters.vector_files import Feature, has_geopackage, write_geojson, write_geopackage
from sc3d.geometry.cameras import View
from sc3d.geometry.raster import Raster, highest_points, spacing_of_all
from sc3d.instances.buildings import roof_tops
from sc3d.instances.kinds import Kind, countable_kinds, ground_ids
from sc3d.instances.object_map import MIN_AREA, MIN_HEIGHT, Chunk, Tops, cover, measure, split_covered
from sc3d.instances.regions import cells_by_number, renumbered
from sc3d.instances.terrain import ground_height
from sc3d.instances.trees import MIN_CROWN
from sc3d.scene.class_table import ClassTable
from sc3d.scene.labelled_cloud import instances_of
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export

if TYPE_CHECKING:
    import shapely
else:
    shapely = load("shapely")

LAYERS = {"roofs": "buildings", "crowns": "trees"}  # files of their own, by kind
ALL = "objects"
CELL = 1.5  # side of the cells, in point spacings
MIN_CELL = 0.05  # m
TOP = 0.99  # quantile of a crown, or of a thing, that is its height: a single point is no tree top

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Site:
    """A labelled cloud and what is known of it on a grid; all lengths are meters.

    points: (N, 3) CRS; above: (N,) bool, points as high above the ground as a building or tree
    instance: (N,) uint32 object of each point as `propagate` told them apart; None = they are told apart here
    """

    projected: ProjectedCloud
    table: ClassTable
    points: np.ndarray
    tops: Tops
    above: np.ndarray
    instance: np.ndarray | None

    @property
    def grid(self) -> Raster:
        return self.tops.grid


def outputs(scene: Scene, settings: Export) -> list[Path]:
    crs = find_projection(scene, settings).crs
    layers = [_geojson(scene, layer, crs is not None) for layer in LAYERS.values()]
    package = [scene.export / "objects.gpkg"] if crs and has_geopackage() else []
    return [*layers, *package, _geojson(scene, ALL, crs is not None)]


def _geojson(scene: Scene, layer: str, placed: bool) -> Path:
    return scene.export / f"{layer}{'' if placed else '_local'}.geojson"


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/buildings.geojson`, `trees.geojson` and, with all countable classes, `objects.geojson`
    (`*_local.geojson` without a CRS), and buildings and trees as `objects.gpkg` where pyogrio is installed.
    """
    require_whole(scene, settings, BYTES)
    projected = read_projected_cloud(scene, settings)
    views = scene.model.views if scene.sparse.is_dir() else []
    layers, everything = find_objects(projected, scene.class_table(), settings, views)
    *maps, whole = outputs(scene, settings)
    for layer, path in zip(LAYERS.values(), maps):
        write_geojson(path, layers[layer], projected.projection)
    write_geojson(whole, everything, projected.projection)
    if len(maps) > len(LAYERS):
        write_geopackage(maps[-1], layers, projected.projection)
    figures: dict[str, object] = {layer: len(found) for layer, found in layers.items()}
    figures |= {
        f"{layer}_area": f"{sum(item.area for item in found):.0f} m2" for layer, found in layers.items()
    }
    others = len(everything) - sum(map(len, layers.values()))
    return {**figures, **({"others": others} if others else {}), **projected.projection.figures()}


def find_objects(
    projected: ProjectedCloud, table: ClassTable, settings: Export, views: Sequence[View] = ()
) -> tuple[dict[str, list[Feature]], list[Feature]]:
    """Buildings and trees of a labelled cloud, from north to south, each numbered from 1; and all objects,
    by the numbers that the cloud has. InputError if its classes cannot tell them from the ground.
    """
    kinds = require_kinds(table)
    site = look_at_site(projected, table, kinds, settings)
    layers: dict[str, list[Feature]] = {layer: [] for layer in LAYERS.values()}
    everything: list[Feature] = []
    for number, kind in enumerate(kinds):
        found = _find(site, number, kind, settings, views)
        if kind.how in LAYERS:
            layers[LAYERS[kind.how]] = found
        first = len(everything) + 1
        everything += [replace(item, number=item.instance or first + row) for row, item in enumerate(found)]
    return layers, everything


def require_kinds(table: ClassTable) -> list[Kind]:
    """The kinds that are counted; InputError if neither buildings nor trees are among them and the table
    does not say that anything is.
    """
    kinds = countable_kinds(table)
    if all(kind.how == "parts" for kind in kinds) and not any(entry.countable for entry in table):
        raise InputError(
            'no class has the ASPRS code of buildings (6) or vegetation (3 to 5): add "asprs" to the classes '
            'in classes.json, or "countable": true to what is to be counted'
        )
    return kinds


def look_at_site(
    projected: ProjectedCloud, table: ClassTable, kinds: Sequence[Kind], settings: Export
) -> Site:
    """The site on a grid; InputError if no point shows the ground."""
    points, label = projected.points * projected.projection.unit, projected.labels.label
    ground = ground_ids(table, np.bincount(label, minlength=256))
    if not ground:
        raise InputError(
            "no point belongs to a ground class, from which heights are measured: label roads or grass too"
        )
    grid = Raster.around(points, max(CELL * spacing_of_all(points), MIN_CELL))
    heights = ground_height(points, np.isin(label, ground), grid)
    chunk = Chunk(points, label, np.ones(len(points), bool))
    tops = measure(lambda: iter([chunk]), kinds, grid, heights, settings.min_height)
    above = points[:, 2] >= heights.ravel()[grid.flat_cells(points)] + settings.min_height
    # smaller things than the cloud's objects are told apart anew
    counted = settings.min_height >= MIN_HEIGHT and settings.min_area >= MIN_AREA
    instance = instances_of(projected.cloud, settings.labelled or Path("labelled.ply")) if counted else None
    return Site(projected, table, points, tops, above, instance)


def _find(site: Site, number: int, kind: Kind, settings: Export, views: Sequence[View]) -> list[Feature]:
    """The objects of one of the kinds."""
    grid, chosen = site.grid, np.isin(site.projected.labels.label, kind.ids)
    covered, heights = cover(site.tops, number, kind)
    if site.instance is None:
        regions = split_covered(covered, heights, grid, kind, (settings.min_height, settings.min_area))
    else:
        if kind.how == "crowns":
            covered = covered & (np.nan_to_num(heights) >= settings.min_height)
        regions = given_regions(site, chosen, covered)
        if kind.how == "roofs":
            large = np.bincount(regions.ravel())[regions] * grid.pixel**2 >= settings.min_area
            regions = renumbered(np.where(large, regions, 0))
    _tell_of_left_out(kind, chosen, regions, site, settings)
    ground = _quantiles(site.tops.ground, regions, 0.5)
    if kind.how == "roofs":
        tops = roof_tops(regions, heights, grid.pixel) - ground
    else:
        above = heights - (0.0 if kind.how == "crowns" else site.tops.ground)
        tops = _quantiles(np.nan_to_num(above), regions, TOP)
    volumes = _volumes(heights - (0.0 if kind.how == "crowns" else site.tops.ground), regions, grid)
    members = chosen & site.above if kind.how != "parts" else chosen
    return _features(
        site, regions, members, _outlines(regions, grid, kind, settings), (tops, ground, volumes), views
    )


def given_regions(site: Site, chosen: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """(H, W) int32 regions from 1 of covered cells (H, W) bool, by the objects of the highest of the chosen
    points (N,) bool in each cell, or in the nearest that has one.
    """
    instance = site.instance if site.instance is not None else np.zeros(len(chosen), np.uint32)
    rows = highest_points(site.grid, site.points, chosen & (instance > 0))
    if not (rows >= 0).any():
        return np.zeros(site.grid.shape, np.int32)
    nearest = ndimage.distance_transform_edt(rows < 0, return_distances=False, return_indices=True)
    return renumbered(np.where(covered, instance[rows[tuple(nearest)]].astype(np.int64), 0))


def _outlines(regions: np.ndarray, grid: Raster, kind: Kind, settings: Export) -> dict[int, shapely.Polygon]:
    """Outline of each region, m: of buildings with right angles where that is wanted, of crowns without
    holes.
    """
    traced = polygonize(regions, grid)
    if kind.how == "roofs":
        draw = orthogonalized if settings.rectangular else simplified
        return {number: draw(outline, 2 * grid.pixel) for number, outline in traced.items()}
    return {
        number: simplified(shapely.Polygon(outline.exterior), grid.pixel)
        for number, outline in traced.items()
    }


def _tell_of_left_out(
    kind: Kind, chosen: np.ndarray, regions: np.ndarray, site: Site, settings: Export
) -> None:
    """How many points of a kind (N,) bool belong to none of the regions (H, W)."""
    why = {
        "roofs": f"lower than {settings.min_height:g} m, or in pieces below {settings.min_area:g} m2",
        "crowns": f"lower than {settings.min_height:g} m, or in crowns below {MIN_CROWN:g} m2",
        "parts": "too small",
    }[kind.how]
    above = site.above if kind.how != "parts" else True
    member = above & (regions.ravel()[site.grid.flat_cells(site.points)] > 0)
    lost, total = int((chosen & ~member).sum()), int(chosen.sum())
    if lost:
        name = LAYERS.get(kind.how, site.table.name(kind.ids[0]))
        logger.info("%s: %d of %d points are part of no object: %s", name, lost, total, why)


def _quantiles(values: np.ndarray, regions: np.ndarray, share: float) -> np.ndarray:
    """(R,) float64 quantile of the values (H, W) in each of the regions (H, W) numbered from 1."""
    cells = cells_by_number(regions, int(regions.max()))
    return np.array([np.quantile(values.ravel()[region], share) for region in cells])


def _volumes(above: np.ndarray, regions: np.ndarray, grid: Raster) -> np.ndarray:
    """(R,) float64 m3 between the heights above the ground (H, W), m, and the ground; below it counts
    nothing.
    """
    heights = np.maximum(np.nan_to_num(above), 0.0)
    return (np.bincount(regions.ravel(), heights.ravel()) * grid.pixel**2)[1:]


def _features(
    site: Site,
    regions: np.ndarray,
    chosen: np.ndarray,
    outlines: dict[int, shapely.Polygon],
    sizes: tuple[np.ndarray, np.ndarray, np.ndarray],
    views: Sequence[View],
) -> list[Feature]:
    """Features of the regions (H, W) numbered from 1; chosen: (N,) bool points of their kind; outlines: m;
    sizes: (R,) of the top above the ground and z of the ground, m, and volume, m3.
    """
    cloud, projection = site.projected, site.projected.projection
    numbers = np.where(chosen, regions.ravel()[site.grid.flat_cells(site.points)], 0)
    members = cells_by_number(numbers, int(regions.max()))
    places = cloud.cloud.point.positions.numpy(), site.points
    photos = best_photos(members, places, (site.grid, site.tops.all), views, projection)
    features = []
    for number, (rows, photo) in enumerate(zip(members, photos), start=1):
        outline = outlines[number]
        label = most_common(cloud.labels.label[rows])
        polygon = (
            outline
            if projection.unit == 1
            else shapely.transform(outline, lambda corners: corners / projection.unit)
        )
        height, ground, volume = (float(values[number - 1]) for values in sizes)
        confidence = float(cloud.labels.confidence[rows].astype(np.float64).mean()) if len(rows) else 0.0
        instance = 0 if site.instance is None else most_common(site.instance[rows])
        # fmt: off
        features.append(
            Feature(polygon, number, site.table.name(label), label, outline.area, height, ground, confidence,
                    len(rows), volume, instance, photo)
        )
        # fmt: on
    return features


def most_common(values: np.ndarray) -> int:
    """The most frequent of whole numbers (K,), of equally frequent ones the smallest; 0 without any."""
    found, counts = np.unique(values, return_counts=True)
    return int(found[np.argmax(counts)]) if len(found) else 0
