"""Colors of points as other programs write them: 8 or 16 bits, fractions, floats up to 255; under several
names.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

COLORS = ("red", "green", "blue")
# as MeshLab, PDAL, PCL and CloudCompare name them, the usual ones first
NAMES = (
    COLORS,
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
    ("rf", "gf", "bf"),
    ("Red", "Green", "Blue"),
    ("R", "G", "B"),
    ("scalar_R", "scalar_G", "scalar_B"),
    ("scalar_Red", "scalar_Green", "scalar_Blue"),
)
FRACTION = 2.0  # floats up to here are fractions of 1, some of them a little brighter than white


def color_names(names: Collection[str]) -> tuple[str, str, str] | None:
    """Which of the columns hold red, green and blue; None if none do."""
    return next((found for found in NAMES if set(found) <= set(names)), None)


def to_bytes(colors: np.ndarray, brightest: float | None = None) -> np.ndarray:
    """uint8 colors from 8 or 16 bits, from fractions of 1, or from floats up to 255 or 65535.

    brightest: largest value of the whole cloud, where `colors` are a part of it
    """
    if colors.dtype == np.uint8:
        return colors
    whole = colors.dtype.kind in "ui"
    values = colors.astype(np.float64) if whole else np.nan_to_num(colors.astype(np.float64))
    if brightest is None:
        brightest = float(values.max(initial=0))
    if brightest > 255:  # 16 bits: the upper 8, by the standard of LAS
        values = np.floor(values / 256)
    elif not whole and brightest <= FRACTION:
        values = values * 255
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
