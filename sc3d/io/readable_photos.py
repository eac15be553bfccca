"""Photos for programs that know neither the range of 16-bit values nor that alpha is a mask."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sc3d.errors import left_out
from sc3d.io.folders import link_or_copy, resolved
from sc3d.io.images import (
    has_alpha,
    image_size,
    photo_bits,
    read_image,
    read_opaque,
    used_range,
    write_image,
)

logger = logging.getLogger(__name__)

PNG = ".png"


def readable_photos(images: Path, names: list[str], work: Path) -> tuple[Path, Path | None]:
    """The folder that COLMAP shall read photos from, and that of its masks (`<name>.png`, 0 = no features),
    None if no photo is transparent anywhere. The folder of photos is `images`, or one in `work` of the same
    names where 16-bit photos must be stretched.

    names: relative to `images`
    """
    deep = {name for name in names if photo_bits(images / name) == 16}
    photos = images if not deep or used_range(images) is None else work / "photos"
    for name in names if photos is not images else ():
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        if name in deep:
            png = photos / f"{name}{PNG}"
            write_image(png, read_image(images / name, images))
            png.rename(photos / name)  # COLMAP looks into files, not at their names
        else:
            link_or_copy(resolved(images / name), photos / name)
    masked = [name for name in names if has_alpha(images / name) and read_opaque(images / name) is not None]
    for name in names if masked else ():  # COLMAP skips photos without a mask where others have one
        opaque = read_opaque(images / name) if name in masked else None
        pixels = np.ones(image_size(images / name)[::-1], bool) if opaque is None else opaque
        write_image(work / "opaque" / f"{name}{PNG}", np.where(pixels, 255, 0).astype(np.uint8))
    return photos, work / "opaque" if masked else None


def transparent_photos(photos: Mapping[str, Path]) -> list[str]:
    """Names of the photos of which nothing is opaque; photos: paths by name, those that do not exist are passed over."""
    files = {name: photo for name, photo in photos.items() if photo.is_file() and has_alpha(photo)}
    opaque = ((name, read_opaque(photo)) for name, photo in files.items())
    return [name for name, pixels in opaque if pixels is not None and not pixels.any()]


def tell_of_transparent(photos: Mapping[str, Path], what: str) -> list[str]:
    """Warn of `transparent_photos`, say what becomes of them, and return their names."""
    clear = transparent_photos(photos)
    if clear:
        logger.warning(left_out(clear, len(photos), f"photos are wholly transparent and {what}"))
    return clear
