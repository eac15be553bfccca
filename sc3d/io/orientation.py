"""Which way up the pixels of a picture lie. This is the one place that says so.

sc3d's pixel frame is the photo as it is stored: COLMAP reads it so, cameras, masks and confidence maps in the
scene folder lie in it. People and their programs see the photo as shown: turned by the orientation that its
EXIF states (1 to 8). So whatever is drawn on a photo (masks, truth, strokes, LabelMe, COCO, CVAT) lies as the
photo is shown; it is turned into sc3d's frame where it is read (`mask_turn`). Two things say otherwise:

- a picture that has an orientation of its own is turned by it first, as every viewer does. Masks that sc3d
  writes for turned photos carry the orientation of their photo, and so does nothing to them;
- a picture without one, whose sides fit the photo only as it is stored, lies as it is stored.

Backends see the photo as shown, the page of `sc3d annotate` shows it so, and instances lie in it.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

ORIENTATION = 0x0112  # EXIF tag
SIGNATURE_AND_HEADER = 33  # bytes of a PNG before its other chunks


def turned(image: np.ndarray, orientation: int) -> np.ndarray:
    """An (H, W, ...) picture as shown, from one as stored with an EXIF orientation of 1 to 8; swaps the sides
    from 5 on. A view where that is possible.
    """
    if orientation >= 5:
        image = image.swapaxes(0, 1)
    rows = slice(None, None, -1 if orientation in (3, 4, 7, 8) else 1)
    columns = slice(None, None, -1 if orientation in (2, 3, 6, 7) else 1)
    return image[rows, columns]


def turned_size(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """(width, height) as shown of a picture of (width, height) as stored, and the other way round."""
    return (size[1], size[0]) if orientation >= 5 else size


def turned_points(points: np.ndarray, size: tuple[int, int], orientation: int) -> np.ndarray:
    """(N, 2) x, y px as shown of points of a picture as stored; size: (width, height) px as stored."""
    points, (width, height) = np.asarray(points, np.float64), turned_size(size, orientation)
    if orientation >= 5:
        points = points[:, ::-1]
    x, y = points.T
    return np.stack(
        [width - x if orientation in (2, 3, 6, 7) else x, height - y if orientation in (3, 4, 7, 8) else y],
        axis=1,
    )


def inverse(orientation: int) -> int:
    """The orientation that turns a picture as shown back to the one as stored."""
    return {6: 8, 8: 6}.get(orientation, orientation)


def mask_turn(own: int, size: tuple[int, int], photo: int, photo_size: tuple[int, int]) -> tuple[int, bool]:
    """How a picture drawn on a photo is turned into the frame of the photo as stored.

    own, photo: orientations that the picture and the photo state, 1 = none; size, photo_size: (width, height)
    px as stored
    returns: the orientation to turn it by; whether only the rule says that it lies as the photo is shown, not
        its sides or its own orientation
    """
    if own != 1:
        return _then(own, inverse(photo)), False
    as_stored = _alike(size, photo_size)
    if photo >= 5 and as_stored and not _alike(size, photo_size[::-1]):
        return 1, False
    return inverse(photo), 2 <= photo < 5 or (photo >= 5 and as_stored)


def _alike(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes have one aspect, within 1 px of the smaller."""
    scale = min(1.0, min(other[0] / size[0], other[1] / size[1]))
    return abs(size[0] * other[1] - size[1] * other[0]) * scale <= max(other)


def _then(first: int, second: int) -> int:
    """The orientation that does what two do one after the other."""
    probe = np.arange(6).reshape(2, 3)
    wanted = turned(turned(probe, first), second)
    return next(number for number in range(1, 9) if np.array_equal(turned(probe, number), wanted))


def with_orientation(png: bytes, orientation: int) -> bytes:
    """A PNG that states an EXIF orientation (chunk eXIf of the PNG specification); the same bytes for 1."""
    if orientation == 1:
        return png
    # TIFF header, one entry: tag, type SHORT, one value, the value; no further directory
    exif = b"eXIf" + struct.pack(">2sHIHHHIHHI", b"MM", 42, 8, 1, ORIENTATION, 3, 1, orientation, 0, 0)
    chunk = struct.pack(">I", len(exif) - 4) + exif + struct.pack(">I", zlib.crc32(exif))
    return png[:SIGNATURE_AND_HEADER] + chunk + png[SIGNATURE_AND_HEADER:]
