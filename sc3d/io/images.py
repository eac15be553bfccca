"""Photos and masks before they are decoded: one of three formats, not too large, and there to the end."""

from __future__ import annotations

import mmap
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from sc3d.errors import InputError

if TYPE_CHECKING:
    from types import ModuleType

    from PIL import Image

FORMATS = ("JPEG", "PNG", "TIFF")  # JPEG holds MPO as well; Pillow knows many more, of which one runs a program
MAX_PIXELS = 160_000_000  # the largest cameras of drones have 151 megapixels; what a few bytes can announce must fit into the memory
MAX_SIDE = 100_000
END_OF_IMAGE, START_OF_SCAN = b"\xff\xd9", 0xDA


@contextmanager
def open_image(path: Path, what: str = "image") -> Iterator[Image.Image]:
    """A Pillow image of which only the header is read so far. InputError, which calls it `what`, if it is too large or damaged, also inside the block."""
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
        raise InputError(f"the {what} {path} has more than {MAX_PIXELS // 10**6} megapixels, which is refused: scale it down") from None
    except Exception:  # Pillow raises OSError, ValueError, SyntaxError, struct.error, KeyError, TypeError and more for damaged files
        raise InputError(f"cannot read the {what} {path}: it is missing, damaged or not a JPEG, PNG or TIFF image") from None


def _check_size(path: Path, size: tuple[int, int], what: str) -> None:
    if min(size) < 1 or max(size) > MAX_SIDE or size[0] * size[1] > MAX_PIXELS:
        raise InputError(f"the {what} {path} is {size[0]}x{size[1]}: sizes from 1 px to {MAX_PIXELS // 10**6} megapixels are possible, scale it down")


@cache
def _pillow() -> ModuleType:
    from PIL import Image

    warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)  # MAX_PIXELS decides, not half of Pillow's own limit
    return Image


def check_end(path: Path) -> None:
    """InputError for a JPEG that stops within its picture: decoders fill the rest with grey and say nothing."""
    with path.open("rb") as file:
        if file.read(2) != b"\xff\xd8":
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            scan = _find_scan(data)
            if scan < 0 or data.rfind(END_OF_IMAGE, scan) < 0:
                raise InputError(f"the photo {path} is cut off: copy it again from the camera")


def _find_scan(data: mmap.mmap) -> int:
    """Position of the first coded picture behind all segments, thumbnails among them; -1 if there is none. Coded data never holds the end marker."""
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
