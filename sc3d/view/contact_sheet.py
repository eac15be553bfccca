"""Contact sheets: photo, rendering, depth and normals, row by row; pictures beside one another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np

from sc3d.view.captions import INK, PAPER, caption_font
from sc3d.view.colors import confidence_colors
from sc3d.view.lettering import lettering

if TYPE_CHECKING:
    from PIL import Image, ImageDraw
    from PIL.ImageFont import FreeTypeFont

    from sc3d.splatting.evaluation import Comparison

_MARGIN, _GAP = 16, 8  # px
_SOFT, _WARNING = (100, 107, 117), (190, 70, 0)
_EMPTY = (60, 62, 66)  # where nothing is


def contact_sheet(rows: Sequence[Comparison], title: str, width: int = 1600) -> np.ndarray:
    """Photos beside what the Gaussians show in their place.

    rows: at least one
    returns: (H, width, 3) uint8 RGB; columns photo, rendering, depth (one color scale for all rows), normals
    """
    from PIL import Image, ImageDraw

    font, size = caption_font(width)
    cell = (width - 2 * _MARGIN - 3 * _GAP) // 4
    near_far = depth_range([row.depth for row in rows])
    panels = [
        [
            _fitted(panel, cell)
            for panel in (
                row.photo,
                row.rendered,
                depth_colors(row.depth, near_far),
                normal_colors(row.normals),
            )
        ]
        for row in rows
    ]
    line = round(1.6 * size)
    top = _MARGIN + 3 * line
    height = top + sum(line + _GAP + panel[0].shape[0] for panel in panels) + _MARGIN
    sheet = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(sheet)
    text, letters = _shortened(title, size, width - 2 * _MARGIN)
    draw.text(
        (_MARGIN, _MARGIN + line // 2),
        text,
        font=letters,
        fill=INK,
        anchor="lm",
    )
    lefts = [_MARGIN + column * (cell + _GAP) for column in range(4)]
    _heads(sheet, lefts, _MARGIN + 2 * line, cell, near_far)
    for row, panel in zip(rows, panels, strict=True):
        _caption(draw, row, top + line // 2, cell, font)
        top += line
        for left, image in zip(lefts, panel, strict=True):
            sheet.paste(Image.fromarray(image), (left + (cell - image.shape[1]) // 2, top))
        top += panel[0].shape[0] + _GAP
    return np.asarray(sheet)


def depth_range(depths: Sequence[np.ndarray]) -> tuple[float, float]:
    """Nearest and farthest depth that the colors tell apart: 1st and 99th percentile of all; (1, 1) if all
    are empty.
    """
    found = np.concatenate([depth[depth > 0].ravel()[::7] for depth in depths])
    return tuple(np.quantile(found, [0.01, 0.99]).tolist()) if len(found) else (1.0, 1.0)


def depth_colors(depth: np.ndarray, near_far: tuple[float, float]) -> np.ndarray:
    """(H, W, 3) uint8 RGB, viridis in inverse depth: near is bright; dark gray where (H, W) `depth` is 0."""
    near, far = near_far
    present = depth > 0
    inverse = 1 / np.where(present, depth, 1)
    levels = (inverse - 1 / far) / max(1 / near - 1 / far, 1e-9)
    colors = confidence_colors(levels).reshape(*depth.shape, 3)
    colors[~present] = _EMPTY
    return colors


def normal_colors(normals: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 RGB (n + 1) / 2 of (H, W, 3) unit normals, so that up (+z) is light blue; dark gray
    where they are 0.
    """
    colors = np.round((np.clip(normals, -1, 1) + 1) * 127.5).astype(np.uint8)
    colors[(normals == 0).all(axis=2)] = _EMPTY
    return colors


def half_of(size: tuple[int, int]) -> tuple[int, int]:
    """(width, height) px left for each of two pictures that `side_by_side` makes `size` of."""
    return max(1, (size[0] - _GAP) // 2), max(1, size[1] - 2 * caption_font(size[0])[1])


def side_by_side(pictures: Sequence[np.ndarray], captions: Sequence[str]) -> np.ndarray:
    """(H, W, 3) uint8 RGB pictures of one size beside one another, with a line of text below each."""
    from PIL import Image, ImageDraw

    height, width = pictures[0].shape[:2]
    total = len(pictures) * (width + _GAP) - _GAP
    size = caption_font(total)[1]
    picture = Image.new("RGB", (total, height + 2 * size), PAPER)
    draw = ImageDraw.Draw(picture)
    for row, (image, caption) in enumerate(zip(pictures, captions, strict=True)):
        start = row * (width + _GAP)
        picture.paste(Image.fromarray(image), (start, 0))
        text, font = _shortened(caption, size, width - size)
        draw.text((start + size // 2, height + size), text, font=font, fill=INK, anchor="lm")
    return np.asarray(picture)


def _heads(
    sheet: Image.Image, lefts: list[int], middle: int, cell: int, near_far: tuple[float, float]
) -> None:
    """Names of the columns, with the color bar of the depth and the colors of three directions."""
    from PIL import Image, ImageDraw

    draw, (font, size) = ImageDraw.Draw(sheet), caption_font(sheet.width)
    for left, name in zip(lefts, ("photo", "rendering", "depth", "normals"), strict=True):
        draw.text((left, middle), name, font=font, fill=_SOFT, anchor="lm")
    near, far = (f"{value:.3g} m" for value in near_far)
    start, end = (
        lefts[2] + font.getlength(f"depth  {near}  "),
        lefts[2] + cell - size - font.getlength(f"  {far}"),
    )
    draw.text((start - font.getlength("  "), middle), near, font=font, fill=INK, anchor="rm")
    draw.text((lefts[2] + cell - size, middle), far, font=font, fill=INK, anchor="rm")
    levels = np.linspace(*near_far, max(2, round(end - start)))[None]
    bar = np.repeat(depth_colors(levels, near_far), size, axis=0)
    sheet.paste(Image.fromarray(bar), (round(start), middle - size // 2))
    place = lefts[3] + font.getlength("normals   ")
    for name, direction in (("up", (0, 0, 1)), ("+x", (1, 0, 0)), ("+y", (0, 1, 0))):
        color = tuple(normal_colors(np.array([[direction]], np.float32))[0, 0].tolist())
        draw.rectangle((place, middle - size // 2, place + size, middle + size // 2), fill=color)
        draw.text((place + 1.4 * size, middle), name, font=font, fill=INK, anchor="lm")
        place += 1.4 * size + font.getlength(name + "   ")


def _caption(draw: ImageDraw.ImageDraw, row: Comparison, middle: int, cell: int, font) -> None:
    name, letters = _shortened(row.name, round(font.size), cell)
    draw.text((_MARGIN, middle), name, font=letters, fill=INK, anchor="lm")
    left, text = _MARGIN + cell + _GAP, f"PSNR {row.psnr:.2f} dB"
    draw.text((left, middle), text, font=font, fill=INK, anchor="lm")
    if row.held_out:
        draw.text(
            (left + font.getlength(text + "   "), middle), "held out", font=font, fill=_WARNING, anchor="lm"
        )


def _shortened(text: str, size: int, width: float) -> tuple[str, FreeTypeFont]:
    """Text that fits into `width` px, and its font; names differ at their end, so that is kept."""
    text, font = lettering(text, size)
    if font.getlength(text) <= width:
        return text, font
    while text and font.getlength("..." + text) > width:
        text = text[1:]
    return "..." + text, font


def _fitted(image: np.ndarray, cell: int) -> np.ndarray:
    """The picture, its longest side `cell` px."""
    scale = cell / max(image.shape[:2])
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)
