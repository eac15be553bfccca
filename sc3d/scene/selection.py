"""What a person means by a click, a stroke or a lasso on a cloud, as points and as balls in the world."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sc3d.errors import InputError
from sc3d.scene.corrections import MAX_CENTERS, Balls, in_polygon

LIKE = 40.0  # distance of colors, of 255 per channel, up to which points look alike
GAP = 2.0  # point spacings over which a region goes on
FARTHEST_CELL = 1 << 19  # of these, from where it starts
HOLE = 2.0  # width of a gap between points through which nothing is seen, point spacings
STEEP = 3.0  # rise of a surface over that width up to which all of it is seen
NARROWEST = 0.2  # cosine between the middle of a lasso and its corners
SIZES = 8  # of balls, each twice as large as the one before
LEVELS, CLOSEST = 5, 1 / 16  # sizes of balls that hold no other points; the smallest, point spacings
HALF_DIAGONAL = 0.88  # of a cube, and a little for rounding


def region_around(
    points: np.ndarray, label: np.ndarray, colors: np.ndarray | None, row: int, spacing: float
) -> np.ndarray:
    """(R,) rows of the points that hang together with one of them and have its label and about its color.

    points: (N, 3) float64; label: (N,); colors: (N, 3) uint8 or None; spacing: between points
    """
    alike = label == label[row]
    if colors is not None:
        differences = colors.astype(np.float32) - colors[row]
        alike &= (differences**2).sum(axis=1) <= LIKE**2
    offsets = np.floor((points - points[row]) / (GAP * spacing))
    rows = np.flatnonzero(alike & (np.abs(offsets) < FARTHEST_CELL).all(axis=1))
    cells = offsets[rows].astype(np.int64)
    cells -= cells.min(axis=0) - 1  # with a free cell around
    shape = tuple((cells.max(axis=0) + 2).tolist())
    keys, cell = np.unique(np.ravel_multi_index(tuple(cells.T), shape), return_inverse=True)
    group = _connected(keys, shape)[cell.ravel()]
    return rows[group == group[np.searchsorted(rows, row)]]


def _connected(keys: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(M,) number of the group of each of the cells that touch at a side, edge or corner; keys: (M,)
    int64 rising, of an array of that shape, whose outermost cells are free.
    """
    strides, pairs = np.array([shape[1] * shape[2], shape[2], 1]), []
    for step in np.ndindex(3, 3, 3):
        other = keys + int((np.array(step) - 1) @ strides)
        found = np.searchsorted(keys, other).clip(0, len(keys) - 1)
        touching = keys[found] == other
        pairs.append(np.stack([np.flatnonzero(touching), found[touching]]))
    links = np.concatenate(pairs, axis=1)
    graph = coo_matrix((np.ones(links.shape[1], np.int8), links), shape=(len(keys), len(keys)))
    return connected_components(graph, directed=False)[1]


def seen_in_lasso(points: np.ndarray, eye: np.ndarray, corners: np.ndarray, spacing: float) -> np.ndarray:
    """(R,) rows of the points that lie in a lasso as it is seen and are hidden by no others.

    points: (N, 3) float64; eye: (3,) where it is seen from; corners: (K, 3) unit directions to them, K >= 3;
        spacing: between points
    Raises InputError for a lasso that is too wide to be a polygon in a picture.
    """
    axis = corners.mean(axis=0)
    axis /= np.linalg.norm(axis) or 1.0
    if (corners @ axis < NARROWEST).any():
        raise InputError("the lasso is wider than a picture: draw a smaller one")
    right = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    right /= np.linalg.norm(right)
    frame = np.stack([right, np.cross(axis, right), axis])
    corners, local = corners @ frame.T, (points - eye) @ frame.T
    rows = np.flatnonzero(local[:, 2] > spacing)
    local = local[rows]
    pixels, depth = local[:, :2] / local[:, 2:], local[:, 2]
    inside = in_polygon(corners[:, :2] / corners[:, 2:], pixels)
    rows, pixels, depth = rows[inside], pixels[inside], depth[inside]
    if not len(rows):
        return rows
    width = HOLE * spacing / depth.min()  # in which every pixel of the nearest surface has a point
    _, cell = np.unique(np.floor(pixels / width).astype(np.int64), axis=0, return_inverse=True)
    first = np.full(cell.max() + 1, np.inf)
    np.minimum.at(first, cell.ravel(), depth)
    first = first[cell.ravel()]
    return rows[depth <= first + STEEP * width * first]


def balls_around(points: np.ndarray, chosen: np.ndarray, spacing: float) -> Balls:
    """Balls that hold the chosen points and hardly more: large ones where no other point is near, and
    at the border such of the size of the spacing.

    points: (N, 3) float64 world; chosen: (R,) rows of them, R >= 1; spacing: between points
    Raises InputError for what would need too many.
    """
    left, others = points[chosen], np.delete(points, chosen, axis=0)
    low, high = left.min(axis=0), left.max(axis=0)
    reach = spacing * 2**SIZES
    others = others[((others > low - reach) & (others < high + reach)).all(axis=1)]
    tree = cKDTree(others) if len(others) else None
    digits, groups = int(np.ceil(-np.log10(spacing))) + 2, []
    for level in reversed(range(SIZES)):
        size = spacing * 2**level
        radius = max(spacing, size * HALF_DIAGONAL)
        cells, cell = np.unique(np.floor((left - low) / size), axis=0, return_inverse=True)
        centers = np.round(low + (cells + 0.5) * size, digits)
        free = np.ones(len(cells), bool)
        if level and tree is not None:
            free = np.isinf(tree.query(centers, distance_upper_bound=radius * (1 + 1e-9))[0])
        if np.count_nonzero(free) > MAX_CENTERS:
            raise InputError(f"that is too ragged for {MAX_CENTERS} balls: choose a smaller part")
        groups += [(centers[free], float(radius))] if free.any() else []
        left = left[~free[cell.ravel()]]
        if not len(left):
            break
    return Balls(tuple(groups))


def balls_within(points: np.ndarray, chosen: np.ndarray, spacing: float) -> Balls:
    """Balls around the chosen points that hold no other: as large as the spacing where none is near, smaller beside
    others; a point that lies closer to another than `CLOSEST` spacings takes it along.

    points: (N, 3) float64 world; chosen: (R,) rows of them, R >= 1; spacing: between points
    """
    centers, others = points[chosen], np.delete(points, chosen, axis=0)
    distance = cKDTree(others).query(centers)[0] if len(others) else np.full(len(chosen), np.inf)
    digits, groups = int(np.ceil(-np.log10(CLOSEST * spacing))) + 2, []
    radii = [spacing * 0.5**level for level in range(LEVELS)]
    level = np.searchsorted(-np.array(radii), -distance, side="right").clip(0, LEVELS - 1)
    for row, radius in enumerate(radii):
        inside = centers[level == row]
        groups += [(np.round(inside, digits), float(radius))] if len(inside) else []
    return Balls(tuple(groups))
