"""Photometric least squares for every pixel (paper, Eq. 5 without weights).

Least squares over all frames is linear in the intensities: g = M(x) v with M = pinv(S(x)), 3 x T.
S is smooth, so M is computed at the grid nodes only and the kernel interpolates M instead of
solving a 3 x 3 system per pixel; scale, flat field and (as one more frame) the ambient picture
are folded into M. `solve_reference` is the same mathematics in plain NumPy.
"""
from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray

from ps_head_driver.errors import ErrorCode, PsError
from ps_reconstruction.bands import for_bands
from ps_reconstruction.problem import (
    FEW_LIGHTS,
    GREY_WEIGHTS,
    MASKED,
    SATURATED,
    SHADOW,
    Problem,
    Solution,
    expand,
    intensities,
)

BAND = 8                      # rows per band: its accumulators stay in the second-level cache
WIDE_BAND = 64                # where there are none
GROUP = 4                     # frames per pass over the accumulators
MAX_CONDITION = 1e3           # of the light matrix at any node; a usable ring has 1 to 10
RESIDUAL_HALF = 0.05          # relative residual that halves the confidence
DARK = 0.1                    # of albedo x |s|: below it a frame counts as shadowed
FAST = {'contract', 'reassoc', 'arcp', 'nsz', 'afn'}    # without nnan: NaN marks invalid pixels


def solve(problem: Problem, quality: bool = True, out: Solution | None = None) -> Solution:
    """Normals and albedo by least squares.

    :param quality: also compute confidence, reason and residual_rms (a second pass).
    :param out: arrays to fill instead of new ones; must fit the problem.
    :raises PsError: RECONSTRUCTION_TOO_FEW_LIGHTS or RECONSTRUCTION_DEGENERATE_LIGHTS.
    """
    height, width = problem.shape
    channels = 3 if problem.colour else 1
    result = out if out is not None else empty_solution(problem, quality)
    albedo = result.albedo.reshape(height, width, channels)
    weights = np.array(GREY_WEIGHTS if problem.colour else (1.0,), np.float32)
    inverse = pseudo_inverse(problem.lights)
    if problem.reciprocal_flat is not None:
        inverse = inverse * problem.reciprocal_flat[..., None, :]
    raw = not problem.colour and not np.isfinite(problem.clip)
    if raw:
        inverse = inverse * problem.scale[:, 0]
        if problem.ambient is not None:
            inverse = np.concatenate([inverse, -inverse.sum(axis=-1, keepdims=True)], axis=-1)
    groups = _grouped(inverse)
    forward = _forward(problem, raw)
    # up to four frames: normals come out of the registers, nothing is accumulated in memory
    fused = raw and len(groups) == 1
    band = BAND if quality or not fused else WIDE_BAND

    def work(first: int, last: int) -> tuple[float, float, int]:
        rows = slice(first, last)
        frames = [frame[rows] for frame in problem.frames]
        ambient = None if problem.ambient is None else problem.ambient[rows]
        if raw:
            planes = [frames if ambient is None else [*frames, ambient]]
        else:
            planes = _normalised(problem, frames, ambient)
        scaled_normal = np.zeros(
            (channels, 3, last - first, width) if quality or not fused else (1, 3, 0, 0),
            np.float32)
        for c in range(channels):
            for i, group in enumerate(groups):
                # the last group is filled up with a frame that counts nothing
                f0, f1, f2, f3 = (
                    planes[c][min(GROUP * i + k, len(planes[c]) - 1)] for k in range(GROUP))
                if fused:
                    _solve_rows(f0, f1, f2, f3, group, problem.step, first,
                                result.normal[rows], result.albedo[rows], scaled_normal[0])
                else:
                    _accumulate(f0, f1, f2, f3, group, problem.step, first, scaled_normal[c])
        if not fused:
            _finish(scaled_normal, weights, result.normal[rows], albedo[rows])
        mask = None if problem.mask is None else problem.mask[rows]
        if mask is not None:
            result.normal[rows][~mask] = np.nan
            albedo[rows][~mask] = np.nan
        if not quality:
            return 0.0, 0.0, 0
        grey = _weighted(weights, scaled_normal)
        tally = np.zeros((4, last - first, width), np.float32)
        no_light = np.zeros_like(planes[0][0])
        for t, frame in enumerate(frames):
            if raw:
                value, dark = frame, no_light if ambient is None else ambient
            else:
                value = _weighted(weights, [plane[t] for plane in planes])
                dark = no_light
            level = frame
            if problem.colour:
                level = np.maximum(np.maximum(frame[..., 0], frame[..., 1]), frame[..., 2])
            _compare(value, dark, level, forward[t], problem.step, first,
                     np.float32(problem.saturation), grey, tally)
        assert result.confidence is not None
        assert result.reason is not None
        squares, brightness, count = _judge(
            result.normal[rows], tally, problem.count, result.confidence[rows],
            result.reason[rows])
        if mask is not None:
            result.reason[rows][~mask] = MASKED
        return squares, brightness, count

    squares, brightness, count = np.sum(for_bands(height, band, work), axis=0)
    if quality and problem.count > 3 and count and brightness > 0:
        result.residual_rms = float(np.sqrt(squares / count) / (brightness / count))
    return result


