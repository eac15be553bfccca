"""Photos and masks before they are decoded: one of three formats, not too large, and there to the end."""

from __future__ import annotations

import base64
import logging
import mmap
import struct
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path
from sc3d.io.limits import MAX_PIXELS, MAX_SIDE
from sc3d.io.orientation import (
    ORIENTATION,
    inverse,
    turned,
    turned_size,
    with_orientation,
)
from sc3d.io.photo_depth import FLOAT, bits_of, stretch, value_range
from sc3d.io.photo_folder import broken_link, find_photos

if TYPE_CHECKING:
    from types import ModuleType

    from PIL import Image

logger = logging.getLogger(__name__)

SAMPLED_PHOTOS = 16  # whose values are looked at for the range of a set

# JPEG holds MPO as well; Pillow knows many more, of which one runs a program
FORMATS = ("JPEG", "PNG", "TIFF")
# by their first bytes
OTHER_FORMATS: dict[str, Callable[[bytes], bool]] = {
    "HEIC or AVIF": lambda head: head[4:8] == b"ftyp",
    "WebP": lambda head: head[:4] == b"RIFF" and head[8:12] == b"WEBP",
    "GIF": lambda head: head[:4] == b"GIF8",
    "BMP": lambda head: head[:2] == b"BM",
    "JPEG 2000": lambda head: head[4:8] == b"jP  ",
    "JPEG XL": lambda head: head[:2] == b"\xff\x0a" or head[4:8] == b"JXL ",
    "PSD": lambda head: head[:4] == b"8BPS",
}
REDUCED = (
    17,
    33,
    65,
)  # cv2.IMREAD_REDUCED_COLOR_2, 4 and 8: a JPEG at a half, a quarter, an eighth of its size
STRIPS_AND_TILES = (273, 279), (324, 325)  # tags of TIFF: offsets and lengths
XMP = 700  # tag of TIFF
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
        # from a stream: what Pillow maps into memory by name, uncompressed TIFF, it scrambles if it is turned
        with path.open("rb") as file, pillow.open(file, formats=FORMATS) as image:
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
        raise InputError(f"cannot read the {what} {path}: {_what_is_wrong(path)}") from None


def _what_is_wrong(path: Path) -> str:
    """Why an image cannot be opened, and what to do."""
    broken = next((link for link in (path, *path.parents) if link.is_symlink() and not link.exists()), None)
    if broken is not None:
        return broken_link(broken)
    head = b""
    with suppress(OSError):
        if path.is_file():
            with path.open("rb") as file:
                head = file.read(32)
    name = next((name for name, found in OTHER_FORMATS.items() if found(head)), None)
    if name is not None:
        return f"it is a {name} image, not a JPEG, PNG or TIFF: convert it"
    if head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return (
            "it is damaged, or a TIFF of a kind that is not supported: save it with 8 or 16 bits per channel"
        )
    return "it is missing, damaged or not a JPEG, PNG or TIFF image"


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
    """InputError for a JPEG, PNG or TIFF that stops within its picture: decoders fill the rest with gray and
    say nothing.
    """
    with path.open("rb") as file:
        head = file.read(8)
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if head[:2] == b"\xff\xd8":
                scan = _find_scan(data)
                whole = scan >= 0 and data.rfind(END_OF_IMAGE, scan) >= 0
            elif head == b"\x89PNG\r\n\x1a\n":
                whole = data.rfind(b"IEND") >= 0
            else:
                whole = _end_of_tiff(path) <= len(data)
    if not whole:
        raise InputError(f"the photo {path} is cut off: copy it again from the camera")


def _end_of_tiff(path: Path) -> int:
    """Where the pixels of the first page of a TIFF end, byte; 0 for other files."""
    with open_image(path) as image:
        tags = getattr(image, "tag_v2", {})
        ends = [0]
        for offsets, counts in STRIPS_AND_TILES:
            ends += [a + b for a, b in zip(tags.get(offsets, ()), tags.get(counts, ()), strict=False)]
        return max(ends)


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


def read_image(path: Path, folder: Path | None = None, shown: bool = False) -> np.ndarray:
    """(H, W, 3) uint8 RGB; InputError if it is damaged, cut off or too large.

    folder: of all photos of the set, by whose range 16-bit photos are stretched; None: the photo's own
    shown: turned by its EXIF orientation; else as stored (see `sc3d.io.orientation`)
    """
    orientation = read_orientation(path)
    image = stretch(read_stored(path), lambda: used_range(folder or path.parent))
    return np.ascontiguousarray(turned(image, orientation if shown else 1))


def read_small(path: Path, longest: int, folder: Path | None = None) -> tuple[np.ndarray, tuple[int, int]]:
    """(H, W, 3) uint8 RGB of a photo as stored, its longest side at most `longest` px, and its stored (width,
    height). As `read_image`, but a JPEG is decoded at about that size, which takes a fraction of the time.
    """
    import cv2

    size = check_photo(path)
    with open_image(path, "photo") as header:
        jpeg = header.format in ("JPEG", "MPO")
    halves = min(int(np.log2(max(1.0, max(size) / longest))), len(REDUCED)) if jpeg else 0
    image = None
    if halves:
        image = cv2.imread(str(path), REDUCED[halves - 1] | cv2.IMREAD_IGNORE_ORIENTATION)
    image = read_image(path, folder) if image is None else np.ascontiguousarray(image[..., ::-1])
    scale = min(1.0, longest / max(size))
    small = tuple(max(1, round(side * scale)) for side in size)
    return (image if scale == 1 else cv2.resize(image, small, interpolation=cv2.INTER_AREA)), size


