"""What people count: building footprints and tree crowns with area, height and confidence."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.exporters.buildings import roof_heights, roof_tops, split_buildings
from sc3d.exporters.polygonize import orthogonalized, polygonize, simplified
from sc3d.exporters.projected_cloud import ProjectedCloud, find_projection, read_projected_cloud
from sc3d.exporters.regions import cells_by_number
from sc3d.exporters.terrain import ground_height
from sc3d.exporters.trees import canopy_height, split_crowns
from sc3d.exporters.vector_files import Feature, has_geopackage, shapely, write_geojson, write_geopackage
from sc3d.geometry.raster import Raster, spacing_of_all
from sc3d.scene.class_table import ClassTable
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export

LAYERS = ("buildings", "trees")
CELL = 1.5  # side of the cells, in point spacings
MIN_CELL = 0.05  # m
BUILDING, LOW, MEDIUM, HIGH = 6, 3, 4, 5  # ASPRS codes: building; low, medium and high vegetation
GROUND = (2, LOW, 9, 10, 11)  # ground, low vegetation, water, rail, road
NOISE = (7, 18)
TREE_TOP = 0.99  # quantile of the crown that is its height: a single point is no tree top


@dataclass(frozen=True)
class Kinds:
    """Which points are what: (N,) bool each."""

    building: np.ndarray
    tree: np.ndarray
    ground: np.ndarray


def outputs(scene: Scene, settings: Export) -> list[Path]:
    crs = find_projection(scene, settings).crs
    paths = [scene.export / f"{layer}{'' if crs else '_local'}.geojson" for layer in LAYERS]
    return paths + ([scene.export / "objects.gpkg"] if crs and has_geopackage() else [])


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/buildings.geojson` and `trees.geojson` (`*_local.geojson` without a CRS), and both as
    `objects.gpkg` where pyogrio is installed.
    """
    projected = read_projected_cloud(scene, settings)
    layers = find_objects(projected, scene.class_table(), settings)
    paths = outputs(scene, settings)
    for layer, path in zip(LAYERS, paths):
        write_geojson(path, layers[layer], projected.projection)
    if len(paths) > len(LAYERS):
        write_geopackage(paths[-1], layers, projected.projection)
    figures = {layer: len(layers[layer]) for layer in LAYERS}
    figures |= {f"{layer}_area": f"{sum(item.area for item in layers[layer]):.0f} m2" for layer in LAYERS}
    return {**figures, **projected.projection.figures()}


def find_objects(projected: ProjectedCloud, table: ClassTable, settings: Export) -> dict[str, list[Feature]]:
    """Buildings and trees of a labelled cloud, from north to south; InputError if its classes cannot tell
    them from the ground.
    """
    kinds = split_kinds(projected.labels.label, table)
    points = projected.points * projected.projection.unit  # all lengths below are meters
    pixel = max(CELL * spacing_of_all(points), MIN_CELL)
    grid = Raster.around(points, pixel)
    ground = ground_height(points, kinds.ground, grid)
    above = points[:, 2] >= ground.ravel()[grid.flat_cells(points)] + settings.min_height
    covered, roofs = roof_heights(points, kinds.building, above, grid)
    buildings = split_buildings(covered, roofs, grid, settings.min_area)
    canopy = canopy_height(points, kinds.tree, ground, grid)
    crowns = split_crowns(canopy, grid, settings.min_height)
    draw = orthogonalized if settings.rectangular else simplified
    building_outlines = {
        number: draw(outline, 2 * pixel) for number, outline in polygonize(buildings, grid).items()
    }
    tree_outlines = {
        number: simplified(shapely.Polygon(outline.exterior), pixel)
        for number, outline in polygonize(crowns, grid).items()
    }
    tops = np.array(
        [np.quantile(canopy.ravel()[cells], TREE_TOP) for cells in cells_by_number(crowns, int(crowns.max()))]
    )
    ground_of = [
        np.array([np.median(ground.ravel()[cells]) for cells in cells_by_number(regions, int(regions.max()))])
        for regions in (buildings, crowns)
    ]
    members = [
        np.where(chosen, regions.ravel()[grid.flat_cells(points)], 0)
        for regions, chosen in ((buildings, kinds.building & above), (crowns, kinds.tree & above))
    ]
    return {
        "buildings": _describe(
            building_outlines,
            roof_tops(buildings, roofs, pixel) - ground_of[0],
            ground_of[0],
            members[0],
            (projected, table),
        ),
        "trees": _describe(tree_outlines, tops, ground_of[1], members[1], (projected, table)),
    }


def split_kinds(labels: np.ndarray, table: ClassTable) -> Kinds:
    """Buildings are ASPRS code 6, trees 4 and 5 (3 if no class has those); the ground is 2, 3, 9, 10 or 11,
    or else whatever is none of these.

    labels: (N,) uint8 class ids
    """
    codes = {entry.id: entry.asprs for entry in table}
    tree_codes = {MEDIUM, HIGH} if {MEDIUM, HIGH} & set(codes.values()) else {LOW}
    if BUILDING not in codes.values() and not tree_codes & set(codes.values()):
        raise InputError(
            'no class has the ASPRS code of buildings (6) or vegetation (3 to 5): add "asprs" to the classes in classes.json'
        )

    def having(wanted: set[int]) -> np.ndarray:
        return np.isin(labels, [label for label, code in codes.items() if code in wanted])

    building, tree = having({BUILDING}), having(tree_codes)
    ground = having(set(GROUND) - tree_codes)
    if not ground.any():
        ground = (labels > 0) & ~building & ~tree & ~having(set(NOISE))
    if not ground.any():
        raise InputError(
            "no point belongs to a ground class, from which heights are measured: label roads or grass too"
        )
    return Kinds(building, tree, ground)


def _describe(
    outlines: dict,
    heights: np.ndarray,
    ground: np.ndarray,
    members: np.ndarray,
    cloud: tuple[ProjectedCloud, ClassTable],
) -> list[Feature]:
    """Objects of numbered outlines in meters; members: (N,) int number of the object that each point belongs
    to, 0 = none.
    """
    projected, table = cloud
    unit = projected.projection.unit
    objects = []
    for number, rows in enumerate(cells_by_number(members, len(heights)), start=1):
        polygon = outlines[number]
        labels = np.bincount(projected.labels.label[rows], minlength=1)
        label = int(np.argmax(labels))
        confidence = float(projected.labels.confidence[rows].astype(np.float64).mean()) if len(rows) else 0.0
        objects.append(
            Feature(
                polygon if unit == 1 else shapely.transform(polygon, lambda corners: corners / unit),
                number,
                table.name(label),
                label,
                polygon.area,
                float(heights[number - 1]),
                float(ground[number - 1]),
                confidence,
                len(rows),
            )
        )
    return objects
