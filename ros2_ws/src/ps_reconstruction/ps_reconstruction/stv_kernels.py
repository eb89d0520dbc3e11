"""The compiled loops of the robust regression: arrays in, arrays out, no threads, no state.

One function per kernel; a GPU version can replace `solve_pixels`, `combine_patches` and
`finish` one by one, see backend.py. All planes are float32 and pixel-last, (..., h, W).
"""
import numba
import numpy as np

from ps_reconstruction.chunks import count_true, fill, interpolate, store
from ps_reconstruction.outliers import (
    CHUNK,
    D0,
    D1,
    D2,
    EQUATION_SIZE,
    FACTOR,
    FAST,
    FRAME_SIZE,
    G0,
    G1,
    G2,
    H0,
    H1,
    H2,
    INVERSE,
    LEAST_COSINE,
    LEAST_RATIO,
    LENGTH,
    PIXEL_SIZE,
    USABLE,
    WEIGHT,
    E,
    U,
    add_equations,
    estimate,
    solve_equations,
)
from ps_reconstruction.problem import (
    FEW_LIGHTS,
    HIGHLIGHT,
    MASKED,
    MAX_PATCH,
    SATURATED,
    SHADOW,
)

BRIGHT_MARGIN = 0.1                       # of |g|: brighter than Lambert's law by this is gloss
NOISE = 0.005                             # relative error of an intensity that is always there
DISAGREEMENT = 0.115                      # expected error per difference to least squares
ERROR_HALF = 0.04                         # expected error of a unit normal that halves confidence
# Sums over the frames of a chunk: squared residuals, intensity, frames used, misfit
SQUARES, LIGHT, USED, MISFIT = 0, CHUNK, 2 * CHUNK, 3 * CHUNK
SUMS_SIZE = 4 * CHUNK
SIDE = CHUNK + MAX_PATCH - 1                # of a chunk with its neighbours


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def solve_pixels(values, saturated, mask, lights, view, flat, step, top, coefficients, margins,    # type: ignore[no-untyped-def]
                 rounds, rejecting, reflecting, reference, scaled, equations, shading, quality,
                 reason):
    """Temporal weights, own estimate and normal equations of every pixel of a band.

    :param values: (T, h, W) intensities, before the flat field.
    :param saturated: (T, h, W) bool, or of size 0 for none.
    :param mask: (h, W) bool.
    :param lights: (T, 3, gh, gw) at the nodes; view: (3, gh, gw); flat: (T, gh, gw) reciprocal
        flat field, or of size 0. ``top`` is the image row of the band's first row.
    :param margins: (2,) excess over Lambert's law, relative to |g|, that noise explains: of a
        pixel, of the mean of some side by side.
    :param reference: (3, h, W) out, least squares.
    :param scaled: (3, h, W) out, the pixel's own robust estimate; 0 where there is none.
    :param equations: (9, h, W) out, xx xy xz yy yz zz of the matrix and the right side.
    :param shading: (T, h, W) out, weights that turn intensities into albedo; or of size 0.
    :param quality: (4, h, W) out: mean squared residual, mean intensity, frames used, misfit of
        all frames relative to |g|.
    :param reason: (h, W) uint8 out.
    """
    count, rows, width = values.shape
    # the last chunk of a row leaves the end of these to numbers that nobody reads
    frames = np.empty((count, FRAME_SIZE), np.float32)
    pixels, system = np.zeros(PIXEL_SIZE, np.float32), np.empty(EQUATION_SIZE, np.float32)
    look, gain = np.empty(3 * CHUNK, np.float32), np.empty(CHUNK, np.float32)
    sums, flags = np.empty(SUMS_SIZE, np.float32), np.empty(CHUNK, np.int32)
    for y in range(rows):
        i = (top + y) // step
        fy = np.float32(top + y - i * step) / np.float32(step)
        for begin in range(0, width, CHUNK):
            end = min(begin + CHUNK, width)
            here = mask[y, begin:end]
            inside = count_true(here)
            if inside == 0:
                continue
            fill(system, np.float32(0))
            fill(sums, np.float32(0))
            fill(pixels, np.float32(0))
            for x in range(CHUNK):
                flags[x] = 0
            for m in range(3):
                interpolate(view[m], i, fy, begin, step, look[m * CHUNK:])
            for t in range(count):
                frame = frames[t]
                load(values[t, y, begin:end], here, frame)
                if saturated.size:
                    exclude(saturated[t, y, begin:end], frame, flags)
                if flat.size:
                    interpolate(flat[t], i, fy, begin, step, gain)
                    for x in range(CHUNK):
                        frame[U + x] *= gain[x]
                for m in range(3):
                    interpolate(lights[t, m], i, fy, begin, step, frame[D0 + m * CHUNK:])
                normalise(frame, look, sums)
                add_equations(frame, system)
            solve_equations(system, pixels)
            for m in range(3):
                store(pixels[m * CHUNK:], reference[m, y, begin:end])
            estimate(frames, coefficients, margins, rounds, rejecting, reflecting, system, pixels)
            fill(system, np.float32(0))
            for t in range(count):
                judge(frames[t], pixels, sums, flags)
                add_equations(frames[t], system)
            if shading.size:
                shade(frames, pixels, shading[:, y, begin:end])
            report(sums, flags, pixels, count, quality[:, y, begin:end], reason[y, begin:end])
            if inside < end - begin:
                blank(here, 3, pixels)
                blank(here, 9, system)
            for m in range(3):
                store(pixels[m * CHUNK:], scaled[m, y, begin:end])
            for m in range(9):
                store(system[m * CHUNK:], equations[m, y, begin:end])


