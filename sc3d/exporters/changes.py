"""What changed between two dates: regions of other height or class, on one grid over both scenes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from sc3d.errors import InputError
from sc3d.exporters.height_grids import LabelledPoints, SurfaceGrid, surface_grid
from sc3d.exporters.packages import load
from sc3d.exporters.polygonize import polygonize, simplified
from sc3d.geometry.raster import Raster
from sc3d.instances.regions import cells_by_number, disk, renumbered
from sc3d.scene.class_table import ClassTable

if TYPE_CHECKING:
    import shapely
else:
    shapely = load("shapely")

REACH = 0.5  # what is as high, or of the same class, this near at the other date has not changed, m
OPENING = 0.5  # strips narrower than about twice this are borders that moved with the points, m
ROBUST = 1.4826  # standard deviations of normal noise per median absolute deviation


@dataclass(frozen=True)
class Dates:
    """Two dates on one grid. before, after: labels by the ids of table, which has the classes of both"""

    before: SurfaceGrid
    after: SurfaceGrid
    table: ClassTable

    @property
    def grid(self) -> Raster:
        """That both dates share."""
        return self.before.grid

    @property
    def rise(self) -> np.ndarray:
        """(H, W) float64 m, height after less height before; NaN where either has no points."""
        return self.after.height - self.before.height

    @property
    def relabelled(self) -> np.ndarray:
        """(H, W) bool: of another class after; False where either has none."""
        before, after = self.before.label, self.after.label
        return (before != after) & (before > 0) & (after > 0)


@dataclass(frozen=True)
class Noise:
    """How the heights of ground that both dates show differ. shift: median, after less before, m; spread:
    standard deviation without outliers, m; on_ground: False if they share no ground and all cells counted
    """

    shift: float
    spread: float
    on_ground: bool


@dataclass(frozen=True)
class Change:
    """A region that changed.

    polygon: CRS; number: from 1, the largest first; kind: higher, lower or class; before, after: names of
        the classes that most of it has; area: m2; rise: median, m; volume: after less before, m3
    """

    polygon: shapely.Polygon
    number: int
    kind: str
    before: str
    after: str
    area: float
    rise: float
    volume: float

    def properties(self) -> dict[str, object]:
        """What the map shows, by name of the field."""
        sizes = {
            "area_m2": round(self.area, 2),
            "rise_m": round(self.rise, 2),
            "volume_m3": round(self.volume, 1),
        }
        names = {"kind": self.kind, "class_before": self.before, "class_after": self.after}
        return {"id": self.number, **names, **sizes}


def joint_table(before: ClassTable, after: ClassTable) -> tuple[ClassTable, np.ndarray]:
    """The classes of both tables, the same by name, and (256,) uint8 the joint id of each id of `after`.

    Raises InputError for more than 255 classes.
    """
    classes, ids = list(before), np.zeros(256, np.uint8)
    free = [number for number in range(1, 256) if number not in {entry.id for entry in before}]
    for entry in after:
        known = before.find(entry.name)
        if known is None:
            if not free:
                raise InputError("the two scenes have more than 255 classes together")
            known = entry.id if entry.id in free else free[0]
            free.remove(known)
            classes.append(replace(entry, id=known))
        ids[entry.id] = known
    return ClassTable(tuple(sorted(classes, key=lambda entry: entry.id))), ids


def common_grid(before: LabelledPoints, after: LabelledPoints, pixel: float) -> Raster:
    """The grid over what both dates cover; pixel: m, 0 = that of the sparser cloud. InputError if that is
    nothing.
    """
    low, high = np.maximum(before.low, after.low), np.minimum(before.high, after.high)
    if (low[:2] >= high[:2]).any():
        places = [f"{(cloud.low + cloud.high)[:2] / 2}" for cloud in (before, after)]
        raise InputError(
            f"the scenes do not overlap: their middles are {places[0]} and {places[1]}, m; are both georeferenced?"
        )
    return Raster.around(np.stack([low, high]), pixel or max(before.usual_pixel, after.usual_pixel))


def read_dates(
    before: LabelledPoints, after: LabelledPoints, grid: Raster, tables: tuple[ClassTable, ClassTable]
) -> Dates:
    """Both dates on a grid; InputError if no cell has points of both."""
    table, ids = joint_table(*tables)
    first, second = surface_grid(before, grid), surface_grid(after, grid)
    if not (np.isfinite(first.height) & np.isfinite(second.height)).any():
        raise InputError("no place has points of both scenes: they lie side by side")
    return Dates(first, SurfaceGrid(grid, second.height, ids[second.label]), table)


def measure_noise(dates: Dates) -> Noise:
    """From the cells that are ground at both dates."""
    ground, rise = dates.table.ground_classes, dates.rise
    both = np.isin(dates.before.label, ground) & np.isin(dates.after.label, ground) & np.isfinite(rise)
    values = rise[both if both.any() else np.isfinite(rise)]
    shift = float(np.median(values))
    return Noise(shift, ROBUST * float(np.median(np.abs(values - shift))), bool(both.any()))


def find_changes(dates: Dates, min_height: float, min_area: float, unit: float) -> list[Change]:
    """Regions of at least min_area, m2, that are higher or lower by min_height, m, or elsewhere of another
    class; the largest first. unit: m per unit of the CRS.
    """
    rise, pixel = np.nan_to_num(dates.rise), dates.grid.pixel
    size = 2 * round(max(REACH / pixel, 1.0)) + 1
    lows, highs = zip(*(_range(date.height, size) for date in (dates.before, dates.after)))
    above, below = dates.after.height, dates.before.height
    new = (above - highs[0] > min_height) & (lows[1] - below > min_height)
    gone = (below - highs[1] > min_height) & (lows[0] - above > min_height)
    higher, lower = _whole(new, rise > min_height, pixel), _whole(gone, -rise > min_height, pixel)
    other = _whole(_elsewhere(dates, size) & ~higher & ~lower, dates.relabelled & ~higher & ~lower, pixel)
    found = []
    for kind, cells in (("higher", higher), ("lower", lower), ("class", other)):
        found += _changes(dates, kind, _large(cells, min_area / pixel**2), unit)
    found.sort(key=lambda change: -change.area)
    return [replace(change, number=number) for number, change in enumerate(found, start=1)]


def _range(heights: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) lowest and highest known height around each cell, m."""
    known = np.isfinite(heights)
    low = ndimage.minimum_filter(np.where(known, heights, np.inf), size, mode="nearest")
    return low, ndimage.maximum_filter(np.where(known, heights, -np.inf), size, mode="nearest")