def read_stored(path: Path) -> np.ndarray:
    """(H, W, 3) uint8 or uint16 RGB as stored, alpha left out; InputError as in `read_image`."""
    import cv2

    check_photo(path)
    with open_image(path, "photo") as header:
        # Pillow and OpenCV both turn TIFF, whatever they are told, and OpenCV multiplies colors by alpha
        if (
            header.format == "TIFF"
            and bits_of(header) == 8
            and (orientation_of(header) != 1 or _has_alpha(header))
        ):
            orientation = orientation_of(header)
            rgba = np.array(header.convert("RGBA"))
            return np.ascontiguousarray(turned(rgba[..., :3], inverse(orientation)))
        if header.format == "TIFF" and orientation_of(header) != 1:
            raise InputError(
                f"cannot read the photo {path}: it is a turned TIFF of more than 8 bits; save it upright, without EXIF orientation"
            )
    try:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"cannot read the photo {path}: it is missing, damaged or not an image")
    return np.ascontiguousarray(image[..., ::-1])


def read_opaque(path: Path) -> np.ndarray | None:
    """(H, W) bool pixels of a photo, as stored, whose alpha is not 0: alpha is a mask, and what it hides is
    used nowhere. None if there is no alpha, or all is opaque.
    """
    with open_image(path, "photo") as image:
        if not _has_alpha(image):
            return None
        orientation = orientation_of(image) if image.format == "TIFF" else 1
        opaque = np.array(image.convert("RGBA").getchannel("A")) > 0
    return None if opaque.all() else np.ascontiguousarray(turned(opaque, inverse(orientation)))


def frame_of_photo(path: Path) -> tuple | None:
    """How masks and the world lie on a photo, by its header: its size as stored, its EXIF orientation and XMP,
    where drones write how they held it; None where that is not all, as it has alpha or cannot be read.
    """
    with suppress(InputError), open_image(path, "photo") as image:
        return None if _has_alpha(image) else (*stored_size(image), orientation_of(image), *_xmp(image))
    return None


def _xmp(image: Image.Image) -> list[object]:
    """XMP of an opened Pillow image, wherever JPEG, PNG and TIFF keep it; None where there is none."""
    segments = [data for name, data in getattr(image, "applist", []) if b"ns.adobe.com/xap" in data[:40]]
    return [*segments, image.info.get("XML:com.adobe.xmp"), getattr(image, "tag_v2", {}).get(XMP)]


def has_alpha(path: Path) -> bool:
    """Whether a photo has alpha, by its header."""
    with open_image(path, "photo") as image:
        return _has_alpha(image)


def _has_alpha(image: Image.Image) -> bool:
    return image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info


@cache
def used_range(folder: Path) -> tuple[int, int] | None:
    """The range of values by which the 16-bit photos of a folder and its subfolders are stretched to 8 bits,
    one for all, so that they stay comparable; None if they use at least half of all values, which need no
    stretching.
    """
    files = [file for file in find_photos(folder) if photo_bits(file) == 16]
    some = files[:: max(1, len(files) // SAMPLED_PHOTOS)]
    found = value_range([read_stored(file) for file in some])
    if found is not None:
        logger.info(
            "%s: %d photos have 16 bits and use the values %d to %d: stretched to 8 bits by this range, the same for all",
            folder,
            len(files),
            *found,
        )
    return found


def photo_bits(path: Path) -> int:
    """Bits per channel of a photo, 8 or 16; InputError for others, such as floating point."""
    with open_image(path) as image:
        bits = bits_of(image)
    if bits not in (8, 16):
        kind = "floating point" if bits == FLOAT else f"{bits} bits"
        raise InputError(
            f"the photo {path} has {kind} per channel: save it with whole numbers of 8 or 16 bits"
        )
    return bits


def num_pages(path: Path) -> int:
    """Pages of a TIFF; 1 for others (the further pictures of an MPO are previews)."""
    with open_image(path) as image:
        return int(getattr(image, "n_frames", 1)) if image.format == "TIFF" else 1


def read_orientation(path: Path) -> int:
    """EXIF orientation of a photo or mask, 1 to 8; 1 if it states none, or there is no such file."""
    if not path.is_file():
        return 1
    with open_image(path) as image:
        return orientation_of(image)


def orientation_of(image: Image.Image) -> int:
    """EXIF orientation of an opened Pillow image, 1 to 8; 1 if it states none."""
    found = image.getexif().get(ORIENTATION, 1)
    return found if isinstance(found, int) and 1 <= found <= 8 else 1


def check_photo(path: Path) -> tuple[int, int]:
    """(width, height) of a photo whose header can be read and that is not cut off; InputError for any other."""
    photo_bits(path)
    size = image_size(path)
    check_end(path)
    return size


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) as stored, from the header; InputError if the file is not an image, or too large a one."""
    with open_image(path) as image:
        return stored_size(image)


def stored_size(image: Image.Image) -> tuple[int, int]:
    """(width, height) as stored of an opened Pillow image; Pillow states that of a TIFF as shown."""
    return turned_size(image.size, orientation_of(image)) if image.format == "TIFF" else image.size


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


def write_image(path: Path, image: np.ndarray, orientation: int = 1) -> None:
    """Write (H, W) or (H, W, 3) uint8 RGB; the suffix chooses the format. orientation: for a PNG to state,
    that of the photo in whose frame a mask lies.
    """
    import cv2

    done, encoded = cv2.imencode(
        path.suffix, image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    )
    if not done:
        raise OSError(f"could not encode {path}")
    with atomic_path(path) as temporary:
        temporary.write_bytes(
            with_orientation(encoded.tobytes(), orientation)
        )  # not by cv2.imwrite, which does not always notice that a disk is full
