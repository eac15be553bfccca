"""Maps as GeoTIFF: tiled, compressed, with a CRS, and with overviews so that map programs draw them at
once.
"""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from sc3d.exporters.packages import load
from sc3d.exporters.projected_cloud import MapProjection
from sc3d.geometry.raster import Raster
from sc3d.io.atomic import atomic_path
from sc3d.scene.class_table import ClassTable

rasterio = load("rasterio")
enums, transforms = load("rasterio.enums"), load("rasterio.transform")

TILE = 256  # px; strips of this many rows are worked on at a time
NO_HEIGHT = -9999.0
OVERVIEW = 512  # overviews halve the longest side until it is below this, px


def open_geotiff(file: Path, projection: MapProjection, grid: Raster, **profile: object):
    """Rasterio's writer; grid: in units of the CRS."""
    transform = transforms.from_origin(grid.left, grid.top, grid.pixel, grid.pixel)
    crs = projection.crs
    return rasterio.open(
        file,
        "w",
        driver="GTiff",
        width=grid.width,
        height=grid.height,
        transform=transform,
        crs=crs.to_wkt() if crs else None,
        tiled=True,
        blockxsize=TILE,
        blockysize=TILE,
        compress="deflate",
        bigtiff="if_safer",
        **profile,
    )


def set_palette(dataset, table: ClassTable) -> None:
    """Colors of the class ids in an open file; 0 is transparent."""
    dataset.write_colormap(
        1, {label: (*map(int, table.palette[label]), 255 if label else 0) for label in range(table.num_ids)}
    )


def category_names(table: ClassTable) -> str:
    """GDAL's side file: the name of each class id, in the order of the ids, for the legend."""
    names = "".join(
        f"<Category>{escape(table.name(label)) if label in {entry.id for entry in table} | {0} else ''}</Category>"
        for label in range(table.num_ids)
    )
    return f'<PAMDataset><PAMRasterBand band="1"><CategoryNames>{names}</CategoryNames></PAMRasterBand></PAMDataset>\n'


def add_overviews(file: Path, resampling: object) -> None:
    """Smaller copies inside the file."""
    with rasterio.open(file, "r+") as dataset:
        longest = max(dataset.width, dataset.height)
        factors = [2**level for level in range(1, 16) if longest / 2 ** (level - 1) > OVERVIEW]
        if factors:
            dataset.build_overviews(factors, resampling)


def scaled_grid(grid: Raster, unit: float) -> Raster:
    """A grid in m as one in units of the CRS, of `unit` m."""
    return Raster(grid.left / unit, grid.top / unit, grid.pixel / unit, grid.height, grid.width)


def write_lengths(
    path: Path, lengths: np.ndarray, projection: MapProjection, grid: Raster, description: str
) -> None:
    """One band of heights or distances, float32, in units of the CRS.

    lengths: (H, W) m, NaN = none; grid: m
    """
    values = np.where(np.isfinite(lengths), lengths / projection.unit, NO_HEIGHT).astype(np.float32)
    with atomic_path(path) as temporary:
        profile = {"count": 1, "dtype": "float32", "predictor": 3, "nodata": NO_HEIGHT}
        with open_geotiff(temporary, projection, scaled_grid(grid, projection.unit), **profile) as dataset:
            dataset.set_band_description(1, description)
            dataset.units = (projection.crs.axis_info[0].unit_name if projection.crs else "metre",)
            dataset.write(values, 1)
        add_overviews(temporary, enums.Resampling.average)


def write_labels(
    path: Path, labels: np.ndarray, projection: MapProjection, grid: Raster, table: ClassTable
) -> None:
    """One band of class ids with palette, and their names in GDAL's side file; labels: (H, W) uint8, 0 =
    none; grid: m.
    """
    with atomic_path(path) as temporary:
        scaled = scaled_grid(grid, projection.unit)
        with open_geotiff(temporary, projection, scaled, count=1, dtype="uint8", nodata=0) as dataset:
            set_palette(dataset, table)
            dataset.set_band_description(1, "class")
            dataset.write(labels, 1)
        add_overviews(temporary, enums.Resampling.mode)
    with atomic_path(path.with_name(f"{path.name}.aux.xml")) as temporary:
        temporary.write_text(category_names(table), encoding="utf-8")
