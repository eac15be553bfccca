"""What no other view confirms: continued from confirmed surface around it, or sky, or nothing.

A pixel continues the confirmed pixel that it reaches with the least change of color. Level ground before the
cameras goes on as such, however far, as it is seen too flat for patches to match; anything else a few pixels
only.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from scipy.sparse import coo_array, diags_array, eye_array, kron, vstack
from scipy.sparse.linalg import spsolve

from sc3d.geometry.cameras import View

COHERENT = 0.02  # of the inverse depth, between pixels of one surface
SPECKLE = 4e-4  # of the pixels of a map
TRIALS = 20_000  # of RANSAC
MOST = 300  # of them tried
TILTED = 10.0  # degrees between ground as a whole and level
FLAT = 0.05  # of the height of the cameras above the ground, how flat that is
MIN_GROUND = 50  # points
STRIP = 0.1  # least width of ground for its length
CELLS = 24  # of the map of its relief, along each side
SMOOTH = 0.3  # weight of the relief's second differences against the heights in a cell
RIDGE = 0.05  # weight of the relief itself: without points around, the ground is the plane
BELOW = 0.01  # of the pixels
CLEARANCE = 0.25  # of the height of a camera above the ground, by which ground differs from a plane
CONTINUED = 0.02  # of the longest side, how far a surface goes on
COLOR_STEP = 8.0  # gray values that cost as much as a pixel
FLATTEST = (
    0.35  # sine of the angle at which ground is seen; steeper, its patches match, and what does not is a tree
)
FARTHEST = 0.01  # quantile of a view's confirmed inverse depths: ground goes on no farther
EVEN = 20  # gray values within 5x5 px
FATTENED = 7  # px of the small image, by which surface is carried over its outline
SKY_PIXELS = 50  # at least, of the small image
SKY_SIZE = 480  # px, longest side of the image in which sky is looked for


@dataclass(frozen=True)
class Ground:
    """Level ground below the cameras, nearly a plane: up . X = height + relief(X).

    up: (3,) unit, world; axes: (2, 3) unit, across it; start: (2,) corner and size of the cells of a map
        along axes
    relief: (CELLS, CELLS) height above the plane at the corners of the map's cells, world units
    """

    up: np.ndarray
    height: float
    axes: np.ndarray
    start: np.ndarray
    size: float
    relief: np.ndarray

    def relief_at(self, points: np.ndarray) -> np.ndarray:
        """(...) height above the plane of the ground at (..., 3) points, bilinear; off the map that of its
        border.
        """
        place = (points @ self.axes.T - self.start) / self.size
        x, y = np.moveaxis(place.astype(np.float32), -1, 0)
        flat = cv2.remap(
            self.relief.astype(np.float32),
            np.atleast_2d(x),
            np.atleast_2d(y),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return flat.reshape(x.shape)


def without_speckles(inverse: np.ndarray, confirmed: np.ndarray, share: float = SPECKLE) -> np.ndarray:
    """(H, W) bool: confirmed pixels without patches of a coherent depth that are smaller: chance.

    inverse: (H, W) float32 inverse depths; confirmed: (H, W) bool; share: of the pixels, of the smallest
        patch kept
    """
    step = np.log1p(COHERENT) / 8
    with np.errstate(divide="ignore"):
        logs = np.where(
            confirmed, np.log(inverse / np.median(inverse[confirmed])) if confirmed.any() else 0, 0
        )
    image = np.clip(logs / step, -32000, 32000).astype(np.int16)
    image[~confirmed] = -32768
    cv2.filterSpeckles(image, -32768, round(share * confirmed.size), 8)
    return image != -32768


@numba.njit(cache=True)
def nearest_by_color(image, seeds):
    """(H, W) int64 flat index of the seed that each pixel reaches with the least change of color, -1 without
    seeds; (H, W) float32 length of that way, px, changes of color included.

    image: (H, W, 3) uint8; seeds: (H, W) bool. Raster scans forth and back (chamfer distance), three times.
    """
    height, width = seeds.shape
    distance = np.where(seeds, np.float32(0), np.float32(1e9))
    source = np.full((height, width), -1, np.int64)
    for row in range(height):
        for column in range(width):
            if seeds[row, column]:
                source[row, column] = row * width + column
    for scan in range(6):
        forth = scan % 2 == 0
        sign = 1 if forth else -1
        for i in range(height):
            row = i if forth else height - 1 - i
            for j in range(width):
                column = j if forth else width - 1 - j
                for k in range(4):
                    r = row - sign if k < 3 else row
                    c = column + k - 1 if k < 3 else column - sign
                    if not (0 <= r < height and 0 <= c < width) or source[r, c] < 0:
                        continue
                    change = np.float32(0)
                    for channel in range(3):
                        change = max(
                            change,
                            abs(np.float32(image[row, column, channel]) - np.float32(image[r, c, channel])),
                        )
                    step = np.float32(1.414) if k == 0 or k == 2 else np.float32(1)
                    reached = distance[r, c] + step + change / np.float32(COLOR_STEP)
                    if reached < distance[row, column]:
                        distance[row, column], source[row, column] = reached, source[r, c]
    return source, distance


def fit_ground(points: np.ndarray, centers: np.ndarray, up: np.ndarray) -> Ground | None:
    """The nearly level plane below all cameras with most points on it and least below it, by RANSAC; None
    where they are few. Not by normals: those of ground are poor where it is seen flat.

    points: (N, 3) confirmed, world; centers: (V, 3) cameras; up: (3,) unit
    """
    chosen = points[points @ up < (centers @ up).min()]
    if len(chosen) < MIN_GROUND:
        return None
    random, best, found = np.random.default_rng(0), 0, None
    corners = chosen[random.integers(len(chosen), size=(TRIALS, 3))]
    directions = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(directions, axis=1)
    normals = directions * (np.sign(directions @ up) / np.maximum(lengths, 1e-30))[:, None]
    level = normals @ up > np.cos(np.deg2rad(TILTED))
    tolerance = FLAT * float(np.median(centers @ up) - np.quantile(chosen @ up, 0.01))
    for corner, normal in zip(corners[level, 0][:MOST], normals[level][:MOST], strict=True):
        heights = (chosen - corner) @ normal
        near = np.abs(heights) < tolerance
        score = int(near.sum()) - 3 * int((heights < -3 * tolerance).sum())
        if score > best:
            best, found = score, near
    if found is None or best < MIN_GROUND:
        return None
    middle = chosen[found].mean(axis=0)
    spread, directions = np.linalg.svd(chosen[found] - middle, full_matrices=False)[1:]
    if spread[1] < STRIP * spread[0]:  # the foot of a wall, no ground
        return None
    normal = directions[2]
    normal *= np.sign(normal @ up)
    heights = (chosen - middle) @ normal
    clearance = float(np.median((centers - middle) @ normal))
    close = chosen[np.abs(heights) < CLEARANCE * clearance]
    if len(close) < MIN_GROUND:  # the plane passes the cameras: a strip of a wall
        return None
    return _with_relief(normal, float(middle @ normal), close)


def _with_relief(up: np.ndarray, height: float, points: np.ndarray) -> Ground:
    """Relief of (N, 3) points close to a plane: least squares with small second differences, reweighted
    thrice against what stands on the ground (Cauchy weights).
    """
    axes = np.linalg.svd(up[None])[2][1:]
    placed, heights = points @ axes.T, points @ up - height
    low, high = np.quantile(placed, [0.01, 0.99], axis=0)
    size = float((high - low).max()) * 1.2 / (CELLS - 1)
    start = (low + high) / 2 - size * (CELLS - 1) / 2
    inside = (np.abs(placed - start - size * (CELLS - 1) / 2) < size * (CELLS - 1) / 2).all(axis=1)
    cells = (placed[inside] - start) / size
    columns, rows = cells.astype(int).T
    fx, fy = cells.T - [columns, rows]
    corners = np.stack([rows * CELLS + columns, rows * CELLS + columns + 1], axis=1)
    corners = np.concatenate([corners, corners + CELLS], axis=1)
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], axis=1)
    which = np.repeat(np.arange(len(cells)), 4)
    matrix = coo_array((weights.ravel(), (which, corners.ravel())), (len(cells), CELLS**2)).tocsr()
    second = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(CELLS - 2, CELLS))
    identity = eye_array(CELLS)
    smooth = vstack([kron(identity, second), kron(second, identity)])
    relief, own = np.zeros(CELLS**2), np.ones(len(cells))
    for _ in range(3):
        # every cell counts alike, however many points lie in it
        share = own / np.maximum(np.bincount(corners[:, 0], own, CELLS**2)[corners[:, 0]], 1e-12)
        normal = (
            matrix.T @ (matrix * share[:, None]) + SMOOTH * (smooth.T @ smooth) + RIDGE * eye_array(CELLS**2)
        )
        relief = spsolve(normal.tocsc(), matrix.T @ (share * heights[inside]))
        residual = heights[inside] - matrix @ relief
        scale = 1.5 * np.median(np.abs(residual)) + 1e-12
        own = 1 / (1 + (residual / scale) ** 2)
    return Ground(up, height, axes, start, size, relief.reshape(CELLS, CELLS))


def not_below(view: View, planes: np.ndarray, confirmed: np.ndarray, ground: Ground) -> np.ndarray:
    """(H, W) bool: confirmed pixels without patches clearly below the ground that are smaller than BELOW.

    Ground at grazing angles looks the same a little farther on, to all views. planes: (H, W, 3+) q, a, b
    """
    level = _ground_planes(view, ground)[..., 0]
    below = confirmed & (planes[..., 0] * (1 + CLEARANCE) < level)
    return confirmed & (~below | without_speckles(planes[..., 0], below, BELOW))


def horizon(view: View, up: np.ndarray) -> np.ndarray:
    """(H, W) sine of the elevation of the pixels' rays above level, of a pinhole view."""
    columns, rows = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=2) @ np.linalg.inv(view.matrix).T
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    return rays @ (view.cam_from_world[:3, :3] @ up)


