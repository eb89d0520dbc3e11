"""The compiled loops of the robust regression: arrays in, arrays out, no threads, no state.

One function per kernel; a GPU version would replace `solve_pixels`, `combine_patches` and
`finish` one by one. All planes are float32 and pixel-last, (..., h, W).
"""
import numba
import numpy as np

from ps_reconstruction.outliers import MANY, first_of_few, first_of_many, refine
from ps_reconstruction.problem import FEW_LIGHTS, HIGHLIGHT, MASKED, SATURATED, SHADOW
from ps_reconstruction.reflectance import solve3

KEEP_LS, REJECT, REFLECT = 0, 1, 2        # stv.Trust, as numba sees it
BRIGHT_MARGIN = 0.1                       # of |g|: brighter than Lambert's law by this is gloss
NOISE = 0.01                              # relative error of an intensity that is always there
ERROR_HALF = 0.04                         # expected error of a unit normal that halves confidence
FAST = {'contract', 'reassoc', 'arcp', 'nsz', 'afn'}    # without nnan: NaN marks invalid pixels


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def estimate(u, d, h, usable, table, rounds, trust, g, weight, factor):    # type: ignore[no-untyped-def]
    """Robust scaled normal of one pixel: g (3,) holds LS on entry and the estimate on return.

    ``weight`` and ``factor`` (T,) return the frame weights and f / (n.l).
    """
    factor[:] = 1
    if trust == KEEP_LS:
        weight[:] = 1
        return
    if u.size >= MANY:
        first_of_many(u, d, usable, weight, g)
    else:
        first_of_few(u, d, h, usable, weight, g)
    if trust == REFLECT:
        if u.size < MANY:      # what the first test dropped stays dropped
            refine(u, d, h, weight > 0, table, rounds, g, weight, factor)
        else:
            refine(u, d, h, usable, table, rounds, g, weight, factor)


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def estimate_samples(u, d, h, usable, table, rounds, trust, g):    # type: ignore[no-untyped-def]
    """`estimate` for (P, T) samples; g (P, 3) in and out."""
    weight, factor = np.empty(u.shape[1], np.float32), np.empty(u.shape[1], np.float32)
    for p in range(u.shape[0]):
        estimate(u[p], d[p], h[p], usable[p], table, rounds, trust, g[p], weight, factor)


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def solve_pixels(values, saturated, mask, lights, view, flat, step, top, table, rounds, trust,
                 reference, scaled, equations, shading, quality, reason):    # type: ignore[no-untyped-def]
    """Temporal weights, own estimate and normal equations of every pixel of a band.

    :param values: (T, h, W) intensities, before the flat field.
    :param saturated: (T, h, W) bool, or of size 0 for none.
    :param mask: (h, W) bool.
    :param lights: (gh, gw, T, 3) at the nodes; view: (gh, gw, 3); flat: (gh, gw, T) reciprocal
        flat field, or of size 0. ``top`` is the image row of the band's first row.
    :param reference: (3, h, W) out, least squares.
    :param scaled: (3, h, W) out, the pixel's own robust estimate; 0 where there is none.
    :param equations: (9, h, W) out, xx xy xz yy yz zz of the matrix and the right side.
    :param shading: (T, h, W) out, weights that turn intensities into albedo; or of size 0.
    :param quality: (4, h, W) out: sum of squared residuals, mean intensity, frames used,
        expected error of the unit normal.
    :param reason: (h, W) uint8 out.
    """
    count, rows, width = values.shape
    u, e = np.empty(count, np.float32), np.empty(count, np.float32)
    d, h = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    weight, factor = np.empty(count, np.float32), np.empty(count, np.float32)
    usable = np.empty(count, np.bool_)
    g, look = np.zeros(3, np.float32), np.zeros(3, np.float32)
    a, b = np.empty(6, np.float32), np.empty(3, np.float32)
    one = np.float32(1)
    for y in range(rows):
        i = (top + y) // step
        fy = np.float32(top + y - i * step) / np.float32(step)
        for x in range(width):
            if not mask[y, x]:
                continue
            j = x // step
            fx = np.float32(x - j * step) / np.float32(step)
            w00, w01 = (one - fy) * (one - fx), (one - fy) * fx
            w10, w11 = fy * (one - fx), fy * fx
            for m in range(3):
                look[m] = (w00 * view[i, j, m] + w01 * view[i, j + 1, m]
                           + w10 * view[i + 1, j, m] + w11 * view[i + 1, j + 1, m])
            a[:], b[:] = 0, 0
            mean = np.float32(0)
            flags = np.uint8(0)
            for t in range(count):
                s0 = (w00 * lights[i, j, t, 0] + w01 * lights[i, j + 1, t, 0]
                      + w10 * lights[i + 1, j, t, 0] + w11 * lights[i + 1, j + 1, t, 0])
                s1 = (w00 * lights[i, j, t, 1] + w01 * lights[i, j + 1, t, 1]
                      + w10 * lights[i + 1, j, t, 1] + w11 * lights[i + 1, j + 1, t, 1])
                s2 = (w00 * lights[i, j, t, 2] + w01 * lights[i, j + 1, t, 2]
                      + w10 * lights[i + 1, j, t, 2] + w11 * lights[i + 1, j + 1, t, 2])
                v = values[t, y, x]
                if flat.size:
                    v *= (w00 * flat[i, j, t] + w01 * flat[i, j + 1, t]
                          + w10 * flat[i + 1, j, t] + w11 * flat[i + 1, j + 1, t])
                a[0] += s0 * s0
                a[1] += s0 * s1
                a[2] += s0 * s2
                a[3] += s1 * s1
                a[4] += s1 * s2
                a[5] += s2 * s2
                b[0] += v * s0
                b[1] += v * s1
                b[2] += v * s2
                e[t] = np.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
                inverse = one / e[t]
                u[t] = v * inverse
                mean += v
                d[t, 0], d[t, 1], d[t, 2] = s0 * inverse, s1 * inverse, s2 * inverse
                h0, h1, h2 = d[t, 0] + look[0], d[t, 1] + look[1], d[t, 2] + look[2]
                inverse = one / np.sqrt(h0 * h0 + h1 * h1 + h2 * h2)
                h[t, 0], h[t, 1], h[t, 2] = h0 * inverse, h1 * inverse, h2 * inverse
                usable[t] = True
                if saturated.size and saturated[t, y, x]:
                    usable[t] = False
                    flags |= np.uint8(SATURATED)
            if not (mean > 0 and solve3(a, b, g)):
                reason[y, x] = np.uint8(FEW_LIGHTS)
                continue
            reference[0, y, x], reference[1, y, x], reference[2, y, x] = g[0], g[1], g[2]
            estimate(u, d, h, usable, table, rounds, trust, g, weight, factor)
            length = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
            a[:] = 0
            b[:] = 0
            used, squares, misfit, norm = 0, np.float32(0), np.float32(0), np.float32(0)
            for t in range(count):
                cosine = g[0] * d[t, 0] + g[1] * d[t, 1] + g[2] * d[t, 2]
                predicted = max(factor[t] * cosine, np.float32(0))
                difference = u[t] - predicted
                if cosine < np.float32(0.1) * length or u[t] < np.float32(0.6) * predicted:
                    flags |= np.uint8(SHADOW)
                elif u[t] > cosine + np.float32(BRIGHT_MARGIN) * length:
                    flags |= np.uint8(HIGHLIGHT)
                misfit += min(abs(difference), length)
                if weight[t] > 0:
                    used += 1
                    squares += weight[t] * difference * difference
                    scale = factor[t] * e[t]
                    w = weight[t] * scale * scale
                    a[0] += w * d[t, 0] * d[t, 0]
                    a[1] += w * d[t, 0] * d[t, 1]
                    a[2] += w * d[t, 0] * d[t, 2]
                    a[3] += w * d[t, 1] * d[t, 1]
                    a[4] += w * d[t, 1] * d[t, 2]
                    a[5] += w * d[t, 2] * d[t, 2]
                    w *= u[t] / factor[t]
                    b[0] += w * d[t, 0]
                    b[1] += w * d[t, 1]
                    b[2] += w * d[t, 2]
                if shading.size:
                    shade = predicted * e[t] / length
                    shading[t, y, x] = weight[t] * shade
                    norm += weight[t] * shade * shade
            if shading.size and norm > 0:
                for t in range(count):
                    shading[t, y, x] /= norm
            if used < 3:
                flags |= np.uint8(FEW_LIGHTS)
            for m in range(3):
                scaled[m, y, x] = g[m]
                equations[6 + m, y, x] = b[m]
            for m in range(6):
                equations[m, y, x] = a[m]
            quality[0, y, x] = squares / max(used - 3, 1)
            quality[1, y, x] = mean / count
            quality[2, y, x] = used
            quality[3, y, x] = misfit / (count * length)
            reason[y, x] = flags


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
    total = np.empty((9, width), np.float32)
    near = np.empty(width, np.float32)
    a, b, g = np.empty(6, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    one = np.float32(1)
    for y in range(rows):
        here = first + y
        g0, g1, g2 = scaled[0, here], scaled[1, here], scaled[2, here]
        for x in range(width):
            square = g0[x] * g0[x] + g1[x] * g1[x] + g2[x] * g2[x]
            near[x] = one / (np.float32(edge_sigma * edge_sigma) * square + np.float32(1e-30))
        total[:] = 0
        for dy in range(-radius, radius + 1):
            there = here + dy
            if not 0 <= there < height:
                continue
            for dx in range(-radius, radius + 1):
                w_spatial = spatial[dy + radius, dx + radius]
                begin, end = max(0, -dx), min(width, width - dx)
                q0 = scaled[0, there, begin + dx:end + dx]
                q1 = scaled[1, there, begin + dx:end + dx]
                q2 = scaled[2, there, begin + dx:end + dx]
                p0, p1, p2 = g0[begin:end], g1[begin:end], g2[begin:end]
                close, n = near[begin:end], end - begin
                c0 = equations[0, there, begin + dx:end + dx]
                c1 = equations[1, there, begin + dx:end + dx]
                c2 = equations[2, there, begin + dx:end + dx]
                c3 = equations[3, there, begin + dx:end + dx]
                c4 = equations[4, there, begin + dx:end + dx]
                c5 = equations[5, there, begin + dx:end + dx]
                c6 = equations[6, there, begin + dx:end + dx]
                c7 = equations[7, there, begin + dx:end + dx]
                c8 = equations[8, there, begin + dx:end + dx]
                t0, t1, t2 = total[0, begin:end], total[1, begin:end], total[2, begin:end]
                t3, t4, t5 = total[3, begin:end], total[4, begin:end], total[5, begin:end]
                t6, t7, t8 = total[6, begin:end], total[7, begin:end], total[8, begin:end]
                for x in range(n):
                    d0, d1, d2 = q0[x] - p0[x], q1[x] - p1[x], q2[x] - p2[x]
                    w = w_spatial / (one + (d0 * d0 + d1 * d1 + d2 * d2) * close[x])
                    t0[x] += w * c0[x]
                    t1[x] += w * c1[x]
                    t2[x] += w * c2[x]
                    t3[x] += w * c3[x]
                    t4[x] += w * c4[x]
                    t5[x] += w * c5[x]
                    t6[x] += w * c6[x]
                    t7[x] += w * c7[x]
                    t8[x] += w * c8[x]
        for x in range(width):
            strength = np.float32(ridge) * (total[0, x] + total[3, x] + total[5, x]) / 3
            for m in range(6):
                a[m] = total[m, x]
            a[0] += strength
            a[3] += strength
            a[5] += strength
            for m in range(3):
                b[m] = total[6 + m, x] + strength * reference[m, here, x]
            g[:] = 0
            if (g0[x] != 0 or g1[x] != 0 or g2[x] != 0) and not solve3(a, b, g):
                g[0], g[1], g[2] = g0[x], g1[x], g2[x]
            for m in range(3):
                solved[m, y, x] = g[m]


@numba.njit(nogil=True, cache=True, fastmath=FAST, error_model='numpy')
def finish(solved, quality, mask, count, normal, albedo, confidence, reason):    # type: ignore[no-untyped-def]
    """Unit normal, albedo and confidence of a band (paper, Eq. 7); returns the residual sums.

    :param albedo: (h, W) out.
    :param confidence: (h, W) uint8 out.
    """
    rows, width = mask.shape
    squares, brightness, valid = 0.0, 0.0, 0
    nan = np.float32(np.nan)
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
            normal[y, x, 0] = g0 / length
            normal[y, x, 1] = g1 / length
            normal[y, x, 2] = g2 / length
            albedo[y, x] = length
            squares += quality[0, y, x]
            brightness += quality[1, y, x]
            valid += 1
            used = quality[2, y, x]
            error = (np.float32(NOISE) + quality[3, y, x]) * np.sqrt(count / max(used, 1.0))
            confidence[y, x] = max(1, int(255 / (1 + error / ERROR_HALF) + 0.5))
    return squares, brightness, valid