def _elsewhere(dates: Dates, size: int) -> np.ndarray:
    """(H, W) bool: relabelled, and neither date has the other's class near."""
    before, after = dates.before.label, dates.after.label
    found = dates.relabelled
    for label in np.unique(np.concatenate([before[found], after[found]])):
        near = [ndimage.maximum_filter(date == label, size, mode="nearest") for date in (before, after)]
        found = found & ~((after == label) & near[0]) & ~((before == label) & near[1])
    return found


def _whole(sure: np.ndarray, maybe: np.ndarray, pixel: float) -> np.ndarray:
    """(H, W) bool: the cells that may have changed, without strips and specks, where they hang together
    with some that surely have.
    """
    wide = ndimage.binary_opening(maybe, disk(max(OPENING / pixel, 1.0)))
    return ndimage.binary_propagation(sure & wide, mask=wide)


def _large(cells: np.ndarray, least: float) -> np.ndarray:
    """(H, W) int32 number of the region of at least so many cells, from 1; 0 = none."""
    regions, _ = ndimage.label(cells)
    return renumbered(np.where(np.bincount(regions.ravel())[regions] >= least, regions, 0))


def _changes(dates: Dates, kind: str, regions: np.ndarray, unit: float) -> list[Change]:
    grid, rise = dates.grid, np.nan_to_num(dates.rise).ravel()
    outlines = polygonize(regions, grid)
    found = []
    for number, cells in enumerate(cells_by_number(regions, int(regions.max())), start=1):
        names = [_usual(date.label.ravel()[cells], dates.table) for date in (dates.before, dates.after)]
        outline = simplified(outlines[number], grid.pixel)
        polygon = shapely.transform(outline, lambda corners: corners / unit)
        area, volume = len(cells) * grid.pixel**2, float(rise[cells].sum()) * grid.pixel**2
        before, after = names
        found.append(Change(polygon, 0, kind, before, after, area, float(np.median(rise[cells])), volume))
    return found


def _usual(labels: np.ndarray, table: ClassTable) -> str:
    return table.name(int(np.bincount(labels).argmax()))
