"""Colors of points as other programs write them: 8 or 16 bits, fractions, floats up to 255; under several
names.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable
from pathlib import Path

import numpy as np

logger = logging.getLogger(__name__)

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
    ("rot", "gr\u00fcn", "blau"),
    ("rot", "gruen", "blau"),
    ("rouge", "vert", "bleu"),
)
FRACTION = 2.0  # floats up to here are fractions of 1, some of them a little brighter than white
BYTE = 255
DARK = 1024  # 16 bits up to here would be black: bytes of which some ran over
MOST = 0.5  # share of the points that are not black that tells what the numbers are
# what the numbers of a file are, by what a byte is in them
SIXTEEN_BITS, BYTES, FRACTIONS = 256.0, 1.0, 1 / 255


def color_names(names: Collection[str]) -> tuple[str, str, str] | None:
    """Which of the columns hold red, green and blue; None if none do."""
    return next((found for found in NAMES if set(found) <= set(names)), None)


def color_unit(parts: Iterable[np.ndarray], path: Path) -> float:
    """What one step of a byte is in the colors of a whole file: `SIXTEEN_BITS`, `BYTES` or `FRACTIONS`. Most
    of the points tell, not the brightest; a warning with their number if some are beyond that.

    parts: (N, 3) of any type, one after the other
    """
    count = lit = above_byte = above_fraction = missing = 0
    brightest, has_floats, has_fractions = 0.0, False, False
    for part in parts:
        peaks = part.max(axis=1).astype(np.float64)
        missing += int(np.isnan(peaks).sum())
        peaks = np.nan_to_num(peaks)
        is_float = part.dtype.kind == "f"
        has_floats = has_floats or is_float
        has_fractions = has_fractions or is_float and bool((peaks != np.rint(peaks)).any())
        count, lit = count + len(peaks), lit + int((peaks > 0).sum())
        above_byte += int((peaks > BYTE).sum())
        above_fraction += int((peaks > FRACTION).sum())
        brightest = max(brightest, float(peaks.max(initial=0)))
    if brightest >= DARK and above_byte >= MOST * lit:
        unit, wrong, limit = SIXTEEN_BITS, 0, 65535
    elif has_floats and (brightest <= FRACTION or has_fractions and above_fraction < MOST * lit):
        unit, wrong, limit = FRACTIONS, above_fraction, 1
    else:
        unit, wrong, limit = BYTES, above_byte, BYTE
    if wrong and brightest >= limit + 1:
        logger.warning(
            "%s: %d of %d points have colors beyond %d, up to %g, which are taken as %d",
            path,
            wrong,
            count,
            limit,
            brightest,
            limit,
        )
    if missing:
        logger.warning("%s: %d of %d points have no color (nan): they are black", path, missing, count)
    return unit


def to_bytes(colors: np.ndarray, path: Path, unit: float | None = None) -> np.ndarray:
    """uint8 colors of a file from 8 or 16 bits, from fractions of 1, or from floats up to 255 or 65535.

    unit: as `color_unit` finds it, where `colors` are a part of the file; None = (N, 3) are all of them
    """
    if colors.dtype == np.uint8:
        return colors
    if unit is None:
        unit = color_unit([colors], path)
    values = np.nan_to_num(colors.astype(np.float64))
    # 16 bits: the upper 8, by the standard of LAS
    values = np.floor(values / SIXTEEN_BITS) if unit == SIXTEEN_BITS else values / unit
    return np.clip(np.rint(values), 0, BYTE).astype(np.uint8)
