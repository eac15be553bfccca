"""What people count: building footprints and tree crowns with area, height and confidence."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import InputError
from sc3d.exporters.buildings import roof_heights, roof_tops, split_buildings
from sc3d.exporters.packages import load
from sc3d.exporters.polygonize import orthogonalized, polygonize, simplified
from sc3d.exporters.projected_cloud import (
    BYTES,
    ProjectedCloud,
    find_projection,
    read_projected_cloud,
    require_whole,
)
from sc3d.exporters.regions import cells_by_number
from sc3d.exporters.terrain import ground_height
from sc3d.exporters.trees import MIN_CROWN, canopy_height, split_crowns
from sc3d.exporters.vector_files import Feature, has_geopackage, write_geojson, write_geopackage
from sc3d.geometry.raster import Raster, spacing_of_all
from sc3d.scene.class_table import ClassTable
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export

if TYPE_CHECKING:
    import shapely
else:
    shapely = load("shapely")

LAYERS = ("buildings", "trees")
CELL = 1.5  # side of the cells, in point spacings
MIN_CELL = 0.05  # m
BUILDING, NOISE = 6, (7, 18)  # ASPRS codes
TREE_TOP = 0.99  # quantile of the crown that is its height: a single point is no tree top

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Kinds:
    """Which points are what: (N,) bool each."""

    building: np.ndarray
    tree: np.ndarray
    ground: np.ndarray


@dataclass(frozen=True)
class Site:
    """A labelled cloud and what is known of it on a grid; all lengths are meters.

    points: (N, 3) CRS; ground: (H, W) z of the ground; above: (N,) bool, points as high above it as a
        building or tree
    """

    projected: ProjectedCloud
    table: ClassTable
    points: np.ndarray
    kinds: Kinds
    grid: Raster
    ground: np.ndarray
    above: np.ndarray


def outputs(scene: Scene, settings: Export) -> list[Path]:
    crs = find_projection(scene, settings).crs
    paths = [scene.export / f"{layer}{'' if crs else '_local'}.geojson" for layer in LAYERS]
    return paths + ([scene.export / "objects.gpkg"] if crs and has_geopackage() else [])


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/buildings.geojson` and `trees.geojson` (`*_local.geojson` without a CRS), and both as
    `objects.gpkg` where pyogrio is installed.
    """
    require_whole(scene, settings, BYTES)
    projected = read_projected_cloud(scene, settings)
    layers = find_objects(projected, scene.class_table(), settings)
    paths = outputs(scene, settings)
    for layer, path in zip(LAYERS, paths):
        write_geojson(path, layers[layer], projected.projection)
    if len(paths) > len(LAYERS):
        write_geopackage(paths[-1], layers, projected.projection)
    figures: dict[str, object] = {layer: len(layers[layer]) for layer in LAYERS}
    figures |= {f"{layer}_area": f"{sum(item.area for item in layers[layer]):.0f} m2" for layer in LAYERS}
    return {**figures, **projected.projection.figures()}


def find_objects(projected: ProjectedCloud, table: ClassTable, settings: Export) -> dict[str, list[Feature]]:
    """Buildings and trees of a labelled cloud, from north to south; InputError if its classes cannot tell
    them from the ground.
    """
    kinds = split_kinds(projected.labels.label, table)
    points = projected.points * projected.projection.unit
    grid = Raster.around(points, max(CELL * spacing_of_all(points), MIN_CELL))
    ground = ground_height(points, kinds.ground, grid)
    above = points[:, 2] >= ground.ravel()[grid.flat_cells(points)] + settings.min_height
    site = Site(projected, table, points, kinds, grid, ground, above)
    return {"buildings": _find_buildings(site, settings), "trees": _find_trees(site, settings)}


