"""Numba kernels: the depth at which half of a pixel's light is gone, and its gradient.

The ray of a pixel meets the plane of fragment i at depth z_i, where it loses the weight w_i (that of
`rasterization`, in the order of the means). The transmittance along the ray, 1 - sum of w_i over z_i < z, is
averaged over one pixel's footprint z_i / f, f = focal length in px, which makes it continuous; the median
depth z is where it is 1/2:
    F(z) = sum w_i c_i = 1/2,   c_i = f (z s_i - 1) + 1/2 cut to [0, 1],   s_i = 1 / z_i = -(n_i . r) / d_i
s_i is linear in the pixel; a plane that the ray does not meet before the camera is at infinity, s_i <= 0.
The gradient is that of the implicit function: dz = -dF / F'(z).

Taken without that average, at the fragment that brings the product of 1 - alpha to 1/2, depth follows one
plane in one pixel and another in the next; interpolated between that fragment and the one before it, a faint
floater would draw the surface behind it into the air.

F is monotone: each walk over a tile's fragments evaluates it at 8 depths between those that still enclose
the solution.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from sc3d.splatting.cpu.projection import LOG2E_HALF, NEAR, RECORD
from sc3d.splatting.cpu.rasterization import (
    CHECK,
    PLANE,
    STRIDE,
    alpha_of,
    finished,
    log2_alpha,
    may_pass,
    measure_rows,
    open_tile,
)
from sc3d.splatting.cpu.rasterization_backward import alpha_gradient
from sc3d.splatting.cpu.simd import (
    LANES,
    absolute,
    fma,
    load,
    maximum,
    minimum,
    ramp,
    splat,
    store,
    sums,
    where_at_least,
)
from sc3d.splatting.cpu.tile_binning import TILE, tile_frame

MIN_SLOPE = 0.01  # sum of the weights within the footprint; below it the depth jumps and has no gradient
_PROBES = 8
_FIRST = (120.0, 20.0, 3.0, 0.5)  # footprints between the first probes and the blended depth
_WALKS = 8  # mostly 3 are enough
_ACCURACY = 0.1  # footprints between the depths that enclose the solution, which is interpolated in between
_SCALE = np.float32(LOG2E_HALF)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@numba.njit(cache=True, error_model="numpy")
def _focal(camera):
    return math.sqrt(camera[12] * camera[13])


@numba.njit(cache=True, error_model="numpy")
def _inverse_depth(records, base, camera, frame):
    """s = start + across * column + down * row of a record's plane, in the pixels of a tile."""
    nx, ny, nz = records[base + 11], records[base + 12], records[base + 13]
    inverse = -1.0 / max(np.float64(records[base + 14]), 1e-30)
    across, down = nx * inverse / camera[12], ny * inverse / camera[13]
    left, top = frame[0] + 0.5 - camera[14], frame[1] + 0.5 - camera[15]
    return nz * inverse + across * left + down * top, across, down


@numba.njit(cache=True, error_model="numpy")
def _passed(inverse_depth, focal_depth, offset):
    """c of 8 pixels; focal_depth: f z; offset: 1/2 - f."""
    return minimum(maximum(fma(inverse_depth, focal_depth, offset), splat(_ZERO)), splat(_ONE))


@numba.njit(cache=True, error_model="numpy")
def _probe_tile(tiles, tile, frame, camera, pixels):
    """Evaluates F. pixels: planes transmittance, F at each of the probes (0 on entry), f z of each."""
    records, lane, first = tiles.records, ramp(), tiles.starts[tile]
    offset = splat(np.float32(0.5 - _focal(camera)))
    lines, ends = np.empty(3 * TILE, np.float32), np.empty(2 * TILE, np.int32)
    for entry in range(first, tiles.starts[tile + 1]):
        if (entry - first) % CHECK == CHECK - 1 and finished(pixels):
            return
        base = np.int64(tiles.ranks[entry]) * RECORD
        first_row, last_row = measure_rows(records, base, frame, lines, ends)
        minus_decay = splat(-records[base + 3])
        start, across, down = _inverse_depth(records, base, camera, frame)
        slope = splat(np.float32(across))
        for row in range(first_row, last_row + 1):
            center, peak = lines[TILE + row], splat(lines[2 * TILE + row])
            edge = splat(np.float32(start + down * row))
            column, end = np.int64(ends[row]), np.int64(ends[TILE + row])
            while column < end:
                place = row * STRIDE + column
                across_tile = lane + splat(np.float32(column))
                u = lane + splat(np.float32(column) - center)
                column += LANES
                transmittance = load(pixels, place)
                if not may_pass(transmittance):
                    continue
                w = alpha_of(log2_alpha(minus_decay, u, peak), transmittance) * transmittance
                store(pixels, place, transmittance - w)
                inverse_depth = fma(slope, across_tile, edge)
                for k in range(1, _PROBES + 1):
                    c = _passed(inverse_depth, load(pixels, place + (_PROBES + k) * PLANE), offset)
                    store(pixels, place + k * PLANE, fma(w, c, load(pixels, place + k * PLANE)))


