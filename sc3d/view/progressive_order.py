"""Level of detail: an order of the points in which every beginning is spread evenly over the cloud."""

from __future__ import annotations

import numpy as np

_BITS = 21  # per axis; three of them fit into 63 bits


def even_order(points: np.ndarray) -> np.ndarray:
    """Rows of the points so that the first K of them, for any K, thin the cloud evenly and keep its relative
    densities.

    The points are sorted along a Z-order curve, which neighbors share, and then taken in the order of the
    van der Corput sequence,
    whose every beginning is spread evenly over the curve. Nothing is random, and copies of a cloud in another
    order give the same points.

    points: (N, 3) finite; returns: (N,) int64, a permutation
    """
    along_curve = np.argsort(morton_codes(points), kind="stable")
    return along_curve[_van_der_corput(len(points))]


def morton_codes(points: np.ndarray) -> np.ndarray:
    """(N,) uint64 position of (N, 3) points on the Z-order curve of the cube around them."""
    points = np.asarray(points, np.float64)
    if not len(points):
        return np.empty(0, np.uint64)
    low = points.min(axis=0)
    side = float((points.max(axis=0) - low).max()) or 1.0
    cells = np.minimum((points - low) / side * (1 << _BITS), (1 << _BITS) - 1).astype(np.uint64)
    x, y, z = (_spread(cells[:, axis]) for axis in range(3))
    return x << np.uint64(2) | y << np.uint64(1) | z


def _spread(values: np.ndarray) -> np.ndarray:
    """Two zero bits between any two of the 21 bits of (N,) uint64."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values = (values | values << np.uint64(shift)) & np.uint64(mask)
    return values


def _van_der_corput(count: int) -> np.ndarray:
    """(count,) int64: 0 to count - 1 by their bits read backwards."""
    bits = max(count - 1, 0).bit_length()
    numbers = np.arange(1 << bits, dtype=np.int64)
    backwards = np.zeros_like(numbers)
    for bit in range(bits):
        backwards |= (numbers >> bit & 1) << (bits - 1 - bit)
    return backwards[backwards < count]