@numba.njit(nogil=True, cache=True)
def load(values, mask, frame):    # type: ignore[no-untyped-def]
    """Intensities of a part of a row, usable within the mask."""
    n = len(values)
    for x in range(n):
        frame[U + x] = values[x]
        frame[USABLE + x] = np.float32(mask[x])
    for x in range(n, CHUNK):
        frame[U + x], frame[USABLE + x] = 1, 0


@numba.njit(nogil=True, cache=True)
def exclude(saturated, frame, flags):    # type: ignore[no-untyped-def]
    """Make saturated values unusable."""
    for x in range(len(saturated)):
        usable = frame[USABLE + x]
        frame[USABLE + x] = np.float32(0) if saturated[x] else usable
        flags[x] |= np.int32(SATURATED) * np.int32(saturated[x])


@numba.njit(nogil=True, cache=True)
def blank(mask, quantities, buffer):    # type: ignore[no-untyped-def]
    """Set what lies outside the mask to 0."""
    for m in range(quantities):
        for x in range(len(mask)):
            value = buffer[m * CHUNK + x]
            buffer[m * CHUNK + x] = value if mask[x] else np.float32(0)


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def report(sums, flags, pixels, count, quality, reason):    # type: ignore[no-untyped-def]
    """Sums over the frames of a chunk to ``quality`` (4, n) and ``reason`` (n,)."""
    one, share = np.float32(1), np.float32(1) / np.float32(count)
    squares, light, used, misfit = quality[0], quality[1], quality[2], quality[3]
    for x in range(len(reason)):
        left = sums[USED + x]
        squares[x] = sums[SQUARES + x] / max(left - np.float32(3), one)
        light[x] = sums[LIGHT + x] * share
        used[x] = left
        misfit[x] = sums[MISFIT + x] * pixels[INVERSE + x] * share
    for x in range(len(reason)):
        few = np.int32(FEW_LIGHTS) if sums[USED + x] < np.float32(3) else np.int32(0)
        reason[x] = np.uint8(flags[x] | few)


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def normalise(frame, look, sums):    # type: ignore[no-untyped-def]
    """From intensity U and light vector D to intensity per irradiance, irradiance, unit vector.

    Sets the half-vector too, and WEIGHT and FACTOR such that `add_equations` adds the equations
    of the intensity, as least squares has them.
    """
    one = np.float32(1)
    for x in range(CHUNK):
        d0, d1, d2, u = frame[D0 + x], frame[D1 + x], frame[D2 + x], frame[U + x]
        square = d0 * d0 + d1 * d1 + d2 * d2
        inverse = one / np.sqrt(square)
        d0, d1, d2 = d0 * inverse, d1 * inverse, d2 * inverse
        h0, h1, h2 = d0 + look[x], d1 + look[CHUNK + x], d2 + look[2 * CHUNK + x]
        half = one / np.sqrt(h0 * h0 + h1 * h1 + h2 * h2)
        sums[LIGHT + x] += u
        frame[U + x], frame[E + x] = u * inverse, square * inverse
        frame[D0 + x], frame[D1 + x], frame[D2 + x] = d0, d1, d2
        frame[H0 + x], frame[H1 + x], frame[H2 + x] = h0 * half, h1 * half, h2 * half
        frame[WEIGHT + x], frame[FACTOR + x] = square, one


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def judge(frame, pixels, sums, flags):    # type: ignore[no-untyped-def]
    """Compare a frame with its prediction: add to ``sums``, set bits of ``flags``.

    Multiplies WEIGHT by the squared irradiance: from here on the equations are those of the
    intensity (Eq. 6).
    """
    zero, one = np.float32(0), np.float32(1)
    shadow, highlight, none = np.int32(SHADOW), np.int32(HIGHLIGHT), np.int32(0)
    for x in range(CHUNK):
        cosine = (pixels[G0 + x] * frame[D0 + x] + pixels[G1 + x] * frame[D1 + x]
                  + pixels[G2 + x] * frame[D2 + x])
        length, u, weight = pixels[LENGTH + x], frame[U + x], frame[WEIGHT + x]
        predicted = max(frame[FACTOR + x] * cosine, zero)
        difference = u - predicted
        square = weight * frame[E + x] * frame[E + x]
        sums[SQUARES + x] += square * difference * difference
        sums[USED + x] += one if weight > zero else zero
        sums[MISFIT + x] += min(abs(difference), length)
        dark = ((cosine < np.float32(LEAST_COSINE) * length)
                | (u < np.float32(LEAST_RATIO) * predicted))
        bright = u > cosine + np.float32(BRIGHT_MARGIN) * length
        flags[x] |= shadow if dark else (highlight if bright else none)
        frame[WEIGHT + x] = square


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def shade(frames, pixels, shading):    # type: ignore[no-untyped-def]
    """Weights w p / sum w p^2 that turn intensities into albedo, p predicted for albedo 1.

    :param shading: (T, n) out.
    """
    count, n = shading.shape
    for x in range(n):
        norm = np.float32(1e-30)
        for t in range(count):
            cosine = (pixels[G0 + x] * frames[t, D0 + x] + pixels[G1 + x] * frames[t, D1 + x]
                      + pixels[G2 + x] * frames[t, D2 + x]) * pixels[INVERSE + x]
            # the weight carries the squared irradiance, the prediction the irradiance
            predicted = max(cosine, np.float32(0)) * frames[t, FACTOR + x]
            shading[t, x] = frames[t, WEIGHT + x] * predicted / frames[t, E + x]
            norm += frames[t, WEIGHT + x] * predicted * predicted
        for t in range(count):
            shading[t, x] /= norm


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def combine_patches(reference, scaled, equations, spatial, edge_sigma, ridge, first, solved):    # type: ignore[no-untyped-def]
    """Add up the equations of each patch and solve them, with a ridge towards least squares.

    :param reference, scaled, equations: of `solve_pixels`, with a halo of patch // 2 rows where
        the image has them; band row ``first`` is row 0 of the result.
    :param spatial: (n, n) spatial weights.
    :param edge_sigma: relative difference of the scaled normals that halves the weight.
    :param solved: (3, rows, W) out; 0 where there is nothing to solve.
    """
    _, rows, width = solved.shape
    height = reference.shape[1]
    radius = spatial.shape[0] // 2
    pixels, system = np.empty(PIXEL_SIZE, np.float32), np.empty(EQUATION_SIZE, np.float32)
    near = np.empty(CHUNK, np.float32)
    # The rows of the neighbourhood in turn, row r at r % ring: scaled normals and equations,
    # quantity after quantity, SIDE apart. What lies beside the image has no equations.
    ring = 2 * radius + 1
    around = np.empty((ring, 12 * SIDE), np.float32)
    zero, one = np.float32(0), np.float32(1)
    for begin in range(0, width, CHUNK):
        n = min(CHUNK, width - begin)
        left, right = max(begin - radius, 0), min(begin + CHUNK + radius, width)
        start, length = left - (begin - radius), right - left
        for y in range(-2 * radius, rows):
            here, new = first + y, first + y + radius
            row = around[new % ring]
            if not 0 <= new < height:
                fill(row, zero)
            else:
                if length < SIDE:
                    fill(row, zero)
                for m in range(3):
                    store(scaled[m, new, left:right], row[m * SIDE + start:][:length])
                for m in range(9):
                    store(equations[m, new, left:right], row[(3 + m) * SIDE + start:][:length])
            if y < 0:
                continue
            for m in range(3):
                store(around[here % ring, m * SIDE + radius:], pixels[m * CHUNK:][:CHUNK])
            for x in range(CHUNK):
                g0, g1, g2 = pixels[G0 + x], pixels[G1 + x], pixels[G2 + x]
                near[x] = one / (np.float32(edge_sigma * edge_sigma)
                                 * (g0 * g0 + g1 * g1 + g2 * g2) + np.float32(1e-30))
            fill(system, zero)
            for dy in range(ring):
                add_neighbours(around[(here + dy - radius) % ring], spatial[dy], near, pixels,
                               system)
            for x in range(CHUNK):
                strength = np.float32(ridge / 3) * (
                    system[x] + system[3 * CHUNK + x] + system[5 * CHUNK + x])
                near[x] = strength
                system[x] += strength
                system[3 * CHUNK + x] += strength
                system[5 * CHUNK + x] += strength
            for m in range(3):
                for x in range(n):
                    system[(6 + m) * CHUNK + x] += near[x] * reference[m, here, begin + x]
            solve_equations(system, pixels)
            for m in range(3):
                store(pixels[m * CHUNK:], solved[m, y, begin:begin + n])


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def add_neighbours(row, spatial, near, pixels, system):    # type: ignore[no-untyped-def]
    """Add the equations of the neighbours in one row, times w_patch: spatial x edge-aware."""
    one = np.float32(1)
    for dx in range(spatial.size):
        other, w_spatial = row[dx:], spatial[dx]
        for x in range(CHUNK):
            d0, d1, d2 = (other[x] - pixels[G0 + x], other[SIDE + x] - pixels[G1 + x],
                          other[2 * SIDE + x] - pixels[G2 + x])
            w = w_spatial / (one + (d0 * d0 + d1 * d1 + d2 * d2) * near[x])
            system[x] += w * other[3 * SIDE + x]
            system[CHUNK + x] += w * other[4 * SIDE + x]
            system[2 * CHUNK + x] += w * other[5 * SIDE + x]
            system[3 * CHUNK + x] += w * other[6 * SIDE + x]
            system[4 * CHUNK + x] += w * other[7 * SIDE + x]
            system[5 * CHUNK + x] += w * other[8 * SIDE + x]
            system[6 * CHUNK + x] += w * other[9 * SIDE + x]
            system[7 * CHUNK + x] += w * other[10 * SIDE + x]
            system[8 * CHUNK + x] += w * other[11 * SIDE + x]


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def finish(solved, reference, quality, mask, count, hold, normal, albedo, confidence, reason):    # type: ignore[no-untyped-def]
    """Unit normal, albedo and confidence of a band (paper, Eq. 7); returns the residual sums.

    The confidence falls with the expected error: the misfit of the frames, more where few of them
    are left and where the surface is seen at a grazing angle, and the distance to least squares.

    :param hold: share of the LS normal added to the robust unit normal.
    :param albedo: (h, W) out.
    :param confidence: (h, W) uint8 out.
    """
    rows, width = mask.shape
    squares, brightness, valid = 0.0, 0.0, 0
    nan, one = np.float32(np.nan), np.float32(1)
    for y in range(rows):
        for x in range(width):
            g0, g1, g2 = solved[0, y, x], solved[1, y, x], solved[2, y, x]
            confidence[y, x] = 0
            if not mask[y, x]:
                reason[y, x] = MASKED
            if not (mask[y, x] and g2 > 0):
                normal[y, x, 0], normal[y, x, 1], normal[y, x, 2] = nan, nan, nan
                albedo[y, x] = nan
                if mask[y, x]:
                    reason[y, x] |= np.uint8(FEW_LIGHTS)
                continue
            length = np.sqrt(g0 * g0 + g1 * g1 + g2 * g2)
            r0, r1, r2 = reference[0, y, x], reference[1, y, x], reference[2, y, x]
            other = one / max(np.sqrt(r0 * r0 + r1 * r1 + r2 * r2), np.float32(1e-30))
            inverse = one / length
            d0, d1, d2 = (g0 * inverse - r0 * other, g1 * inverse - r1 * other,
                          g2 * inverse - r2 * other)
            share = np.float32(hold) * other
            n0, n1, n2 = (g0 * inverse + share * r0, g1 * inverse + share * r1,
                          g2 * inverse + share * r2)
            scale = one / np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
            normal[y, x, 0], normal[y, x, 1], normal[y, x, 2] = n0 * scale, n1 * scale, n2 * scale
            albedo[y, x] = length
            squares += quality[0, y, x]
            brightness += quality[1, y, x]
            valid += 1
            used = max(quality[2, y, x], one)
            error = ((np.float32(NOISE) + quality[3, y, x]) * np.sqrt(np.float32(count) / used)
                     / max(g2 * inverse, np.float32(0.1))
                     + np.float32(DISAGREEMENT) * np.sqrt(d0 * d0 + d1 * d1 + d2 * d2))
            certainty = one / (one + error / np.float32(ERROR_HALF))
            confidence[y, x] = max(1, int(np.float32(255) * certainty + np.float32(0.5)))
    return squares, brightness, valid