@numba.njit(cache=True, error_model="numpy")
def _spread(bracket, probes):
    """Fills probes (8,) evenly between the ends of a bracket."""
    for k in range(_PROBES):
        probes[k] = bracket[0] + (k + 1) / (_PROBES + 1) * (bracket[1] - bracket[0])


@numba.njit(cache=True, error_model="numpy")
def _first_probes(x, y, camera, image, bracket, probes):
    """Fills bracket (`_narrow`) and probes (8,), inverse depths from near to far around the blended one, if
    there is one.
    """
    bracket[:], bracket[0] = 0.0, 1.0 / NEAR
    across, down = (x + 0.5 - camera[14]) / camera[12], (y + 0.5 - camera[15]) / camera[13]
    facing = -(image[3, y, x] * across + image[4, y, x] * down + image[5, y, x])
    if not facing > 1e-6 or not image[6, y, x] > 0.0:
        _spread(bracket, probes)
        return
    middle, count = facing / image[6, y, x], len(_FIRST)
    for k in range(count):
        factor = 1.0 + _FIRST[k] / _focal(camera)
        probes[k], probes[2 * count - 1 - k] = middle * factor, middle / factor


@numba.njit(cache=True, error_model="numpy")
def _narrow(place, pixels, probes, bracket):
    """Moves the bracket (near and far inverse depth; F there) to the two probes (8,) around F = 1/2."""
    for k in range(_PROBES):
        value = pixels[place + (k + 1) * PLANE]
        if value < 0.5:
            bracket[0], bracket[2] = probes[k], value
        else:
            bracket[1], bracket[3] = probes[k], value
            break
    _spread(bracket, probes)


@numba.njit(cache=True, error_model="numpy")
def _solution(bracket):
    """Depth between the ends of a bracket, 0 where F never reaches 1/2."""
    near, far, low, high = bracket[0], bracket[1], bracket[2], bracket[3]
    if far <= 0.0:
        return 0.0
    return 1.0 / (near + (0.5 - low) / (high - low) * (far - near))


@numba.njit(cache=True, error_model="numpy")
def _solve_tile(tiles, tile, frame, camera, image, depth):
    """Median depth of one tile."""
    left, top, rows, columns = frame
    focal, pixels = _focal(camera), np.empty((1 + 2 * _PROBES) * PLANE, np.float32)
    active, probes = np.empty((rows, columns), np.bool_), np.empty((rows, columns, _PROBES))
    brackets = np.empty((rows, columns, 4))
    for row in range(rows):
        for column in range(columns):
            x, y = left + column, top + row
            active[row, column] = image[7, y, x] >= 0.5
            _first_probes(x, y, camera, image, brackets[row, column], probes[row, column])
    for walk in range(_WALKS):
        if not active.any():
            return
        open_tile(pixels, rows, columns)
        for row in range(rows):
            for column in range(columns):
                place = row * STRIDE + column
                pixels[place] = _ONE if active[row, column] else _ZERO
                for k in range(_PROBES):
                    pixels[place + (_PROBES + k + 1) * PLANE] = focal / probes[row, column, k]
        _probe_tile(tiles, tile, frame, camera, pixels)
        for row in range(rows):
            for column in range(columns):
                if active[row, column]:
                    bracket = brackets[row, column]
                    _narrow(row * STRIDE + column, pixels, probes[row, column], bracket)
                    narrow = (bracket[0] - bracket[1]) * focal <= _ACCURACY * bracket[0]
                    if narrow or walk == _WALKS - 1:
                        depth[top + row, left + column] = _solution(bracket)
                        active[row, column] = False


@numba.njit(cache=True, error_model="numpy", parallel=True)
def solve(tiles, camera, image, depth):
    """Fills the median depth (H, W), zero on entry; 0 where T never falls to 1/2.

    tiles: `TileLists`; camera: `projection.camera_array`; image: (8, H, W) of `rasterization.rasterize`, with
        geometry
    """
    height, width = depth.shape
    for item in numba.prange(tiles.order.shape[0]):
        tile = tiles.order[item]
        if tiles.starts[tile] < tiles.starts[tile + 1]:
            _solve_tile(tiles, tile, tile_frame(tile, width, height), camera, image, depth)


