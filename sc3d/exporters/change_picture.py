"""A picture of what changed: classes before and after in relief, and the difference of heights, with the
changes outlined and numbered.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from sc3d.exporters.changes import Change, Dates
from sc3d.geometry.raster import Raster
from sc3d.view.captions import INK, PAPER, add_legend, caption_font

if TYPE_CHECKING:
    from PIL import ImageDraw
    from PIL.ImageFont import FreeTypeFont

LONGEST = 900  # of a panel, px
GAP = 12  # between panels, px
LOWER, LEVEL, HIGHER = (33, 102, 172), (247, 247, 247), (178, 24, 43)  # ColorBrewer's RdBu
NOTHING = (205, 205, 205)
OUTLINE = (255, 220, 0)
LIGHT = np.array([-0.5, 0.5, 0.7071])


def draw_changes(dates: Dates, changes: list[Change], names: tuple[str, str], unit: float) -> np.ndarray:
    """(H, W, 3) uint8 RGB: before, after, difference, and a legend below; names: of the scenes; unit: m per
    unit of the CRS.
    """
    from PIL import Image, ImageDraw

    limit = color_limit(dates.rise)
    pictures = [
        relief(date.height, dates.table.palette[date.label], dates.grid.pixel)
        for date in (dates.before, dates.after)
    ] + [difference_colors(dates.rise, limit)]
    titles = [
        f"before: {names[0]}",
        f"after: {names[1]}",
        f"height: {-limit:g} m (blue) to +{limit:g} m (red)",
    ]
    factor = LONGEST / max(dates.grid.shape)
    size = max(round(dates.grid.width * factor), 8), max(round(dates.grid.height * factor), 8)
    font, letter = caption_font(3 * size[0])
    sheet = Image.new("RGB", (3 * size[0] + 2 * GAP, size[1] + 2 * letter), PAPER)
    draw = ImageDraw.Draw(sheet)
    for column, (picture, title) in enumerate(zip(pictures, titles)):
        left, top = column * (size[0] + GAP), 2 * letter
        method = cv2.INTER_AREA if factor < 1 else cv2.INTER_NEAREST
        sheet.paste(Image.fromarray(cv2.resize(picture, size, interpolation=method)), (left, top))
        draw.text(
            (left + letter // 2, letter), _shortened(title, font, size[0]), font=font, fill=INK, anchor="lm"
        )
        _outline(draw, changes, dates.grid, (left, top, factor, unit), font)
    present = set(np.unique([dates.before.label, dates.after.label]).tolist()) - {0}
    return add_legend(np.asarray(sheet), "label", dates.table, present)


def color_limit(rise: np.ndarray) -> float:
    """Difference that has the strongest color, m, to one digit; rise: (H, W) m, NaN = unknown."""
    known = np.abs(rise[np.isfinite(rise)])
    return max(float(f"{np.quantile(known, 0.995):.0e}"), 1.0)


def difference_colors(rise: np.ndarray, limit: float) -> np.ndarray:
    """(H, W, 3) uint8 RGB: blue for lower, red for higher, gray where unknown."""
    known = np.isfinite(rise)
    share = np.clip(np.where(known, rise, 0.0) / limit, -1, 1)
    steps = [np.interp(share, [-1, 0, 1], ends) for ends in zip(LOWER, LEVEL, HIGHER)]
    image = np.rint(np.stack(steps, axis=-1)).astype(np.uint8)
    image[~known] = NOTHING
    return image


def relief(heights: np.ndarray, colors: np.ndarray, pixel: float) -> np.ndarray:
    """(H, W, 3) uint8 RGB: colors (H, W, 3) in light from the northwest; heights: (H, W) m, NaN = none."""
    known = np.isfinite(heights)
    if min(heights.shape) < 2:
        return np.where(known[..., None], colors, NOTHING).astype(np.uint8)
    down, right = np.gradient(np.where(known, heights, np.nanmedian(heights)), pixel)
    normals = np.stack([-right, down, np.ones_like(down)], axis=-1)
    light = np.clip(normals @ LIGHT / np.linalg.norm(normals, axis=-1), 0, 1)
    shaded = np.clip(colors * (0.35 + 0.65 * light / LIGHT[2])[..., None], 0, 255)
    return np.where(known[..., None], shaded, NOTHING).astype(np.uint8)


def _outline(
    draw: ImageDraw.ImageDraw,
    changes: list[Change],
    grid: Raster,
    place: tuple[int, int, float, float],
    font: FreeTypeFont,
) -> None:
    """place: left and top of the panel, px; px per cell; m per unit of the CRS."""
    left, top, factor, unit = place
    for change in changes:
        corners = np.asarray(change.polygon.exterior.coords)[:, :2] * unit
        x = left + (corners[:, 0] - grid.left) / grid.pixel * factor
        y = top + (grid.top - corners[:, 1]) / grid.pixel * factor
        line = list(zip(x.tolist(), y.tolist()))
        draw.line(line, fill=INK, width=4)
        draw.line(line, fill=OUTLINE, width=2)
        corner = int(np.argmin(y))
        draw.text(
            (x[corner], y[corner] - 2), str(change.number), font=font, fill=INK, anchor="mb",
            stroke_width=2, stroke_fill=PAPER,
        )  # fmt: skip


def _shortened(text: str, font: FreeTypeFont, width: int) -> str:
    while len(text) > 4 and font.getlength(text) > width - 2 * GAP:
        text = text[:-4] + "..."
    return text