def find_sky(image: np.ndarray, confirmed: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """(H, W) bool: above the horizon, bright or blue, even up to the border of the image, and not confirmed,
    but for the fringe of confirmed surface: patches carry it over its outline.

    What is even and reaches the border is sure, and so is what has its colors; what lies between goes to sky
    or to the rest, whichever it reaches with less change of color.
    image: (H, W, 3) uint8 RGB; confirmed: (H, W) bool; elevation: (H, W) sine of `horizon`
    """
    height, width = confirmed.shape
    scale = min(1.0, SKY_SIZE / max(height, width))
    size = max(8, round(width * scale)), max(8, round(height * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    known = cv2.resize(confirmed.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.2
    sure = cv2.erode(known.astype(np.uint8), np.ones((2 * FATTENED + 1,) * 2, np.uint8)).astype(bool)
    above = cv2.resize(elevation.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    shiny = _bright_or_blue(small, sure | ~above)
    even = above & shiny & ~sure & ~_uneven(small)
    labels = cv2.connectedComponents(even.astype(np.uint8), connectivity=4)[1]
    border = np.zeros_like(even)
    border[0], border[-1], border[:, 0], border[:, -1] = True, True, True, True
    core = even & np.isin(labels, np.unique(labels[border & even]))
    if core.sum() < SKY_PIXELS:
        return np.zeros(confirmed.shape, bool)
    core |= even & _like(small, core)
    source, _ = nearest_by_color(small, core | sure | ~above | ~shiny)
    sky = core.ravel()[source] & above & ~sure
    _, labels, sizes, _ = cv2.connectedComponentsWithStats(sky.astype(np.uint8), connectivity=4)
    open_sky = np.bincount(labels[~known], minlength=len(sizes)) > 0.5 * sizes[:, cv2.CC_STAT_AREA]
    sky &= open_sky[labels]
    return cv2.resize(sky.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5


def _uneven(image: np.ndarray) -> np.ndarray:
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return cv2.morphologyEx(gray, cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8)) > EVEN


def _bright_or_blue(image: np.ndarray, solid: np.ndarray) -> np.ndarray:
    """(H, W) bool: brighter than half of what is solid, or blue."""
    luma = image @ np.array([0.299, 0.587, 0.114], np.float32)
    middle = np.median(luma[solid]) if solid.any() else 128.0
    red, green, blue = np.moveaxis(image.astype(np.int16), 2, 0)
    return (luma > middle) | ((blue > red + 15) & (blue > green))


def _like(image: np.ndarray, core: np.ndarray) -> np.ndarray:
    """(H, W) bool: colors of the core, by the closest of eight mean colors (CIE Lab)."""
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB).astype(np.float32)
    cv2.setRNGSeed(0)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, 20, 0.5)
    means = cv2.kmeans(lab[core], 8, None, criteria, 1, cv2.KMEANS_PP_CENTERS)[2]
    gaps = np.linalg.norm(lab[:, :, None] - means, axis=3).min(axis=2)
    return gaps < 10


def continued_planes(
    view: View, planes: np.ndarray, confirmed: np.ndarray, image: np.ndarray, ground: Ground | None
) -> np.ndarray:
    """(H, W, 3) float32 planes: the confirmed ones, and those that go on; q = 0 where nothing does.

    planes: (H, W, 3+) q, a, b; confirmed: (H, W) bool; image: (H, W, 3) uint8
    """
    height, width = confirmed.shape
    result = np.where(confirmed[..., None], planes[..., :3], 0).astype(np.float32)
    if not confirmed.any():
        return result
    source, way = nearest_by_color(image, confirmed)
    rows, columns = np.divmod(source, width)
    dy, dx = np.arange(height)[:, None] - rows, np.arange(width) - columns
    q, a, b = np.moveaxis(planes[rows, columns, :3], 2, 0)
    further = q + a * dx + b * dy
    near = (way <= CONTINUED * max(height, width)) & (np.abs(further / q - 1) < 0.2)
    goes_on = near & ~confirmed
    result[goes_on] = np.stack([further, a, b], axis=2)[goes_on]
    if ground is not None:
        level, steep = _ground_planes(view, ground), horizon(view, ground.up)
        _continue_ground(result, level, steep, confirmed, source, image)
    return result


def _continue_ground(
    result: np.ndarray,
    level: np.ndarray,
    steep: np.ndarray,
    confirmed: np.ndarray,
    source: np.ndarray,
    image: np.ndarray,
) -> None:
    """Change planes to those of the ground where that goes on, or hides what goes on behind it.

    result: (H, W, 3) planes so far; level: (H, W, 3) of the ground; steep: (H, W) sine of `horizon` above it
    source: (H, W) confirmed pixel of each
    """
    reachable = (level[..., 0] > 0) & (level[..., 0] > np.quantile(result[..., 0][confirmed], FARTHEST))
    reachable &= steep > -FLATTEST
    on_ground = _on_ground(result, level) & confirmed
    hidden = (result[..., 0] > 0) & (result[..., 0] < level[..., 0])
    lies = (on_ground.ravel()[source] | hidden) & ~confirmed & reachable
    result[lies] = level[lies]
    on_ground |= lies
    source, _ = nearest_by_color(image, result[..., 0] > 0)  # around what went on for a few pixels only
    lies = on_ground.ravel()[source] & (result[..., 0] == 0) & reachable
    result[lies] = level[lies]


def _ground_planes(view: View, ground: Ground) -> np.ndarray:
    """(H, W, 3) planes of the ground in a view: with X = ray / q, up . (R^T (X - t)) = height gives
    q = (R up) . ray / (height - up . center), linear in the pixel; relief r at X makes it q h / (h - r), with
    h the height of the camera.
    """
    above = ground.up @ view.center - ground.height
    if above <= 0:
        return np.zeros((view.height, view.width, 3), np.float32)
    slopes = (view.cam_from_world[:3, :3] @ ground.up) @ np.linalg.inv(view.matrix) / -above
    columns, rows = np.arange(view.width) + 0.5, np.arange(view.height)[:, None] + 0.5
    level = slopes[0] * columns + slopes[1] * rows + slopes[2]
    rays_cam = np.stack(np.broadcast_arrays(columns, rows, 1.0), axis=2) @ np.linalg.inv(view.matrix).T
    directions = rays_cam @ view.cam_from_world[:3, :3]
    q = np.maximum(level, 1e-12)
    for _ in range(3):
        relief = ground.relief_at(view.center + directions / q[..., None])
        factor = above / np.maximum(above - relief, 0.1 * above)
        q = np.maximum(level, 1e-12) * factor
    planes = np.stack([q, factor * slopes[0], factor * slopes[1]], axis=2)
    return np.where(level[..., None] > 0, planes, 0).astype(np.float32)


def _on_ground(planes: np.ndarray, level: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels whose surface is as high as the ground, up to CLEARANCE of the camera's height.

    Along a ray from height h, a surface at inverse depth q lies h (1 - level / q) above the ground.
    """
    above = 1 - level[..., 0] / np.maximum(planes[..., 0], 1e-30)
    return (level[..., 0] > 0) & (np.abs(above) < CLEARANCE)
