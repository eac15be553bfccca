"""The strip below a picture that explains its colors."""

from __future__ import annotations

import numpy as np

from sc3d.scene.class_table import ClassTable
from sc3d.view.colors import Coloring, ColorScale, color_scale, legend_entries
from sc3d.view.lettering import lettering

PAPER, INK = (255, 255, 255), (32, 34, 38)


def add_legend(
    image: np.ndarray, by: Coloring, class_table: ClassTable | None, present: set[int] | None = None
) -> np.ndarray:
    """The picture with a legend strip below it; the picture itself stays as it is.

    image: (H, W, 3) uint8 RGB; present: ids to list, None = all
    returns: (H + strip, W, 3) uint8 RGB; unchanged for photo colors
    """
    scale = color_scale(by)
    if scale is not None:
        strip = _color_bar(scale, image.shape[1])
    else:
        entries = legend_entries(by, class_table, present)
        if not entries:
            return image
        strip = _swatches(entries, image.shape[1])
    return np.concatenate([image, strip])


def _swatches(entries: list[tuple[str, tuple[int, int, int]]], width: int) -> np.ndarray:
    from PIL import Image, ImageDraw

    size = caption_font(width)[1]
    texts = [lettering(name, size) for name, _ in entries]
    line, gap = round(1.9 * size), size
    places, x, y = [], gap, gap // 2
    for name, font in texts:
        length = round(1.6 * size + font.getlength(name))
        if x > gap and x + length > width - gap:
            x, y = gap, y + line
        places.append((x, y))
        x += length + round(1.5 * gap)
    strip = Image.new("RGB", (width, y + line + gap // 2), PAPER)
    draw = ImageDraw.Draw(strip)
    for (name, font), (_, color), (left, top) in zip(texts, entries, places, strict=True):
        middle = top + line // 2
        draw.rectangle(
            (left, middle - size // 2, left + size, middle + size // 2),
            fill=tuple(color),
            outline=(120, 120, 120),
        )
        draw.text((left + 1.6 * size, middle), name, font=font, fill=INK, anchor="lm")
    return np.asarray(strip)


def _color_bar(scale: ColorScale, width: int) -> np.ndarray:
    from PIL import Image, ImageDraw

    font, size = caption_font(width)
    height, start = 3 * size, round(1.5 * size + font.getlength(scale.low + " "))
    strip = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(strip)
    length = int(np.clip(width - start - 2 * size - font.getlength(scale.high), 2, 18 * size))
    bar = np.repeat(scale.colors[np.linspace(0, 255, length).astype(int)][None], size, axis=0)
    draw.text((size, height / 2), scale.low, font=font, fill=INK, anchor="lm")
    strip.paste(Image.fromarray(bar), (start, (height - size) // 2))
    draw.text((start + length + size // 2, height / 2), scale.high, font=font, fill=INK, anchor="lm")
    return np.asarray(strip)


def caption_font(width: int) -> tuple:
    """A Pillow font that suits a picture of `width` px, and its size, px."""
    from PIL import ImageFont

    size = int(np.clip(width // 70, 11, 28))
    return ImageFont.load_default(size), size