def _find_buildings(site: Site, settings: Export) -> list[Feature]:
    grid, is_building = site.grid, site.kinds.building
    covered, roofs = roof_heights(site.points, is_building, site.above, grid)
    buildings = split_buildings(covered, roofs, grid, settings.min_area)
    why = f"lower than {settings.min_height:g} m, or in pieces below {settings.min_area:g} m2"
    _tell_of_left_out("buildings", is_building, buildings, site, why)
    draw = orthogonalized if settings.rectangular else simplified
    outlines = {
        number: draw(traced, 2 * grid.pixel) for number, traced in polygonize(buildings, grid).items()
    }
    ground = _quantiles(site.ground, buildings, 0.5)
    heights = roof_tops(buildings, roofs, grid.pixel) - ground
    volumes = _volumes(roofs - site.ground, buildings, grid)
    return _features(site, buildings, is_building, outlines, (heights, ground, volumes))


def _find_trees(site: Site, settings: Export) -> list[Feature]:
    grid, is_tree = site.grid, site.kinds.tree
    canopy = canopy_height(site.points, is_tree, site.ground, grid)
    crowns = split_crowns(canopy, grid, settings.min_height)
    why = f"lower than {settings.min_height:g} m, or in crowns below {MIN_CROWN:g} m2"
    _tell_of_left_out("trees", is_tree, crowns, site, why)
    outlines = {
        number: simplified(shapely.Polygon(traced.exterior), grid.pixel)
        for number, traced in polygonize(crowns, grid).items()
    }
    heights, ground = _quantiles(canopy, crowns, TREE_TOP), _quantiles(site.ground, crowns, 0.5)
    volumes = _volumes(canopy, crowns, grid)
    return _features(site, crowns, is_tree, outlines, (heights, ground, volumes))


def _tell_of_left_out(kind: str, chosen: np.ndarray, regions: np.ndarray, site: Site, why: str) -> None:
    """How many points of a kind (N,) bool belong to none of the regions (H, W)."""
    member = site.above & (regions.ravel()[site.grid.flat_cells(site.points)] > 0)
    lost, total = int((chosen & ~member).sum()), int(chosen.sum())
    if lost:
        logger.info("%s: %d of %d points are part of no object: %s", kind, lost, total, why)


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


def split_kinds(labels: np.ndarray, table: ClassTable) -> Kinds:
    """Buildings are ASPRS code 6, trees 4 and 5 (3 if no class has those); the ground is 2, 3, 9, 10 or 11,
    or else whatever is none of these.

    labels: (N,) uint8 class ids
    """
    codes = {entry.id: entry.asprs for entry in table}
    trees = table.tree_codes
    if BUILDING not in codes.values() and not trees & set(codes.values()):
        raise InputError(
            'no class has the ASPRS code of buildings (6) or vegetation (3 to 5): add "asprs" to the classes in classes.json'
        )

    def having(wanted: set[int]) -> np.ndarray:
        return np.isin(labels, [label for label, code in codes.items() if code in wanted])

    building, tree = having({BUILDING}), having(trees)
    ground = np.isin(labels, table.ground_classes)
    if not ground.any():
        ground = (labels > 0) & ~building & ~tree & ~having(set(NOISE))
    if not ground.any():
        raise InputError(
            "no point belongs to a ground class, from which heights are measured: label roads or grass too"
        )
    return Kinds(building, tree, ground)


def _features(
    site: Site,
    regions: np.ndarray,
    chosen: np.ndarray,
    outlines: dict[int, shapely.Polygon],
    sizes: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> list[Feature]:
    """Features of the regions (H, W) numbered from 1; chosen: (N,) bool points of their kind; outlines: m;
    sizes: (R,) of the top above the ground and z of the ground, m, and volume, m3.
    """
    cloud, unit = site.projected, site.projected.projection.unit
    members = np.where(chosen & site.above, regions.ravel()[site.grid.flat_cells(site.points)], 0)
    features = []
    for number, rows in enumerate(cells_by_number(members, int(regions.max())), start=1):
        outline, label = outlines[number], int(np.argmax(np.bincount(cloud.labels.label[rows], minlength=1)))
        polygon = outline if unit == 1 else shapely.transform(outline, lambda corners: corners / unit)
        height, ground, volume = (float(values[number - 1]) for values in sizes)
        confidence = float(cloud.labels.confidence[rows].astype(np.float64).mean()) if len(rows) else 0.0
        name = site.table.name(label)
        features.append(
            Feature(polygon, number, name, label, outline.area, height, ground, confidence, len(rows), volume)
        )
    return features
