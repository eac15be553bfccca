"""Walks along records whose length stands in the file. Nothing is kept, nothing is allocated, and no step
leaves the data.
"""

from __future__ import annotations

import numba
import numpy as np

# what a walk may end with, instead of a position
CUT_OFF, WRONG_LENGTH, OUT_OF_RANGE = -1, -2, -3


@numba.njit(cache=True)
def walk_bytes(
    data: np.ndarray, start: int, count: int, fields: np.ndarray, big_endian: bool
) -> tuple[int, int]:
    """Skip records in binary data.

    data: (B,) uint8; start: position of the first record; count: number of records
    fields: (F, 5) int64 per field of a record: bytes of the count in front of a list, 0 for no list; bytes of
        the field, or of an item of the list; smallest and largest count that are allowed; items must be
        smaller than this, 0 = not looked at
    returns: position behind the last record, or a negative code; number of whole records
    """
    position, size = start, len(data)
    for row in range(count):
        for field in range(len(fields)):
            items, width = 1, fields[field, 1]
            if fields[field, 0] > 0:
                if size - position < fields[field, 0]:
                    return CUT_OFF, row
                items = _whole_number(data, position, fields[field, 0], big_endian)
                position += fields[field, 0]
                if items < fields[field, 2] or items > fields[field, 3]:
                    return WRONG_LENGTH, row
            if items > (size - position) // width:
                return CUT_OFF, row
            if fields[field, 4] > 0:
                for item in range(items):
                    value = _whole_number(data, position + item * width, width, big_endian)
                    if value < 0 or value >= fields[field, 4]:
                        return OUT_OF_RANGE, row
            position += items * width
    return position, count


@numba.njit(cache=True)
def walk_numbers(data: np.ndarray, start: int, count: int, fields: np.ndarray) -> tuple[int, int]:
    """The same for text whose words were decoded to (W,) float64; of `fields`, widths do not count and a
    first column > 0 says that it is a list.
    """
    position, size = start, len(data)
    for row in range(count):
        for field in range(len(fields)):
            items = 1
            if fields[field, 0] > 0:
                if position >= size:
                    return CUT_OFF, row
                stated = data[position]
                position += 1
                if not (fields[field, 2] <= stated <= fields[field, 3]) or stated != np.floor(stated):
                    return WRONG_LENGTH, row
                items = int(stated)
            if items > size - position:
                return CUT_OFF, row
            if fields[field, 4] > 0:
                for item in range(items):
                    value = data[position + item]
                    if not (0 <= value < fields[field, 4]) or value != np.floor(value):
                        return OUT_OF_RANGE, row
            position += items
    return position, count


@numba.njit(cache=True)
def _whole_number(data: np.ndarray, position: int, width: int, big_endian: bool) -> int:
    """An unsigned number; negative if it does not fit into 63 bits."""
    value = np.int64(0)
    for place in range(width):
        byte = data[position + (place if big_endian else width - 1 - place)]
        value = (value << np.int64(8)) | np.int64(byte)
    return value
