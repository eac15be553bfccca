"""Photos of 16 bits per channel, of which many use a small part: thermal images, raw counts of a sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from PIL import Image

FLOAT = 0  # what `bits_of` says of floating point
BITS_PER_SAMPLE, SAMPLE_FORMAT, UNSIGNED, SIGNED = 258, 339, 1, 2  # tags and values of TIFF
WIDE = 1 << 15  # a set that uses as many values loses nothing that can be seen when it is cut to 8 bits
TAILS = (0.0005, 0.9995)  # quantiles taken for the ends of a set's range: single hot pixels do not count


def bits_of(image: Image.Image) -> int:
    """Bits per channel of an opened Pillow image, at least 8; FLOAT for floating point."""
    tags = getattr(image, "tag_v2", {})
    if image.mode == "F" or set(_values(tags.get(SAMPLE_FORMAT, UNSIGNED))) - {UNSIGNED, SIGNED}:
        return FLOAT
    if image.format == "TIFF":
        return max(8, *_values(tags.get(BITS_PER_SAMPLE, 8)))
    return 16 if image.mode.startswith("I") or "16B" in raw_mode(image) else 8


def raw_mode(image: Image.Image) -> str:
    """How the pixels of an opened Pillow image are stored, such as "RGB;16B" or "L;4"; before they are read."""
    tile = getattr(image, "tile", [])
    return str(tile[0].args) if tile else ""


def _values(tag: int | Sequence[int]) -> tuple[int, ...]:
    return (tag,) if isinstance(tag, int) else tuple(tag)


def value_range(images: Sequence[np.ndarray]) -> tuple[int, int] | None:
    """Lowest and highest value that 16-bit images use, but for single pixels; None if that is half of all or
    more, or nothing.
    """
    counts = np.zeros(1 << 16, np.int64)
    for image in images:
        counts += np.bincount(image.ravel(), minlength=1 << 16)
    if not counts.any():
        return None
    below = np.cumsum(counts)
    low, high = (int(np.searchsorted(below, share * below[-1])) for share in TAILS)
    return None if high - low >= WIDE else (low, max(high, low + 1))


def stretch(image: np.ndarray, used: Callable[[], tuple[int, int] | None]) -> np.ndarray:
    """uint8 of an image of 8 or 16 bits: the used range of 16 bits becomes 0 to 255; without one, the high
    byte is taken.

    used: gives the range, asked for 16 bits only
    """
    if image.dtype == np.uint8:
        return image
    found = used()
    if found is None:
        return (image >> 8).astype(np.uint8)
    low, high = found
    table = np.clip(np.rint((np.arange(1 << 16) - low) * (255 / (high - low))), 0, 255).astype(np.uint8)
    return table[image]