def solve_reference(problem: Problem) -> Solution:
    """The same by plain NumPy: light vectors and normal equations of every pixel, float64."""
    check_lights(problem.lights)
    value = intensities(problem)                                                 # (H, W, T)
    lights = expand(problem.lights, problem.step, problem.shape)                 # (H, W, T, 3)
    normal_matrix: NDArray = np.einsum('hwti,hwtj->hwij', lights, lights)
    right_side: NDArray = np.einsum('hwti,hwt->hwi', lights, value)
    g = np.linalg.solve(normal_matrix, right_side[..., None])[..., 0]
    albedo: NDArray = np.linalg.norm(g, axis=-1)
    valid = (albedo > 0) & (g[..., 2] > 0)
    if problem.mask is not None:
        valid &= problem.mask
    with np.errstate(divide='ignore', invalid='ignore'):
        normal = np.where(valid[..., None], g / albedo[..., None], np.nan)
    return Solution(
        normal.astype(np.float32), np.where(valid, albedo, np.nan).astype(np.float32))


def empty_solution(problem: Problem, quality: bool = True) -> Solution:
    """Arrays of the right shapes, not initialised."""
    height, width = problem.shape
    colour = (3,) if problem.colour else ()
    return Solution(
        np.empty((height, width, 3), np.float32), np.empty((height, width, *colour), np.float32),
        np.empty((height, width), np.uint8) if quality else None,
        np.empty((height, width), np.uint8) if quality else None)


def check_lights(lights: NDArray) -> None:
    """Refuse lights that do not determine a normal.

    :param lights: (..., T, 3).
    :raises PsError: RECONSTRUCTION_TOO_FEW_LIGHTS or RECONSTRUCTION_DEGENERATE_LIGHTS.
    """
    count = lights.shape[-2]
    if count < 3:
        raise PsError(ErrorCode.RECONSTRUCTION_TOO_FEW_LIGHTS,
                      f'{count} frames lit by a single panel; photometric stereo needs at least 3')
    if not np.all(np.isfinite(lights)):
        raise PsError(ErrorCode.RECONSTRUCTION_BAD_STACK, 'lights: light vectors are not finite')
    with np.errstate(over='ignore', invalid='ignore'):
        gram = np.swapaxes(lights, -1, -2) @ lights
    if not np.all(np.isfinite(gram)):           # as of an intensity of 1e200
        raise PsError(ErrorCode.RECONSTRUCTION_BAD_STACK, 'lights: light vectors are too long')
    square = np.linalg.eigvalsh(gram)
    condition = float(np.sqrt(np.max(
        square[..., 2] / np.maximum(square[..., 0], 1e-14 * square[..., 2] + 1e-300))))
    if not np.all(square[..., 2] > 1e-100):     # as of a light that is infinitely far away
        condition = float('inf')
    if condition > MAX_CONDITION:
        raise PsError(ErrorCode.RECONSTRUCTION_DEGENERATE_LIGHTS,
                      'the light directions lie (nearly) in one plane: condition number '
                      f'{condition:.3g}, at most {MAX_CONDITION:.0f} is usable')