@numba.njit(cache=True, error_model="numpy")
def _slope_tile(tiles, tile, frame, camera, pixels):
    """Adds up F and sum w s over the fragments within the footprint. pixels: planes transmittance, F, that
    sum, sum w, f z.
    """
    records, lane, first = tiles.records, ramp(), tiles.starts[tile]
    zero, one, offset = splat(_ZERO), splat(_ONE), splat(np.float32(0.5 - _focal(camera)))
    lines, ends = np.empty(3 * TILE, np.float32), np.empty(2 * TILE, np.int32)
    for entry in range(first, tiles.starts[tile + 1]):
        if (entry - first) % CHECK == CHECK - 1 and finished(pixels):
            return
        base = np.int64(tiles.ranks[entry]) * RECORD
        first_row, last_row = measure_rows(records, base, frame, lines, ends)
        minus_decay = splat(-records[base + 3])
        start, across, down = _inverse_depth(records, base, camera, frame)
        slope = splat(np.float32(across))
        for row in range(first_row, last_row + 1):
            center, peak = lines[TILE + row], splat(lines[2 * TILE + row])
            edge = splat(np.float32(start + down * row))
            column, end = np.int64(ends[row]), np.int64(ends[TILE + row])
            while column < end:
                place = row * STRIDE + column
                inverse_depth = fma(slope, lane + splat(np.float32(column)), edge)
                u = lane + splat(np.float32(column) - center)
                column += LANES
                transmittance = load(pixels, place)
                if not may_pass(transmittance):
                    continue
                w = alpha_of(log2_alpha(minus_decay, u, peak), transmittance) * transmittance
                store(pixels, place, transmittance - w)
                c = fma(inverse_depth, load(pixels, place + 4 * PLANE), offset)
                inside = where_at_least(c, zero, where_at_least(one, c, w))
                passed = minimum(maximum(c, zero), one)
                store(pixels, place + PLANE, fma(w, passed, load(pixels, place + PLANE)))
                store(pixels, place + 2 * PLANE, fma(inside, inverse_depth, load(pixels, place + 2 * PLANE)))
                store(pixels, place + 3 * PLANE, load(pixels, place + 3 * PLANE) + inside)


@numba.njit(cache=True, error_model="numpy")
def _add_plane_gradient(records, base, camera, frame, moments, gradients, place):
    """Adds the gradient of normal and plane distance. moments: sums of q = d loss / d s, q column, q row."""
    inverse = 1.0 / max(np.float64(records[base + 14]), 1e-30)
    total = -np.float64(moments[0]) * inverse
    across = (total * (frame[0] + 0.5 - camera[14]) - moments[1] * inverse) / camera[12]
    down = (total * (frame[1] + 0.5 - camera[15]) - moments[2] * inverse) / camera[13]
    gradients[place + 11] += np.float32(across)
    gradients[place + 12] += np.float32(down)
    gradients[place + 13] += np.float32(total)
    along = records[base + 11] * across + records[base + 12] * down + records[base + 13] * total
    gradients[place + 14] -= np.float32(along * inverse)


