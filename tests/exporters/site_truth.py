"""True footprints, heights and trees of a synthetic site, from its layout, and how well exported objects
agree with them.
"""

import numpy as np
import shapely

from sc3d.synthetic.mesh import BARK, LEAF
from sc3d.synthetic.objects import FLAT, Building
from sc3d.synthetic.world import World

EAVES = 0.5  # pitched roofs reach this far over the walls, m


def footprint(building: Building, eaves: bool = True) -> shapely.Polygon:
    """The outline of the roof, or of the walls."""
    margin = EAVES if eaves and building.roof != FLAT else 0.0
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    parts = []
    for x, y, half_length, half_width in building.boxes():
        local = np.c_[corners * [half_length + margin, half_width + margin] + [x, y], np.zeros(4), np.ones(4)]
        parts.append(shapely.Polygon((local @ building.pose.T)[:, :2]))
    return shapely.union_all(parts)


def roof_height(building: Building) -> float:
    """The ridge or the parapet above the levelled plot, m; chimneys and machines do not count."""
    return (
        building.wall if building.roof == FLAT else building.wall + 0.12 + 0.62 * (min(building.half) + EAVES)
    )


def trees(world: World, min_height: float = 2.0) -> np.ndarray:
    """(T, 4) x, y of the trunk, crown radius and height above the trunk's foot, m, of the trees on the site."""
    kinds, objects = world.ints[:, 0], world.ints[:, 2]
    rows = []
    for number in np.unique(objects[kinds == BARK]):
        bark = world.corners[(objects == number) & (kinds == BARK)].reshape(-1, 3)
        leaves = world.corners[(objects == number) & (kinds == LEAF)].reshape(-1, 3)
        foot = bark[:, 2].min()
        middle = bark[bark[:, 2] < foot + 0.1, :2].mean(axis=0)
        height = leaves[:, 2].max() - foot - 0.4
        if np.abs(middle).max() <= world.ground.extent / 2 and height >= min_height:
            rows.append([*middle, np.quantile(np.hypot(*(leaves[:, :2] - middle).T), 0.95), height])
    return np.array(rows)


def compare_buildings(
    found: list[dict], buildings: list[Building], eaves: bool = True
) -> dict[str, np.ndarray]:
    """Match each true building with the found one that overlaps it most; found if the IoU is at least 0.5.

    found: [{"polygon": ..., "height": m}]; returns: iou (B,), height_error (B,), NaN where nothing overlaps;
        extra: number of found ones without a match
    """
    iou, error, used = np.zeros(len(buildings)), np.full(len(buildings), np.nan), set()
    for row, building in enumerate(buildings):
        true = footprint(building, eaves)
        overlaps = [
            true.intersection(item["polygon"]).area / true.union(item["polygon"]).area for item in found
        ]
        if overlaps and max(overlaps) > 0:
            best = int(np.argmax(overlaps))
            iou[row], error[row] = overlaps[best], found[best]["height"] - roof_height(building)
            if overlaps[best] >= 0.5:
                used.add(best)
    return {"iou": iou, "height_error": error, "extra": len(found) - len(used)}


def match_trees(found: np.ndarray, true: np.ndarray) -> int:
    """How many true trees (T, 4) have one of the found places (F, 2) within their crown radius, one to one,
    nearest pairs first.
    """
    distance = np.hypot(*(found[:, None] - true[None, :, :2]).transpose(2, 0, 1))
    matched = 0
    for flat in np.argsort(distance, axis=None, kind="stable"):
        row, column = np.unravel_index(flat, distance.shape)
        if np.isfinite(distance[row, column]) and distance[row, column] <= true[column, 2]:
            matched += 1
            distance[row], distance[:, column] = np.inf, np.inf
    return matched
