"""Maps as GeoTIFF: tiled, compressed, with a CRS, and with overviews so that map programs draw them at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sc3d.exporters.packages import load
from sc3d.exporters.projected_cloud import MapProjection
from sc3d.geometry.raster import Raster
from sc3d.io.atomic import atomic_path

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


def add_overviews(file: Path, resampling: object) -> None:
    """Smaller copies inside the file."""
    with rasterio.open(file, "r+") as dataset:
        longest = max(dataset.width, dataset.height)
        factors = [2**level for level in range(1, 16) if longest / 2 ** (level - 1) > OVERVIEW]
        if factors:
            dataset.build_overviews(factors, resampling)


def write_lengths(
    path: Path, lengths: np.ndarray, projection: MapProjection, grid: Raster, description: str
) -> None:
    """One band of heights or distances, float32, in units of the CRS.

    lengths: (H, W) m, NaN = none; grid: m
    """
    unit = projection.unit
    scaled = Raster(grid.left / unit, grid.top / unit, grid.pixel / unit, grid.height, grid.width)
    values = np.where(np.isfinite(lengths), lengths / unit, NO_HEIGHT).astype(np.float32)
    with atomic_path(path) as temporary:
        profile = {"count": 1, "dtype": "float32", "predictor": 3, "nodata": NO_HEIGHT}
        with open_geotiff(temporary, projection, scaled, **profile) as dataset:
            dataset.set_band_description(1, description)
            dataset.units = (projection.crs.axis_info[0].unit_name if projection.crs else "metre",)
            dataset.write(values, 1)
        add_overviews(temporary, enums.Resampling.average)
