"""Photos and masks before they are decoded: one of three formats, not too large, and there to the end."""

from __future__ import annotations

import base64
import mmap
import os
import shutil
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path
from sc3d.io.limits import MAX_PIXELS, MAX_SIDE

if TYPE_CHECKING:
    from types import ModuleType

    from PIL import Image

# JPEG holds MPO as well; Pillow knows many more, of which one runs a program
FORMATS = ("JPEG", "PNG", "TIFF")
END_OF_IMAGE, START_OF_SCAN = b"\xff\xd9", 0xDA


@contextmanager
def open_image(path: Path, what: str = "image") -> Iterator[Image.Image]:
    """A Pillow image of which only the header is read so far. InputError, which calls it `what`, if it is too
    large or damaged, also inside the block.
    """
    pillow = _pillow()
    try:
        if not path.is_file():  # a pipe or a device could be opened, and waited for
            raise FileNotFoundError
        with pillow.open(path, formats=FORMATS) as image:
            _check_size(path, image.size, what)
            yield image
    except InputError:
        raise
    except MemoryError:
        raise InputError(f"the {what} {path} does not fit into the memory: scale it down") from None
    except pillow.DecompressionBombError:
        raise InputError(
            f"the {what} {path} has more than {MAX_PIXELS // 10**6} megapixels, which is refused: scale it down"
        ) from None
    # Pillow raises OSError, ValueError, SyntaxError, struct.error, KeyError, TypeError and more for damaged
    # files
    except Exception:
        raise InputError(
            f"cannot read the {what} {path}: it is missing, damaged or not a JPEG, PNG or TIFF image"
        ) from None


def _check_size(path: Path, size: tuple[int, int], what: str) -> None:
    if min(size) < 1 or max(size) > MAX_SIDE or size[0] * size[1] > MAX_PIXELS:
        raise InputError(
            f"the {what} {path} is {size[0]}x{size[1]}: sizes from 1 px to {MAX_PIXELS // 10**6} megapixels are possible, scale it down"
        )


@cache
def _pillow() -> ModuleType:
    from PIL import Image

    # MAX_PIXELS decides, not half of Pillow's own limit
    warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)
    return Image


def check_end(path: Path) -> None:
    """InputError for a JPEG that stops within its picture: decoders fill the rest with gray and say nothing."""
    with path.open("rb") as file:
        if file.read(2) != b"\xff\xd8":
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            scan = _find_scan(data)
            if scan < 0 or data.rfind(END_OF_IMAGE, scan) < 0:
                raise InputError(f"the photo {path} is cut off: copy it again from the camera")


def _find_scan(data: mmap.mmap) -> int:
    """Position of the first coded picture behind all segments, thumbnails among them; -1 if there is none.
    Coded data never holds the end marker.
    """
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == START_OF_SCAN:
            return position
        if marker == 0xFF or 0xD0 <= marker <= 0xD8 or marker == 0x01:  # padding and markers without a length
            position += 1 if marker == 0xFF else 2
            continue
        position += 2 + struct.unpack_from(">H", data, position + 2)[0]
    return -1


IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}


def list_photos(folder: Path) -> list[Path]:
    """Photos of a folder and its subfolders, by path."""
    return sorted(
        file
        for file in folder.rglob("*")
        if file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith(".") and file.is_file()
    )


def find_photos(folder: Path) -> list[Path]:
    """As `list_photos`; InputError if there are none, or one is a link that leads elsewhere."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: give the folder that holds the photos")
    photos = list_photos(folder)
    if not photos:
        raise InputError(f"no photos in {folder}: JPEG, PNG or TIFF files are expected")
    for photo in photos:
        require_within(photo, folder)
    return photos


def require_place(photos: Path, images: Path) -> None:
    """InputError if `images` already holds other photos than those of the folder `photos`."""
    if images.exists() and not images.is_symlink() and images.resolve() != photos.resolve():
        raise InputError(f"{images} already holds other photos: choose another scene folder")


def link_photos(photos: Path, images: Path) -> None:
    """Make `images` a link to a folder of photos, a copy where links are not possible; nothing if it is that
    folder. InputError if it already holds others.
    """
    require_place(photos, images)
    if images.exists() and images.resolve() == photos.resolve():
        return
    with atomic_path(images) as temporary:
        try:
            os.symlink(photos.resolve(), temporary, target_is_directory=True)
        except (OSError, NotImplementedError):  # Windows asks for a privilege
            shutil.copytree(photos, temporary)


def require_within(file: Path, folder: Path) -> None:
    """InputError if a file of a folder is a link to a file outside of it; the folder itself may be a link."""
    if not file.resolve().is_relative_to(folder.resolve()):
        raise InputError(
            f"{file} is a link that leads out of {folder}: copy the file there, or make the whole folder a link"
        )


def read_image(path: Path) -> np.ndarray:
    """(H, W, 3) uint8 RGB, as stored (EXIF orientation is not applied, as in COLMAP); InputError if it is
    damaged, cut off or too large.
    """
    import cv2

    check_photo(path)
    try:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"cannot read the photo {path}: it is missing, damaged or not an image")
    return np.ascontiguousarray(image[..., ::-1])


def check_photo(path: Path) -> tuple[int, int]:
    """(width, height) of a photo whose header can be read and that is not cut off; InputError for any other."""
    size = image_size(path)
    check_end(path)
    return size


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header; InputError if the file is not an image, or too large a one."""
    with open_image(path) as image:
        return image.size


def read_index_image(path: Path) -> np.ndarray:
    """(H, W) uint8 of a gray or palette PNG (labels or confidence)."""
    with open_image(path, "mask") as image:
        if image.mode.startswith("I"):
            raise InputError(f"{path} has 16 bits per pixel: an 8-bit PNG with one id per pixel is expected")
        if image.mode not in ("L", "P", "1"):
            raise InputError(
                f"{path} has colors ({image.mode}): an 8-bit PNG with one id per pixel is expected"
            )
        return np.array(image.convert("L") if image.mode == "1" else image, dtype=np.uint8)


def data_uri(image: np.ndarray, suffix: str = ".jpg") -> str:
    """A picture as an address that holds it, for pages of one file.

    image: (H, W, 3) uint8 RGB, or (H, W, 4) with opacity for PNG; suffix: ".jpg", of quality 85, or ".png"
    """
    import cv2

    channels = [2, 1, 0, 3][: image.shape[2]]  # OpenCV's order
    options = {".jpg": [cv2.IMWRITE_JPEG_QUALITY, 85], ".png": [cv2.IMWRITE_PNG_COMPRESSION, 9]}[suffix]
    encoded = cv2.imencode(suffix, np.ascontiguousarray(image[..., channels]), options)[1]
    kind = {".jpg": "jpeg", ".png": "png"}[suffix]
    return f"data:image/{kind};base64,{base64.b64encode(encoded.tobytes()).decode()}"


def write_image(path: Path, image: np.ndarray) -> None:
    """Write (H, W) or (H, W, 3) uint8 RGB; the suffix chooses the format."""
    import cv2

    done, encoded = cv2.imencode(
        path.suffix, image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    )
    if not done:
        raise OSError(f"could not encode {path}")
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded)  # not by cv2.imwrite, which does not always notice that a disk is full