def pseudo_inverse(lights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pseudo-inverse of the light matrix at every node, (gh, gw, T, 3) to (gh, gw, 3, T)."""
    count = lights.shape[-2]
    inverse = np.empty((*lights.shape[:-2], 3, count))
    worst = _invert(np.ascontiguousarray(lights, np.float64).reshape(-1, count, 3),
                    inverse.reshape(-1, 3, count))
    if worst > MAX_CONDITION ** 2:              # only a bound: look closer
        check_lights(lights)
    return inverse


def _grouped(inverse: NDArray) -> list[NDArray[np.float32]]:
    """(gh, gw, 3, T) as contiguous groups (gh, gw, 3, GROUP), the last one filled with zeros."""
    count = inverse.shape[-1]
    padded = np.pad(inverse, [(0, 0)] * 3 + [(0, -count % GROUP)])
    return [np.ascontiguousarray(padded[..., i:i + GROUP], np.float32)
            for i in range(0, count, GROUP)]


def _forward(problem: Problem, raw: bool) -> list[NDArray[np.float32]]:
    """Per frame (gh, gw, 4): light vector, and the factor from counts to intensity."""
    factor = np.ones(problem.lights.shape[:3])
    if problem.reciprocal_flat is not None:
        factor = factor * problem.reciprocal_flat
    if raw:
        factor = factor * problem.scale[:, 0]
    both = np.concatenate([problem.lights, factor[..., None]], axis=-1).astype(np.float32)
    return [np.ascontiguousarray(both[:, :, t]) for t in range(problem.count)]


def _weighted(weights: NDArray, planes: Sequence[NDArray] | NDArray) -> NDArray:
    """Sum of planes by weights; the plane itself where there is one."""
    total = planes[0] if len(planes) == 1 else planes[0] * weights[0]
    for weight, plane in zip(weights[1:], planes[1:], strict=True):
        total = total + plane * weight
    return total


def _normalised(problem: Problem, frames: list[NDArray], ambient: NDArray | None,
                ) -> list[list[NDArray[np.float32]]]:
    """Scaled and clipped channels of a band: C lists of T planes (h, W) float32."""
    channels = 3 if problem.colour else 1
    shape = frames[0].shape[:2]
    planes = np.empty((len(frames), channels, *shape), np.float32)
    offset = np.zeros_like(frames[0]) if ambient is None else ambient
    for frame, scale, plane in zip(frames, problem.scale, planes, strict=True):
        _scale_rows(frame.reshape(*shape, channels), offset.reshape(*shape, channels),
                    scale.astype(np.float32), np.float32(problem.clip), plane)
    return [list(planes[:, c]) for c in range(channels)]


@numba.njit(nogil=True, cache=True, error_model='numpy')
def _invert(lights, inverse):    # type: ignore[no-untyped-def]
    """Pseudo-inverses (n, 3, T) of light matrices (n, T, 3) by their normal equations.

    The condition number is bounded: float64 normal equations are good to 1e-10.

    :returns: an upper bound of the squared condition numbers; infinite if in doubt.
    """
    worst = 0.0
    for n in range(len(lights)):
        s = lights[n]
        xx = yy = zz = xy = xz = yz = 0.0
        for t in range(len(s)):
            x, y, z = s[t, 0], s[t, 1], s[t, 2]
            xx, yy, zz = xx + x * x, yy + y * y, zz + z * z
            xy, xz, yz = xy + x * y, xz + x * z, yz + y * z
        ax, ay, az = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        by, bz, cz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
        determinant = xx * ax + xy * ay + xz * az
        trace = xx + yy + zz
        # with eigenvalues a >= b >= c: c = det / (a b) and a b <= (trace / 2)^2
        bound = trace ** 3 / (4 * determinant) if trace > 1e-90 and determinant > 0 else np.inf
        worst = max(worst, bound if bound <= 1e300 else np.inf)
        for t in range(len(s)):
            x, y, z = s[t, 0] / determinant, s[t, 1] / determinant, s[t, 2] / determinant
            inverse[n, 0, t] = ax * x + ay * y + az * z
            inverse[n, 1, t] = ay * x + by * y + bz * z
            inverse[n, 2, t] = az * x + bz * y + cz * z
    return worst


@numba.njit(nogil=True, cache=True, error_model='numpy')
def _scale_rows(frame, ambient, scale, clip, out):    # type: ignore[no-untyped-def]
    """Channels of one frame (h, W, C) apart, (C, h, W): ambient off, scaled, clipped."""
    rows, width, channels = frame.shape
    for y in range(rows):
        for c in range(channels):
            for x in range(width):
                value = np.float32(frame[y, x, c]) - np.float32(ambient[y, x, c])
                out[c, y, x] = min(value * scale[c], clip)


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def _solve_rows(f0, f1, f2, f3, matrix, step, first,    # type: ignore[no-untyped-def]
                normal, albedo, total):
    """Unit normals and albedo of the rows from ``first`` from four frames in one pass.

    :param matrix: (gh, gw, 3, 4) float32 at the nodes.
    :param total: (3, h, W), gets the scaled normals; (3, 0, 0) if nobody wants them.
    """
    rows, width = f0.shape
    nan, one, q = np.float32(np.nan), np.float32(1), np.float32(1) / np.float32(step)
    m = np.empty((2, 12), np.float32)
    # planes first, interleaving after: so the arithmetic is vectorised
    planes = np.empty((3, step), np.float32)
    px, py, pz = planes[0], planes[1], planes[2]
    for y in range(rows):
        i = (first + y) // step
        fy = np.float32((first + y) - i * step) * q
        for j in range((width - 1) // step + 1):
            for side in range(2):
                for a in range(3):
                    for t in range(4):
                        top = matrix[i, j + side, a, t]
                        m[side, 4 * a + t] = top + fy * (matrix[i + 1, j + side, a, t] - top)
            x0, x1, x2, x3, y0, y1, y2, y3, z0, z1, z2, z3 = m[0]
            dx0, dx1, dx2, dx3, dy0, dy1, dy2, dy3, dz0, dz1, dz2, dz3 = (m[1] - m[0]) * q
            begin, end = j * step, min((j + 1) * step, width)
            c0, c1, c2, c3 = f0[y, begin:end], f1[y, begin:end], f2[y, begin:end], f3[y, begin:end]
            length = albedo[y, begin:end]
            for x in range(end - begin):
                k = np.float32(x)
                v0, v1 = np.float32(c0[x]), np.float32(c1[x])
                v2, v3 = np.float32(c2[x]), np.float32(c3[x])
                gx = ((x0 + k * dx0) * v0 + (x1 + k * dx1) * v1
                      + (x2 + k * dx2) * v2 + (x3 + k * dx3) * v3)
                gy = ((y0 + k * dy0) * v0 + (y1 + k * dy1) * v1
                      + (y2 + k * dy2) * v2 + (y3 + k * dy3) * v3)
                gz = ((z0 + k * dz0) * v0 + (z1 + k * dz1) * v1
                      + (z2 + k * dz2) * v2 + (z3 + k * dz3) * v3)
                g = np.sqrt(gx * gx + gy * gy + gz * gz)
                g = g if gz > 0 else nan
                inverse = one / g
                px[x], py[x], pz[x] = gx * inverse, gy * inverse, gz * inverse
                length[x] = g
            row = normal[y, begin:end]
            for x in range(end - begin):
                row[x, 0], row[x, 1], row[x, 2] = px[x], py[x], pz[x]
            if total.shape[1] > 0:
                tx, ty, tz = total[0, y, begin:end], total[1, y, begin:end], total[2, y, begin:end]
                for x in range(end - begin):
                    tx[x], ty[x], tz[x] = px[x] * length[x], py[x] * length[x], pz[x] * length[x]


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def _accumulate(f0, f1, f2, f3, matrix, step, first, total):    # type: ignore[no-untyped-def]
    """Add M v of four frames to the scaled normals ``total`` (3, h, W) of the rows from ``first``.

    :param matrix: (gh, gw, 3, 4) float32 at the nodes.
    """
    rows, width = f0.shape
    m = np.empty((2, 3, 4), np.float32)
    for y in range(rows):
        i = (first + y) // step
        fy = np.float32((first + y) - i * step) / np.float32(step)
        for j in range((width - 1) // step + 1):
            for side in range(2):
                for a in range(3):
                    for t in range(4):
                        top = matrix[i, j + side, a, t]
                        m[side, a, t] = top + fy * (matrix[i + 1, j + side, a, t] - top)
            begin = j * step
            end = min(begin + step, width)
            c0, c1, c2, c3 = f0[y, begin:end], f1[y, begin:end], f2[y, begin:end], f3[y, begin:end]
            for a in range(3):
                target = total[a, y, begin:end]
                m0, m1, m2, m3 = m[0, a, 0], m[0, a, 1], m[0, a, 2], m[0, a, 3]
                d0 = (m[1, a, 0] - m0) / np.float32(step)
                d1 = (m[1, a, 1] - m1) / np.float32(step)
                d2 = (m[1, a, 2] - m2) / np.float32(step)
                d3 = (m[1, a, 3] - m3) / np.float32(step)
                for x in range(end - begin):
                    k = np.float32(x)
                    target[x] += ((m0 + k * d0) * np.float32(c0[x])
                                  + (m1 + k * d1) * np.float32(c1[x])
                                  + (m2 + k * d2) * np.float32(c2[x])
                                  + (m3 + k * d3) * np.float32(c3[x]))


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def _finish(total, weights, normal, albedo):    # type: ignore[no-untyped-def]
    """Unit normals and albedo of a band from its scaled normals (C, 3, h, W).

    Albedo of a channel: its scaled normal projected on the common normal.
    """
    channels, _, rows, width = total.shape
    nan = np.float32(np.nan)
    one = np.float32(1)
    for y in range(rows):
        if channels == 1:
            gx, gy, gz = total[0, 0, y], total[0, 1, y], total[0, 2, y]
            row, reflectance = normal[y], albedo[y]
            for x in range(width):
                length = np.sqrt(gx[x] * gx[x] + gy[x] * gy[x] + gz[x] * gz[x])
                inverse = one / length if gz[x] > 0 else nan
                row[x, 0] = gx[x] * inverse
                row[x, 1] = gy[x] * inverse
                row[x, 2] = gz[x] * inverse
                reflectance[x, 0] = length if gz[x] > 0 else nan
        else:
            for x in range(width):
                sx, sy, sz = np.float32(0), np.float32(0), np.float32(0)
                for c in range(channels):
                    sx += weights[c] * total[c, 0, y, x]
                    sy += weights[c] * total[c, 1, y, x]
                    sz += weights[c] * total[c, 2, y, x]
                length = np.sqrt(sx * sx + sy * sy + sz * sz)
                inverse = one / length if sz > 0 else nan
                sx, sy, sz = sx * inverse, sy * inverse, sz * inverse
                normal[y, x, 0], normal[y, x, 1], normal[y, x, 2] = sx, sy, sz
                for c in range(channels):
                    albedo[y, x, c] = (sx * total[c, 0, y, x] + sy * total[c, 1, y, x]
                                       + sz * total[c, 2, y, x])


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def _compare(frame, ambient, level, forward, step, first,    # type: ignore[no-untyped-def]
             saturation, total, tally):
    """Compare one frame of a band with what its scaled normals (3, h, W) predict.

    :param level: (h, W) raw counts to hold against ``saturation``.
    :param forward: (gh, gw, 4) float32, light vector and factor at the nodes.
    :param tally: (4, h, W), adds: squared residual; intensity; 1 if dark; 1 if saturated.
    """
    rows, width = frame.shape
    node = np.empty((2, 4), np.float32)
    zero, one, dark_square = np.float32(0), np.float32(1), np.float32(DARK * DARK)
    for y in range(rows):
        i = (first + y) // step
        fy = np.float32((first + y) - i * step) / np.float32(step)
        for j in range((width - 1) // step + 1):
            for side in range(2):
                for a in range(4):
                    top = forward[i, j + side, a]
                    node[side, a] = top + fy * (forward[i + 1, j + side, a] - top)
            s0, s1, s2, s3 = node[0]
            d0 = (node[1, 0] - s0) / np.float32(step)
            d1 = (node[1, 1] - s1) / np.float32(step)
            d2 = (node[1, 2] - s2) / np.float32(step)
            d3 = (node[1, 3] - s3) / np.float32(step)
            begin, end = j * step, min((j + 1) * step, width)
            counts, offset, raw = (
                frame[y, begin:end], ambient[y, begin:end], level[y, begin:end])
            gx, gy, gz = total[0, y, begin:end], total[1, y, begin:end], total[2, y, begin:end]
            squares, sums = tally[0, y, begin:end], tally[1, y, begin:end]
            darks, saturated = tally[2, y, begin:end], tally[3, y, begin:end]
            for x in range(end - begin):
                k = np.float32(x)
                sx, sy, sz = s0 + k * d0, s1 + k * d1, s2 + k * d2
                value = (np.float32(counts[x]) - np.float32(offset[x])) * (s3 + k * d3)
                residual = value - (gx[x] * sx + gy[x] * sy + gz[x] * sz)
                limit = dark_square * ((gx[x] * gx[x] + gy[x] * gy[x] + gz[x] * gz[x])
                                       * (sx * sx + sy * sy + sz * sz))
                squares[x] += residual * residual
                sums[x] += value
                darks[x] += one if max(value, zero) * value <= limit else zero
                saturated[x] += one if np.float32(raw[x]) >= saturation else zero


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def _judge(normal, tally, count, confidence, reason):    # type: ignore[no-untyped-def]
    """Confidence and reason of a band; returns the sums behind residual_rms."""
    rows, width = confidence.shape
    total_square, total_mean, valid = 0.0, 0.0, 0
    one, few = np.float32(1), np.float32(1) / np.float32(max(count - 3, 1))
    share, sharpness = one / np.float32(count), np.float32(1 / RESIDUAL_HALF ** 2)
    redundant = np.float32(1 if count > 3 else 0)
    for y in range(rows):
        for x in range(width):
            dark, saturated = tally[2, y, x], tally[3, y, x]
            mean, variance = tally[1, y, x] * share, tally[0, y, x] * few
            usable = np.float32(count) - dark - saturated
            known = not np.isnan(normal[y, x, 2])
            relative = redundant * variance / max(mean * mean, np.float32(1e-20))
            score = max(usable, one) * share / (one + relative * sharpness)
            score *= np.float32(0.25) if usable < 3 else one
            confidence[y, x] = np.uint8(max(score * 255 + np.float32(0.5), one)) if known else 0
            flags = (SHADOW if dark > 0 else 0) | (SATURATED if saturated > 0 else 0)
            reason[y, x] = flags | (FEW_LIGHTS if usable < 3 or not known else 0)
            if known:
                total_square += variance
                total_mean += mean
                valid += 1
    return total_square, total_mean, valid
