"""PatchMatch stereo: a slanted plane for every pixel, found by trying the planes of the pixels around it.

The inverse depth 1 / z of a plane is linear in the pixel, so a plane is (q, a, b): the inverse depth at the
pixel and its slopes along columns and rows; it goes on at an offset (i, j) with q + i a + j b. A pixel p of
the reference lands in a source at A (p, 1) + q(p) B, projected, A = K_s R K_r^-1 and B = K_s t. Its patch is
compared by normalized cross-correlation (NCC), weighted with the color difference to the middle (bilateral
weights), and warped by the derivative of that map, which is exact up to second order in the patch radius.

After Bleyer et al., PatchMatch Stereo (2011), with the red-black updates of Galliani et al., Massively
Parallel Multiview Stereopsis (2015). Written from the papers.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from sc3d.stereo.agreement import continued, moved

RADIUS = 4  # px, of the patch
STEP = 2  # every second pixel of it
SIDE = 2 * RADIUS // STEP + 1
SAMPLES = SIDE * SIDE
LANES = 32  # SAMPLES filled up with such of weight 0, so that they fill vector registers
_OFFSETS = np.zeros((LANES, 2), np.float32)
_OFFSETS[:SAMPLES] = np.stack(
    np.meshgrid(*[np.arange(-RADIUS, RADIUS + 1, STEP)] * 2, indexing="ij"), 2
).reshape(-1, 2)
ROWS, COLUMNS = np.ascontiguousarray(_OFFSETS.T)
NOISE = (1.5 / 255) ** 2  # variance of gray values that counts as noise
SPATIAL = 3.0  # px, standard deviation of the weights
COLOR = 0.06  # gray value, standard deviation of the weights
WORST = 2.0  # the cost where nothing can be compared
LONELY = 0.25  # cost of a plane that one source only sees
BEST = 2  # sources whose costs are averaged: the others may not see the pixel
AGREEMENT = 0.2  # cost per px by which a source's own depth contradicts
CONTRADICTION = 3.0  # px; more does not count


class Stereo(NamedTuple):
    """One reference and its sources, all undistorted.

    gray: (H, W) float32, 0 to 1; sources: (S, h, w) float32, filled up with 0; sizes: (S, 2) width, height px
    A: (S, 3, 3), B: (S, 3) float32 of `pinhole_pairs.transfer`
    farthest, nearest: inverse depths allowed, farthest <= q <= nearest; span: of which random changes are a
        share
    others: (S, h, w, 3) float32 planes that the sources have found, q = 0: none; without any (S, 0, 0, 3)
    back_A, back_B: A and B from each source to the reference
    """

    gray: np.ndarray
    sources: np.ndarray
    sizes: np.ndarray
    A: np.ndarray
    B: np.ndarray
    farthest: float
    nearest: float
    span: float
    others: np.ndarray
    back_A: np.ndarray
    back_B: np.ndarray


@numba.njit(cache=True, fastmath=True, inline="always")
def _hash(state):
    """Next state of a 32-bit generator (PCG's output function on an LCG)."""
    return np.uint32(state * np.uint32(747796405) + np.uint32(2891336453))


@numba.njit(cache=True, fastmath=True)
def _uniform(state):
    word = np.uint32(
        ((state >> np.uint32((state >> np.uint32(28)) + np.uint32(4))) ^ state) * np.uint32(277803737)
    )
    word = np.uint32((word >> np.uint32(22)) ^ word)
    return np.float32(word) * np.float32(2.3283064e-10)


@numba.njit(cache=True, fastmath=True)
def _patch(gray, row, column, weights, values):
    """Fill (LANES,) weights (sum 1) and weighted centered values of a reference patch; returns its
    variance.
    """
    height, width = gray.shape
    middle = gray[row, column]
    total = np.float32(0)
    mean = np.float32(0)
    k = 0
    for j in range(-RADIUS, RADIUS + 1, STEP):
        y = min(max(row + j, 0), height - 1)
        for i in range(-RADIUS, RADIUS + 1, STEP):
            x = min(max(column + i, 0), width - 1)
            value = gray[y, x]
            difference = (value - middle) / np.float32(COLOR)
            weight = np.exp(
                np.float32(-0.5)
                * (difference * difference + np.float32((i * i + j * j) / (SPATIAL * SPATIAL)))
            )
            weights[k] = weight
            values[k] = value
            total += weight
            mean += weight * value
            k += 1
    mean /= total
    variance = np.float32(0)
    for k in range(SAMPLES):
        weights[k] /= total
        centered = values[k] - mean
        variance += weights[k] * centered * centered
        values[k] = weights[k] * centered
    return variance


@numba.njit(cache=True, fastmath=True, inline="always")
def _dissimilarity(stereo, flat, s, x, y, q, a, b, weights, values, variance):
    """1 - NCC of a reference patch and its image in source s; WORST where it lies outside. x, y: the pixel's
    center; flat: all sources, one after another
    """
    A, B, width, height = stereo.A, stereo.B, stereo.sizes[s, 0], stereo.sizes[s, 1]
    stride = np.int32(stereo.sources.shape[2])
    start = np.int32(s * stereo.sources.shape[1] * stereo.sources.shape[2])
    w = A[s, 2, 0] * x + A[s, 2, 1] * y + A[s, 2, 2] + B[s, 2] * q
    if w <= np.float32(1e-6):
        return np.float32(WORST)
    inverse = np.float32(1) / w
    u = (A[s, 0, 0] * x + A[s, 0, 1] * y + A[s, 0, 2] + B[s, 0] * q) * inverse
    v = (A[s, 1, 0] * x + A[s, 1, 1] * y + A[s, 1, 2] + B[s, 1] * q) * inverse
    u_x = (A[s, 0, 0] + B[s, 0] * a - u * (A[s, 2, 0] + B[s, 2] * a)) * inverse
    u_y = (A[s, 0, 1] + B[s, 0] * b - u * (A[s, 2, 1] + B[s, 2] * b)) * inverse
    v_x = (A[s, 1, 0] + B[s, 1] * a - v * (A[s, 2, 0] + B[s, 2] * a)) * inverse
    v_y = (A[s, 1, 1] + B[s, 1] * b - v * (A[s, 2, 1] + B[s, 2] * b)) * inverse
    u -= np.float32(0.5)
    v -= np.float32(0.5)
    reach_u = np.float32(RADIUS) * (abs(u_x) + abs(u_y))
    reach_v = np.float32(RADIUS) * (abs(v_x) + abs(v_y))
    if not (
        u - reach_u >= 0
        and v - reach_v >= 0
        and u + reach_u < width - 1
        and v + reach_v < height - 1
        and reach_u < 4 * RADIUS
        and reach_v < 4 * RADIUS
    ):
        return np.float32(WORST)
    first, second, product = np.float32(0), np.float32(0), np.float32(0)
    one, below = np.uintp(1), np.uintp(stride)
    for k in range(LANES):
        su, sv = u + u_x * COLUMNS[k] + u_y * ROWS[k], v + v_x * COLUMNS[k] + v_y * ROWS[k]
        cu, cv = np.int32(su), np.int32(sv)
        fu, fv = su - np.float32(cu), sv - np.float32(cv)
        corner = np.uintp(np.uint32(start + cv * stride + cu))
        upper = flat[corner] + fu * (flat[corner + one] - flat[corner])
        lower = flat[corner + below] + fu * (flat[corner + below + one] - flat[corner + below])
        sample = upper + fv * (lower - upper)
        weighted = weights[k] * sample
        first += weighted
        second += weighted * sample
        product += values[k] * sample
    other = max(second - first * first, np.float32(0))
    noise = np.float32(NOISE)
    return np.float32(1) - product / np.sqrt((variance + noise) * (other + noise))


@numba.njit(cache=True, fastmath=True, inline="always")
def _contradiction(stereo, s, x, y, q):
    """Cost of a depth that the own map of source s contradicts: by how far the pixel lands from itself, there
    and back.
    """
    worst = np.float32(AGREEMENT * CONTRADICTION)
    u, v, w = moved(stereo.A, stereo.B, s, x, y, q)
    if not (u >= 0 and v >= 0 and u < stereo.sizes[s, 0] and v < stereo.sizes[s, 1]):
        return worst
    found = continued(stereo.others, s, u, v)
    if found <= 0:
        return worst
    u, v, w = moved(stereo.back_A, stereo.back_B, s, u, v, found)
    if w <= np.float32(1e-6):
        return worst
    gap = np.sqrt((u - x) * (u - x) + (v - y) * (v - y))
    return np.float32(AGREEMENT) * min(gap, np.float32(CONTRADICTION))


@numba.njit(cache=True, fastmath=True)
def _cost(stereo, flat, row, column, q, a, b, weights, values, variance):
    """Mean cost of the BEST sources for one plane; where one source only sees it, its cost and LONELY."""
    best, next_best = np.float32(WORST), np.float32(WORST)
    x, y = np.float32(column + 0.5), np.float32(row + 0.5)
    for s in range(len(stereo.sizes)):
        cost = np.float32(0)
        if stereo.others.shape[1]:
            cost = _contradiction(stereo, s, x, y, q)
        if cost < next_best:
            cost += _dissimilarity(stereo, flat, s, x, y, q, a, b, weights, values, variance)
        if cost < best:
            next_best = best
            best = cost
        elif cost < next_best:
            next_best = cost
    if next_best >= np.float32(WORST):
        return best if len(stereo.sizes) == 1 else best + np.float32(LONELY)
    return np.float32(0.5) * (best + next_best)


@numba.njit(cache=True, parallel=True, fastmath=True)
def evaluate(stereo, planes, costs):
    """Costs of given planes: (H, W, 3 or more) q, a, b to (H, W)."""
    height, width = stereo.gray.shape
    flat = stereo.sources.ravel()
    for row in numba.prange(height):
        weights, values = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
        for column in range(width):
            variance = _patch(stereo.gray, row, column, weights, values)
            q, a, b = planes[row, column, 0], planes[row, column, 1], planes[row, column, 2]
            costs[row, column] = _cost(stereo, flat, row, column, q, a, b, weights, values, variance)


@numba.njit(cache=True, fastmath=True, inline="always")
def _surest(costs, row, column, arm, reach):
    """Row and column of the pixel of least cost along one of four arms, at odd distances: those are of the
    other color; -1 outside of the map.
    """
    height, width = costs.shape
    chosen_row, chosen_column, surest = -1, -1, np.float32(1e9)
    for distance in range(1, reach + 1, 2):
        r = row + (distance if arm == 0 else -distance if arm == 1 else 0)
        c = column + (distance if arm == 2 else -distance if arm == 3 else 0)
        if 0 <= r < height and 0 <= c < width and costs[r, c] < surest:
            chosen_row, chosen_column, surest = r, c, costs[r, c]
    return chosen_row, chosen_column


@numba.njit(cache=True, parallel=True, fastmath=True)
def sweep(stereo, planes, costs, color, round_number, spread, tilt, num_trials, reach):
    """One half of an iteration: pixels of one color of a checkerboard try the planes of pixels of the other,
    then random changes of their own.

    planes: (H, W, 3) float32 q, a, b, changed in place; costs: (H, W) float32
    color: 0 or 1; round_number: seeds the random numbers
    spread: largest change of q, share of the span; tilt: largest change of a and b, share of q
    num_trials: random changes tried per pixel; reach: how far the planes come from, px
    """
    height, width = stereo.gray.shape
    flat = stereo.sources.ravel()
    for row in numba.prange(height):
        weights, values = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
        for column in range((row + color) % 2, width, 2):
            variance = _patch(stereo.gray, row, column, weights, values)
            q, a, b = planes[row, column, 0], planes[row, column, 1], planes[row, column, 2]
            best = costs[row, column]
            state = np.uint32(row * 9781 + column * 6271 + round_number * 26699 + 1)
            amplitude = np.float32(spread)
            for trial in range(4 + num_trials):
                if trial < 4:
                    r, c = _surest(costs, row, column, trial, reach)
                    if r < 0:
                        continue
                    ta, tb = planes[r, c, 1], planes[r, c, 2]
                    tq = planes[r, c, 0] + ta * np.float32(column - c) + tb * np.float32(row - r)
                    if abs(tq - q) < 1e-5 * q and ta == a and tb == b:
                        continue
                else:
                    state = _hash(state)
                    tq = q + (_uniform(state) * 2 - 1) * amplitude * np.float32(stereo.span)
                    slope = np.float32(tilt) * amplitude / np.float32(spread) * q
                    state = _hash(state)
                    ta = a + (_uniform(state) * 2 - 1) * slope
                    state = _hash(state)
                    tb = b + (_uniform(state) * 2 - 1) * slope
                    amplitude *= np.float32(0.35)
                if tq < stereo.farthest or tq > stereo.nearest:
                    continue
                cost = _cost(stereo, flat, row, column, tq, ta, tb, weights, values, variance)
                if cost < best:
                    best, q, a, b = cost, tq, ta, tb
            planes[row, column, 0], planes[row, column, 1], planes[row, column, 2] = q, a, b
            costs[row, column] = best