@numba.njit(cache=True, error_model="numpy")
def _backward_tile(tiles, tile, frame, camera, pixels, gradients):
    """Adds the pixel sums of each instance (`projection_backward.SUMS`).

    pixels: planes transmittance; rest = g F of the fragments still to come; g = d loss / d F; f z
    d loss / d ln(alpha) as in `rasterization_backward`, of a channel that shows c; d loss / d s_i = g w f z
    """
    records, lane, first = tiles.records, ramp(), tiles.starts[tile]
    zero, one, offset = splat(_ZERO), splat(_ONE), splat(np.float32(0.5 - _focal(camera)))
    lines, ends = np.empty(3 * TILE, np.float32), np.empty(2 * TILE, np.int32)
    for entry in range(first, tiles.starts[tile + 1]):
        if (entry - first) % CHECK == CHECK - 1 and finished(pixels):
            return
        base = np.int64(tiles.ranks[entry]) * RECORD
        first_row, last_row = measure_rows(records, base, frame, lines, ends)
        minus_decay = splat(-records[base + 3])
        start, across, down = _inverse_depth(records, base, camera, frame)
        slope = splat(np.float32(across))
        s_sum = su_sum = suu_sum = sy_sum = suy_sum = syy_sum = x_sum = y_sum = zero
        q_sum = qx_sum = qy_sum = zero
        to_x, to_y = records[base + 3] / _SCALE, records[base + 4] / _SCALE  # a, h of `projection`
        tilt = splat(-to_x * records[base + 2])
        for row in range(first_row, last_row + 1):
            center, peak, s_row, su_row = lines[TILE + row], splat(lines[2 * TILE + row]), zero, zero
            edge, q_row = splat(np.float32(start + down * row)), zero
            column, end = np.int64(ends[row]), np.int64(ends[TILE + row])
            height, lift = splat(lines[row]), splat(to_y * lines[row])
            while column < end:
                place = row * STRIDE + column
                across_tile = lane + splat(np.float32(column))
                u = lane + splat(np.float32(column) - center)
                column += LANES
                transmittance = load(pixels, place)
                if not may_pass(transmittance):
                    continue
                exponent = log2_alpha(minus_decay, u, peak)
                alpha = alpha_of(exponent, transmittance)
                w, focal_depth = alpha * transmittance, load(pixels, place + 3 * PLANE)
                store(pixels, place, transmittance - w)
                c = fma(fma(slope, across_tile, edge), focal_depth, offset)
                g = load(pixels, place + 2 * PLANE) * w
                q = where_at_least(c, zero, where_at_least(one, c, g * focal_depth))
                q_row, qx_sum = q_row + q, fma(q, across_tile, qx_sum)
                s = alpha_gradient(pixels, place, g * minimum(maximum(c, zero), one), alpha, exponent)
                su = s * u
                s_row, su_row, suu_sum = s_row + s, su_row + su, fma(su, u, suu_sum)
                x_sum = x_sum + absolute(su)
                y_sum = y_sum + absolute(fma(tilt, su, lift * s))
            s_sum, su_sum, syy_sum = s_sum + s_row, su_sum + su_row, fma(height * height, s_row, syy_sum)
            sy_sum, suy_sum = fma(height, s_row, sy_sum), fma(height, su_row, suy_sum)
            q_sum, qy_sum = q_sum + q_row, fma(splat(np.float32(row)), q_row, qy_sum)
        place, x_sum = np.int64(tiles.instances[entry]) * RECORD, x_sum * splat(to_x)
        moments = sums(s_sum, su_sum, suu_sum, sy_sum, suy_sum, syy_sum, x_sum, y_sum)
        store(gradients, place, load(gradients, place) + moments)
        store(lines, 0, sums(q_sum, qx_sum, qy_sum, zero, zero, zero, zero, zero))
        _add_plane_gradient(records, base, camera, frame, lines, gradients, place)


@numba.njit(cache=True, error_model="numpy")
def _load_depth(pixels, plane, frame, camera, depth):
    """Fills the transmittance, 0 where there is no depth, and f z, in the given plane; clears the others."""
    left, top, rows, columns = frame
    pixels[:] = _ZERO
    for row in range(rows):
        for column in range(columns):
            place, z = row * STRIDE + column, depth[top + row, left + column]
            pixels[place] = _ONE if z > 0.0 else _ZERO
            pixels[place + plane * PLANE] = _focal(camera) * z


@numba.njit(cache=True, error_model="numpy", parallel=True)
def backward(tiles, camera, depth, depth_gradient, gradients):
    """Reverse of `solve`: adds to gradients (P * 16,), also to their absolute sums.

    depth, depth_gradient: (H, W)
    """
    height, width = depth.shape
    for item in numba.prange(tiles.order.shape[0]):
        tile = tiles.order[item]
        if tiles.starts[tile] < tiles.starts[tile + 1]:
            frame = tile_frame(tile, width, height)
            slopes, pixels = np.empty(5 * PLANE, np.float32), np.empty(4 * PLANE, np.float32)
            _load_depth(slopes, 4, frame, camera, depth)
            _slope_tile(tiles, tile, frame, camera, slopes)
            _load_depth(pixels, 3, frame, camera, depth)
            for row in range(frame[2]):
                for column in range(frame[3]):
                    place = row * STRIDE + column
                    slope = _focal(camera) * slopes[place + 2 * PLANE]  # F'(z)
                    if slopes[place + 3 * PLANE] >= MIN_SLOPE and slope > 0.0:
                        g = -depth_gradient[frame[1] + row, frame[0] + column] / slope
                        pixels[place + 2 * PLANE] = g
                        pixels[place + PLANE] = g * slopes[place + PLANE]
            _backward_tile(tiles, tile, frame, camera, pixels, gradients)
